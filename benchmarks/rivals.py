r"""surefoot and its rivals on two cores: steps of physics per second, and errors over the time of a training.

    python benchmarks/rivals.py --model go1.xml --mjbatch CLONE --mjbatch-python PYTHON
    python benchmarks/rivals.py --model go1.xml --quick --anyway        # does it work? a minute or two, and no result

MODEL is the MJCF of the Unitree Go1, from which both sides get their robot: mjbatch's example as it is, surefoot as
`surefoot robot new` imports it. CLONE is a clone of mjbatch 0.1.4 (https://github.com/kevinzakka/mjbatch), and PYTHON
an interpreter that has it and torch. Without them only surefoot is measured. `go2` is surefoot's own robot.

**Learning.** Rivals train in turns, one training at a time, each in its own process with `--threads` threads: mjbatch's
example `go1_joystick.py` unchanged, and surefoot's task `steer` with `--randomize table1`. The clock is wall time from
the construction of the robots on, with modules imported and surefoot's compiled code on the disk; evaluations are not
counted. At points of this clock the deterministic policy follows 128 commands, one per robot, the same for all:
forward -0.5 to 1 m/s, sideways up to 0.4 m/s and yaw rates up to 0.8 rad/s to both sides, uniformly drawn. Errors and
falls are those of `command_following`. Each side is evaluated in its own simulation. surefoot's robots follow the data
sheet; at 60 s, 180 s and the end there are two more evaluations, with robots in the ranges of the training, and with
commands from the whole range of the task. mjbatch's robots are randomized as in its training (floor friction 0.4 to 1,
joints up to 0.1 rad from its pose), and its policy observes the true velocity of the base.

**Throughput.** Layers take turns on the Go1 at physics steps of 4, 2 and 1 ms with 1 and 2 threads: `mjbatch`
(`Batch.step` on its example's model alone, without observations and reward) and `rollout` (`mujoco.rollout` on the
same model, ten control steps at once) hold random motor angles for 20 ms; `world` (`SimWorld.step`: servo, motor,
delays, foot contact and sensors) does so for 16 ms, and `env` (`LocomotionEnv.step`) takes random actions, with
observation, reward and resets. With `--envpool-python PYTHON` the layer `envpool` is a step of EnvPool's own Go1 (4 ms,
random actions of 20 ms). Ratios to mjbatch are medians over rounds with quartiles.

learning.csv, runs.csv, summary.csv, throughput.csv, machine.json and learning.png are written to `--out`. The machine
must be idle when a part begins, or the run ends; `--anyway` continues, and the column `idle` is then 0. Each row has
the wall time, the processor time of its own process, and in `other_cores` what other processes used meanwhile. A low
priority of other processes does not help: `nice` has no effect between sessions where the kernel groups them
(`sched_autogroup_enabled`).

Limits: one processor, one set of commands, and one example of the rival; versions of MuJoCo differ (machine.json). The
trainings of a complete run with five seeds take 100 minutes, to which evaluations come; throughput (`--parts
throughput`) takes a few minutes.
"""

from __future__ import annotations

import json
import math
import os
import platform
import statistics
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from command_following import SECONDS, command_errors, draw_commands
from processor_time import TooBusy, check_idle
from rounds import measure, ratio_quartiles
from worker_process import Worker, WorkerError

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.files import atomic_write
from surefoot.report.figures.style import COLORS, QUIET, new_figure
from surefoot.robot import RobotDescription
from surefoot.tables import print_table, write_csv
from surefoot.task.config import load_task

Part = Literal["throughput", "learning"]
Run = list[dict[str, Any]]
"""Rows of one training, in order of time."""

