"""`surefoot gap`: measure the reality gap, the loss of return of policies in another world than the training's."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from surefoot.cli.helpers.options import (
    Count,
    Json,
    PluginNames,
    PolicyNames,
    Pushes,
    Repeated,
    Seed,
    Settings,
    Terrain,
    Threads,
    make_figures_folder,
)
from surefoot.cli.helpers.output import print_json, show_command
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import Simulator, describe_simulator
from surefoot.configuration import Duration
from surefoot.errors import SurefootError, check_name, prefix_errors
from surefoot.evaluation.conditions import Actuator, Condition, episode_duration

if TYPE_CHECKING:
    from surefoot.api.policies import Candidate
    from surefoot.evaluation.recorded import RecordedTraces
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig

TRACE = "trace"
_LENGTH_TOLERANCE = 0.01
"""Relative difference of durations that rounding to whole control steps may cause."""


Side = str | Path
"""Source of runs: the name of a simulated world, or a folder of traces."""


def parse_side(option: str, words: Sequence[str]) -> Side:
    """Parse the values of `--from` or `--to`: one world, or `trace FOLDER`."""
    if len(words) == 2 and words[0] == TRACE:
        return Path(words[1])
    if len(words) == 1 and words[0] != TRACE:
        return words[0]
    text = " ".join(words) or "nothing"
    raise SurefootError(f"{option} is '{text}'; it takes the name of a world, or {TRACE} FOLDER")


def _text(side: Side) -> str:
    return side if isinstance(side, str) else f"{TRACE} {side}"


def _check_sides(command: GapCommand, home: Side, away: Sequence[Side]) -> None:
    """Reject repeated sides, simulation options without a simulation, and --out inside a folder of traces."""
    if not away:
        raise SurefootError(f"no --to is given; it takes the name of a world, or {TRACE} FOLDER")
    for side in away:
        if list(away).count(side) > 1:
            raise SurefootError(f"--to {_text(side)} is given twice; give it once")
    for side in (home, *away):
        if isinstance(side, Path):
            out, folder = command.out.resolve(), side.resolve()
            if out == folder or out in folder.parents or folder in out.parents:
                raise SurefootError(
                    f"--out {command.out} and the traces of {side} are inside one another; give --out another folder"
                )
    for option, value, sides in (
        ("--params", command.params, [home, *away]),
        ("--set", command.settings, [home, *away]),
        ("--from-set", command.from_settings, [home]),
        ("--to-set", command.to_settings, away),
        ("--to-actuator", command.to_actuator != "dc", away),
        ("--pushes", command.pushes, [home, *away]),
        ("--terrain", command.terrain != "flat", [home, *away]),
        ("--episodes", command.episodes != GapCommand.episodes, [home, *away]),
        ("--seed", command.seed != GapCommand.seed, [home, *away]),
    ):
        if value and not any(isinstance(side, str) for side in sides):
            raise SurefootError(f"{option} is given, but nothing is simulated on its side: {_text(sides[0])}")


def make_labels(worlds: Sequence[str], sides: Sequence[Side]) -> list[str]:
    """Return a unique name for each side, derived from its world (home first); a repeated world gets a suffix."""
    labels: list[str] = []
    for world, side in zip(worlds, sides, strict=True):
        stem = world
        if world in labels:
            stem = f"{world}-away" if isinstance(side, str) else f"{world}-{side.resolve().name}"
        name, number = stem, 2
        while name in labels:
            name, number = f"{stem}-{number}", number + 1
        labels.append(name)
    return labels


@dataclass(frozen=True)
class GapCommand:
    """Run policies in their training simulator and in other worlds, and measure the loss of return (reality gap).

    The home world is the simulator in which a policy was trained, with its actuator model and latencies. In the target
    worlds of --to the robot has the parameters of its data sheet. --params FILE sets the robot's parameters in all
    worlds. `--to trace FOLDER` uses recorded runs instead, such as a real robot's. Files in --out: the traces of all
    runs; gap.csv, one row per policy and world; episodes.csv, one row per run; gap.png; and for each policy runs.png
    with its runs over time.
    """

    policies: PolicyNames
    home: Annotated[tuple[str, ...], tyro.conf.arg(name="from", metavar="WORLD | trace FOLDER")] = ("mujoco",)
    """Home world, such as mujoco or bullet, or recorded traces."""
    away: Annotated[Repeated, tyro.conf.arg(name="to", metavar="WORLD | trace FOLDER")] = ()
    """Target world, such as mujoco or bullet, or recorded traces. May be repeated."""
    episodes: Count = 3
    """Number of episodes per policy and world."""
    duration: Duration | None = None
    """Duration of an episode [s], the same in all worlds. Defaults to the policy's task."""
    params: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of a robot's physical parameters (.toml), which are used in all worlds, including the home world."""
    settings: Settings = ()
    """Physical parameters in all worlds, such as contact_friction=0.8; they override --params."""
    from_settings: Annotated[Repeated, tyro.conf.arg(name="from-set", metavar="NAME=VALUE [...]")] = ()
    """Physical parameters in the home world; they override --set."""
    to_settings: Annotated[Repeated, tyro.conf.arg(name="to-set", metavar="NAME=VALUE [...]")] = ()
    """Physical parameters in the target worlds; they override --set."""
    to_actuator: Actuator = "dc"
    """Actuator model in the target worlds; dc: servo and DC motor; constraint: position motor of the physics engine."""
    terrain: Terrain = "flat"
    pushes: Pushes = False
    seed: Seed = 1
    out: Path = Path("gap")
    """Folder for traces (.npz), tables (.csv) and figures (.png)."""
    json: Json = False
    threads: Threads = 0
    plugin: PluginNames = ()


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(GapCommand, argv, "surefoot gap")
    from surefoot.api.evaluation import run_conditions
    from surefoot.api.policies import load_policies
    from surefoot.world.registry import find_world

    home, away = parse_side("--from", command.home), [parse_side("--to", words) for words in command.away]
    _check_sides(command, home, away)
    from surefoot.evaluation.estimated_motion import with_estimated_motion
    from surefoot.evaluation.recorded import assign_to_policies, find_traces, save_runs
    from surefoot.evaluation.runs import common_value
    from surefoot.world.process_world import worker_pool

    sides, worlds = (home, *away), []
    for side in sides:
        if isinstance(side, str):
            find_world(side)
    candidates, robot = load_policies(command.policies)
    at_home, elsewhere = _conditions(command)
    tasks = {one.name: [part.apply(one.task, robot) for part in (at_home, elsewhere)] for one in candidates}
    recorded: dict[Side, dict[str, RecordedTraces]] = {}
    for side in sides:
        if isinstance(side, str):
            worlds.append(side)
            continue
        traces = find_traces(side)
        assigned = assign_to_policies(traces, [one.name for one in candidates], robot.name)
        recorded[side] = {
            name: [(path, with_estimated_motion(trace, robot)) for path, trace in runs]
            for name, runs in assigned.items()
        }
        with prefix_errors(_text(side)):
            worlds.append(common_value([trace for _, trace in traces], "world"))
    labels = make_labels(worlds, sides)
    for one in candidates:
        duration = episode_duration(tasks[one.name][0])
        for path, trace in [pair for part in recorded.values() for pair in part[one.name]]:
            length = trace.meta["max_steps"] * trace.meta["control_step"]
            if abs(length - duration) > _LENGTH_TOLERANCE * duration:
                raise SurefootError(
                    f"trace file {path}: its run was planned for {length:.3g} s, the others for {duration:.3g} s; "
                    f"give --duration {length:.3g} to compare runs of equal duration"
                )
        check_name("policy name", one.name)
    make_figures_folder(command.out)
    simulated = [
        replace(at_home if label == labels[0] else elsewhere, name=label, world=side)
        for side, label in zip(sides, labels, strict=True)
        if isinstance(side, str)
    ]
    places = dict(zip(labels, sides, strict=True))
    runs: dict[str, dict[str, RecordedTraces]] = {
        one.name: {label: recorded[side][one.name] if side in recorded else [] for label, side in places.items()}
        for one in candidates
    }
    with worker_pool():
        how = (command.episodes, command.seed, command.threads)
        for one, condition, made in run_conditions(candidates, simulated, robot, *how):
            runs[one.name][condition.name] = save_runs(command.out / one.name / condition.name, made)
    _report(command, candidates, tasks, robot, sides, runs)
    return 0


