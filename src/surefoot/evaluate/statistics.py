"""Means with confidence intervals, for a few numbers that vary by chance, such as one for each seed.

The numbers are taken as drawn independently from normal distributions; none, or any that is not finite, is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError

CONFIDENCE = 0.95
"""Chance that an interval covers the true value."""


@dataclass(frozen=True)
class Interval:
    """An estimate and the interval that covers the true value with some confidence."""

    mean: float
    """The estimate."""
    low: float = math.nan
    """Lower end; NaN where there are too few numbers to tell."""
    high: float = math.nan
    """Upper end; NaN where there are too few numbers to tell."""

    @property
    def known(self) -> bool:
        """Whether there are enough numbers for an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    @property
    def covers_zero(self) -> bool:
        """Whether zero is within; true where there is no interval."""
        return not self.known or self.low <= 0 <= self.high

    def columns(self, name: str) -> dict[str, float]:
        """Return its cells of a table: the estimate under a name, the ends as `name_low` and `name_high`."""
        return {name: self.mean, f"{name}_low": self.low, f"{name}_high": self.high}

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 [1.05, 1.35]`, numbers as `decimal` writes them; without ends if not known."""
        mean, low, high = (decimal(number, digits, sign) for number in (self.mean, self.low, self.high))
        return f"{mean} [{low}, {high}]" if self.known else mean


def t_interval(values: ArrayLike) -> Interval:
    """The mean of numbers (N,) with Student's t interval; from one number only, there is none."""
    array = _checked(values)
    mean = float(array.mean())
    if len(array) < 2:
        return Interval(mean)
    half = _quantile(len(array) - 1) * float(array.std(ddof=1)) / math.sqrt(len(array))
    return Interval(mean, mean - half, mean + half)


def welch_interval(values: ArrayLike, base: ArrayLike) -> Interval:
    """The mean of `values` (N,) less that of `base` (M,), with Welch's interval: their variances need not be alike.

    Degrees of freedom are those of Welch and Satterthwaite. With fewer than two numbers on either side there is no
    interval.
    """
    first, second = _checked(values), _checked(base)
    return _satterthwaite(float(first.mean() - second.mean()), (first, second))


def crossed_interval(values: ArrayLike, base: ArrayLike | None = None) -> Interval:
    """Return the mean of a table (P, R), or its difference to another's (Q, R), over rows and columns drawn by chance.

    Rows are policies, of which each table has its own; columns are robots, the same in both tables. The variance of
    the mean is that of the row means over their number, for each table, plus that of the column means (of the tables'
    differences) over theirs; what rows and columns have together is counted twice, so that the interval is rather too
    wide. Degrees of freedom are those of Satterthwaite. With fewer than two rows or columns there is no interval.
    """
    tables = [np.asarray(table, np.float64) for table in ((values,) if base is None else (values, base))]
    if any(table.ndim != 2 for table in tables) or len({table.shape[1] for table in tables}) != 1:
        raise SurefootError(f"tables of shapes {[table.shape for table in tables]}; they need the same columns")
    rows = [_checked(table.mean(axis=1)) for table in tables]
    columns = tables[0].mean(axis=0) - (tables[1].mean(axis=0) if base is not None else 0.0)
    return _satterthwaite(float(columns.mean()), [*rows, columns])


def _satterthwaite(mean: float, samples: Sequence[Array]) -> Interval:
    """Return the interval of a sum of means of independent samples, whose variances need not be alike."""
    if min(map(len, samples)) < 2:
        return Interval(mean)
    parts = [float(sample.var(ddof=1)) / len(sample) for sample in samples]
    total = sum(parts)
    if total == 0:
        return Interval(mean, mean, mean)
    # As shares of the whole, so that variances of any size square without running out of range.
    freedom = 1 / sum((part / total) ** 2 / (len(sample) - 1) for part, sample in zip(parts, samples, strict=True))
    half = _quantile(freedom) * math.sqrt(total)
    return Interval(mean, mean - half, mean + half)


def _quantile(freedom: float) -> float:
    # What `scipy.stats.t.ppf` comes to: importing that takes seconds.
    from scipy.special import stdtrit

    return float(stdtrit(freedom, 0.5 + CONFIDENCE / 2))


def _checked(values: ArrayLike) -> Array:
    array = np.asarray(values, np.float64)
    if array.ndim != 1 or not array.size or not np.isfinite(array).all():
        raise SurefootError(f"numbers {array.tolist()}; a mean takes 1 or more in one row, all of them finite")
    return array


def decimal(number: float, digits: int = 2, sign: bool = False) -> str:
    """A number as text with `digits` behind the point; with `sign`, + before what is above zero. Zero has no sign.

    One that is not known, NaN, is a dash.
    """
    if math.isnan(number):
        return "-"
    rounded = round(number, digits) + 0.0
    return f"{rounded:{'+' if sign and rounded else ''}.{digits}f}"