LOW, HIGH = np.array([-0.5, -0.4, -0.8]), np.array([1.0, 0.4, 0.8])
"""Ranges of commands that all follow: forward and sideways speed [m/s] and yaw rate [rad/s]."""
LIMITS = (0.3, 0.2, 0.1)
"""Planar errors [m/s] whose times are reported."""
MAX_FALLS = 0.05
"""Fraction of robots that may fall if a policy is to count as having reached an error."""
REPORTED = (60.0, 180.0)
"""Times of training at which errors are reported [s]."""
FIRST, POINTS_PER_DOUBLING = 10.0, 3
"""First point at which a policy is evaluated, at the earliest [s], and the number of points until the time doubles."""
TIMESTEPS = (0.004, 0.002, 0.001)
"""Steps of the physics [s]."""
ENVPOOL_TIMESTEP = 0.004
"""Step of the physics in EnvPool's environment [s]."""
BASE = "mjbatch"
"""Layer to which others are compared."""
TASK, RANDOMIZE = "steer", "table1"
"""Task and randomization of surefoot's trainings."""
CASES = ("randomized", "whole_range")
"""Evaluations of surefoot's policies at some points only, with other robots or other commands than all others."""


@dataclass(frozen=True)
class Command:
    """Compare surefoot with its rivals on this machine."""

    model: Path
    """MJCF of the Unitree Go1."""
    mjbatch: Path | None = None
    """Clone of mjbatch. Without it only surefoot is measured."""
    mjbatch_python: Path = Path(sys.executable)
    """Python with mjbatch and torch."""
    envpool_python: Path | None = None
    """Python with EnvPool 1.2.7. Without it EnvPool is not measured."""
    parts: tuple[Part, ...] = ("throughput", "learning")
    """What to measure."""
    robots: tuple[str, ...] = ("go1", "go2")
    """Robots that surefoot trains: go1 is imported from the model, others are names or folders."""
    seeds: tuple[int, ...] = (0, 1, 2, 3, 4)
    """Seeds of the trainings."""
    rival_seeds: tuple[int, ...] | None = None
    """Seeds of mjbatch's trainings, which take longest. Defaults to `seeds`."""
    minutes: float = 4.0
    """Wall time of each of surefoot's trainings [min]."""
    rival_minutes: float = 12.0
    """Wall time of each of mjbatch's trainings [min]."""
    commands: int = 128
    """Number of commands of an evaluation."""
    threads: int = 2
    """Threads of trainings."""
    num_envs: int = 256
    """Robots of a layer in throughput."""
    rounds: int = 12
    """Turns of each layer in throughput."""
    turn: float = 0.5
    """Wall time of a turn [s]; a layer's last call may exceed it."""
    out: Path = Path("results/rivals")
    """Folder for tables and the figure."""
    anyway: bool = False
    """Measure on a busy machine also; the results say so."""
    quick: bool = False
    """Only see whether all parts work: seconds of training, few commands and turns; written to runs/rivals-quick."""


def checkpoint_times(last: float) -> list[float]:
    """Return the times of a training at which it is evaluated, evenly spaced in their logarithm, up to `last` [s].

    The times of `REPORTED` are among them.
    """
    first = math.ceil(POINTS_PER_DOUBLING * math.log2(FIRST / REPORTED[0]))
    count = math.floor(POINTS_PER_DOUBLING * math.log2(last / REPORTED[0]) + 1e-9) + 1
    times = {round(REPORTED[0] * 2 ** (k / POINTS_PER_DOUBLING), 1) for k in range(first, count)}
    return sorted({*times, *(time for time in REPORTED if time <= last), last})


def first_below(run: Run, limit: float) -> float:
    """Return the time [s] at which a policy first had a planar error below a limit; NaN if never.

    Policies of which more than `MAX_FALLS` of the robots fell do not count. Between two points the logarithm of the
    error is a straight line over the logarithm of the time.
    """
    for k, row in enumerate(run):
        if not counts(row) or row["planar"] >= limit:
            continue
        before = run[k - 1] if k else row
        if not counts(before) or before["planar"] < limit:
            return float(row["seconds"])
        fraction = math.log(before["planar"] / limit) / math.log(before["planar"] / row["planar"])
        return float(before["seconds"] * (row["seconds"] / before["seconds"]) ** fraction)
    return math.nan


def counts(row: Mapping[str, Any]) -> bool:
    """Return whether a policy has an error of robots that walk."""
    return math.isfinite(row["planar"]) and row["falls"] <= MAX_FALLS * row["episodes"]


