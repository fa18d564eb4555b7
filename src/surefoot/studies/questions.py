"""Questions of a study about differences between groups, paired over robots, and their answers.

A question with an expected direction is a claim, which holds if it holds in all its comparisons. By the
intersection-union test each comparison may be tested at the full level, and the claim's p value is their maximum
(Berger 1982). A question without an expected direction is a family of comparisons, whose p values are corrected by
Holm's method. There is no correction across questions.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Positive
from surefoot.errors import SurefootError, suggest
from surefoot.evaluation.statistics import CONFIDENCE, Interval, equivalence_p_value, holm, robots_interval

METRICS = {
    "home": ("return in training simulator", "m", 2),
    "on_robot": ("return on the robot", "m", 2),
    "gap": ("gap", "m", 2),
    "home_falls": ("falls in training simulator", "%", 1),
    "falls": ("falls on the robot", "%", 1),
    "far": ("runs over 3 m on the robot", "%", 1),
}
"""Metrics of a group on a robot: title, unit and decimals."""
LEVEL = 1 - CONFIDENCE
NO_RESULTS = "no results"
"""Reason that a comparison is left out because a group has no results yet."""


def check_pairs(where: str, pairs: Sequence[tuple[str, str]]) -> None:
    """Check that each pair has two groups and occurs once, in either order; each comparison counts in a correction.

    Raises:
        SurefootError: with the first pair for which it is not so.
    """
    seen: set[frozenset[str]] = set()
    for pair in pairs:
        if pair[0] == pair[1]:
            raise SurefootError(f"{where}: '{pair[0]}' is compared with itself")
        if frozenset(pair) in seen:
            raise SurefootError(f"{where}: {pair[0]} and {pair[1]} are compared twice")
        seen.add(frozenset(pair))


@dataclass(frozen=True)
class Question:
    """Question of a study about its groups."""

    figure: Literal["home", "on_robot", "gap", "home_falls", "falls", "far"]
    """Metric that is compared, a mean over seeds and starts for each robot."""
    text: str
    """The claim or question in words."""
    pairs: tuple[tuple[str, str], ...] = ()
    """Pairs of groups; a difference is the second minus the first, paired over robots."""
    expect: Literal["", "less", "more"] = ""
    """Claimed sign of every difference. Empty for a question without a claim, whose p values are corrected by Holm."""
    group: str = ""
    """Instead of pairs: a group whose metric is claimed to be within +-`within`."""
    within: Positive | None = None

    def __post_init__(self) -> None:
        """Check that there are either pairs, or a group with a bound."""
        if bool(self.pairs) == bool(self.group) or bool(self.group) != (self.within is not None):
            raise SurefootError(
                f"question '{self.text}' must have either pairs of groups, or a group and the bound within"
            )
        if self.group and self.expect:
            raise SurefootError(f"question '{self.text}' has expect, which belongs to pairs of groups")
        check_pairs(f"question '{self.text}'", self.pairs)

    @property
    def is_claim(self) -> bool:
        """Whether the question is a claim."""
        return bool(self.expect or self.group)

    @property
    def groups(self) -> tuple[str, ...]:
        """Groups in the question."""
        return (self.group,) if self.group else tuple(dict.fromkeys(name for pair in self.pairs for name in pair))

    def check(self, groups: Sequence[str]) -> None:
        """Check that the study has the question's groups.

        Raises:
            SurefootError: it lacks one.
        """
        for name in self.groups:
            if name not in groups:
                raise SurefootError(f"'{name}' is no group of the study; {suggest(name, groups)}")


@dataclass(frozen=True)
class ComparedPair:
    """One comparison of a question."""

    group: str
    against: str
    """Empty for a single group."""
    interval: Interval
    p: float
    """p value: two-sided for a difference, and 1 if it has not the claimed sign; the larger of two one-sided tests for
    a claim of equivalence."""
    confidence: float = CONFIDENCE
    """Confidence of the interval: 90 % for a claim of equivalence, which is two one-sided tests at 5 %."""
    p_holm: float = math.nan
    robots: int = 0
    left_out: str = ""
    """Reason that the comparison is not part of the claim; otherwise empty."""


@dataclass(frozen=True)
class Answer:
    """The comparisons of a question, and the p value of its claim."""

    question: Question
    comparisons: tuple[ComparedPair, ...]
    preliminary: bool = False
    """Whether trainings of its groups are missing."""

    @property
    def tested(self) -> list[ComparedPair]:
        """Comparisons that are part of the claim."""
        return [one for one in self.comparisons if not one.left_out]

    @property
    def p(self) -> float:
        """Maximum p value of the claim's parts; NaN without a claim or parts, or if a part has no results yet."""
        values = [one.p for one in self.tested]
        return float(np.max(values)) if self.question.is_claim and values and not self._is_waiting else math.nan

    @property
    def _is_waiting(self) -> bool:
        return any(one.left_out == NO_RESULTS for one in self.comparisons)

    @property
    def verdict(self) -> str:
        """Result of the claim; empty without one."""
        if not self.question.is_claim:
            return ""
        if math.isnan(self.p):
            return "not tested yet" if self._is_waiting else "not tested"
        result = "holds" if self.p < LEVEL else "not significant"
        if count := len(self.comparisons) - len(self.tested):
            result += f", without {count} of {len(self.comparisons)} comparisons"
        return f"{result} (preliminary: trainings are missing)" if self.preliminary else result


