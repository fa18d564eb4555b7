"""Answers to questions of a study: known p values of claims and of families of comparisons."""

from __future__ import annotations

import math

import numpy as np
import pytest

pytest.importorskip("scipy")
from scipy import stats

from surefoot.errors import SurefootError
from surefoot.evaluation.statistics import holm, t_interval
from surefoot.studies.questions import Question, answer

# Six robots: `good` is better than `poor` by 2 and than `fair` by about 0.1 on each, in units of the metric.
GOOD = {201: 0.1, 202: -0.1, 203: 0.2, 204: 0.0, 205: -0.2, 206: 0.3}
POOR = {seed: value + 2 + 0.01 * (seed % 2) for seed, value in GOOD.items()}
FAIR = {seed: value + 0.1 * (seed - 203) for seed, value in GOOD.items()}
VALUES = {"good": GOOD, "poor": POOR, "fair": FAIR}
GAP = Question("gap", "the gap is smaller", (("poor", "good"), ("fair", "good")), "less")


def paired_p(one: dict[int, float], other: dict[int, float]) -> float:
    return float(stats.ttest_rel(list(one.values()), list(other.values())).pvalue)


def test_a_claim_has_the_maximum_p_value_of_its_parts() -> None:
    result = answer(GAP, VALUES, {})
    first, second = result.comparisons
    assert (first.p, second.p) == pytest.approx((paired_p(GOOD, POOR), paired_p(GOOD, FAIR)))
    assert (first.robots, first.interval.mean) == (6, pytest.approx(-2.005))
    assert result.p == second.p > 0.05 > first.p
    assert result.verdict == "not significant"
    alone = answer(Question("gap", "smaller", (("poor", "good"),), "less"), VALUES, {})
    assert (alone.p, alone.verdict) == (first.p, "holds")


def test_a_difference_of_the_other_sign_does_not_support_a_claim() -> None:
    result = answer(Question("gap", "greater", (("poor", "good"),), "more"), VALUES, {})
    assert (result.p, result.verdict) == (1.0, "not significant")


def test_differences_are_paired_over_robots_that_both_groups_have() -> None:
    few = {seed: GOOD[seed] - 1 for seed in (203, 204, 205)}
    result = answer(Question("falls", "?", (("good", "few"),)), {**VALUES, "few": few}, {})
    (pair,) = result.comparisons
    # Equal differences have zero variance.
    assert (pair.robots, pair.interval.mean, pair.interval.low) == (3, pytest.approx(-1), pytest.approx(-1))


def test_comparisons_without_a_claim_are_corrected_within_their_question() -> None:
    result = answer(Question("on_robot", "?", GAP.pairs), VALUES, {})
    raw = [paired_p(GOOD, POOR), paired_p(GOOD, FAIR)]
    assert [one.p for one in result.comparisons] == pytest.approx(raw)
    assert [one.p_holm for one in result.comparisons] == pytest.approx(list(holm(raw)))
    assert result.verdict == ""
    assert math.isnan(result.p)


def test_equivalence_holds_exactly_if_the_90_percent_interval_is_within_the_bound() -> None:
    numbers = list(GOOD.values())
    end = t_interval(numbers, 0.9).high
    for bound, verdict in ((1.001 * end, "holds"), (0.999 * end, "not significant")):
        result = answer(Question("gap", "none", group="good", within=bound), VALUES, {})
        assert result.verdict == verdict
        assert result.comparisons[0].interval.high == end
    p = max(
        stats.ttest_1samp(numbers, -0.3, alternative="greater").pvalue,
        stats.ttest_1samp(numbers, 0.3, alternative="less").pvalue,
    )
    assert answer(Question("gap", "none", group="good", within=0.3), VALUES, {}).p == pytest.approx(p)