class Throughput:
    """Turns of a layer, for `rounds.measure`.

    Args:
        worker: process of the layer.
        arguments: of its `turn`.
    """

    def __init__(self, worker: Worker, **arguments: Any) -> None:
        self._worker, self._arguments = worker, arguments
        self.turns: list[dict[str, Any]] = []
        """Steps of physics and times of each turn."""

    def __call__(self) -> tuple[int, float]:
        """Run a turn; return its steps of physics and wall time [s]."""
        self.turns.append(turn := self._worker.ask("turn", **self._arguments))
        return turn["steps"], turn["seconds"]


def throughput_rows(layers: Mapping[str, Throughput], wall: Mapping[str, Sequence[float]]) -> list[dict[str, Any]]:
    """Return the row of each layer: medians of rates, and ratios to `BASE` with quartiles if it was measured.

    Args:
        layers: layers after their turns.
        wall: steps of physics per second of wall time of each turn, from `rounds.measure`.
    """
    cpu = {name: [turn["steps"] / turn["cpu_seconds"] for turn in layer.turns] for name, layer in layers.items()}
    rows = []
    for name, layer in layers.items():
        row: dict[str, Any] = {"layer": name}
        for kind, rates in (("cpu", cpu), ("wall", wall)):
            row[f"steps_per_{kind}_second"] = round(statistics.median(rates[name]))
            ratios = ratio_quartiles(rates, name, BASE) if BASE in layers else (None, None, None)
            for end, ratio in zip(("_low", "", "_high"), ratios, strict=True):
                row[f"{kind}_ratio{end}"] = ratio
        row |= {name: round(sum(turn[name] for turn in layer.turns), 2) for name in ("seconds", "cpu_seconds")}
        rows.append(row | {"other_cores": mean_load(layer.turns)})
    return rows


def mean_load(turns: Sequence[Mapping[str, Any]]) -> float | None:
    """Return the mean of `other_cores` over turns, weighted by their duration; None if unknown."""
    if any(turn["other_cores"] is None for turn in turns):
        return None
    seconds = [turn["seconds"] for turn in turns]
    return round(float(np.average([turn["other_cores"] for turn in turns], weights=seconds)), 3)


def measure_throughput(command: Command, robot: str, idle: bool) -> list[dict[str, Any]]:
    """Return one row per number of threads, step of the physics and layer, as they are measured."""
    rows: list[dict[str, Any]] = []
    for threads in (1, 2):
        with workers(command, threads) as (own, rival, envpool):
            for timestep in TIMESTEPS:
                common = {"num_envs": command.num_envs, "threads": threads, "seconds": command.turn}
                layers: dict[str, Throughput] = {}
                if rival is not None:
                    about = {"clone": str(command.mjbatch), "model": str(command.model), "timestep": timestep}
                    layers |= {name: Throughput(rival, layer=name, **about, **common) for name in (BASE, "rollout")}
                if envpool is not None and timestep == ENVPOOL_TIMESTEP:
                    layers["envpool"] = Throughput(envpool, **common)
                for name in ("world", "env"):
                    layers[name] = Throughput(own, layer=name, robot=robot, timestep=timestep, **common)
                wall = measure(layers, command.rounds)
                setting = {"idle": idle, "threads": threads, "timestep_ms": 1000 * timestep}
                part = [{"layer": row["layer"], **setting, **row} for row in throughput_rows(layers, wall)]
                rows += part
                loads = [row["other_cores"] for row in part]
                print(f"threads {threads}, {1000 * timestep:g} ms: others used {describe_load(loads)}", flush=True)
    return rows


def describe_load(loads: Sequence[float | None]) -> str:
    """Return how much of the machine others used, such as `0.01 to 0.03 cores`."""
    known = [load for load in loads if load is not None]
    if not known:
        return "an unknown part of the machine"
    low, high = f"{min(known):.2f}", f"{max(known):.2f}"
    return f"{low} cores" if low == high else f"{low} to {high} cores"