Values = Mapping[str, Mapping[int, float]]
"""A metric of each group by robot."""


def answer(
    question: Question,
    values: Values,
    not_learned: Mapping[str, str],
    policies: Mapping[str, Array] | None = None,
    incomplete: Collection[str] = (),
) -> Answer:
    """Return the answer to a question.

    Args:
        question: the question; groups without values are left out.
        values: the question's metric, by group and robot.
        not_learned: groups that did not learn, with the reason; they are excluded from claims about the gap.
        policies: for each group whose policies run on all robots, the mean over robots of each policy (P,).
        incomplete: groups of which trainings are missing.
    """
    excluded = not_learned if question.figure == "gap" and question.is_claim else {}
    preliminary = not set(question.groups).isdisjoint(incomplete)
    comparisons = []
    for against, group in question.pairs or (("", question.group),):
        names = [name for name in (group, against) if name]
        numbers = _paired(values, group, against) if against else np.array([*values.get(group, {}).values()])
        shared = [(policies or {})[name] for name in names if name in (policies or {})]
        reason = next((excluded[name] for name in names if name in excluded), "" if len(numbers) else NO_RESULTS)
        confidence = CONFIDENCE if question.within is None else 1 - 2 * LEVEL
        interval = robots_interval(numbers, shared, confidence) if len(numbers) else Interval(math.nan)
        if question.within is not None:
            p = equivalence_p_value(numbers, question.within, shared)
        else:
            p = _p_of_claim(interval, question.expect) if question.expect else interval.p
        comparisons.append(ComparedPair(group, against, interval, p, confidence, robots=len(numbers), left_out=reason))
    if not question.is_claim:
        adjusted = holm([one.p for one in comparisons])
        comparisons = [replace(one, p_holm=float(p)) for one, p in zip(comparisons, adjusted, strict=True)]
    return Answer(question, tuple(comparisons), preliminary)


def _paired(values: Values, group: str, against: str) -> Array:
    """Return `group` minus `against` on the robots that both have."""
    one, other = values.get(group, {}), values.get(against, {})
    return np.array([one[robot] - other[robot] for robot in one if robot in other], np.float64)


def _p_of_claim(interval: Interval, expect: str) -> float:
    """Return the two-sided p value of a difference with the claimed sign; 1 for the opposite sign."""
    is_there = interval.mean < 0 if expect == "less" else interval.mean > 0
    return interval.p if is_there or math.isnan(interval.p) else 1.0
