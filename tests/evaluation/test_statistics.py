"""Confidence intervals: known values, comparison with scipy, and coverage of the true value."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("scipy")
from scipy import stats

from surefoot.evaluation.statistics import (
    Interval,
    MeanEstimate,
    crossed_interval,
    difference_interval,
    equivalence_p_value,
    holm,
    proportion_difference,
    proportion_interval,
    t_interval,
)


def test_t_interval_of_three_samples_by_hand() -> None:
    # Mean 2, standard deviation 1, standard error 1 / sqrt 3, and t(0.975, 2) = 4.302653.
    interval = t_interval([1.0, 2.0, 3.0])
    half = pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    assert (interval.mean, interval.high - 2, 2 - interval.low) == (2, half, half)


def test_difference_interval_with_equal_variances_by_hand() -> None:
    # Standard error sqrt(1/3 + 1/3), 4 degrees of freedom, t(0.975, 4) = 2.776445.
    interval = difference_interval(([2.0, 3.0, 4.0], [1.0, 2.0, 3.0]))
    assert interval.mean == 1
    assert interval.high - 1 == pytest.approx(2.776445 * math.sqrt(2 / 3), rel=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_difference_interval_equals_scipys_with_unequal_variances_and_sizes(scale: float) -> None:
    random = np.random.default_rng(3)
    a, b = scale * random.normal(1.0, 0.2, 4), scale * random.normal(0.5, 2.0, 7)
    interval = difference_interval((a, b))
    test = stats.ttest_ind(a, b, equal_var=False)
    expected = (*test.confidence_interval(0.95), test.pvalue)
    assert (interval.low, interval.high, interval.p) == pytest.approx(expected, rel=1e-10)


def test_intervals_cover_the_true_value_as_often_as_their_confidence() -> None:
    random = np.random.default_rng(1)
    rounds, inside, between = 1000, 0, 0
    for _ in range(rounds):
        a, b = random.normal(2.0, 1.0, 3), random.normal(1.0, 0.3, 4)
        one, change = t_interval(a), difference_interval((a, b))
        inside += one.low <= 2 <= one.high
        between += change.low <= 1 <= change.high
    assert inside / rounds == pytest.approx(0.95, abs=0.02)
    assert between / rounds == pytest.approx(0.95, abs=0.02)


def test_one_or_two_samples_have_no_interval() -> None:
    two = t_interval([1.0, 2.0])
    for interval in (
        t_interval([1.5]),
        two,
        difference_interval(([2.0] * 3, [0.5] * 2)),
        difference_interval(([2.0, 2.0], [0.5])),
    ):
        assert (interval.mean, interval.is_finite, math.isnan(interval.p)) == (1.5, False, True)
    assert (t_interval([1.5]).text(1), two.text(1, sign=True)) == ("1.5", "+1.5 (+1.0, +2.0)")


def test_proportion_interval_is_exact_binomial() -> None:
    # None of 100: 1 - 0.025^(1 / 100).
    none = proportion_interval([0.0, 0.0], 50)
    assert (none.mean, none.low, none.high) == pytest.approx((0.0, 0.0, 1 - 0.025**0.01))
    assert proportion_interval([1.0, 1.0], 2).low == pytest.approx(0.025**0.25)
    for hits, trials in ((3, 10), (41, 100)):
        expected = stats.binomtest(hits, trials).proportion_ci(method="exact")
        interval = proportion_interval([hits / trials], trials)
        assert (interval.mean, interval.low, interval.high) == pytest.approx((hits / trials, *expected), rel=1e-10)


def test_differences_between_seeds_or_robots_widen_proportion_intervals_within_bounds() -> None:
    alike, unlike = proportion_interval([0.5, 0.5, 0.5], 20), proportion_interval([0.0, 0.5, 1.0], 20)
    assert alike.mean == unlike.mean == 0.5
    assert 0.0 <= unlike.low < alike.low < 0.5 < alike.high < unlike.high <= 1.0
    # Korn and Graubard 1998: 0.25 / (0.25 / 3) = 3 trials, times the square of t(0.975, 59) / t(0.975, 2) =
    # 2.000995 / 4.302653.
    hits = 0.5 * 3 * (2.000995 / 4.302653) ** 2
    assert unlike.high == pytest.approx(stats.beta.ppf(0.975, hits + 1, hits), rel=1e-6)
    robots = proportion_interval(np.repeat([[0.0, 1.0]], 10, axis=1).repeat(3, axis=0), 20)
    assert unlike.low < robots.low < alike.low
    random, inside = np.random.default_rng(2), 0
    for _ in range(1000):
        share = proportion_interval(random.binomial(20, random.beta(3.0, 7.0, 4)) / 20, 20)
        inside += share.low <= 0.3 <= share.high
    assert inside / 1000 >= 0.95


def test_difference_of_proportions_combines_their_intervals() -> None:
    # Newcombe 1998, table II, (a): 56 of 70 minus 48 of 80 by Wilson's intervals is 0.2 [0.0524, 0.3339].
    wilson = Interval(0.8, 0.6918, 0.8769), Interval(0.6, 0.4904, 0.7003)
    change = proportion_difference(*wilson)
    assert (change.mean, change.low, change.high) == pytest.approx((0.2, 0.0524, 0.3339), abs=2e-4)
    # Altman and Bland 2011: the standard error is the half width towards zero divided by 1.96.
    assert change.p == pytest.approx(2 * stats.norm.sf(0.2 / (0.1476 / 1.96)), rel=0.02)
    worst = proportion_difference(proportion_interval([1.0], 2), proportion_interval([0.0], 2))
    assert -1.0 <= worst.low < worst.high == 1.0
    assert proportion_difference(proportion_interval([0.0], 20), proportion_interval([0.0], 20)).p == 1.0


def test_holm_by_hand() -> None:
    # The minimum times 4, the next times 3, ..., never below an earlier one, at most 1; NaN counts as a comparison.
    adjusted = holm([0.02, 0.011, math.nan, 0.6])
    np.testing.assert_allclose(adjusted, [0.06, 0.044, math.nan, 1.0])
    np.testing.assert_allclose(holm([0.01, 0.011]), [0.02, 0.02])


def test_constant_samples_give_an_interval_of_zero_width() -> None:
    assert t_interval([0.0, 0.0, 0.0]) == Interval(0.0, 0.0, 0.0, 1.0)
    assert difference_interval(([2.0] * 3, [1.0] * 3)) == Interval(1.0, 1.0, 1.0, 0.0)
    one_side = difference_interval(([2.0, 2.0, 2.0], [1.0, 2.0, 3.0]))
    assert one_side.high - one_side.mean == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)


@pytest.mark.parametrize(
    ("values", "mean", "error"),
    [
        # Deviations -1, 0, 1: variance 1, of the mean 1/3.
        ([1.0, 2.0, 3.0], 2.0, 1 / math.sqrt(3)),
        ([math.nan, 1.0, 3.0], 2.0, 1.0),
        ([math.nan, 4.0], 4.0, math.nan),
        ([math.nan, math.nan], math.nan, math.nan),
        ([], math.nan, math.nan),
    ],
)
def test_a_mean_estimate_leaves_out_nan(values: list[float], mean: float, error: float):
    assert vars(MeanEstimate.from_values(values)) == pytest.approx({"mean": mean, "error": error}, nan_ok=True)


def test_errors_of_a_difference_add_in_squares():
    assert MeanEstimate(5.0, 0.3) - MeanEstimate(3.0, 0.4) == MeanEstimate(2.0, pytest.approx(0.5))


@pytest.mark.parametrize(
    ("estimate", "options", "text"),
    [
        (MeanEstimate(1.2, 0.05), {}, "1.20 ± 0.05"),
        (MeanEstimate(1.2, math.nan), {}, "1.20"),
        (MeanEstimate(math.nan, math.nan), {}, "-"),
        (MeanEstimate(1.2, 0.05), {"sign": True, "digits": 1}, "+1.2 ± 0.1"),
        (MeanEstimate(-1.2, 0.0), {"sign": True}, "-1.20 ± 0.00"),
        (MeanEstimate(-0.001, 0.05), {"sign": True}, "0.00 ± 0.05"),
        (Interval(1.234, 1.0, 1.5), {}, "1.23 [1.00, 1.50]"),
        (Interval(-0.301, -0.5, 0.1), {"digits": 1, "sign": True}, "-0.3 [-0.5, +0.1]"),
        (Interval(-0.001, -0.004, 0.003), {"sign": True}, "0.00 [0.00, 0.00]"),
        (Interval(2.0), {}, "2.00"),
    ],
)
def test_estimates_and_intervals_as_text(estimate: MeanEstimate | Interval, options: dict, text: str):
    assert estimate.text(**options) == text


def test_crossed_interval_over_rows_and_columns_by_hand() -> None:
    # Rows 1, 2, 3 and columns 0, 2, 4: variances of the means are 1 / 3 and 4 / 3, with sum 5 / 3.
    values = np.array([1.0, 2.0, 3.0])[:, None] + np.array([-2.0, 0.0, 2.0])
    interval = crossed_interval(values)
    freedom = (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert interval.mean == pytest.approx(2.0)
    assert interval.high - 2.0 == pytest.approx(stats.t.ppf(0.975, freedom) * math.sqrt(5 / 3))
    # Column effects on both tables cancel; rows are independent.
    change = difference_interval((values + 5.0, values))
    assert change.mean == pytest.approx(5.0)
    assert change.high - 5.0 == pytest.approx(stats.t.ppf(0.975, 4) * math.sqrt(2 / 3))
    assert not crossed_interval(values[:1]).is_finite


def test_a_main_effect_by_hand() -> None:
    # Differences of 1 and 3. Each of four samples has a variance of 1, which a quarter of a third remains of.
    samples = [np.array([-1.0, 0.0, 1.0]) + level for level in (2.0, 1.0, 7.0, 4.0)]
    effect = difference_interval((samples[0], samples[1]), (samples[2], samples[3]))
    assert effect.mean == pytest.approx(2.0)
    assert effect.high - 2.0 == pytest.approx(stats.t.ppf(0.975, 8) * math.sqrt(4 * (1 / 3) / 4))
    assert effect.p == pytest.approx(2 * stats.t.sf(2.0 / math.sqrt(1 / 3), 8))
    # With the same robots in all tables their effects cancel in every pair.
    columns = np.array([-2.0, 0.0, 2.0])
    tables = [sample[:, None] + columns for sample in samples]
    crossed = difference_interval((tables[0], tables[1]), (tables[2], tables[3]))
    assert (crossed.mean, crossed.high) == pytest.approx((effect.mean, effect.high))


def test_crossed_interval_covers_the_true_value() -> None:
    rng, hits = np.random.default_rng(3), 0
    for _ in range(400):
        table = rng.normal(size=(5, 1)) + 2 * rng.normal(size=(1, 20)) + rng.normal(size=(5, 20))
        interval = crossed_interval(table)
        hits += interval.low <= 0 <= interval.high
    # 95 % of 400, minus three standard errors; the interval is slightly too wide.
    assert hits >= 367


def test_t_interval_with_another_confidence_equals_scipys() -> None:
    values = [0.3, -0.1, 0.4, 0.2]
    interval, test = t_interval(values, 0.9), stats.ttest_1samp(values, 0.0).confidence_interval(0.9)
    assert (interval.low, interval.high) == pytest.approx((test.low, test.high), rel=1e-12)


def test_equivalence_of_three_samples_by_hand() -> None:
    # Mean 0, standard error 1 / sqrt 3. The bound is t(0.95, 2) = 2.919986 standard errors away, so p is 0.05.
    assert equivalence_p_value([-1.0, 0.0, 1.0], 2.919986 / math.sqrt(3)) == pytest.approx(0.05, rel=1e-6)
    # A mean at the bound is equally likely on either side of it.
    assert equivalence_p_value([1.0, 2.0, 3.0], 2.0) == pytest.approx(0.5)
    assert [equivalence_p_value([level] * 3, 0.5) for level in (0.4, 0.6)] == pytest.approx([0, 1], abs=1e-9)
    assert math.isnan(equivalence_p_value([0.1, 0.2], 0.5))


def test_equivalence_equals_scipys_two_one_sided_tests() -> None:
    values = np.random.default_rng(2).normal(0.2, 0.3, 12)
    tests = ((-0.5, "greater"), (0.5, "less"))
    p = max(stats.ttest_1samp(values, bound, alternative=side).pvalue for bound, side in tests)
    assert equivalence_p_value(values, 0.5) == pytest.approx(p, rel=1e-10)
