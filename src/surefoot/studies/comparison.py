"""Comparison of groups of trained policies: metrics with confidence intervals over seeds, differences, and tables."""

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

from surefoot.arrays import Array
from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.runs import summarize_runs
from surefoot.evaluation.sensitivity import Sensitivity
from surefoot.evaluation.statistics import (
    CONFIDENCE,
    Interval,
    MeanEstimate,
    crossed_interval,
    difference_interval,
    holm,
    policies_proportion,
    proportion_difference,
    t_interval,
)
from surefoot.files import atomic_write
from surefoot.report.figures.learning import bin_curve, learning_curve
from surefoot.studies.evaluations import EVALUATIONS, Result, ResultMetric, evaluation_names, find_gap, gap_from_result
from surefoot.studies.study_config import OTHERS, StudyConfig, return_unit
from surefoot.tables import plain_rows, write_csv

FAR_DISTANCE = 3.0
"""Distance from which a run counts as far [m]; the paper reports how many of nine runs on the robot were."""
CONTENTS = {
    "policies": "one row per trained policy",
    "groups": "one row per group and metric, with its interval",
    "differences": "one row per pair of groups and metric: difference, interval, p, and p after Holm's correction",
    "episodes": "one row per episode of all evaluations",
    "effects": "one row per main effect and metric: mean difference, interval, and p without correction",
    "sensitivity": "one row per policy and test world",
    "gap_groups": "one row per group and world, for all policies and for the best (`top`): means, errors, intervals",
    "top_differences": "differences.csv for the best policies, metrics of the reality gap",
    "gaits": "one row per policy: gait, stride period [s] and duty factor",
}
"""Description of each table."""
_EPISODE_COLUMNS = (
    *("group", "seed", "evaluation", "world", "row", "value", "run", "return", "speed", "fell"),
    *("distance", "power", "steps", "balanced"),
)
_GAIT_COLUMNS = ("gait", "agree", "pattern", "reason", "stride", "duty")


def late_gain(curve: pd.DataFrame) -> float:
    """Return the gain in mean return from the fourth to the last fifth of a training [m]; NaN without episodes."""
    before, last = bin_curve(curve, "return", np.array([0.6, 0.8, 1.0]) * curve.steps.max())
    return float(last - before)


def policy_row(group: str, seed: int, log: Sequence[dict[str, Any]], results: dict[str, Result]) -> dict[str, Any]:
    """Return the row of a trained policy in `Comparison.policies`, from its training log and its evaluations."""
    metrics = [EVALUATIONS[kind].read_metrics(result) for kind, result in results.items()]
    gait = {name: results["gait"][name] for name in ("gait", "pattern")} if "gait" in results else {}
    row = {"group": group, "seed": seed, "steps": log[-1]["steps"], "training_seconds": round(log[-1]["seconds"], 1)}
    row |= {"best_steps": None, **{name: value for part in metrics for name, value in part.items()}, **gait}
    curve = learning_curve(log)
    return row | {"late_gain": late_gain(curve), "results": results, "curve": curve, "policy": None}


