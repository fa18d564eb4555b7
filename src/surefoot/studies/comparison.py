"""Groups of trained policies side by side: their figures with intervals over seeds, their differences, all tables."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.evaluate.gap import PolicyGap, gap_difference
from surefoot.evaluate.runs import summarize_runs
from surefoot.evaluate.sensitivity import Sensitivity
from surefoot.evaluate.statistics import CONFIDENCE, Interval, MeanEstimate, t_interval, welch_interval
from surefoot.files import atomic_write
from surefoot.studies.evaluations import EVALUATIONS, Result, ResultFigure, evaluation_names, gap_from_result
from surefoot.studies.study_config import StudyConfig
from surefoot.tables import plain_rows, write_csv

FAR = 3.0
"""A run goes far over this [m]; the paper counts such runs among nine on the robot."""
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
_EPISODE_COLUMNS = (
    *("group", "seed", "evaluation", "world", "row", "value", "run", "return", "speed", "fell"),
    *("distance", "power", "steps", "balanced"),
)


def learning_curve(rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """Return the curve of a training's log, an update a row.

    Returns:
        control steps so far, mean return [m] and speed [m/s] of the episodes that ended, the share that fell [%] (NaN
        where none ended), and how many ended (`episodes`).
    """
    log = pd.DataFrame(rows, columns=["steps", "return_mean", "speed_mean", "falls", "episodes"]).astype(np.float64)
    log["falls"] *= 100 / log.episodes.where(log.episodes > 0)
    return log.rename(columns={"return_mean": "return", "speed_mean": "speed"})


def bin_curve(curve: pd.DataFrame, name: str, edges: ArrayLike) -> Array:
    """Return means of a column between steps `edges` (B + 1,), each with its upper end; NaN where no episode ended.

    Each update counts by its episodes: in most updates only the falls end, and all the others end together.
    """
    ended = curve[np.isfinite(curve[name]) & (curve.episodes > 0)]
    bins = pd.cut(ended.steps, np.asarray(edges))
    total, weight = (x.groupby(bins, observed=False).sum() for x in (ended[name] * ended.episodes, ended.episodes))
    return np.asarray(total / weight.where(weight > 0), np.float64)


def late_gain(curve: pd.DataFrame) -> float:
    """Return mean return in the last fifth of a training less that in the fifth before [m]; NaN without episodes."""
    before, last = bin_curve(curve, "return", np.array([0.6, 0.8, 1.0]) * curve.steps.max())
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
    curve: pd.DataFrame
    """Its `learning_curve`."""
    results: dict[str, Result]
    """Result of each kind of evaluation."""
    best: int | None = None
    """Control steps after which the policy was the one that is evaluated, the best of its training; None if unknown."""
    policy: Path | None = None
    """Its file; needed for kind `gait`, which stores an episode beside it."""

    @cached_property
    def figures(self) -> dict[str, float]:
        """Figures of the evaluations, by name."""
        parts = [EVALUATIONS[kind].read_figures(result) for kind, result in self.results.items()]
        return {name: value for part in parts for name, value in part.items()}


@dataclass(frozen=True)
class GroupResult:
    """Policies whose trainings differ in the seed alone."""

    name: str
    """Name of the group."""
    label: str
    """What figures and tables call it."""
    seeds: tuple[SeedResult, ...]
    """Its policies."""

    def values(self, figure: str) -> Array:
        """Return a figure of every seed (S,)."""
        return np.array([seed.figures[figure] for seed in self.seeds])

    def interval(self, figure: str) -> Interval:
        """Return a figure's mean over seeds with its interval."""
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
        parts = [gap_from_result(seed.results["gap"], f"{self.label}, seed {seed.seed}") for seed in self.seeds]
        return PolicyGap.pooled(self.label, parts)

    def best(self, count: int) -> GroupResult:
        """Return the group with the policies of the highest return in their own simulator alone, best first.

        They are selected by other episodes than those that measure the gap.
        """
        seeds = sorted(self.seeds, key=lambda seed: seed.figures["nominal_return"], reverse=True)
        return replace(self, seeds=tuple(seeds[:count]))


@dataclass(frozen=True)
class Comparison:
    """The groups of a study side by side."""

    study: StudyConfig
    """The study."""
    groups: tuple[GroupResult, ...]
    """Its groups with one policy or more."""
    missing: tuple[str, ...] = ()
    """Names of its trainings that are not in it."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of evaluation that every policy has."""
        return evaluation_names(self.study.evaluate)

    @property
    def figures(self) -> tuple[ResultFigure, ...]:
        """The numbers that are compared."""
        return tuple(figure for kind in self.kinds for figure in EVALUATIONS[kind].figures)

    def best(self) -> Comparison:
        """Return the comparison with the `top` policies of each group alone."""
        return replace(self, groups=tuple(group.best(self.study.top) for group in self.groups))

    def present_pairs(self) -> list[tuple[GroupResult, GroupResult]]:
        """Return the pairs of which both groups have policies."""
        by_name = {group.name: group for group in self.groups}
        return [(by_name[a], by_name[b]) for a, b in self.study.pairs if a in by_name and b in by_name]

    def sets(self) -> list[tuple[str, tuple[GroupResult, ...]]]:
        """Return the groups of each set of bars, and those in no set as `others`; all as `groups` without sets."""
        bars = {name: set(groups) for name, groups in self.study.bars.items()}
        bars["others" if bars else "groups"] = {one.name for one in self.groups}.difference(*bars.values())
        sets = [(name, tuple(one for one in self.groups if one.name in names)) for name, names in bars.items()]
        return [(name, groups) for name, groups in sets if groups]

    def finding(self, names: Iterable[str]) -> str:
        """Return the published results on the same groups; empty if there are none."""
        return " ".join(one.text for one in self.study.findings if set(one.groups) == set(names))


