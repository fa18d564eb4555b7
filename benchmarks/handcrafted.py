"""Comparison of handcrafted and learned gaits: power, cost of transport and falls by speed (the paper's table III).

    python benchmarks/handcrafted.py results/handcrafted

Handcrafted gaits are the YAML files in the folder, from `surefoot study tune`, with their tuning curves (.csv). Learned
gaits are its ONNX files, NAME-seed_N.onnx for each of several trainings, and released policies. Each runs in MuJoCo, in
MuJoCo with physical parameters randomized in the paper's ranges (table I), and in Bullet. Runs are stored in runs.csv;
a second call runs only missing ones and those whose gait has changed. Afterwards `python tools/result_pages.py
handcrafted` writes the page of results.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from surefoot.api.policies import find_policy, load_gait
from surefoot.cli.helpers.simulator import RunOptions
from surefoot.evaluation.footfalls import analyze_footfalls
from surefoot.evaluation.rollout import Controller, run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.evaluation.statistics import Interval, t_interval
from surefoot.report.figures.runs import footfall_diagram
from surefoot.report.figures.style import COLORS, MARKERS, new_figure
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.studies.tune import has_converged, read_curve
from surefoot.tables import print_table, read_csv, write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.handcrafted import HandcraftedGait
from surefoot.world.registry import find_world

SHIPPED = ("trot-robust", "gallop-robust")
CONDITIONS = {"mujoco": ("mujoco", "none"), "table1": ("mujoco", "table1"), "bullet": ("bullet", "none")}
"""World and ranges of each condition."""
_TITLES = {"mujoco": "MuJoCo", "table1": "MuJoCo, randomized (table I)", "bullet": "Bullet"}
FAMILIES = ("foot trajectories", "foot trajectories, Raibert", "learned", "learned on tuned trajectories")
DURATION = 6.0
"""Length of an episode [s]."""
WINDOW = 40
"""Number of generations at the end of a tuning that are compared with as many before."""


@dataclass(frozen=True)
class Command:
    """Run missing cases, print the table, draw the figures."""

    folder: Annotated[Path, tyro.conf.Positional] = Path("results/handcrafted")
    """Gaits, and results."""
    policies: tuple[str, ...] = SHIPPED
    """Learned gaits: names of released policies, or policy files."""
    conditions: tuple[str, ...] = tuple(CONDITIONS)
    """Conditions: mujoco, table1, bullet."""
    episodes: int = 20
    """Episodes in each."""
    seed: int = 1
    """The one seed."""
    threads: int = 0
    """Threads of the simulation; 0 means one per core."""
    missing: bool = True
    """Run missing cases; otherwise only report existing results."""
    draw: bool = False
    """Also draw the footfalls of each gait's first episode in MuJoCo."""


