"""Means with standard errors and confidence intervals for small samples, such as one value per seed.

Intervals of means assume independent, normally distributed samples; intervals of proportions are exact binomial.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array

CONFIDENCE = 0.95
"""Probability that an interval covers the true value."""
MIN_SAMPLES = 3
"""Minimum sample size for an interval: with two samples it would be 13 times as wide as their distance."""
_NORMAL_QUANTILE = 1.959963984540054
"""Two-sided normal quantile of `CONFIDENCE`."""


@dataclass(frozen=True)
class MeanEstimate:
    """A mean and its standard error."""

    mean: float = math.nan
    """Mean; NaN without samples."""
    error: float = math.nan
    """Standard error of the mean; NaN for fewer than two samples."""

    @classmethod
    def from_values(cls, values: ArrayLike) -> MeanEstimate:
        """Return mean and standard error of samples (N,); NaN samples are left out."""
        array = np.asarray(values, np.float64)
        array = array[np.isfinite(array)]
        if not array.size:
            return cls()
        error = float(array.std(ddof=1)) / math.sqrt(array.size) if array.size > 1 else math.nan
        return cls(float(array.mean()), error)

    def __sub__(self, other: MeanEstimate) -> MeanEstimate:
        return MeanEstimate(self.mean - other.mean, math.hypot(self.error, other.error))

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 ± 0.05`; `-` for NaN. A NaN error is left out."""
        mean = decimal(self.mean, digits, sign)
        return f"{mean} ± {decimal(self.error, digits)}" if math.isfinite(self.error) else mean