@contextmanager
def workers(command: Command, threads: int) -> Iterator[tuple[Worker, Worker | None, Worker | None]]:
    """Context manager that yields the processes of surefoot, mjbatch and EnvPool; None for a rival that is left out."""
    pythons = {"rivals_surefoot.py": Path(sys.executable)}
    if command.mjbatch is not None:
        pythons["rivals_mjbatch.py"] = command.mjbatch_python
    if command.envpool_python is not None:
        pythons["rivals_envpool.py"] = command.envpool_python
    with ExitStack() as stack:
        found = {script: stack.enter_context(Worker(python, script, threads)) for script, python in pythons.items()}
        yield found["rivals_surefoot.py"], found.get("rivals_mjbatch.py"), found.get("rivals_envpool.py")


@dataclass(frozen=True)
class Training:
    """What is trained in turns with others."""

    system: str
    """surefoot or mjbatch."""
    robot: str
    """Name of the robot in tables."""
    folder: str = ""
    """surefoot's name or folder of the robot."""

    def run(self, command: Command, seed: int, folder: str) -> list[dict[str, Any]]:
        """Train in a process of its own, and return one row per point; poses are written to a folder."""
        commands = draw_commands(command.commands, LOW, HIGH)
        last = 60 * (command.minutes if self.system == "surefoot" else command.rival_minutes)
        arguments: dict[str, Any] = {
            "seed": seed, "threads": command.threads, "times": checkpoint_times(last),
            "commands": commands.tolist(), "seconds": SECONDS, "folder": folder,
        }  # fmt: skip
        cases: dict[str, Array] = {}
        if self.system == "surefoot":
            cases = {"randomized": commands, "whole_range": draw_task_commands(self.folder, command.commands)}
            more: dict[str, Any] = {
                "robot": self.folder, "randomize": RANDOMIZE, "cases_at": [*REPORTED, last],
                "cases": {name: wanted.tolist() for name, wanted in cases.items()},
            }  # fmt: skip
            with Worker(sys.executable, "rivals_surefoot.py", command.threads) as worker:
                points = worker.ask("train", **arguments, **more)
        else:
            more = {"clone": str(command.mjbatch), "model": str(command.model)}
            with Worker(command.mjbatch_python, "rivals_mjbatch.py", command.threads) as worker:
                points = worker.ask("train", **arguments, **more)
        about = {"system": self.system, "robot": self.robot, "seed": seed, "threads": command.threads}
        return [about | read_point(point, commands, cases) for point in points]


def draw_task_commands(robot: str, number: int) -> Array:
    """Return random commands (number, 3) [m/s, m/s, rad/s] over the whole range of the task of a robot."""
    task, _ = load_task(TASK, robot)
    limits = task.commands.limits(RobotDescription.load(robot))
    assert limits is not None
    return draw_commands(number, limits.low, limits.high)


def read_point(point: Mapping[str, Any], commands: Array, cases: Mapping[str, Array]) -> dict[str, Any]:
    """Return the row of a point: its times and the errors from the poses that it names.

    Args:
        point: a point of a training, from its process.
        commands: commands of its evaluation (N, 3) [m/s, m/s, rad/s].
        cases: commands of the evaluations that only some points have.
    """
    row = {name: point[name] for name in ("seconds", "cpu_seconds", "other_cores", "samples")}
    row |= command_errors(np.load(point["nominal"]), commands)
    for case in CASES:
        errors = command_errors(np.load(point[case]), cases[case]) if case in point else {}
        row |= {f"{name}_{case}": errors.get(name) for name in ("falls", "planar", "yaw_rate")}
    return row