@dataclass(frozen=True)
class Entry:
    """Handcrafted gait, or one training of a learned gait."""

    path: Path

    @property
    def gait(self) -> str:
        """Name of the gait, the same for all its trainings."""
        return re.sub(r"-seed_\d+$", "", self.path.stem)

    @property
    def digest(self) -> str:
        """Short digest of its file."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()[:12]

    def load(self) -> tuple[Controller, TaskConfig]:
        policy, _, task, _ = load_gait(self.path, None)
        return policy, task

    def family(self, task: TaskConfig) -> str:
        if self.path.suffix == ".yaml":
            return FAMILIES[HandcraftedGait.load(self.path).raibert is not None]
        return FAMILIES[3 if task.reference.kind == "foot" else 2]


def entries(folder: Path, policies: tuple[str, ...]) -> Iterable[Entry]:
    paths = [*sorted(folder.glob("*.yaml")), *map(find_policy, policies), *sorted(folder.glob("*.onnx"))]
    return map(Entry, paths)


def run(entry: Entry, condition: str, command: Command) -> list[dict[str, Any]]:
    """Return one row per episode of a gait."""
    world, ranges = CONDITIONS[condition]
    policy, task = entry.load()
    robot = RobotDescription.load(task.robot)
    steps = round(DURATION / float(task.nominal(robot).control_step[0]))
    key = {"file": entry.path.stem, "gait": entry.gait, "condition": condition, "family": entry.family(task)}
    task = RunOptions().apply(replace(task, max_steps=steps), robot, load_ranges(ranges))
    traces = run_episodes(policy, task, command.episodes, find_world(world), command.seed, command.threads)
    if command.draw and condition == "mujoco":
        footfall_diagram(traces[0], command.folder / f"{entry.path.stem}-footfalls.png")
    runs = measure_runs(traces).drop(columns="world")
    rows = runs.astype(dict.fromkeys(runs.select_dtypes(bool), int)).to_dict("records")
    feet = [analyze_footfalls(trace) for trace in traces]
    return [
        {**key, "digest": entry.digest, **row, "pattern": foot.pattern} for row, foot in zip(rows, feet, strict=True)
    ]


def estimate(rows: list[dict[str, Any]], column: str) -> Interval:
    """Return the mean with a 95 % interval, over trainings if there are several, otherwise over episodes."""
    files: dict[str, list[float]] = {}
    for row in rows:
        files.setdefault(row["file"], []).append(float(row[column]))
    means = [float(np.mean(values)) for values in files.values()]
    return t_interval(means if len(means) > 1 else next(iter(files.values())))


def summary(rows: list[dict[str, Any]], weight: float) -> dict[str, Any]:
    """Return the row of a gait in a condition."""
    speed, power = estimate(rows, "speed"), estimate(rows, "power")
    patterns = [row["pattern"] for row in rows]
    gait, condition = rows[0]["gait"], rows[0]["condition"]
    return {
        "name": gait if condition == "mujoco" else f"{gait}/{condition}",
        **{"gait": gait, "condition": condition, "family": rows[0]["family"]},
        "trainings": len({row["file"] for row in rows}) if rows[0]["family"] in FAMILIES[2:] else 0,
        "episodes": len(rows),
        **speed.columns("speed"),
        **power.columns("power"),
        "cost_of_transport": power.mean / (weight * speed.mean) if speed.mean > 0 else math.nan,
        "falls": round(sum(float(row["fell"]) for row in rows)),
        "pattern": max(set(patterns), key=patterns.count),
    }


def at_equal_speed(speed: float, others: list[dict[str, Any]]) -> tuple[float, str]:
    """Return the power [W] of handcrafted gaits at a speed, and their names.

    It is the minimum over linear interpolations between a slower and a faster gait. Only gaits without a fall count;
    NaN if no gait is as slow, or as fast.
    """
    points = sorted((row["speed"], row["power"], row["gait"]) for row in others if row["falls"] == 0)
    selected = [
        (a[1] + (b[1] - a[1]) * (speed - a[0]) / (b[0] - a[0]), f"{a[2]}, {b[2]}")
        for a in points
        for b in points
        if a[0] <= speed <= b[0] and a[0] < b[0]
    ]
    return min(selected, default=(math.nan, ""))


def comparison(rows: list[dict[str, Any]], others: list[dict[str, Any]]) -> dict[str, Any]:
    """Return how much less power [%] a learned gait needs than handcrafted gaits at the speed of each training.

    NaN if one of the trainings is slower or faster than all handcrafted gaits. Intervals are as in `estimate`.
    """
    relative, names, each = [], [], []
    for file in dict.fromkeys(row["file"] for row in rows):
        own = [row for row in rows if row["file"] == file]
        tuned, name = at_equal_speed(float(np.mean([float(row["speed"]) for row in own])), others)
        relative += [
            {"file": file, "tuned": tuned, "less_power": 100 * (1 - float(row["power"]) / tuned)} for row in own
        ]
        names += [name] if name else []
        each.append(f"{estimate(relative[-len(own) :], 'less_power').mean:.0f}")
    return {
        "tuned_power": estimate(relative, "tuned").mean,
        **estimate(relative, "less_power").columns("less_power"),
        "less_power_of_each": ", ".join(each),
        "baseline": "; ".join(dict.fromkeys(names)),
    }


def tuning(curve: list[dict[str, str]]) -> dict[str, Any]:
    """Return the row of a gait's tuning: its generations, and those with the most frequent number of episodes."""
    own = [row for row in curve if row["gait"] == curve[-1]["gait"]]
    searches: dict[tuple[str, str], list[float]] = {}
    for row in own:
        searches.setdefault((row["starts"], row["duration"]), []).append(float(row["cost"]))
    (starts, duration), costs = max(searches.items(), key=lambda item: len(item[1]))
    last, before = min(costs[-WINDOW:]), min(costs[-2 * WINDOW : -WINDOW], default=math.nan)
    return {
        "gait": own[-1]["gait"],
        "started_from": curve[0]["gait"] if len(own) < len(curve) else "",
        "generations": len(own),
        "control_steps": sum(float(row["control_steps"]) for row in own),
        **{"starts": starts, "duration": duration, "searched": len(costs)},
        **{"first_cost": costs[0], "cost_before": before, "last_cost": last, "last_gain": 100 * (1 - last / before)},
        "converged": has_converged(costs, WINDOW),
    }


def tuning_figure(curves: dict[str, list[dict[str, str]]], path: Path) -> Path:
    """Plot the minimum cost of each generation over simulated control steps, one line per tuning."""
    with new_figure(path, (6.4, 3.6)) as (_, (ax,)):
        for number, (name, curve) in enumerate(curves.items()):
            steps = np.cumsum([float(row["control_steps"]) for row in curve]) / 1e6
            costs = [float(row["cost"]) for row in curve]
            ax.plot(steps, costs, color=COLORS[number % len(COLORS)], linewidth=0.9)
            ax.annotate(name, (steps[-1], costs[-1]), (3, -2), textcoords="offset points", fontsize=7)
        ax.set(
            xlabel="Control steps (million)",
            ylabel="Minimum cost of the generation (W)",
            yscale="log",
            ylim=(None, 200),
        )
        ax.set_yticks([5, 10, 20, 50, 100, 200], ["5", "10", "20", "50", "100", "200"])
        ax.minorticks_off()
        ax.margins(x=0.12)
    return path


