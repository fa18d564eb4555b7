"""Groups of trained policies side by side: their figures with intervals over seeds, their differences, all tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.evaluate.gap import PolicyGap, gap_difference
from surefoot.evaluate.runs import Estimate
from surefoot.evaluate.sensitivity import Sensitivity
from surefoot.evaluate.statistics import CONFIDENCE, Interval, t_interval, welch_interval
from surefoot.files import atomic_write
from surefoot.studies.evaluations import EVALUATIONS, Figure, Result, gap_of
from surefoot.tables import plain_rows, write_csv

FAR = 3.0
"""A run goes far over this [m]; the paper tells so of nine runs on the robot."""
CONTENTS = {
    "policies": "a row a trained policy",
    "groups": "a row a group and figure, with its interval over seeds",
    "differences": "a row a pair of groups and figure, with its interval over seeds",
    "episodes": "a row an episode, of all evaluations",
    "sensitivity": "a row a policy and test world",
    "gap_groups": "a row a group and world, of the best policies and of all: means and standard errors over runs",
    "gap_differences": "a row a pair of groups, of the best policies and of all: the difference of their gaps",
}
"""What each table holds."""


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
    policy: Path | None = None
    """Its file; needed for kind `gait`, which keeps an episode beside it."""

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


def study_tables(comparison: Comparison) -> dict[str, list[dict[str, Any]]]:
    """Return the tables of a study by name; those on test worlds and gaps only where the study has them."""
    tables = {
        "policies": [_policy_row(group, i) for group in comparison.groups for i in range(len(group.seeds))],
        "groups": [
            {"group": group.name, "label": group.label, "figure": figure.name, "unit": figure.unit}
            | {"seeds": len(group.seeds), **vars(group.interval(figure.name))}
            for group in comparison.groups
            for figure in comparison.figures
        ],
        "differences": [
            {"group": other.name, "against": base.name, "figure": figure.name, "unit": figure.unit}
            | difference(base, other, figure.name).columns("difference")
            for base, other in comparison.present_pairs()
            for figure in comparison.figures
        ],
        "episodes": [row for group in comparison.groups for row in _episode_rows(group)],
    }
    tested = [one for group in comparison.groups for one in group.sensitivities]
    if tested:
        tables["sensitivity"] = [row for one in tested for row in one.world_rows()]
    if "gap" in comparison.kinds:
        chosen = {"top": comparison.best(), "all": comparison}
        tables["gap_groups"] = [
            row for group in range(len(comparison.groups)) for which, part in chosen.items()
            for row in _gap_rows(which, part.groups[group])
        ]  # fmt: skip
        tables["gap_differences"] = [
            _gap_difference_row(which, base, other)
            for which, part in chosen.items()
            for base, other in part.present_pairs()
        ]
    return tables


def write_tables(comparison: Comparison, folder: Path) -> list[Path]:
    """Write each table as CSV, and summary.json with all but the episodes; returns the paths."""
    tables = study_tables(comparison)
    files = [write_csv(folder / f"{name}.csv", rows) for name, rows in tables.items() if rows]
    summary = {
        "study": comparison.name,
        "confidence": CONFIDENCE,
        "evaluations": {
            name: {"what": EVALUATIONS[name].what, "settings": EVALUATIONS[name].settings} for name in comparison.kinds
        },
        "missing": list(comparison.missing),
        **{name: plain_rows(rows) for name, rows in tables.items() if name != "episodes"},
    }
    atomic_write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return [*files, folder / "summary.json"]


def _policy_row(group: GroupResult, number: int) -> dict[str, Any]:
    seed = group.seeds[number]
    row = {"group": group.name, "seed": seed.seed, "steps": seed.steps, "training_seconds": round(seed.seconds, 1)}
    gait = {name: seed.results["gait"][name] for name in ("gait", "pattern")} if "gait" in seed.results else {}
    return row | {"best_steps": seed.best, **seed.figures, **gait}


def _episode_rows(group: GroupResult) -> list[dict[str, Any]]:
    """Return a row for each episode; of those in test worlds, whose row and value are told, the nominal ones first."""
    unknown = dict.fromkeys(("distance", "power", "steps", "balanced"), math.nan)
    found: list[dict[str, Any]] = []
    for number, seed in enumerate(group.seeds):
        for name, result in seed.results.items():
            rows: list[dict[str, Any]]
            if name == "sensitivity":
                rows = group.sensitivities[number].episode_rows()
            elif name == "gap":
                gap = group.gap.parts[number]
                rows = [{"world": runs.world, **row} for runs in gap.runs for row in runs.rows()]
            elif name == "gait":
                rows = []  # names a gait and measures no episode
            else:
                columns = zip(result["returns"], result["speed"], result["fell"], strict=True)
                rows = [{"run": i, "return": r, "speed": s, "fell": fell} for i, (r, s, fell) in enumerate(columns)]
            world = EVALUATIONS[name].world_names[0]
            start = {"group": group.name, "seed": seed.seed, "evaluation": name, "world": world}
            start |= {"row": "", "value": math.nan, "run": 0, "return": math.nan, "speed": math.nan, "fell": False}
            found += [start | unknown | {k: v for k, v in row.items() if k not in ("policy", "unit")} for row in rows]
    return found


def _gap_rows(which: str, group: GroupResult) -> list[dict[str, Any]]:
    """Return the rows of a group's gap, a row a world: home, away, and home as described."""
    gap, seeds = group.gap, " ".join(str(seed.seed) for seed in group.seeds)
    rows = []
    for runs in gap.runs:
        row = {"group": group.name, "label": group.label, "policies": which, "seeds": seeds, **runs.summary()}
        row |= {"balanced": int(runs.balanced.sum()), "far": int((runs.distance > FAR).sum())}
        row |= {"least_distance": float(runs.distance.min())}
        over_runs, interval = Estimate.of([]), Interval(math.nan)
        if runs is not gap.home:
            over_runs, interval = gap.gap_over_runs(runs.world), gap.interval(runs.world)
        row |= {"gap": over_runs.mean, "gap_error": over_runs.error, "gap_low": interval.low, "gap_high": interval.high}
        rows.append(row)
    return rows


def _gap_difference_row(which: str, base: GroupResult, other: GroupResult) -> dict[str, Any]:
    over_runs, crossed, away = gap_difference(base.gap, other.gap)
    row: dict[str, Any] = {"policies": which, "group": other.name, "against": base.name}
    row |= {"difference": over_runs.mean, "error": over_runs.error}
    return row | crossed.columns("interval_difference") | away.columns("away_difference")
