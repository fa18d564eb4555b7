"""Handcrafted gaits beside learned ones: power, cost of transport and falls over speed (the paper's table III).

    python benchmarks/handcrafted.py results/handcrafted

Handcrafted gaits are the YAML files of the folder, from `surefoot tune`; learned ones the policies that ship, and its
ONNX files. Each runs in MuJoCo, in MuJoCo with table I drawn for every episode, and in Bullet. Runs are kept in
runs.csv; a second call makes only those that are missing, or whose gait has changed.
"""

from __future__ import annotations

import csv
import hashlib
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from surefoot.api.policies import find_policy, load_gait
from surefoot.cli.helpers.simulator import RunOptions
from surefoot.evaluation.footfalls import analyze_footfalls
from surefoot.evaluation.rollout import Policy, run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.statistics import t_interval
from surefoot.report.figures.runs import footfall_diagram
from surefoot.report.figures.style import COLORS, MARKERS, new_figure
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.studies.handcrafted import HandcraftedGait
from surefoot.tables import markdown, print_table, write_csv
from surefoot.task.config import TaskConfig
from surefoot.world.registry import find_world

SHIPPED = ("trot", "trot-robust", "gallop", "gallop-robust")
CONDITIONS = {"mujoco": ("mujoco", "none"), "table1": ("mujoco", "table1"), "bullet": ("bullet", "none")}
"""World and ranges of each condition."""
_TITLES = {"mujoco": "MuJoCo", "table1": "MuJoCo, table I drawn", "bullet": "Bullet"}
FAMILIES = ("foot trajectories", "foot trajectories, Raibert", "learned")
DURATION = 6.0
"""Of an episode [s]."""

_TOLD = """# Handcrafted gaits beside learned ones

`python benchmarks/handcrafted.py`: {episodes} episodes of 6 s each, seed {seed}; a row an episode in `runs.csv`, means
with intervals of 95 % over episodes in `table.csv`. The last two columns compare a learned gait with the cheapest
handcrafted ones without a fall in the same condition, on the straight line between a slower and a faster one."""


@dataclass(frozen=True)
class Command:
    """Run what is missing, print the table, draw the figure."""

    folder: Annotated[Path, tyro.conf.Positional] = Path("results/handcrafted")
    """Gaits, and results."""
    policies: tuple[str, ...] = SHIPPED
    """Learned gaits: names of policies that ship, or policy files."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Out of mujoco, table1 and bullet."""
    episodes: int = 20
    """Episodes in each."""
    seed: int = 1
    """The one seed."""
    threads: int = 0
    """Threads of the simulation; 0 means one a core."""
    missing: bool = True
    """Run what is missing; else report the results that exist."""
    draw: bool = False
    """Draw the footfalls of each gait's first episode in MuJoCo too."""


