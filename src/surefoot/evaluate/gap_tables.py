"""What a measurement of the reality gap came to, as tables: one line a policy and world, or one line a run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surefoot.evaluate.gap import PolicyGap, Runs, known
from surefoot.files import write_table


def write_csv(path: str | Path, policies: Sequence[PolicyGap]) -> Path:
    """Write one line for each policy and world; returns the path.

    Columns: policy, world, side (`home` or `away`), runs, return_mean [m], return_error [m], speed_mean [m/s],
    power_mean [W], distance_mean [m], falls, success_rate (0 to 1), gap [m], gap_error [m]. Errors are standard
    errors; what is not known is empty, and so is the gap at home.
    """
    header = "policy,world,side,runs,return_mean,return_error,speed_mean,power_mean,distance_mean,falls,success_rate"
    lines = []
    for policy in policies:
        for runs in (policy.home, *policy.away):
            row = summary(policy, runs)
            numbers = [row[name] for name in ("return_mean", "return_error", "speed_mean", "power_mean")]
            numbers.append(row["distance_mean"])
            gap = [row.get("gap"), row.get("gap_error")]
            lines.append(
                [
                    *(policy.name, runs.world, row["side"], row["runs"]),
                    *map(text, numbers),
                    *(row["falls"], text(row["success_rate"])),
                    *map(text, gap),
                ]
            )
    return write_table(path, f"{header},gap,gap_error", lines)


def write_runs_csv(
    path: str | Path, policies: Sequence[PolicyGap], files: Mapping[tuple[str, str], Sequence[Path]]
) -> Path:
    """Write one line for each run; returns the path.

    Columns: policy, world, run, return [m], speed [m/s], power [W], distance [m], steps, fell (0 or 1), balanced (0
    or 1: kept its balance to the end), trace (the run's file). What is not known is empty.

    Args:
        path: the file.
        policies: what was measured.
        files: traces of the runs, by names of policy and world.
    """
    lines: list[list[object]] = []
    for policy in policies:
        for runs in (policy.home, *policy.away):
            for i, file in enumerate(files[policy.name, runs.world]):
                numbers = (runs.returns[i], runs.speed[i], runs.power[i], runs.distance[i])
                flags = (int(runs.fell[i]), int(runs.balanced[i]))
                lines.append([policy.name, runs.world, i, *map(text, numbers), int(runs.steps[i]), *flags, file])
    return write_table(path, "policy,world,run,return,speed,power,distance,steps,fell,balanced,trace", lines)


def summary(policy: PolicyGap, runs: Runs) -> dict[str, Any]:
    """What the runs of one policy in one of its worlds came to, as JSON holds it; what is not known is None.

    Args:
        policy: says which of its worlds is home, and what the gap is.
        runs: those at home, or in one of the other worlds.
    """
    gained = runs.estimate("returns")
    row = {
        "world": runs.world,
        "side": "home" if runs is policy.home else "away",
        "runs": len(runs),
        "return_mean": known(gained.mean),
        "return_error": known(gained.error),
        "speed_mean": known(runs.estimate("speed").mean),
        "power_mean": known(runs.estimate("power").mean),
        "distance_mean": known(runs.estimate("distance").mean),
        "falls": int(runs.fell.sum()),
        "success_rate": runs.success_rate,
    }
    if runs is policy.home:
        return row
    gap = policy.gap(runs.world)
    return row | {"gap": known(gap.mean), "gap_error": known(gap.error)}


def text(value: float | None) -> str:
    """A number for a table; empty where it is not known."""
    return "" if value is None or not math.isfinite(value) else f"{value:.6f}"