def test_a_group_that_did_not_learn_is_excluded_only_from_claims_about_the_gap() -> None:
    reasons = {"fair": "fair did not learn"}
    result = answer(GAP, VALUES, reasons)
    assert [one.left_out for one in result.comparisons] == ["", "fair did not learn"]
    assert (result.p, result.verdict) == (result.comparisons[0].p, "holds, without 1 of 2 comparisons")
    returns = Question("on_robot", "less", GAP.pairs, "less")
    assert answer(returns, VALUES, reasons).verdict == "not significant"
    family = Question("gap", "?", GAP.pairs)
    assert [one.left_out for one in answer(family, VALUES, reasons).comparisons] == ["", ""]
    # If the claim's own group did not learn, nothing is left to test.
    assert answer(GAP, VALUES, {"good": "good did not learn"}).verdict == "not tested"
    equal = Question("gap", "none", group="good", within=0.5)
    assert answer(equal, VALUES, {"good": "good did not learn"}).verdict == "not tested"


def test_groups_without_results_are_left_out() -> None:
    result = answer(GAP, {"good": GOOD, "poor": POOR}, {})
    assert [one.left_out for one in result.comparisons] == ["", "no results"]
    assert result.verdict == "not tested yet"  # a claim with two parts does not hold because of one
    assert answer(Question("gap", "none", group="good", within=0.5), {}, {}).verdict == "not tested yet"


def test_a_verdict_without_all_trainings_is_preliminary() -> None:
    alone = Question("gap", "smaller", (("poor", "good"),), "less")
    assert answer(alone, VALUES, {}, incomplete=["poor"]).verdict == "holds (preliminary: trainings are missing)"
    assert answer(alone, VALUES, {}, incomplete=["fair"]).verdict == "holds"


def test_policies_that_run_on_all_robots_add_the_variance_of_their_mean() -> None:
    policies = np.array([1.9, 2.3, 2.0, 2.2])  # means over robots of the four policies of `poor`
    (pair,) = answer(Question("gap", "?", (("poor", "good"),)), VALUES, {}, {"poor": policies}).comparisons
    differences = np.array([GOOD[seed] - POOR[seed] for seed in GOOD])
    parts = [differences.var(ddof=1) / 6, policies.var(ddof=1) / 4]
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 5 + parts[1] ** 2 / 3)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(sum(parts))
    assert (pair.interval.low, pair.interval.high) == pytest.approx((-2.005 - half, -2.005 + half))
    assert pair.p == pytest.approx(2 * stats.t.sf(2.005 / math.sqrt(sum(parts)), freedom))
    # Equivalence: the larger of two one-sided tests with the same standard error.
    within = answer(Question("gap", "none", group="poor", within=3.0), VALUES, {}, {"poor": policies})
    parts[0] = np.var(list(POOR.values()), ddof=1) / 6
    freedom = sum(parts) ** 2 / (parts[0] ** 2 / 5 + parts[1] ** 2 / 3)
    room = 3.0 - np.mean(list(POOR.values()))
    assert within.p == pytest.approx(stats.t.sf(room / math.sqrt(sum(parts)), freedom))
    assert within.comparisons[0].confidence == pytest.approx(0.9)


@pytest.mark.parametrize("wrong", [{}, {"pairs": (("a", "b"),), "group": "a", "within": 0.5}, {"group": "a"}])
def test_a_question_has_either_pairs_or_a_bound(wrong: dict[str, object]) -> None:
    with pytest.raises(SurefootError, match="question 'why' must have either pairs of groups, or a group"):
        Question("gap", "why", **wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"group": "a", "within": 0.3, "expect": "less"}, "has expect, which belongs to pairs of groups"),
        ({"pairs": (("a", "a"),)}, "'a' is compared with itself"),
        ({"pairs": (("a", "b"), ("c", "b"), ("b", "a"))}, "b and a are compared twice"),
    ],
)
def test_a_comparison_counts_once(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(SurefootError, match=f"question 'why'.*{message}"):
        Question("gap", "why", **wrong)  # type: ignore[arg-type]