@dataclass(frozen=True)
class Entry:
    """A gait of the table."""

    name: str
    family: str
    path: Path

    @property
    def digest(self) -> str:
        """Of its file, short."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:12]

    def load(self) -> tuple[Policy, TaskConfig]:
        policy, _, task, _ = load_gait(self.path, None)
        return policy, task


def entries(folder: Path, policies: tuple[str, ...]) -> Iterable[Entry]:
    for path in sorted(folder.glob("*.yaml")):
        yield Entry(path.stem, FAMILIES[HandcraftedGait.load(path).raibert is not None], path)
    for path in [*map(find_policy, policies), *sorted(folder.glob("*.onnx"))]:
        yield Entry(path.stem, FAMILIES[2], path)


def run(entry: Entry, condition: str, command: Command) -> list[dict[str, Any]]:
    """Return a row for each episode of a gait."""
    world, ranges = CONDITIONS[condition]
    policy, task = entry.load()
    robot = RobotDescription.load(task.robot)
    steps = round(DURATION / float(task.nominal(robot).control_step[0]))
    task = RunOptions().apply(replace(task, max_steps=steps), robot, load_ranges(ranges))
    traces = run_episodes(policy, task, command.episodes, find_world(world), command.seed, command.threads)
    if command.draw and condition == "mujoco":
        footfall_diagram(traces[0], command.folder / f"{entry.name}-footfalls.png")
    key = {"gait": entry.name, "family": entry.family, "condition": condition, "digest": entry.digest}
    rows = measure_runs(traces).drop(columns="world").to_dict("records")
    feet = [analyze_footfalls(trace) for trace in traces]
    return [
        {**key, **row, "pattern": foot.pattern, "duty_factor": np.mean(list(foot.duty_factor.values()))}
        for row, foot in zip(rows, feet, strict=True)
    ]


def summary(rows: list[dict[str, Any]], weight: float) -> dict[str, Any]:
    """Return the row of a gait in a condition: means with intervals of 95 % over episodes."""
    speed, power = (t_interval([float(row[name]) for row in rows]) for name in ("speed", "power"))
    patterns = [row["pattern"] for row in rows]
    return {
        **{key: rows[0][key] for key in ("gait", "family", "condition")},
        "episodes": len(rows),
        **{"speed": speed.mean, "speed_low": speed.low, "speed_high": speed.high},
        **{"power": power.mean, "power_low": power.low, "power_high": power.high},
        "cost_of_transport": power.mean / (weight * speed.mean) if speed.mean > 0 else math.nan,
        "falls": sum(float(row["fell"]) for row in rows),
        "pattern": max(set(patterns), key=patterns.count),
    }


def at_equal_speed(one: dict[str, Any], others: list[dict[str, Any]]) -> float:
    """Return the power [W] of the cheapest gaits of others at the speed of one, on straight lines between two of them.

    Only gaits without a fall count; NaN where none is as slow, or as fast.
    """
    points = sorted((row["speed"], row["power"]) for row in others if row["falls"] == 0)
    selected = [
        a[1] + (b[1] - a[1]) * (one["speed"] - a[0]) / (b[0] - a[0])
        for a in points
        for b in points
        if a[0] <= one["speed"] <= b[0] and a[0] < b[0]
    ]
    return min(selected, default=math.nan)


def figure(rows: list[dict[str, Any]], conditions: tuple[str, ...], path: Path) -> Path:
    """Draw power over speed, a panel for each condition; gaits that fell are hollow."""
    with new_figure(path, (4.4 * len(conditions), 4.6), columns=len(conditions), sharey=True) as (_, axes):
        for ax, condition in zip(axes, conditions, strict=True):
            for number, family in enumerate(FAMILIES):
                for row in (row for row in rows if (row["family"], row["condition"]) == (family, condition)):
                    face = COLORS[number] if row["falls"] == 0 else "white"
                    marker = MARKERS[number]
                    ax.plot(row["speed"], row["power"], marker, color=COLORS[number], markerfacecolor=face)
                    ax.annotate(
                        row["gait"], (row["speed"], row["power"]), (4, 3), textcoords="offset points", fontsize=6
                    )
            ax.set_title(_TITLES[condition])
            ax.set_xlabel("Speed (m/s)")
            ax.set(xscale="log", yscale="log", xlim=(0.35, 4.0), ylim=(6.0, 90.0))
            ax.set_xticks([0.4, 0.6, 1.0, 1.5, 2.5], ["0.4", "0.6", "1", "1.5", "2.5"])
            ax.set_yticks([10, 20, 40, 80], ["10", "20", "40", "80"])
            ax.minorticks_off()
        for number, family in enumerate(FAMILIES):
            axes[0].plot([], [], MARKERS[number], color=COLORS[number], label=family)
        axes[0].plot([], [], "o", color="gray", markerfacecolor="white", label="hollow: falls")
        axes[0].set_ylabel("Mean power (W)")
        axes[0].legend(loc="upper left", fontsize=7)
    return path


def main(command: Command) -> None:
    kept, path = [], command.folder / "runs.csv"
    if path.exists():
        with path.open(newline="") as file:
            kept = list(csv.DictReader(file))
    selected = list(entries(command.folder, command.policies))
    current = {(entry.name, entry.digest) for entry in selected}
    kept = [row for row in kept if (row["gait"], row["digest"]) in current]
    for condition in command.conditions:
        for entry in selected:
            have = [row for row in kept if (row["gait"], row["condition"]) == (entry.name, condition)]
            if command.missing and len(have) < command.episodes:
                kept = [row for row in kept if row not in have] + run(entry, condition, command)
                write_csv(path, kept)
                print(f"ran {entry.name}: {condition}", flush=True)
    weight = RobotDescription.load("minitaur").urdf.total_mass * GRAVITY
    rows = []
    for condition in command.conditions:
        for entry in selected:
            own = [row for row in kept if (row["gait"], row["condition"]) == (entry.name, condition)]
            rows += [summary(own, weight)] if own else []
    write_csv(command.folder / "table.csv", rows)
    shown = []
    for row in rows:
        like = [one for one in rows if one["condition"] == row["condition"] and one["family"] != FAMILIES[2]]
        other = at_equal_speed(row, like) if row["family"] == FAMILIES[2] else math.nan
        shown.append(
            {
                **{key: row[key] for key in ("gait", "family", "condition", "pattern")},
                "speed (m/s)": f"{row['speed']:.2f}",
                "power (W)": f"{row['power']:.1f}",
                "cost of transport": f"{row['cost_of_transport']:.2f}",
                "falls": f"{row['falls']:.0f} of {row['episodes']}",
                "handcrafted at this speed (W)": "" if math.isnan(other) else f"{other:.1f}",
                "less power (%)": "" if math.isnan(other) else f"{100 * (1 - row['power'] / other):.0f}",
            }
        )
    print_table(shown, text_columns=4)
    text = f"{_TOLD.format(**vars(command))}\n\n{markdown(shown)}\n\n![Power over speed](power.png)\n"
    (command.folder / "README.md").write_text(text, encoding="utf-8")
    print(f"wrote {figure(rows, command.conditions, command.folder / 'power.png')}")


if __name__ == "__main__":
    main(tyro.cli(Command))