@dataclass(frozen=True)
class Interval:
    """An estimate and its confidence interval."""

    mean: float
    low: float = math.nan
    """Lower end; NaN for too few samples."""
    high: float = math.nan
    """Upper end; NaN for too few samples."""
    p: float = math.nan
    """Two-sided p value of the null hypothesis that the true value is zero; NaN for too few samples, and for a single
    proportion."""
    values: tuple[float, ...] = ()
    """The samples, if they are too few for an interval."""

    @property
    def is_finite(self) -> bool:
        """Whether there were enough samples for an interval."""
        return math.isfinite(self.low) and math.isfinite(self.high)

    def columns(self, name: str) -> dict[str, float]:
        """Return columns of a table: the estimate as `name`, the ends as `name_low` and `name_high`."""
        return {name: self.mean, f"{name}_low": self.low, f"{name}_high": self.high}

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 [1.05, 1.35]`, or `1.20 (1.10, 1.30)` for two samples without an interval."""
        mean, low, high = (decimal(number, digits, sign) for number in (self.mean, self.low, self.high))
        if self.is_finite:
            return f"{mean} [{low}, {high}]"
        values = ", ".join(decimal(value, digits, sign) for value in self.values)
        return f"{mean} ({values})" if len(self.values) > 1 else mean

    def scale(self, factor: float) -> Interval:
        """Return the interval multiplied by a positive factor."""
        values = tuple(factor * value for value in self.values)
        return Interval(self.mean * factor, self.low * factor, self.high * factor, self.p, values)


def t_interval(values: ArrayLike, confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of samples (N,) with Student's t interval; without interval for fewer than `MIN_SAMPLES`."""
    array = np.asarray(values, np.float64)
    if not array.size:
        return Interval(math.nan)
    interval = _satterthwaite([array], confidence=confidence)
    return interval if interval.is_finite else Interval(interval.mean, values=tuple(map(float, array)))


def robots_interval(values: ArrayLike, policies: Sequence[ArrayLike] = (), confidence: float = CONFIDENCE) -> Interval:
    """Return the mean of one value, or paired difference, per robot (R,), with Student's t interval.

    Robots on which the same policies run are not independent: values share the deviation of these policies' mean. For
    each group of such policies the variance of its mean is added, with Satterthwaite's degrees of freedom.

    Args:
        values: one value per robot (R,).
        policies: for each group whose P policies run on all robots, the mean over robots of each policy (P,).
        confidence: probability that the interval covers the true mean.
    """
    samples = [np.asarray(sample, np.float64) for sample in (values, *policies)]
    return _satterthwaite(samples, confidence=confidence) if policies else t_interval(samples[0], confidence)


def equivalence_p_value(values: ArrayLike, bound: float, policies: Sequence[ArrayLike] = ()) -> float:
    """Return the p value of the claim that the mean over robots is within +-bound (equivalence test).

    It is the larger p value of two one-sided t tests, against mean <= -bound and mean >= bound (Schuirmann 1987). It is
    below a level exactly if the interval with confidence 1 - 2 level is within the bounds. NaN for fewer than
    `MIN_SAMPLES`. For the arguments see `robots_interval`.
    """
    from scipy.special import stdtr

    samples = [np.asarray(sample, np.float64) for sample in (values, *policies)]
    if min(map(len, samples)) < MIN_SAMPLES:
        return math.nan
    room = bound - abs(float(samples[0].mean()))
    variance, freedom = _variance_of_sum(samples)
    if variance == 0:
        return float(room <= 0)
    return float(stdtr(freedom, -room / math.sqrt(variance)))


def proportion_interval(proportions: ArrayLike, trials: int) -> Interval:
    """Return the mean of proportions with the exact binomial interval (Clopper and Pearson 1934).

    Trials of the same seed are correlated. If proportions differ more than independent trials would, the interval uses
    the effective number of trials that corresponds to the variance of the mean, reduced for the degrees of freedom
    with which this variance is estimated (Korn and Graubard 1998).

    Args:
        proportions: one proportion for each seed (S,), or for each seed and robot (S, R) if robots are also random.
        trials: number of trials of each seed.
    """
    from scipy.special import betaincinv, stdtrit

    table = np.asarray(proportions, np.float64)
    samples = [table] if table.ndim == 1 else [table.mean(axis=1), table.mean(axis=0)]
    proportion, count = float(table.mean()), float(len(table) * trials)
    variance, freedom = _variance_of_sum([sample for sample in samples if len(sample) > 1])
    if variance > 0 and 0 < proportion < 1:
        tail = 0.5 + CONFIDENCE / 2
        loss = float(stdtrit(count - 1, tail) / stdtrit(freedom, tail)) ** 2
        count = min(count, proportion * (1 - proportion) / variance * loss)
    hits, misses, tail = proportion * count, (1 - proportion) * count, (1 - CONFIDENCE) / 2
    low = float(betaincinv(hits, misses + 1, tail)) if hits > 0 else 0.0
    return Interval(proportion, low, float(betaincinv(hits + 1, misses, 1 - tail)) if misses > 0 else 1.0)


def policies_proportion(proportions: ArrayLike, trials: int) -> Interval:
    """Return `proportion_interval` over trained policies; no interval for fewer than `MIN_SAMPLES`.

    The spread between one or two policies can't be estimated, and episodes of one policy are not independent.
    """
    table = np.asarray(proportions, np.float64)
    if len(table) >= MIN_SAMPLES:
        return proportion_interval(table, trials)
    return crossed_interval(table) if table.ndim == 2 else t_interval(table)


def proportion_difference(proportion: Interval, base: Interval) -> Interval:
    """Return `proportion` minus an independent `base`; the interval follows from theirs (Zou and Donner 2008).

    The p value follows from the interval (Altman and Bland 2011).
    """
    from scipy.special import ndtr

    mean = proportion.mean - base.mean
    below = math.hypot(proportion.mean - proportion.low, base.high - base.mean)
    above = math.hypot(proportion.high - proportion.mean, base.mean - base.low)
    p = 2 * float(ndtr(-_NORMAL_QUANTILE * abs(mean) / (below if mean > 0 else above)))
    return Interval(mean, mean - below, mean + above, p)


def holm(p: ArrayLike) -> Array:
    """Return p values (M,) adjusted for M comparisons (Holm 1979): below 0.05 means significant at a family-wise 5 %.

    NaN stays NaN, and counts as a comparison.
    """
    values = np.asarray(p, np.float64)
    order, adjusted = np.argsort(values), np.empty_like(values)
    adjusted[order] = np.minimum(np.maximum.accumulate(values[order] * np.arange(len(values), 0, -1)), 1.0)
    return adjusted


def difference_interval(*pairs: tuple[ArrayLike, ArrayLike]) -> Interval:
    """Return the difference of two means, the first minus the second, or its mean over several pairs of samples.

    All samples are independent and have their own variance. For one pair of samples (N,) and (M,) this is Welch's
    interval; for several it is a main effect. Tables (P, R) and (Q, R) have crossed random effects as in
    `crossed_interval`: rows are different policies in each table, columns are the same robots in all. Degrees of
    freedom follow Welch and Satterthwaite. No interval if a sample has fewer than `MIN_SAMPLES` values, rows or
    columns.
    """
    tables = [[np.asarray(table, np.float64) / len(pairs) for table in pair] for pair in pairs]
    differences = np.sum([first.mean(axis=0) - second.mean(axis=0) for first, second in tables], axis=0)
    rows = [table.mean(axis=1) if table.ndim == 2 else table for pair in tables for table in pair]
    return _satterthwaite([*rows, differences] if differences.ndim else rows, float(differences.mean()))


def crossed_interval(values: ArrayLike) -> Interval:
    """Return the mean of `values` (P, R) with crossed random effects: rows are policies, columns robots.

    The variance of the mean is the variance of the row means divided by their number plus the variance of the column
    means divided by theirs. Variance that rows and columns share counts twice, so the interval is conservative. Degrees
    of freedom follow Satterthwaite. No interval for fewer than `MIN_SAMPLES` rows or columns.
    """
    table = np.asarray(values, np.float64)
    if len(table) < MIN_SAMPLES:
        return t_interval(table.mean(axis=1))
    return _satterthwaite([table.mean(axis=1), table.mean(axis=0)])


def _satterthwaite(samples: Sequence[Array], mean: float | None = None, confidence: float = CONFIDENCE) -> Interval:
    """Return the interval around `mean` for a sum of means of independent samples with unequal variances."""
    # As `scipy.stats.t`, whose import takes seconds.
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
    # Fractions of the total do not overflow when squared.
    weights = [(part / total) ** 2 / (len(sample) - 1) for part, sample in zip(parts, samples, strict=True)]
    return total, 1 / sum(weights)


def decimal(number: float, digits: int = 2, sign: bool = False) -> str:
    """Return a number as text with `digits` decimals; `sign` puts + before positive numbers. NaN becomes a dash."""
    if math.isnan(number):
        return "-"
    rounded = round(number, digits) + 0.0
    return f"{rounded:{'+' if sign and rounded else ''}.{digits}f}"