@dataclass(frozen=True)
class Comparison:
    """Comparison of the groups of a study."""

    study: StudyConfig
    policies: pd.DataFrame
    """One row per trained policy: group, seed, control steps and duration of its training, steps after which it was
    best, metrics of its evaluations by name, gait and pattern. In addition `results` of its evaluations by kind, its
    learning `curve` and its `policy` file, next to which the evaluation `gait` stores an episode."""
    missing: tuple[str, ...] = ()
    """Names of the study's trainings that are missing in the comparison."""

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of evaluation that every policy has."""
        return evaluation_names(self.study.evaluate)

    @property
    def gap_kind(self) -> str:
        """Kind of evaluation that measures the reality gap; empty if there is none."""
        return find_gap(self.kinds)

    @cached_property
    def return_unit(self) -> str:
        """Unit of returns: m, or empty if a group's reward has terms of other units."""
        return return_unit(self.study)

    @property
    def metrics(self) -> tuple[ResultMetric, ...]:
        """Metrics that are compared."""
        return tuple(metric for kind in self.kinds for metric in self.metrics_of(kind))

    def metrics_of(self, kind: str) -> tuple[ResultMetric, ...]:
        """Return the metrics of a kind of evaluation."""
        metrics = EVALUATIONS[kind].metrics
        return tuple(replace(one, unit=self.return_unit) if one.is_return else one for one in metrics)

    @property
    def primary(self) -> ResultMetric:
        """Primary metric of the study."""
        return next(metric for metric in self.metrics if metric.name == self.study.primary)

    @property
    def groups(self) -> list[str]:
        """Names of the groups that have policies."""
        return list(self.policies.group.unique())

    def select_group(self, group: str) -> pd.DataFrame:
        """Return the policies of a group."""
        return self.policies[self.policies.group == group]

    def best(self) -> Comparison:
        """Return the comparison of the `top` policies of each group, by nominal return in the training simulator.

        The episodes that select them are independent of those that measure the gap.
        """
        ranked = self.policies.sort_values("nominal_return", ascending=False, kind="stable")
        return replace(self, policies=pd.concat([ranked[ranked.group == g][: self.study.top] for g in self.groups]))

    def interval(self, group: str, metric: ResultMetric) -> Interval:
        """Return the mean of a metric over a group, with its interval over seeds and, if it has several, robots."""
        values, trials = self._values(group, metric), self._trials(group, metric)
        if trials:
            full = metric.full_scale(trials)
            return policies_proportion(values / full, trials).scale(full)
        return crossed_interval(values) if values.ndim == 2 else t_interval(values)

    def difference(self, group: str, base: str, metric: ResultMetric) -> Interval:
        """Return the difference of a metric's means, `group` minus `base`, with its interval."""
        if self._trials(group, metric):
            return proportion_difference(self.interval(group, metric), self.interval(base, metric))
        return difference_interval((self._values(group, metric), self._values(base, metric)))

    def effect(self, name: str, metric: ResultMetric) -> Interval | None:
        """Return a main effect of the study on a metric that is a mean; None for a metric that is a percentage."""
        pairs = self.study.effects[name]
        if self._trials(pairs[0][0], metric):
            return None
        return difference_interval(
            *((self._values(group, metric), self._values(base, metric)) for base, group in pairs)
        )

    def _values(self, group: str, metric: ResultMetric) -> Array:
        """Return a metric of each policy of a group (P,), or of each of its runs (P, R)."""
        kind = self._kind(metric)
        read = EVALUATIONS[kind].read_runs
        return np.array([read(results[kind])[metric.name] for results in self.select_group(group).results])

    def _trials(self, group: str, metric: ResultMetric) -> int:
        return metric.count_trials(self.select_group(group).results.iloc[0][self._kind(metric)])

    def _kind(self, metric: ResultMetric) -> str:
        """Return the kind of evaluation that measures a metric."""
        return next(kind for kind in self.kinds if metric.name in [one.name for one in EVALUATIONS[kind].metrics])

    def sensitivities(self, group: str) -> list[Sensitivity]:
        """Return the sensitivity of each policy of a group."""
        rows = self.select_group(group).itertuples()
        return [Sensitivity.from_mapping(row.results["sensitivity"], self._name(row)) for row in rows]

    def gap(self, group: str) -> PolicyGap:
        """Return the runs of all policies of a group: in the training simulator, in the target world, and as described.

        "As described" is the training simulator's engine with the robot of the data sheet.
        """
        parts = [
            gap_from_result(row.results[self.gap_kind], self._name(row))
            for row in self.select_group(group).itertuples()
        ]
        return PolicyGap.pooled(self.study.label(group), parts)

    def _name(self, row: Any) -> str:
        return f"{self.study.label(row.group)}, seed {row.seed}"

    def present_effects(self) -> list[str]:
        """Return the names of the main effects whose groups all have policies."""
        return [name for name, pairs in self.study.effects.items() if set().union(*pairs) <= set(self.groups)]

    def present_pairs(self) -> list[tuple[str, str]]:
        """Return the pairs in which both groups have policies."""
        return [pair for pair in self.study.pairs if set(pair) <= set(self.groups)]

    def sets(self) -> dict[str, list[str]]:
        """Return the groups of each set of bars, and all other groups as `others`; without sets, all as `groups`."""
        bars = {name: set(groups) for name, groups in self.study.bars.items()}
        bars[OTHERS if bars else "groups"] = set(self.groups).difference(*bars.values())
        sets = {name: [group for group in self.groups if group in members] for name, members in bars.items()}
        return {name: groups for name, groups in sets.items() if groups}

    def finding(self, names: Iterable[str]) -> str:
        """Return the published findings about the same groups; empty if there are none."""
        return " ".join(one.text for one in self.study.findings if set(one.groups) == set(names))