def figure(rows: list[dict[str, Any]], conditions: tuple[str, ...], path: Path) -> Path:
    """Plot power over speed with intervals, one panel per condition; markers of gaits that fell are hollow."""
    with new_figure(path, (4.4 * len(conditions), 4.6), columns=len(conditions), sharey=True) as (_, axes):
        for ax, condition in zip(axes, conditions, strict=True):
            for row in (row for row in rows if row["condition"] == condition):
                number = FAMILIES.index(row["family"])
                ax.errorbar(
                    *(row["speed"], row["power"]),
                    xerr=[[row["speed"] - row["speed_low"]], [row["speed_high"] - row["speed"]]],
                    yerr=[[row["power"] - row["power_low"]], [row["power_high"] - row["power"]]],
                    fmt=MARKERS[number],
                    color=COLORS[number],
                    markerfacecolor=COLORS[number] if row["falls"] == 0 else "white",
                    elinewidth=0.7,
                )
                ax.annotate(row["gait"], (row["speed"], row["power"]), (4, 3), textcoords="offset points", fontsize=6)
            ax.set_title(_TITLES[condition])
            ax.set_xlabel("Speed (m/s)")
            ax.set(xscale="log", yscale="log", xlim=(0.35, 4.0), ylim=(3.0, 90.0))
            ax.set_xticks([0.4, 0.6, 1.0, 1.5, 2.5], ["0.4", "0.6", "1", "1.5", "2.5"])
            ax.set_yticks([5, 10, 20, 40, 80], ["5", "10", "20", "40", "80"])
            ax.minorticks_off()
        for number, family in enumerate(FAMILIES):
            axes[0].plot([], [], MARKERS[number], color=COLORS[number], label=family)
        axes[0].plot([], [], "o", color="gray", markerfacecolor="white", label="hollow: falls")
        axes[0].set_ylabel("Mean power (W)")
        axes[0].legend(loc="upper left", fontsize=7)
    return path


def shown(row: dict[str, Any]) -> dict[str, str]:
    """Return the printed cells of a row."""

    def text(name: str, digits: int) -> str:
        columns = (name, f"{name}_low", f"{name}_high")
        return "" if math.isnan(row[name]) else Interval(*(row[column] for column in columns)).text(digits)

    return {
        "gait": row["gait"] + (f", {row['trainings']} trainings" if row["trainings"] > 1 else ""),
        "footfalls": row["pattern"],
        "speed (m/s)": text("speed", 2),
        "power (W)": text("power", 1),
        "falls": f"{row['falls']} of {row['episodes']}",
        "tuned (W)": "" if math.isnan(row["tuned_power"]) else f"{row['tuned_power']:.1f}, {row['baseline']}",
        "less power (%)": text("less_power", 0),
    }


def main(command: Command) -> None:
    path = command.folder / "runs.csv"
    kept = read_csv(path)
    selected = list(entries(command.folder, command.policies))
    current = {(entry.path.stem, entry.digest) for entry in selected}
    kept = [row for row in kept if (row.get("file"), row["digest"]) in current]
    for condition in command.conditions:
        for entry in selected:
            have = [row for row in kept if (row["file"], row["condition"]) == (entry.path.stem, condition)]
            if command.missing and len(have) < command.episodes:
                kept = [row for row in kept if row not in have] + run(entry, condition, command)
                write_csv(path, kept)
                print(f"ran {entry.path.stem}: {condition}", flush=True)
    weight = RobotDescription.load("minitaur").urdf.total_mass * GRAVITY
    rows: list[dict[str, Any]] = []
    for condition in command.conditions:
        runs = {
            entry.gait: [row for row in kept if (row["gait"], row["condition"]) == (entry.gait, condition)]
            for entry in selected
        }
        own = {gait: summary(episodes, weight) for gait, episodes in runs.items() if episodes}
        others = [row for row in own.values() if row["family"] in FAMILIES[:2]]
        for gait, row in own.items():
            learned = row["family"] in FAMILIES[2:]
            row |= comparison(runs[gait], others if learned else [])
        rows += own.values()
        print(_TITLES[condition])
        print_table([shown(row) for row in own.values()], text_columns=2)
    write_csv(command.folder / "table.csv", rows)
    curves = {entry.gait: curve for entry in selected if (curve := read_curve(entry.path))}
    if curves:
        write_csv(command.folder / "tuning.csv", [tuning(curve) for curve in curves.values()])
        tuning_figure(curves, command.folder / "tuning.png")
    print(f"wrote {figure(rows, command.conditions, command.folder / 'power.png')}")


if __name__ == "__main__":
    main(tyro.cli(Command))
