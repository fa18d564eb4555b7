"""Means with standard errors and confidence intervals, for a few numbers that vary by chance, such as one a seed.

Intervals of means take the numbers as independent draws from normal distributions; those of shares are exact binomial.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array

CONFIDENCE = 0.95
"""Chance that an interval covers the true value."""
MIN_SAMPLES = 3
"""Fewest numbers whose mean has an interval: that of two numbers is 13 times as wide as their distance."""
_NORMAL_QUANTILE = 1.959963984540054
"""Of `CONFIDENCE` on both sides."""


@dataclass(frozen=True)
class MeanEstimate:
    """A mean and its standard error."""

    mean: float = math.nan
    """Mean; NaN without any number."""
    error: float = math.nan
    """Standard error of the mean; NaN for fewer than two numbers."""

    @classmethod
    def from_values(cls, values: ArrayLike) -> MeanEstimate:
        """Return mean and standard error of numbers (N,), NaN left out."""
        array = np.asarray(values, np.float64)
        array = array[np.isfinite(array)]
        if not array.size:
            return cls()
        error = float(array.std(ddof=1)) / math.sqrt(array.size) if array.size > 1 else math.nan
        return cls(float(array.mean()), error)

    def __sub__(self, other: MeanEstimate) -> MeanEstimate:
        return MeanEstimate(self.mean - other.mean, math.hypot(self.error, other.error))

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 ± 0.05`; `-` for NaN, and no error where that is NaN."""
        mean = decimal(self.mean, digits, sign)
        return f"{mean} ± {decimal(self.error, digits)}" if math.isfinite(self.error) else mean


@dataclass(frozen=True)
class Interval:
    """An estimate and its confidence interval."""

    mean: float
    low: float = math.nan
    """Lower end; NaN for too few numbers."""
    high: float = math.nan
    """Upper end; NaN for too few numbers."""
    p: float = math.nan
    """Two-sided p value of the hypothesis that the true number is zero; NaN for too few numbers, or one share."""
    values: tuple[float, ...] = ()
    """The numbers themselves, where they are too few for an interval of their mean."""

    @property
    def is_finite(self) -> bool:
        """Whether there were enough numbers for an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def columns(self, name: str) -> dict[str, float]:
        """Return cells of a table: the estimate under a name, the ends as `name_low` and `name_high`."""
        return {name: self.mean, f"{name}_low": self.low, f"{name}_high": self.high}

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 [1.05, 1.35]`, or `1.20 (1.10, 1.30)` of two numbers without an interval."""
        mean, low, high = (decimal(number, digits, sign) for number in (self.mean, self.low, self.high))
        if self.is_finite:
            return f"{mean} [{low}, {high}]"
        values = ", ".join(decimal(value, digits, sign) for value in self.values)
        return f"{mean} ({values})" if len(self.values) > 1 else mean

    def scale(self, factor: float) -> Interval:
        """Return the interval of the number times a factor above 0."""
        return Interval(self.mean * factor, self.low * factor, self.high * factor, self.p)


def t_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of numbers (N,) with Student's t interval; fewer than `MIN_SAMPLES` have none."""
    array = np.asarray(values, np.float64)
    if not array.size:
        return Interval(math.nan)
    interval = _satterthwaite([array], confidence=confidence)
    return interval if interval.is_finite else Interval(interval.mean, values=tuple(map(float, array)))


def equivalence_p_value(values: ArrayLike, bound: float) -> float:
    """Return the p value of the claim that the mean of numbers (N,) lies within +-bound.

    It is the greater one of two one-sided t tests, of mean <= -bound and of mean >= bound (Schuirmann 1987). It is
    below a level exactly if the interval of confidence 1 - 2 level lies within the bounds. Fewer than `MIN_SAMPLES`
    have NaN.
    """
    from scipy.special import stdtr

    array = np.asarray(values, np.float64)
    if len(array) < MIN_SAMPLES:
        return math.nan
    room = bound - abs(float(array.mean()))
    error = float(array.std(ddof=1)) / math.sqrt(len(array))
    if error == 0:
        return float(room <= 0)
    return float(stdtr(len(array) - 1, -room / error))


def proportion_interval(shares: ArrayLike, trials: int) -> Interval:
    """Return the mean of shares with the exact binomial interval (Clopper and Pearson 1934).

    Trials of one seed are alike. Where shares differ more than chance among independent trials explains, there are
    only as many effective trials as the variance of the mean is worth, fewer by the degrees of freedom that it is
    estimated with (Korn and Graubard 1998).

    Args:
        shares: a share for each seed (S,), or for each seed and robot (S, R), if robots too are drawn by chance.
        trials: how many each seed has.
    """
    from scipy.special import betaincinv, stdtrit

    table = np.asarray(shares, np.float64)
    samples = [table] if table.ndim == 1 else [table.mean(axis=1), table.mean(axis=0)]
    share, count = float(table.mean()), float(len(table) * trials)
    variance, freedom = _variance_of_sum([sample for sample in samples if len(sample) > 1])
    if variance > 0 and 0 < share < 1:
        tail = 0.5 + CONFIDENCE / 2
        loss = float(stdtrit(count - 1, tail) / stdtrit(freedom, tail)) ** 2
        count = min(count, share * (1 - share) / variance * loss)
    hits, misses, tail = share * count, (1 - share) * count, (1 - CONFIDENCE) / 2
    low = float(betaincinv(hits, misses + 1, tail)) if hits > 0 else 0.0
    return Interval(share, low, float(betaincinv(hits + 1, misses, 1 - tail)) if misses > 0 else 1.0)