def difference(base: GroupResult, other: GroupResult, figure: str) -> Interval:
    """Return a figure's mean over the seeds of `other` less that of `base`, with Welch's interval."""
    return welch_interval(other.values(figure), base.values(figure))


def study_tables(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return the tables of a study by name; those on test worlds and gaps only where the study has them."""
    groups = comparison.groups
    tables: dict[str, Any] = {
        "policies": [_policy_row(group, seed) for group in groups for seed in group.seeds],
        "groups": [
            {"group": group.name, "label": group.label, "figure": figure.name, "unit": figure.unit}
            | {"seeds": len(group.seeds), **vars(group.interval(figure.name))}
            for group in groups
            for figure in comparison.figures
        ],
        "differences": [
            {"group": other.name, "against": base.name, "figure": figure.name, "unit": figure.unit}
            | difference(base, other, figure.name).columns("difference")
            for base, other in comparison.present_pairs()
            for figure in comparison.figures
        ],
        "episodes": _episodes(groups),
    }
    if tested := [one for group in groups for one in group.sensitivities]:
        tables["sensitivity"] = pd.concat([one.worlds.assign(policy=one.policy) for one in tested])
        tables["sensitivity"] = tables["sensitivity"].set_index("policy").reset_index()
    if "gap" in comparison.kinds:
        parts = {"top": comparison.best(), "all": comparison}
        tables["gap_groups"] = [
            row
            for number in range(len(groups))
            for which, part in parts.items()
            for row in _gap_rows(which, part.groups[number])
        ]
        tables["gap_differences"] = [
            _gap_difference_row(which, base, other)
            for which, part in parts.items()
            for base, other in part.present_pairs()
        ]
    return {name: pd.DataFrame(table) for name, table in tables.items()}


def write_tables(comparison: Comparison, tables: Mapping[str, pd.DataFrame], folder: Path) -> list[Path]:
    """Write each table as CSV, and summary.json with all but the episodes; return the paths."""
    files = [write_csv(folder / f"{name}.csv", table) for name, table in tables.items() if len(table)]
    summary = {
        "study": comparison.study.name,
        "confidence": CONFIDENCE,
        "evaluations": {
            name: {"what": EVALUATIONS[name].what, "settings": EVALUATIONS[name].settings} for name in comparison.kinds
        },
        "missing": list(comparison.missing),
        **{name: plain_rows(table) for name, table in tables.items() if name != "episodes"},
    }
    atomic_write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return [*files, folder / "summary.json"]


def _policy_row(group: GroupResult, seed: SeedResult) -> dict[str, Any]:
    row = {"group": group.name, "seed": seed.seed, "steps": seed.steps, "training_seconds": round(seed.seconds, 1)}
    gait = {name: seed.results["gait"][name] for name in ("gait", "pattern")} if "gait" in seed.results else {}
    return row | {"best_steps": seed.best, **seed.figures, **gait}


def _episodes(groups: Sequence[GroupResult]) -> pd.DataFrame:
    """Return a row for each episode; kind `gait` measures none."""
    tables = []
    for group in groups:
        for seed in group.seeds:
            for kind, result in seed.results.items():
                if columns := result.get("runs") or result.get("episodes"):
                    about = {"group": group.name, "seed": seed.seed, "evaluation": kind}
                    world = {"world": EVALUATIONS[kind].world_names[0]} | columns
                    tables.append(pd.DataFrame(about | world).reindex(columns=_EPISODE_COLUMNS))
    return pd.concat(tables)


def _gap_rows(which: str, group: GroupResult) -> list[dict[str, Any]]:
    """Return the rows of a group's gap, a row a world: home, away, and home as described."""
    gap, seeds = group.gap, " ".join(str(seed.seed) for seed in group.seeds)
    rows = []
    for number, world in enumerate(gap.worlds):
        runs = gap.in_world(world)
        row = {"group": group.name, "label": group.label, "policies": which, "seeds": seeds, **summarize_runs(runs)}
        row |= {"balanced": int(runs.balanced.sum()), "far": int((runs.distance > FAR).sum())}
        row |= {"least_distance": float(runs.distance.min())}
        over_runs, interval = MeanEstimate(), Interval(math.nan)
        if number:
            over_runs, interval = gap.gap_over_runs(world), gap.interval(world)
        row |= {"gap": over_runs.mean, "gap_error": over_runs.error, "gap_low": interval.low, "gap_high": interval.high}
        rows.append(row)
    return rows


def _gap_difference_row(which: str, base: GroupResult, other: GroupResult) -> dict[str, Any]:
    over_runs, crossed, away = gap_difference(base.gap, other.gap)
    row: dict[str, Any] = {"policies": which, "group": other.name, "against": base.name}
    row |= {"difference": over_runs.mean, "error": over_runs.error}
    return row | crossed.columns("interval_difference") | away.columns("away_difference")