def measure_learning(command: Command, robots: Mapping[str, str], idle: bool) -> Iterator[list[dict[str, Any]]]:
    """Yield the rows of each training; with each seed the first is another one, as in `rounds.measure`.

    Args:
        command: what to measure.
        robots: surefoot's name or folder of each robot.
        idle: whether the machine was idle before.
    """
    trainings = [Training("surefoot", name, folder) for name, folder in robots.items()]
    if command.mjbatch is not None:
        trainings.insert(1, Training("mjbatch", "go1"))
    for number, seed in enumerate(command.seeds):
        first = number % len(trainings)
        for training in trainings[first:] + trainings[:first]:
            if training.system == "mjbatch" and seed not in (command.rival_seeds or command.seeds):
                continue
            with tempfile.TemporaryDirectory(prefix="rivals-") as folder:
                rows = [{**row, "idle": idle} for row in training.run(command, seed, folder)]
            if not rows:
                raise SurefootError(
                    f"{training.system}, seed {seed}: ended before {FIRST:g} s of training; give it more time"
                )
            last = rows[-1]
            print(
                f"{training.system} {training.robot}, seed {seed}: planar error {last['planar']:.3f} m/s after "
                f"{last['seconds']:.0f} s ({last['cpu_seconds']:.0f} s of processors), {last['falls']} of "
                f"{last['episodes']} fell; others used {describe_load([last['other_cores']])}",
                flush=True,
            )
            yield rows


def runs_of(rows: Sequence[dict[str, Any]]) -> dict[str, dict[int, Run]]:
    """Return trainings by `SYSTEM ROBOT` and seed."""
    runs: dict[str, dict[int, Run]] = {}
    for row in rows:
        runs.setdefault(f"{row['system']} {row['robot']}", {}).setdefault(row["seed"], []).append(row)
    return runs


def run_row(name: str, seed: int, run: Run) -> dict[str, Any]:
    """Return the row of a training: times to planar errors, errors at `REPORTED` times, samples per second."""
    row: dict[str, Any] = {"run": f"{name} {seed}", "name": name, "seed": seed}
    row |= {f"seconds_to_{limit:g}": round(first_below(run, limit), 1) for limit in LIMITS}
    for time in REPORTED:
        # The first point at or after this time is the first update after it.
        point = next((one for one in run if one["seconds"] >= time), None)
        for case in ("", *(f"_{case}" for case in CASES)):
            for column in (f"{name}{case}" for name in ("planar", "yaw_rate", "falls")):
                row[f"{column}_at_{time:g}"] = None if point is None else point[column]
    last = run[-1]
    row |= {"samples_per_second": round(last["samples"] / last["seconds"])}
    row |= {"cores": round(last["cpu_seconds"] / last["seconds"], 2)}
    return row | {"other_cores": last["other_cores"], "idle": last["idle"]}