def _conditions(command: GapCommand) -> tuple[Condition, Condition]:
    """Return the conditions of the home world and of the target worlds, with episodes of equal duration."""
    changes = {
        "pushes": command.pushes,
        "terrain": command.terrain,
        "duration": command.duration,
        "same_duration": True,
    }
    there = Simulator(command.to_actuator, params=command.params)
    return (
        Simulator(params=command.params).condition((*command.settings, *command.from_settings), **changes),
        there.condition((*command.settings, *command.to_settings), data_sheet=True, **changes),
    )


def _report(
    command: GapCommand,
    candidates: list[Candidate],
    tasks: dict[str, list[TaskConfig]],
    robot: RobotDescription,
    sides: tuple[Side, ...],
    runs: dict[str, dict[str, RecordedTraces]],
) -> None:
    """Measure the runs of each policy in each world; write tables and figure, and print the results."""
    from surefoot.evaluation.estimated_motion import NOTE, estimate_intervals, interval_text, is_estimated
    from surefoot.evaluation.gap import PolicyGap, gap_cells
    from surefoot.evaluation.runs import measure_runs
    from surefoot.report.figures.gap import gap_figure
    from surefoot.report.figures.runs import side_by_side
    from surefoot.tables import plain_rows, print_files, print_table, write_csv

    out, gaps, episodes, figures = command.out, [], [], []
    estimated = [
        str(path)
        for worlds in runs.values()
        for recorded in worlds.values()
        for path, trace in recorded
        if is_estimated(trace)
    ]
    unit = min(at_home.return_unit(robot) for at_home, _ in tasks.values())
    for name, worlds in runs.items():
        traces = {world: [trace for _, trace in recorded] for world, recorded in worlds.items()}
        gaps.append(PolicyGap.from_runs(name, [measure_runs(part, world) for world, part in traces.items()]))
        paths = [path for recorded in worlds.values() for path, _ in recorded]
        episodes += gaps[-1].runs.assign(trace=paths).to_dict("records")
        figures.append(side_by_side(traces, out / name / "runs.png", name))
    pooled = [PolicyGap.pooled("all policies", gaps)] if len(gaps) > 1 else []
    rows = {gap.name: gap.rows() for gap in (*gaps, *pooled)}
    intervals = {
        gap.name: {
            row["world"]: estimate_intervals(part, row)
            for row in rows[gap.name]
            if any(map(is_estimated, part := [trace for _, trace in runs[gap.name][row["world"]]]))
        }
        for gap in gaps
    }
    files = [
        write_csv(out / "gap.csv", [row for part in rows.values() for row in part]),
        write_csv(out / "episodes.csv", episodes),
        gap_figure([*gaps, *pooled], out / "gap.png", unit),
        *figures,
    ]
    if not command.json:
        title = f"Reality gap: return in {gaps[0].worlds[0]} minus return elsewhere, ± one standard error"
        texts = [
            {"policy": name} | gap_cells(row, row["side"] == "home", sign=True, unit=unit)
            for name, part in rows.items()
            for row in part
        ]
        print_table(texts, title, 2)
        if estimated:
            print(NOTE)
        for name, by_world in intervals.items():
            for world, ends in by_world.items():
                print(f"{name} in {world}: {interval_text(ends)}")
        print_files(files, out)
        first = next(iter(runs.values()))
        print(show_command(recorded[0][0] for recorded in first.values()))
        return
    plain = {name: plain_rows(part) for name, part in rows.items()}
    result = {
        "robot": robot.name,
        "from": _text(sides[0]),
        "to": list(map(_text, sides[1:])),
        "runs": command.episodes if any(isinstance(side, str) for side in sides) else None,
        "seed": command.seed,
        "pushes": command.pushes,
        "policies": [
            {
                "policy": one.name,
                "policy_file": str(one.path),
                "config_hash": one.policy.contract.config_hash,
                "home": describe_simulator(tasks[one.name][0]),
                "away": describe_simulator(tasks[one.name][1]),
                "worlds": plain[one.name],
            }
            for one in candidates
        ],
        "pooled": plain[pooled[0].name] if pooled else None,
        **({"estimated": estimated, "estimated_intervals": intervals} if estimated else {}),
        "files": [str(file) for file in files],
    }
    print_json(result)