def proportion_difference(share: Interval, base: Interval) -> Interval:
    """Return a share less another, independent one, with the interval of their two (Zou and Donner 2008).

    Its p value follows from the interval (Altman and Bland 2011).
    """
    from scipy.special import ndtr

    mean = share.mean - base.mean
    below = math.hypot(share.mean - share.low, base.high - base.mean)
    above = math.hypot(share.high - share.mean, base.mean - base.low)
    p = 2 * float(ndtr(-_NORMAL_QUANTILE * abs(mean) / (below if mean > 0 else above)))
    return Interval(mean, mean - below, mean + above, p)


def holm(p: ArrayLike) -> Array:
    """Return p values (M,) adjusted for M comparisons (Holm 1979); one below .05 is significant at 5 % among them all.

    NaN stays NaN, and counts as a comparison.
    """
    values = np.asarray(p, np.float64)
    order, adjusted = np.argsort(values), np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)
    return adjusted


def welch_interval(values: ArrayLike, base: ArrayLike) -> Interval:
    """Return the mean of `values` (N,) less that of `base` (M,) with Welch's interval for unequal variances.

    Degrees of freedom are those of Welch and Satterthwaite. Fewer than `MIN_SAMPLES` on either side have no interval.
    """
    first, second = np.asarray(values, np.float64), np.asarray(base, np.float64)
    return _satterthwaite([first, second], float(first.mean() - second.mean()))


def crossed_interval(values: ArrayLike, base: ArrayLike | None = None) -> Interval:
    """Return the mean of a table (P, R), or its difference from another's (Q, R), over random rows and columns.

    Rows are policies, of which each table has its own; columns are robots, the same in both tables. The variance of
    the mean is that of the row means over their number, for each table, plus that of the column means (of the tables'
    differences) over theirs. Variance that rows and columns share counts twice, so the interval is conservative.
    Degrees of freedom are those of Satterthwaite. Fewer than `MIN_SAMPLES` rows or columns have no interval.
    """
    tables = [np.asarray(table, np.float64) for table in ((values,) if base is None else (values, base))]
    if base is None and len(tables[0]) < MIN_SAMPLES:
        return t_interval(tables[0].mean(axis=1))
    columns = tables[0].mean(axis=0) - (tables[1].mean(axis=0) if base is not None else 0.0)
    return _satterthwaite([*(table.mean(axis=1) for table in tables), columns], float(columns.mean()))


def _satterthwaite(samples: Sequence[Array], mean: float | None = None, confidence: float = CONFIDENCE) -> Interval:
    """Return the interval of a sum of means of independent samples with unequal variances, around `mean`."""
    # What `scipy.stats.t` computes; importing that takes seconds.
    from scipy.special import stdtr, stdtrit

    mean = float(samples[0].mean()) if mean is None else mean
    if min(map(len, samples)) < MIN_SAMPLES:
        return Interval(mean)
    variance, freedom = _variance_of_sum(samples)
    if variance == 0:
        return Interval(mean, mean, mean, float(mean == 0))
    error = math.sqrt(variance)
    half = float(stdtrit(freedom, 0.5 + confidence / 2)) * error
    return Interval(mean, mean - half, mean + half, 2 * float(stdtr(freedom, -abs(mean) / error)))


def _variance_of_sum(samples: Sequence[Array]) -> tuple[float, float]:
    """Return the variance of a sum of means of independent samples, and Satterthwaite's degrees of freedom."""
    parts = [float(sample.var(ddof=1)) / len(sample) for sample in samples]
    if not (total := sum(parts)):
        return 0.0, math.nan
    # Shares of the whole do not overflow when squared, whatever the variances.
    weights = [(part / total) ** 2 / (len(sample) - 1) for part, sample in zip(parts, samples, strict=True)]
    return total, 1 / sum(weights)


def decimal(number: float, digits: int = 2, sign: bool = False) -> str:
    """Return a number as text with `digits` decimals; with `sign`, + before what is above zero. NaN is a dash."""
    if math.isnan(number):
        return "-"
    rounded = round(number, digits) + 0.0
    return f"{rounded:{'+' if sign and rounded else ''}.{digits}f}"
