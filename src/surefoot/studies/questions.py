"""Questions that a study asks of groups, with robots in pairs, and their answers: claims and families of comparisons.

A question with an expected direction is a claim that all its comparisons make together. By the intersection-union test
each may be tested at the full level, and the p value of the claim is their greatest (Berger 1982). A question without
one is a family of comparisons, whose p values are corrected for their number by Holm. Questions are families of their
own: none is corrected for the others.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import Positive
from surefoot.errors import SurefootError, suggest
from surefoot.evaluation.statistics import CONFIDENCE, Interval, equivalence_p_value, holm, t_interval

METRICS = {
    "home": ("return at home", "m", 2),
    "on_robot": ("return on the robot", "m", 2),
    "gap": ("gap", "m", 2),
    "falls": ("falls on the robot", "%", 1),
    "far": ("runs over 3 m on the robot", "%", 1),
}
"""Numbers of a group on a robot: title, unit and digits."""
LEVEL = 1 - CONFIDENCE


@dataclass(frozen=True)
class Question:
    """What a study asks of its groups."""

    figure: Literal["home", "on_robot", "gap", "falls", "far"]
    """The number that is compared, a mean over seeds and starts for each robot."""
    text: str
    """The claim or the question, in words."""
    pairs: tuple[tuple[str, str], ...] = ()
    """Pairs of groups: the second less the first, paired over robots."""
    expect: Literal["", "less", "more"] = ""
    """What the claim says of every difference; empty: there is no claim, and Holm's correction holds for the pairs."""
    group: str = ""
    """The group whose figure is claimed to lie within +-`within`, in place of pairs."""
    within: Positive | None = None

    def __post_init__(self) -> None:
        """Refuse a question that asks nothing, or two things."""
        if bool(self.pairs) == bool(self.group) or bool(self.group) != (self.within is not None):
            raise SurefootError(
                f"question '{self.text}' must have either pairs of groups, or a group and the bound within"
            )

    @property
    def is_claim(self) -> bool:
        """Whether it claims something."""
        return bool(self.expect or self.group)

    @property
    def groups(self) -> tuple[str, ...]:
        """The groups that it is about."""
        return (self.group,) if self.group else tuple(dict.fromkeys(name for pair in self.pairs for name in pair))

    def check(self, groups: Sequence[str]) -> None:
        """Refuse groups that a study does not have."""
        for name in self.groups:
            if name not in groups:
                raise SurefootError(f"'{name}' is no group of the study; {suggest(name, groups)}")


@dataclass(frozen=True)
class ComparedPair:
    """One comparison of a question."""

    group: str
    against: str
    """Empty for a group alone."""
    interval: Interval
    """Of 95 %; of 90 % for a claim of equivalence, which two one-sided tests at 5 % make."""
    p: float
    """Of its part of the claim, or two-sided where there is none."""
    p_holm: float = math.nan
    robots: int = 0
    left_out: str = ""
    """Why it is no part of the claim; empty if it is."""


@dataclass(frozen=True)
class Answer:
    """The comparisons of a question, and the p value of its claim."""

    question: Question
    comparisons: tuple[ComparedPair, ...]

    @property
    def tested(self) -> list[ComparedPair]:
        """Comparisons that are part of the claim."""
        return [one for one in self.comparisons if not one.left_out]

    @property
    def p(self) -> float:
        """The greatest p value of the claim's parts; NaN without a claim, and where no part is left."""
        values = [one.p for one in self.tested]
        return float(np.max(values)) if self.question.is_claim and values else math.nan

    @property
    def verdict(self) -> str:
        """What came out of the claim; empty without one."""
        if not self.question.is_claim:
            return ""
        if math.isnan(self.p):
            return "not tested"
        held = "holds" if self.p < LEVEL else "not shown"
        count = len(self.comparisons) - len(self.tested)
        return f"{held}, without {count} of {len(self.comparisons)} comparisons" if count else held


Values = Mapping[str, Mapping[int, float]]
"""A figure of each group by robot."""


def answer(question: Question, values: Values, not_learned: Mapping[str, str]) -> Answer:
    """Return the answer to a question.

    Args:
        question: the question; its groups without values are left out.
        values: its figure, by group and robot.
        not_learned: groups that did not learn, with the reason; they leave claims on the gap.
    """
    leaves = not_learned if question.figure == "gap" and question.is_claim else {}
    if question.within is not None:
        table = values.get(question.group, {})
        numbers = np.array(list(table.values()))
        interval = t_interval(numbers, 1 - 2 * LEVEL)
        reason = leaves.get(question.group, "") or ("" if len(numbers) else "no results")
        p = equivalence_p_value(numbers, question.within)
        return Answer(question, (ComparedPair(question.group, "", interval, p, robots=len(numbers), left_out=reason),))
    comparisons = []
    for against, group in question.pairs:
        differences = _paired(values, group, against)
        interval = t_interval(differences)
        reason = leaves.get(group) or leaves.get(against) or ("" if len(differences) else "no results")
        p = _p_of_claim(interval, question.expect) if question.expect else interval.p
        comparisons.append(ComparedPair(group, against, interval, p, robots=len(differences), left_out=reason))
    if not question.is_claim:
        adjusted = holm([one.p for one in comparisons])
        comparisons = [replace(one, p_holm=float(p)) for one, p in zip(comparisons, adjusted, strict=True)]
    return Answer(question, tuple(comparisons))


def _paired(values: Values, group: str, against: str) -> Array:
    """Return the differences of two groups on the robots that both have."""
    one, other = values.get(group, {}), values.get(against, {})
    return np.array([one[robot] - other[robot] for robot in one if robot in other], np.float64)


def _p_of_claim(interval: Interval, expect: str) -> float:
    """Return the two-sided p value of a difference on the claimed side of zero; 1 on the other side."""
    is_there = interval.mean < 0 if expect == "less" else interval.mean > 0
    return interval.p if is_there or math.isnan(interval.p) else 1.0