def study_tables(comparison: Comparison) -> dict[str, pd.DataFrame]:
    """Return the tables of a study by name, see `CONTENTS`, as far as the study has the evaluations for them."""
    groups, policies = comparison.groups, comparison.policies
    tables: dict[str, Any] = {
        "policies": policies.drop(columns=["results", "curve", "policy"]),
        "groups": [
            {"group": group, "label": comparison.study.label(group), "figure": metric, "unit": unit}
            | {"seeds": len(comparison.select_group(group)), "mean": interval.mean}
            | {"low": interval.low, "high": interval.high}
            for group in groups
            for metric, unit, interval in [
                *((one.name, one.unit, comparison.interval(group, one)) for one in comparison.metrics),
                ("late_gain", comparison.return_unit, t_interval(comparison.select_group(group).late_gain)),
            ]
        ],
        "differences": _differences(comparison, comparison.metrics),
        "episodes": _episodes(policies),
    }
    if effects := _effects(comparison):
        tables["effects"] = effects
    if "sensitivity" in comparison.kinds:
        tested = [one for group in groups for one in comparison.sensitivities(group)]
        tables["sensitivity"] = pd.concat([one.worlds.assign(policy=one.policy) for one in tested])
        tables["sensitivity"] = tables["sensitivity"].set_index("policy").reset_index()
    if comparison.gap_kind:
        best = comparison.best()
        parts = {"all": comparison, "top": best}
        tables["gap_groups"] = [
            row for group in groups for which, part in parts.items() for row in _gap_rows(which, group, part)
        ]
        tables["top_differences"] = _differences(best, best.metrics_of(comparison.gap_kind))
    if "gait" in comparison.kinds:
        tables["gaits"] = [
            {"group": row.group, "seed": row.seed} | {name: row.results["gait"][name] for name in _GAIT_COLUMNS}
            for row in policies.itertuples()
        ]
    return {name: pd.DataFrame(table) for name, table in tables.items()}


def _effects(comparison: Comparison) -> list[dict[str, Any]]:
    """Return one row per main effect and metric, without the metrics that are percentages."""
    return [
        {"effect": name, "figure": metric.name, "unit": metric.unit, **interval.columns("difference"), "p": interval.p}
        for name in comparison.present_effects()
        for metric in comparison.metrics
        if (interval := comparison.effect(name, metric)) is not None
    ]


def _differences(comparison: Comparison, metrics: Sequence[ResultMetric]) -> pd.DataFrame:
    """Return one row per pair and metric; a metric's p values are adjusted for the number of pairs in the study."""
    rows = [
        {"group": other, "against": base, "figure": metric.name, "unit": metric.unit}
        | interval.columns("difference")
        | {"p": interval.p}
        for base, other in comparison.present_pairs()
        for metric in metrics
        for interval in [comparison.difference(other, base, metric)]
    ]
    table = pd.DataFrame(rows)
    if not rows:
        return table
    waiting = len(comparison.study.pairs) - len(comparison.present_pairs())
    # Pairs whose groups have no policies yet count in the correction.
    adjusted = table.groupby("figure").p.transform(lambda p: holm([*p, *[math.nan] * waiting])[: len(p)])
    return table.assign(p_holm=adjusted)


def write_tables(comparison: Comparison, tables: Mapping[str, pd.DataFrame], folder: Path) -> list[Path]:
    """Write each table as CSV, and summary.json with all but the episodes; return the paths."""
    files = [write_csv(folder / f"{name}.csv", table) for name, table in tables.items() if len(table)]
    summary = {
        "study": comparison.study.name,
        "confidence": CONFIDENCE,
        "evaluations": {
            name: {"what": EVALUATIONS[name].description, "settings": EVALUATIONS[name].settings}
            for name in comparison.kinds
        },
        "missing": list(comparison.missing),
        **{name: plain_rows(table) for name, table in tables.items() if name != "episodes"},
    }
    atomic_write(folder / "summary.json", json.dumps(summary, indent=2, allow_nan=False) + "\n")
    return [*files, folder / "summary.json"]


def _episodes(policies: pd.DataFrame) -> pd.DataFrame:
    """Return one row per episode; the evaluation `gait` has none."""
    tables = []
    for policy in policies.itertuples():
        for kind, result in policy.results.items():
            if columns := result.get("runs") or result.get("episodes"):
                about = {"group": policy.group, "seed": policy.seed, "evaluation": kind}
                world = {"world": EVALUATIONS[kind].world_names[0]} | columns
                tables.append(pd.DataFrame(about | world).reindex(columns=_EPISODE_COLUMNS))
    return pd.concat(tables)


def _gap_rows(which: str, group: str, comparison: Comparison) -> list[dict[str, Any]]:
    """Return the gap of a group, one row per world: training simulator, target world, simulator as described."""
    gap, seeds = comparison.gap(group), " ".join(map(str, comparison.select_group(group).seed))
    rows = []
    for number, world in enumerate(gap.worlds):
        runs, balanced = gap.in_world(world), gap.table(world, "balanced")
        row = {"group": group, "label": gap.name, "policies": which, "seeds": seeds, **summarize_runs(runs)}
        row |= crossed_interval(gap.table(world, "return")).columns("return")
        row |= policies_proportion(balanced, balanced.shape[1]).columns("balanced_share")
        row |= {"balanced": int(balanced.sum()), "far": int((runs.distance > FAR_DISTANCE).sum())}
        row |= {"least_distance": float(runs.distance.min())}
        over_runs = gap.gap_over_runs(world) if number else MeanEstimate()
        interval = crossed_interval(gap.gaps(world)) if number else Interval(math.nan)
        row |= {"gap": over_runs.mean, "gap_error": over_runs.error, "gap_low": interval.low, "gap_high": interval.high}
        rows.append(row)
    return rows
