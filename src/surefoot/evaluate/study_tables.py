"""The tables of a study: one list of rows each, for CSV files, for programs and for the report."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from surefoot.evaluate.comparison import Comparison, GroupResult, difference
from surefoot.evaluate.evaluations import EVALUATIONS
from surefoot.evaluate.gap import gap_difference
from surefoot.evaluate.runs import Estimate
from surefoot.evaluate.statistics import CONFIDENCE, Interval
from surefoot.files import whole_file
from surefoot.tables import Rows, plain_value, write_csv

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
            | _interval("difference", difference(base, other, figure.name))
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
        **{name: _plain(rows) for name, rows in tables.items() if name != "episodes"},
    }
    with whole_file(folder / "summary.json") as file:
        file.write((json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())
    return [*files, folder / "summary.json"]


def _plain(rows: Rows) -> list[dict[str, object]]:
    return [{name: plain_value(value) for name, value in row.items()} for row in rows]


def _interval(name: str, interval: Interval) -> dict[str, float]:
    return {name: interval.mean, f"{name}_low": interval.low, f"{name}_high": interval.high}


def _policy_row(group: GroupResult, number: int) -> dict[str, Any]:
    seed = group.seeds[number]
    row = {"group": group.name, "seed": seed.seed, "steps": seed.steps, "training_seconds": round(seed.seconds, 1)}
    return row | {"best_steps": seed.best, **seed.figures}


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
    return row | _interval("interval_difference", crossed) | _interval("away_difference", away)