def summarize(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per rival and robot from the rows of trainings: times to planar errors, and ratios of rivals.

    A ratio is mjbatch's time to surefoot's with the same seed on the same robot; its median, minimum and maximum over
    seeds are given if all these trainings reached the error.
    """
    table = []
    for name in dict.fromkeys(row["name"] for row in rows):
        own = [row for row in rows if row["name"] == name]
        out: dict[str, Any] = {"name": name, "seeds": len(own)}
        rival = name.replace("surefoot", "mjbatch")
        others = {row["seed"]: row for row in rows if row["name"] == rival and rival != name}
        for limit in LIMITS:
            column = f"seconds_to_{limit:g}"
            times = [row[column] for row in own]
            out[f"reached_{limit:g}"] = sum(map(math.isfinite, times))
            out |= spread(times, column)
            ratios = [others[row["seed"]][column] / row[column] for row in own if row["seed"] in others]
            out |= spread(ratios, f"ratio_{limit:g}")
        table.append(out)
    return table


def spread(values: Sequence[float], name: str) -> dict[str, float | None]:
    """Return median, minimum and maximum under a name; None if there are no values or some are not finite."""
    whole = bool(values) and all(map(math.isfinite, values))
    functions: tuple[tuple[str, Callable[[Sequence[float]], float]], ...] = (
        ("", statistics.median), ("_low", min), ("_high", max)
    )  # fmt: skip
    return {f"{name}{end}": round(function(values), 2) if whole else None for end, function in functions}


def median_line(lines: Sequence[Array]) -> Array:
    """Return the median (points, 2) of lines (points, 2) over time, all positive, where all have values.

    Trainings are evaluated at slightly different times, so their logarithms are interpolated.
    """
    first, last = max(line[0, 0] for line in lines), min(line[-1, 0] for line in lines)
    times = np.unique(np.concatenate([line[:, 0] for line in lines]))
    times = times[(times >= first) & (times <= last)]
    values = [np.exp(np.interp(np.log(times), *np.log(line).T)) for line in lines]
    return np.column_stack([times, np.median(values, axis=0)])


def draw(runs: Mapping[str, Mapping[int, Run]], path: Path, idle: bool) -> None:
    """Draw planar and yaw rate error over the time of training: thin lines are seeds, thick ones their medians."""
    names = (("planar", "planar error (m/s)"), ("yaw_rate", "yaw rate error (rad/s)"))
    with new_figure(path, (9.0, 3.6), 1, len(names), sharex=True) as (_, axes):
        for ax, (column, title) in zip(axes, names, strict=True):
            for color, (name, seeds) in zip(COLORS, runs.items(), strict=False):
                lines = [
                    np.array([(row["seconds"], row[column]) for row in run if math.isfinite(row[column])]).reshape(
                        -1, 2
                    )
                    for run in seeds.values()
                ]
                lines = [line for line in lines if len(line)]
                for line in lines:
                    ax.loglog(*line.T, color=color, linewidth=0.7, alpha=0.5)
                if lines:
                    label = f"{name}, {len(lines)} {'seed' if len(lines) == 1 else 'seeds'}"
                    ax.loglog(*median_line(lines).T, ".-", color=color, linewidth=2.0, markersize=3.0, label=label)
            ax.set_title(title)
            threads = next(iter(next(iter(runs.values())).values()))[0]["threads"]
            ax.set_xlabel(f"training with {threads} threads (s){'' if idle else '; the machine was busy'}")
            ax.set_xticks(times := [10, 20, 30, 60, 120, 240, 480], [f"{tick:g}" for tick in times])
            ax.set_yticks(errors := [0.05, 0.1, 0.2, 0.3, 0.5, 1.0], [f"{tick:g}" for tick in errors])
            ax.minorticks_off()
        axes[0].axhline(LIMITS[-1], color=QUIET, linewidth=0.8, linestyle="--")
        axes[0].legend(loc="upper right")


def write_learning(folder: Path, rows: Sequence[dict[str, Any]], idle: bool) -> list[dict[str, Any]]:
    """Write the tables of trainings and the figure; return the summary."""
    runs = runs_of(rows)
    table = [run_row(name, seed, run) for name, seeds in runs.items() for seed, run in seeds.items()]
    summary = summarize(table)
    for name, one in (("learning", rows), ("runs", table), ("summary", summary)):
        write_csv(folder / f"{name}.csv", one)
    draw(runs, folder / "learning.png", idle)
    return summary


def machine() -> dict[str, Any]:
    """Return what the figures depend on: processor, number of cores and system."""
    names = [""]
    if (info := Path("/proc/cpuinfo")).is_file():
        lines = info.read_text(encoding="utf-8", errors="replace").splitlines()
        names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")] or names
    return {
        "processor": names[0] or platform.processor(), "cores": os.cpu_count(), "system": platform.system(),
        "python": platform.python_version(),
    }  # fmt: skip


def quick(command: Command) -> Command:
    """Return the smallest command that runs every part, with the same rivals."""
    small = {"seeds": command.seeds[:1], "rival_seeds": None, "commands": 8, "num_envs": 16, "rounds": 2, "turn": 0.05}
    out = Path("runs/rivals-quick") if command.out == Command.out else command.out
    return replace(command, **small, minutes=0.2, rival_minutes=0.2, out=out)  # type: ignore[arg-type]


def print_throughput(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print rates in thousands and ratios with quartiles."""

    def ratio(row: Mapping[str, Any], kind: str) -> str:
        low, middle, high = (row[f"{kind}_ratio{end}"] for end in ("_low", "", "_high"))
        return "-" if middle is None else f"{middle:.2f} ({low:.2f} to {high:.2f})"

    print_table(
        [
            {
                "layer": row["layer"],
                "threads": row["threads"],
                "step (ms)": f"{row['timestep_ms']:g}",
                "1000 steps (CPU s)": f"{row['steps_per_cpu_second'] / 1000:.1f}",
                f"to {BASE} (CPU)": ratio(row, "cpu"),
                "1000 steps (s)": f"{row['steps_per_wall_second'] / 1000:.1f}",
                f"to {BASE} (wall)": ratio(row, "wall"),
                "others (cores)": describe_load([row["other_cores"]]).removesuffix(" cores"),
            }
            for row in rows
        ],
        "Steps of physics per second, medians of turns; ratios with quartiles",
    )


def print_learning(summary: Sequence[Mapping[str, Any]]) -> None:
    """Print the times to planar errors, and mjbatch's times in surefoot's."""

    def times(row: Mapping[str, Any], limit: float, name: str, decimals: int) -> str:
        low, middle, high = (row[f"{name}_{limit:g}{end}"] for end in ("_low", "", "_high"))
        return "-" if middle is None else f"{middle:.{decimals}f} ({low:.{decimals}f} to {high:.{decimals}f})"

    print_table(
        [
            {
                "": row["name"],
                "error (m/s)": f"{limit:g}",
                "seeds": f"{row[f'reached_{limit:g}']} of {row['seeds']}",
                "time (s)": times(row, limit, "seconds_to", 0),
                "mjbatch takes (x)": times(row, limit, "ratio", 1),
            }
            for row in summary
            for limit in LIMITS
        ],
        "Time of training to a planar error, median (minimum to maximum) if all seeds reached it",
    )


def begin(command: Command, part: Part, about: Mapping[str, Any]) -> bool:
    """Check that the machine is idle before a part, and write what its results depend on; see `check_idle`."""
    idle, other = check_idle(command.anyway)
    print(f"{part}: others use {describe_load([other])}{'' if idle else ', so times mean nothing'}", flush=True)
    path = command.out / "machine.json"
    known = json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}
    known[part] = {**about, "idle": idle, "other_cores": None if other is None else round(other, 3)}
    path.parent.mkdir(parents=True, exist_ok=True)
    atomic_write(path, json.dumps(known, indent=2) + "\n")
    return idle


