"""Tables of a comparison, for other programs and for whoever wants to look closer."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

from surefoot.evaluate.comparison import Comparison, difference
from surefoot.evaluate.gap_group_tables import gap_summary, write_gap_tables
from surefoot.evaluate.kinds import KINDS
from surefoot.evaluate.sensitivity_tables import write_csv, write_episodes_csv
from surefoot.evaluate.statistics import CONFIDENCE, Interval
from surefoot.files import whole_file, write_table

_OWN_TABLES = ("sensitivity", "gap")
"""Kinds of evaluation whose episodes are in tables of their own."""
_WORLDS = {"sensitivity.csv": write_csv, "sensitivity_episodes.csv": write_episodes_csv}


def write_tables(comparison: Comparison, folder: Path) -> list[Path]:
    """Write runs.csv, groups.csv, differences.csv, episodes.csv, summary.json, and what test worlds and gaps came to.

    Returns:
        the paths.
    """
    figures = comparison.figures
    runs = [
        [group.name, seed.seed, seed.steps, f"{seed.seconds:.1f}", "" if seed.best is None else seed.best]
        + [f"{seed.figures[f.name]:.6f}" for f in figures]
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
        if kind not in _OWN_TABLES
        for number, (gained, speed, fell) in enumerate(
            zip(result["returns"], result["speed"], result["fell"], strict=True)
        )
    ]
    names = [figure.name for figure in figures]
    tested = [one for group in comparison.groups for one in group.sensitivities]
    worlds = [write(folder / name, tested) for name, write in _WORLDS.items()] if tested else []
    gaps = write_gap_tables(comparison, folder) if "gap" in comparison.kinds else []
    return [
        *worlds,
        *gaps,
        write_table(folder / "runs.csv", ",".join(["group,seed,steps,training_seconds,best_steps", *names]), runs),
        write_table(folder / "groups.csv", "group,label,figure,unit,seeds,mean,low,high", groups),
        write_table(folder / "differences.csv", "group,against,figure,unit,difference,low,high", differences),
        write_table(folder / "episodes.csv", "group,seed,kind,episode,return,speed,fell", episodes),
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
        **({"gap": gap_summary(comparison)} if "gap" in comparison.kinds else {}),
        "missing": list(comparison.missing),
    }


def _table(interval: Interval) -> dict[str, Any]:
    ends = [value if math.isfinite(value) else None for value in (interval.low, interval.high)]
    return {"mean": interval.mean, "low": ends[0], "high": ends[1]}


def _ends(interval: Interval) -> list[str]:
    numbers = (interval.mean, interval.low, interval.high)
    return [f"{number:.6f}" if math.isfinite(number) else "" for number in numbers]


def _write(path: Path, text: str) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        file.write(text.encode())
    return path
