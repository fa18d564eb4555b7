"""`surefoot evaluate`: run a policy in simulation and measure it."""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from surefoot.cli.parsing import parse
from surefoot.cli.ranges import take_ranges
from surefoot.cli.simulator import Simulator, SimulatorOptions
from surefoot.configuration import Seed, Threads, Within
from surefoot.errors import SurefootError
from surefoot.task.randomize import RandomizeConfig

if TYPE_CHECKING:
    from surefoot.robot import RobotDescription
    from surefoot.task.trace import EpisodeTrace

Settings = Annotated[
    tuple[tuple[str, ...], ...],
    tyro.conf.UseAppendAction,
    tyro.conf.arg(name="set", metavar="NAME=VALUE [...]"),
]


@dataclass(frozen=True)
class EvaluateCommand:
    """Run a policy for some episodes and print speed, power, return and gait; or measure runs that were recorded.

    With --randomize NAME (table1, none, or a YAML file) every episode draws its physical parameters;
    --randomize.ROW LOW HIGH sets or changes one row, such as --randomize.latency 0.010 0.030.
    --trace FILE measures what a robot or a simulation recorded, by the same functions, and simulates nothing.
    """

    policy: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")] = None
    """Path of a policy file (.onnx), or the name of a policy that ships with surefoot."""
    trace: tuple[Path, ...] = ()
    """Recorded runs instead of a policy: trace files (.npz), or folders of them."""
    episodes: Annotated[int, Within(1, 10_000)] = 20
    """Episodes to run, side by side."""
    pushes: bool = False
    """Push the robot at random, as its task says how; without this nothing pushes."""
    settings: Settings = ()
    """Physical parameters that differ from the task's, such as motor_strength=0.8."""
    seed: Seed = 1
    """The one seed."""
    json: bool = False
    """Print one JSON object instead of a table."""
    world: str = "mujoco"
    """Where to run: mujoco or bullet."""
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policy's own."""
    thermal_protection: bool = False
    """Switch off motors that overheat."""
    robot: str | None = None
    """Name or folder of the robot; the one of the policy's task, if not given."""
    out: Path | None = None
    """Folder for traces (.npz), a footfall diagram and an episode plot (.png)."""
    threads: Threads = 0
    """Threads of the simulation; 0 means one a core."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    config = (tyro.conf.FlagCreatePairsOff,)
    words, ranges = take_ranges(argv, RandomizeConfig())
    command = parse(EvaluateCommand, words, "surefoot evaluate", config=config)
    if command.trace:
        return _recorded(command, bool(ranges.ranges))
    if command.policy is None:
        raise SurefootError("no POLICY and no --trace is given; give one of them")
    from surefoot.cli.policies import adjust_task, find_policy, find_world, load_policy
    from surefoot.evaluate.metrics import summarize

    path = find_policy(command.policy)
    make_world = find_world(command.world)
    policy, robot, task = load_policy(path, command.robot)
    task = adjust_task(
        task, robot, command.settings, command.pushes, command.thermal_protection, ranges, command.simulator
    )
    if command.out is not None:
        import_module("matplotlib")
        command.out.mkdir(parents=True, exist_ok=True)
    from surefoot.cli.progress import run_with_progress

    traces = run_with_progress(
        policy,
        task,
        command.episodes,
        make_world,
        command.seed,
        command.threads,
        world_name=command.world,
        policy_name=policy.contract.name,
    )
    summary = summarize(traces, robot.urdf.total_mass)
    summary |= {
        "faults": sum(trace.meta["ended"] == "fault" for trace in traces),
        "seed": command.seed,
        "pushes": command.pushes,
        "randomize": {row: list(given) for row, given in ranges.ranges.items()},
        "params": task.params,
        "params_source": task.params_source,
        "set": command.simulator.latencies
        | {name: task.params[name] for group in command.settings for name in (w.split("=")[0] for w in group)},
        "actuator": task.actuator,
        "robot": robot.name,
        "policy_file": str(path),
        "config_hash": policy.contract.config_hash,
    }
    if command.out is not None:
        files = [trace.save(command.out / f"episode_{i:03d}.npz") for i, trace in enumerate(traces)]
        summary["files"] = [str(file) for file in [*files, *_figures(command.out, traces, robot)]]
    return _tell(summary, command.json)


def _recorded(command: EvaluateCommand, drawn: bool) -> int:
    """Measure runs that were recorded, by a robot or by a simulation."""
    heeded = ("trace", "robot", "out", "json", "simulator")
    given = [
        item.name for item in fields(command) if item.name not in heeded and getattr(command, item.name) != item.default
    ]
    given += [item.name for item in fields(command.simulator) if getattr(command.simulator, item.name) is not None]
    if given or drawn:
        odd = given[0] if given else "randomize"
        named = "a policy" if odd == "policy" else f"--{dict(settings='set').get(odd, odd).replace('_', '-')}"
        raise SurefootError(f"--trace and {named} are given; recorded runs are measured as they are, nothing is run")
    from surefoot.evaluate.metrics import summarize
    from surefoot.evaluate.recorded import find_traces
    from surefoot.robot import RobotDescription

    found = [one for path in command.trace for one in find_traces(path)]
    robot = RobotDescription.load(command.robot or str(found[0][1].meta["robot"]))
    for path, trace in found:
        if trace.meta["robot"] != robot.name:
            raise SurefootError(
                f"trace file {path}: is of robot '{trace.meta['robot']}', not of '{robot.name}'; "
                "runs that are measured together must be of one robot"
            )
    traces = [trace for _, trace in found]
    summary = summarize(traces, robot.urdf.total_mass)
    summary |= {
        "faults": sum(trace.meta["ended"] == "fault" for trace in traces),
        "stopped": sum(trace.meta["ended"] == "stopped" for trace in traces),
        "robot": robot.name,
        "traces": [str(path) for path, _ in found],
    }
    if command.out is not None:
        import_module("matplotlib")
        command.out.mkdir(parents=True, exist_ok=True)
        summary["files"] = [str(file) for file in _figures(command.out, traces, robot)]
    return _tell(summary, command.json)


def _tell(summary: dict[str, Any], as_json: bool) -> int:
    if as_json:
        print(json.dumps(summary, allow_nan=False))
    else:
        print_table(summary)
    return 0


def _figures(folder: Path, traces: list[EpisodeTrace], robot: RobotDescription) -> list[Path]:
    """Draw a footfall diagram and a plot of the first episode; returns the files."""
    import numpy as np

    from surefoot.report.figures import episode_plot, footfall_diagram

    leg_angle = np.concatenate(robot.motor_to_leg_pose(traces[0].motor_angle), axis=-1)
    plot = episode_plot(traces[0], folder / "episode.png", leg_angle=leg_angle)
    # Who has no switches in the feet knows of no footfalls.
    if np.isnan(traces[0].foot_contact).any():
        return [plot]
    return [footfall_diagram(traces[0], folder / "footfalls.png"), plot]


def print_table(summary: dict[str, Any]) -> None:
    """Print the figures of an evaluation as a table."""
    from rich.console import Console
    from rich.table import Table

    def text(key: str, unit: str, spread: str = "") -> str:
        value = summary[key]
        if value is None:
            return "-"
        return f"{value:.3f}" + (f" ± {summary[spread]:.3f}" if spread else "") + f" {unit}".rstrip()

    falls = f"{summary['falls']} of {summary['episodes']}"
    faults = "faults" if "traces" in summary else "diverged"
    for name, word in (("faults", faults), ("stopped", "stopped")):
        if summary.get(name):
            falls += f", {summary[name]} {word}"
    rows = [
        ("falls", falls),
        ("steps", f"{summary['steps_mean']:.1f}"),
        ("speed", text("speed_mean", "m/s", "speed_std")),
        ("power", text("power_mean", "W")),
        ("return", text("return_mean", "", "return_std")),
        ("distance", text("distance_mean", "m")),
        ("drift", text("drift_mean", "m")),
        ("cost of transport", text("cost_of_transport_mean", "")),
    ]
    duty, phases = summary["duty_factor"], summary["phases"]
    # Without any duty factor nothing is known of the feet.
    rows.append(("gait", summary["gait"] if any(value is not None for value in duty.values()) else "-"))
    for leg in duty:
        numbers = ["-" if value is None else f"{value:.2f}" for value in (duty[leg], phases[leg])]
        rows.append((leg.replace("_", " "), f"duty factor {numbers[0]}, phase {numbers[1]}"))
    rows += [("wrote", file) for file in summary.get("files", [])[-2:]]
    runs = "recorded runs" if "traces" in summary else "episodes"
    table = Table(title=f"{summary['policy']} in {summary['world']}, {summary['episodes']} {runs}", show_header=False)
    for row in rows:
        table.add_row(*row)
    Console().print(table)
