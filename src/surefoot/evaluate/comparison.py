"""Groups of trained policies side by side: their figures with intervals over seeds, and their differences."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.evaluate.evaluations import EVALUATIONS, Figure, Result, gap_of
from surefoot.evaluate.gap import PolicyGap
from surefoot.evaluate.sensitivity import Sensitivity
from surefoot.evaluate.statistics import Interval, t_interval, welch_interval


@dataclass(frozen=True)
class Curve:
    """How a training went, update by update."""

    steps: Array
    """Control steps so far (U,), rising."""
    returns: Array
    """Mean return of the episodes that ended (U,) [m]; NaN where none did."""
    speed: Array
    """Their mean speed (U,) [m/s]; NaN where none did."""
    falls: Array
    """How many of them ended before their time (U,) [%]; NaN where none did."""
    episodes: Array
    """How many ended (U,)."""

    @classmethod
    def of_rows(cls, rows: Sequence[dict[str, Any]]) -> Curve:
        """The curve of a run's log."""

        def column(name: str) -> Array:
            return np.array([math.nan if row[name] is None else row[name] for row in rows], np.float64)

        episodes = column("episodes")
        falls = np.divide(100 * column("falls"), episodes, out=np.full(len(rows), math.nan), where=episodes > 0)
        return cls(column("steps"), column("return_mean"), column("speed_mean"), falls, episodes)

    def binned(self, name: str, edges: ArrayLike) -> Array:
        """Means over episodes between steps `edges` (B + 1,), each with its upper end; NaN where none ended.

        Each update counts by its episodes: in most updates only the falls end, and all the others end together.
        """
        values, bounds = getattr(self, name), np.asarray(edges, np.float64)
        known = np.isfinite(values) & (self.episodes > 0)
        place = np.searchsorted(bounds, self.steps[known], side="left")
        inner, count = slice(1, len(bounds)), len(bounds) + 1
        weight = np.bincount(place, self.episodes[known], count)[inner]
        total = np.bincount(place, (values * self.episodes)[known], count)[inner]
        return np.divide(total, weight, out=np.full(len(weight), math.nan), where=weight > 0)

    @property
    def late_gain(self) -> float:
        """Mean return in the last fifth of the training less that in the fifth before [m]; NaN where not known."""
        if not len(self.steps):
            return math.nan
        before, last = self.binned("returns", np.array([0.6, 0.8, 1.0]) * self.steps[-1])
        return float(last - before)


@dataclass(frozen=True)
class SeedResult:
    """One trained policy."""

    seed: int
    """Seed of its training."""
    steps: int
    """Control steps that it was trained for."""
    seconds: float
    """How long its training took [s]."""
    curve: Curve
    """How its training went."""
    results: dict[str, Result]
    """Result of each kind of evaluation."""
    best: int | None = None
    """Control steps after which the policy was what is evaluated: the best of its training; None if not known."""

    @cached_property
    def figures(self) -> dict[str, float]:
        """What the evaluations came to, by name."""
        parts = self.results.items()
        return {figure.name: figure.read(result) for name, result in parts for figure in EVALUATIONS[name].figures}


@dataclass(frozen=True)
class GroupResult:
    """Policies whose trainings differ in nothing but the seed."""

    name: str
    """Name of the group."""
    label: str
    """What figures and tables call it."""
    seeds: tuple[SeedResult, ...]
    """Its policies."""

    def values(self, figure: str) -> Array:
        """A figure of every seed (S,)."""
        return np.array([seed.figures[figure] for seed in self.seeds])

    def interval(self, figure: str) -> Interval:
        """A figure's mean over seeds."""
        return t_interval(self.values(figure))

    @cached_property
    def sensitivities(self) -> list[Sensitivity]:
        """Test worlds of every seed; empty where the study has none."""
        return [
            Sensitivity.from_mapping(seed.results["sensitivity"], f"{self.label}, seed {seed.seed}")
            for seed in self.seeds
            if "sensitivity" in seed.results
        ]

    @cached_property
    def gap(self) -> PolicyGap:
        """Runs of all policies at home, away and, last, at home as described."""
        parts = [gap_of(seed.results["gap"], f"{self.label}, seed {seed.seed}") for seed in self.seeds]
        return PolicyGap.pooled(self.label, parts)

    def best(self, count: int) -> GroupResult:
        """Return the group with only the policies of the highest return in their own simulator, best first.

        They are chosen by other episodes than those that tell the gap.
        """
        seeds = sorted(self.seeds, key=lambda seed: seed.figures["nominal_return"], reverse=True)
        return replace(self, seeds=tuple(seeds[:count]))


@dataclass(frozen=True)
class Comparison:
    """Groups side by side."""

    name: str
    """Name of the study."""
    kinds: tuple[str, ...]
    """Kinds of evaluation that every policy has."""
    groups: tuple[GroupResult, ...]
    """The groups, one or more, each with one policy or more."""
    pairs: tuple[tuple[str, str], ...] = ()
    """Names of groups whose difference is told, the second against the first."""
    missing: tuple[str, ...] = ()
    """Runs of the study that are not in it."""
    top: int = 3
    """How many policies of a group, those with the highest return in their own simulator, tell its reality gap."""
    bars: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    """Names of groups whose reality gaps stand side by side, by the name of the set."""
    findings: tuple[tuple[frozenset[str], str], ...] = ()
    """Names of groups, and what others found of the groups that these stand for."""

    @property
    def figures(self) -> tuple[Figure, ...]:
        """The numbers that are compared."""
        return tuple(figure for kind in self.kinds for figure in EVALUATIONS[kind].figures)

    def best(self) -> Comparison:
        """Return the comparison with only the `top` policies of each group."""
        return replace(self, groups=tuple(group.best(self.top) for group in self.groups))

    def present_pairs(self) -> list[tuple[GroupResult, GroupResult]]:
        """Pairs of which both groups have policies."""
        by_name = {group.name: group for group in self.groups}
        return [(by_name[a], by_name[b]) for a, b in self.pairs if a in by_name and b in by_name]

    def sets(self) -> list[tuple[str, tuple[GroupResult, ...]]]:
        """The groups of each set of bars that there are, and those in no set as `others`; all as one without sets."""
        by_name = {group.name: group for group in self.groups}
        rest = tuple(group for group in self.groups if not any(group.name in names for names in self.bars.values()))
        found = [(one, tuple(by_name[name] for name in names if name in by_name)) for one, names in self.bars.items()]
        found.append(("others" if self.bars else "groups", rest))
        return [(name, groups) for name, groups in found if groups]

    def finding(self, names: Iterable[str]) -> str:
        """What others found of the same groups; empty, if nothing is told."""
        return " ".join(text for groups, text in self.findings if groups == set(names))


def difference(base: GroupResult, other: GroupResult, figure: str) -> Interval:
    """A figure's mean over the seeds of `other` less that of `base`, with Welch's interval."""
    return welch_interval(other.values(figure), base.values(figure))
