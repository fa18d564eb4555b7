"""Confidence intervals: known answers, scipy's own, and how often they cover the truth."""

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
    share_difference,
    t_interval,
    welch_interval,
    wilson_interval,
)


def test_t_interval_of_three_numbers_by_hand() -> None:
    # Mean 2, standard deviation 1, standard error 1 / sqrt 3, and t(0.975, 2) = 4.302653.
    interval = t_interval([1.0, 2.0, 3.0])
    half = pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)
    assert (interval.mean, interval.high - 2, 2 - interval.low) == (2, half, half)


def test_welch_interval_of_alike_spreads_by_hand() -> None:
    # Standard error sqrt(1/3 + 1/3), 4 degrees of freedom, t(0.975, 4) = 2.776445.
    interval = welch_interval([2.0, 3.0, 4.0], [1.0, 2.0, 3.0])
    assert interval.mean == 1
    assert interval.high - 1 == pytest.approx(2.776445 * math.sqrt(2 / 3), rel=1e-6)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_welch_interval_is_scipys_for_unlike_spreads_and_counts(scale: float) -> None:
    random = np.random.default_rng(3)
    a, b = scale * random.normal(1.0, 0.2, 4), scale * random.normal(0.5, 2.0, 7)
    interval = welch_interval(a, b)
    expected = stats.ttest_ind(a, b, equal_var=False).confidence_interval(0.95)
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high), rel=1e-9)


def test_intervals_cover_the_truth_as_often_as_their_confidence() -> None:
    random = np.random.default_rng(1)
    rounds, inside, between = 1000, 0, 0
    for _ in range(rounds):
        a, b = random.normal(2.0, 1.0, 3), random.normal(1.0, 0.3, 4)
        one, change = t_interval(a), welch_interval(a, b)
        inside += one.low <= 2 <= one.high
        between += change.low <= 1 <= change.high
    assert inside / rounds == pytest.approx(0.95, abs=0.02)
    assert between / rounds == pytest.approx(0.95, abs=0.02)


def test_one_or_two_numbers_have_no_interval() -> None:
    two = t_interval([1.0, 2.0])
    for interval in (t_interval([1.5]), two, welch_interval([2.0] * 3, [0.5] * 2), welch_interval([2.0, 2.0], [0.5])):
        assert (interval.mean, interval.is_finite, interval.covers_zero) == (1.5, False, True)
    assert (t_interval([1.5]).text(1), two.text(1, sign=True)) == ("1.5", "+1.5 (+1.0, +2.0)")


def test_wilson_interval_by_hand() -> None:
    # Wilson 1927 with z = 1.96: 3 of 10 give (.3 + .192 +- 1.96 sqrt(.021 + .0096)) / 1.384.
    interval = wilson_interval([0.3], 10)
    assert (interval.mean, interval.low, interval.high) == pytest.approx((0.3, 0.1078, 0.6032), abs=1e-4)
    # None of 60: z^2 / (60 + z^2).
    none = wilson_interval([0.0, 0.0, 0.0], 20)
    assert (none.mean, none.low, none.high) == pytest.approx((0.0, 0.0, 0.0602), abs=1e-4)
    assert wilson_interval([1.0, 1.0], 20).high == 1.0


def test_shares_that_differ_between_seeds_widen_their_interval_within_bounds() -> None:
    alike, unlike = wilson_interval([0.5, 0.5, 0.5], 20), wilson_interval([0.0, 0.5, 1.0], 20)
    assert alike.mean == unlike.mean == 0.5
    assert 0.0 <= unlike.low < alike.low < 0.5 < alike.high < unlike.high <= 1.0
    random, inside = np.random.default_rng(2), 0
    for _ in range(1000):
        share = wilson_interval(random.binomial(20, random.beta(3.0, 7.0, 4)) / 20, 20)
        inside += share.low <= 0.3 <= share.high
    assert inside / 1000 >= 0.93


def test_difference_of_shares_is_newcombes() -> None:
    # Newcombe 1998, table II, (a): 56 of 70 less 48 of 80 is .2 [.0524, .3339].
    change = share_difference(wilson_interval([56 / 70], 70), wilson_interval([48 / 80], 80))
    assert (change.mean, change.low, change.high) == pytest.approx((0.2, 0.0524, 0.3339), abs=1e-4)
    worst = share_difference(wilson_interval([1.0], 2), wilson_interval([0.0], 2))
    assert -1.0 <= worst.low < worst.high == 1.0


def test_numbers_that_do_not_vary_give_a_point() -> None:
    assert t_interval([0.0, 0.0, 0.0]) == Interval(0.0, 0.0, 0.0)
    assert welch_interval([2.0] * 3, [1.0] * 3) == Interval(1.0, 1.0, 1.0)
    one_side = welch_interval([2.0, 2.0, 2.0], [1.0, 2.0, 3.0])
    assert one_side.high - one_side.mean == pytest.approx(4.302653 / math.sqrt(3), rel=1e-6)


def test_covers_zero() -> None:
    intervals = Interval(1.0, -0.1, 2.1), Interval(1.0, 0.1, 1.9), Interval(-1.0, -1.9, -0.1)
    assert [interval.covers_zero for interval in intervals] == [True, False, False]


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
def test_text_of_estimates_and_intervals(estimate: MeanEstimate | Interval, options: dict, text: str):
    assert estimate.text(**options) == text


def test_a_table_has_an_interval_over_its_rows_and_columns() -> None:
    # Rows 1, 2, 3 and columns 0, 2, 4: variances of the means are 1 / 3 and 4 / 3, together 5 / 3.
    values = np.array([1.0, 2.0, 3.0])[:, None] + np.array([-2.0, 0.0, 2.0])
    interval = crossed_interval(values)
    freedom = (5 / 3) ** 2 / ((1 / 3) ** 2 / 2 + (4 / 3) ** 2 / 2)
    assert interval.mean == pytest.approx(2.0)
    assert interval.high - 2.0 == pytest.approx(stats.t.ppf(0.975, freedom) * math.sqrt(5 / 3))
    # Effects of columns on both tables cancel; rows are each table's own.
    change = crossed_interval(values + 5.0, values)
    assert change.mean == pytest.approx(5.0)
    assert change.high - 5.0 == pytest.approx(stats.t.ppf(0.975, 4) * math.sqrt(2 / 3))
    assert not crossed_interval(values[:1]).is_finite


def test_an_interval_over_rows_and_columns_covers_the_truth() -> None:
    rng, hits = np.random.default_rng(3), 0
    for _ in range(400):
        table = rng.normal(size=(5, 1)) + 2 * rng.normal(size=(1, 20)) + rng.normal(size=(5, 20))
        interval = crossed_interval(table)
        hits += interval.low <= 0 <= interval.high
    # 95 % of 400, within three standard errors below; the interval is rather too wide.
    assert hits >= 367