def main(command: Command) -> None:
    """Measure, and write the tables and the figure."""
    if command.quick:
        command = quick(command)
    if not command.model.is_file():
        raise SurefootError(f"--model {command.model}: no such file; name the MJCF of the Unitree Go1")
    if min(command.minutes, command.rival_minutes) * 60 < FIRST:
        raise SurefootError(f"--minutes and --rival-minutes must be at least {FIRST / 60:.2f}")
    about: dict[str, Any] = {**machine(), "threads": command.threads, "quick": command.quick}
    with tempfile.TemporaryDirectory(prefix="rivals-") as temporary:
        go1 = f"{temporary}/go1"
        robots = {name: go1 if name == "go1" else name for name in command.robots}
        check_idle(command.anyway)  # before the preparations, which take half a minute
        with workers(command, 1) as (worker, rival, envpool):
            if envpool is not None:
                about["envpool"] = envpool.ask("about")
            if rival is not None:
                about["mjbatch"] = rival.ask("about", clone=str(command.mjbatch), model=str(command.model))
            worker.ask("import_robot", model=str(command.model), folder=go1, name="go1")
            about["surefoot"] = worker.ask("about", robots=list(robots.values()))
            worker.ask("warm_up", robot=go1, randomize=RANDOMIZE)
        if "throughput" in command.parts:
            rows = measure_throughput(command, go1, begin(command, "throughput", about))
            write_csv(command.out / "throughput.csv", rows)
            print_throughput(rows)
        if "learning" in command.parts:
            idle = begin(command, "learning", about)
            points, summary = list[dict[str, Any]](), list[dict[str, Any]]()
            for run in measure_learning(command, robots, idle):
                points += run
                summary = write_learning(command.out, points, idle)  # an interrupted run leaves what it has
            print_learning(summary)


if __name__ == "__main__":
    try:
        main(tyro.cli(Command))
    except (SurefootError, TooBusy, WorkerError) as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
