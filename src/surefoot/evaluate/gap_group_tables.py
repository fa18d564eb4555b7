"""Tables of groups' reality gaps: one line a group, one line a pair of groups, and one line a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from surefoot.evaluate.comparison import Comparison
from surefoot.evaluate.gap import Estimate
from surefoot.evaluate.gap_groups import (
    FAR,
    MEASURES,
    GroupGap,
    estimate_mapping,
    gap_difference,
    gap_groups,
    gap_mapping,
    interval_mapping,
)
from surefoot.evaluate.gap_tables import text
from surefoot.files import write_table

_RUN = ("returns", "distance", "speed", "power")
_PARTS = ("home", "described", "away")
"""At home, there with the robot as its data sheet describes it, and in the other world."""


def write_gap_tables(comparison: Comparison, folder: Path) -> list[Path]:
    """Write gap_groups.csv and gap_differences.csv, with the top policies and with all of them, and gap_runs.csv.

    Units are those of `MEASURES`; `error` is a standard error over runs, `low` and `high` are the ends of an interval
    over policies and robots. What is not known is empty.

    Returns:
        the paths.
    """
    best, every = _parts(comparison).values()
    measured = [f"{world}_{name}{end}" for world in _PARTS for name in MEASURES for end in ("", "_error")]
    header = ["group", "label", "policies", "seeds", "runs", *measured, "gap", "gap_error"]
    header += ["interval_gap", "interval_low", "interval_high", *(f"{part}_balanced" for part in _PARTS), "away_far"]
    header += ["away_least_distance"]
    groups = [_group_row(which, group) for name in best for which, group in (("top", best[name]), ("all", every[name]))]
    differences = [
        [
            which,
            other.name,
            base.name,
            *_numbers(change.runs),
            *map(text, (*vars(change.crossed).values(), *vars(change.away).values())),
        ]
        for which, found in (("top", best), ("all", every))
        for one, two in comparison.present_pairs()
        for base, other in [(found[one.name], found[two.name])]
        for change in [gap_difference(base, other)]
    ]
    runs = [
        [group.name, seed, int(seed in best[group.name].seeds), part, world.world, run]
        + [text(getattr(world, name)[run]) for name in _RUN]
        + [int(world.steps[run]), int(world.balanced[run]), int(world.distance[run] > FAR)]
        for group in every.values()
        for seed, policy in zip(group.seeds, group.policies, strict=True)
        for part, world in (("home", policy.home), ("described", policy.away[1]), ("away", policy.away[0]))
        for run in range(len(world))
    ]
    changed = "policies,group,against,difference,error,interval_difference,interval_low,interval_high"
    changed += ",away_difference,away_low,away_high"
    columns = "group,seed,top,part,world,run,return,distance,speed,power,steps,balanced,far"
    return [
        write_table(folder / "gap_groups.csv", ",".join(header), groups),
        write_table(folder / "gap_differences.csv", changed, differences),
        write_table(folder / "gap_runs.csv", columns, runs),
    ]


def gap_summary(comparison: Comparison) -> dict[str, Any]:
    """Everything that the report tells of gaps, for programs: of the top policies and of all."""
    return {
        which: {
            "groups": {name: gap_mapping(group) for name, group in groups.items()},
            "differences": [
                {
                    "group": two.name,
                    "against": one.name,
                    "runs": estimate_mapping(change.runs),
                    "interval": interval_mapping(change.crossed),
                    "away": interval_mapping(change.away),
                }
                for one, two in comparison.present_pairs()
                for change in [gap_difference(groups[one.name], groups[two.name])]
            ],
        }
        for which, groups in _parts(comparison).items()
    }


def _parts(comparison: Comparison) -> dict[str, dict[str, GroupGap]]:
    return {"top": gap_groups(comparison, comparison.top), "all": gap_groups(comparison)}


def _group_row(which: str, group: GroupGap) -> list[object]:
    home, away = group.home, group.away
    row: list[object] = [group.name, group.label, which, " ".join(map(str, group.seeds)), len(away)]
    for runs in (home, group.described, away):
        for name in MEASURES:
            row += _numbers(runs.estimate(name))
    row += [*_numbers(group.gap), *map(text, vars(group.interval).values())]
    row += [*(int(runs.balanced.sum()) for runs in (home, group.described, away)), group.far]
    return [*row, text(away.distance.min())]


def _numbers(estimate: Estimate) -> list[str]:
    return [text(estimate.mean), text(estimate.error)]
