"""Groups of trained policies side by side: their figures with intervals over seeds, their differences, as tables."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.errors import SurefootError
from surefoot.evaluate.sensitivity import Sensitivity, write_csv, write_episodes_csv
from surefoot.evaluate.statistics import CONFIDENCE, Interval, t_interval, welch_interval
from surefoot.evaluate.study import KINDS, Figure, Result, sensitivity_of
from surefoot.files import whole_file

Array = NDArray[np.float64]
_WORLDS = {"sensitivity.csv": write_csv, "sensitivity_episodes.csv": write_episodes_csv}


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

    @classmethod
    def of_rows(cls, rows: Sequence[dict[str, Any]]) -> Curve:
        """The curve of a run's log."""

        def column(name: str) -> Array:
            return np.array([math.nan if row[name] is None else row[name] for row in rows], np.float64)

        episodes = column("episodes")
        falls = np.divide(100 * column("falls"), episodes, out=np.full(len(rows), math.nan), where=episodes > 0)
        return cls(column("steps"), column("return_mean"), column("speed_mean"), falls)

    def binned(self, name: str, edges: ArrayLike) -> Array:
        """Means of one quantity between steps `edges` (B + 1,), each with its upper end; NaN where nothing is known."""
        values, bounds = getattr(self, name), np.asarray(edges, np.float64)
        known = np.isfinite(values)
        place = np.searchsorted(bounds, self.steps[known], side="left")
        count = np.bincount(place, minlength=len(bounds) + 1)[1 : len(bounds)]
        total = np.bincount(place, values[known], minlength=len(bounds) + 1)[1 : len(bounds)]
        return np.divide(total, count, out=np.full(len(count), math.nan), where=count > 0)

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

    @property
    def figures(self) -> dict[str, float]:
        """What the evaluations came to, by name."""
        return {one.name: one.read(result) for kind, result in self.results.items() for one in KINDS[kind].figures}


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

    @property
    def sensitivities(self) -> list[Sensitivity]:
        """Test worlds of every seed; empty where the study has none."""
        return [
            sensitivity_of(seed.results["sensitivity"], f"{self.label}, seed {seed.seed}")
            for seed in self.seeds
            if "sensitivity" in seed.results
        ]


@dataclass(frozen=True)
class Comparison:
    """Groups side by side.

    Raises:
        SurefootError: no groups, or one without seeds.
    """

    name: str
    """Name of the study."""
    kinds: tuple[str, ...]
    """Kinds of evaluation that every policy has."""
    groups: tuple[GroupResult, ...]
    """The groups, each with one policy or more."""
    pairs: tuple[tuple[str, str], ...] = ()
    """Names of groups whose difference is told, the second against the first."""
    missing: tuple[str, ...] = field(default=())
    """Runs of the study that are not in it."""

    def __post_init__(self) -> None:
        """Refuse what can't be compared."""
        if not self.groups or not all(group.seeds for group in self.groups):
            raise SurefootError("nothing to compare: a study's report needs one evaluated policy in a group or more")

    @property
    def figures(self) -> tuple[Figure, ...]:
        """The numbers that are compared."""
        return tuple(figure for kind in self.kinds for figure in KINDS[kind].figures)

    def present_pairs(self) -> list[tuple[GroupResult, GroupResult]]:
        """Pairs of which both groups have policies."""
        by_name = {group.name: group for group in self.groups}
        return [(by_name[a], by_name[b]) for a, b in self.pairs if a in by_name and b in by_name]


def difference(base: GroupResult, other: GroupResult, figure: str) -> Interval:
    """A figure's mean over the seeds of `other` less that of `base`, with Welch's interval."""
    return welch_interval(other.values(figure), base.values(figure))


def write_tables(comparison: Comparison, folder: Path) -> list[Path]:
    """Write runs.csv, groups.csv, differences.csv, episodes.csv, summary.json and what the test worlds came to.

    Returns:
        the paths.
    """
    figures = comparison.figures
    runs = [
        [group.name, seed.seed, seed.steps, f"{seed.seconds:.1f}", *(f"{seed.figures[f.name]:.6f}" for f in figures)]
        for group in comparison.groups
        for seed in group.seeds
    ]
    groups = [
        [group.name, group.label, figure.name, figure.unit, len(group.seeds), *_ends(group.interval(figure.name))]
        for group in comparison.groups
        for figure in figures
    ]
    differences = [
        [other.name, base.name, figure.name, figure.unit, *_ends(difference(base, other, figure.name))]
        for base, other in comparison.present_pairs()
        for figure in figures
    ]
    episodes = [
        [group.name, seed.seed, kind, number, f"{gained:.6f}", f"{speed:.6f}", int(fell)]
        for group in comparison.groups
        for seed in group.seeds
        for kind, result in seed.results.items()
        if kind != "sensitivity"
        for number, (gained, speed, fell) in enumerate(
            zip(result["returns"], result["speed"], result["fell"], strict=True)
        )
    ]
    names = [figure.name for figure in figures]
    tested = [one for group in comparison.groups for one in group.sensitivities]
    worlds = [write(folder / name, tested) for name, write in _WORLDS.items()] if tested else []
    return [
        *worlds,
        _write_csv(folder / "runs.csv", ",".join(["group,seed,steps,training_seconds", *names]), runs),
        _write_csv(folder / "groups.csv", "group,label,figure,unit,seeds,mean,low,high", groups),
        _write_csv(folder / "differences.csv", "group,against,figure,unit,difference,low,high", differences),
        _write_csv(folder / "episodes.csv", "group,seed,kind,episode,return,speed,fell", episodes),
        _write(folder / "summary.json", json.dumps(_summary(comparison), indent=2, allow_nan=False) + "\n"),
    ]


def _summary(comparison: Comparison) -> dict[str, Any]:
    """Everything that the report tells, for programs."""
    return {
        "study": comparison.name,
        "confidence": CONFIDENCE,
        "evaluations": {
            kind: {"what": KINDS[kind].what, "settings": KINDS[kind].settings} for kind in comparison.kinds
        },
        "groups": {
            group.name: {
                "label": group.label,
                "seeds": [seed.seed for seed in group.seeds],
                "steps": [seed.steps for seed in group.seeds],
                "training_seconds": [round(seed.seconds, 1) for seed in group.seeds],
                "figures": {f.name: _table(group.interval(f.name)) | {"unit": f.unit} for f in comparison.figures},
            }
            for group in comparison.groups
        },
        "differences": [
            {
                "group": other.name,
                "against": base.name,
                "figures": {f.name: _table(difference(base, other, f.name)) for f in comparison.figures},
            }
            for base, other in comparison.present_pairs()
        ],
        "missing": list(comparison.missing),
    }


def _table(interval: Interval) -> dict[str, Any]:
    ends = [value if math.isfinite(value) else None for value in (interval.low, interval.high)]
    return {"mean": interval.mean, "low": ends[0], "high": ends[1]}


def _ends(interval: Interval) -> list[str]:
    numbers = (interval.mean, interval.low, interval.high)
    return [f"{number:.6f}" if math.isfinite(number) else "" for number in numbers]


def _write_csv(path: Path, header: str, lines: Sequence[Sequence[object]]) -> Path:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header.split(","))
    writer.writerows(lines)
    return _write(path, text.getvalue())


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        file.write(text.encode())
    return path
