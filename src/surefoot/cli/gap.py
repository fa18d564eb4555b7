"""`surefoot gap`: what policies lose in another world than the one that they learned in."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from surefoot.cli.evaluate import Settings
from surefoot.cli.gap_sides import Side, check_heeded, check_lengths, check_sides, labels
from surefoot.cli.parsing import parse
from surefoot.cli.simulator import Simulator
from surefoot.configuration import Duration, Seed, Threads, Within
from surefoot.errors import SurefootError, check_name

if TYPE_CHECKING:
    from surefoot.cli.policies import Candidate
    from surefoot.evaluate.recorded import Recorded
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig
    from surefoot.world.interface import SimulationFactory


@dataclass(frozen=True)
class GapCommand:
    """Run policies at home and in other worlds, and tell how much of their return is lost there: the reality gap.

    At home is the simulator that a policy was trained in, with its actuator and latencies. In the worlds of --to the
    robot is as its data sheet says. --params FILE puts the robot of a file in both places. `--to trace FOLDER` takes
    recorded runs instead, such as a robot's. Written to --out: the runs' traces, gap.csv with one row a policy and
    world, episodes.csv with one row a run, gap.png, and for each policy its runs over time in runs.png.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY [POLICY ...]")]
    """Paths of policy files (.onnx), or names of policies that ship with surefoot."""
    home: Annotated[tuple[str, ...], tyro.conf.arg(name="from", metavar="WORLD | trace FOLDER")] = ("mujoco",)
    """Home: mujoco or bullet, or recorded traces."""
    away: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="to", metavar="WORLD | trace FOLDER"),
    ] = ()
    """Another world: mujoco or bullet, or recorded traces; as often as you like."""
    runs: Annotated[int, Within(1, 10_000)] = 3
    """Runs of each policy in each world."""
    duration: Duration | None = None
    """Length of a run [s], the same in all worlds; that of the policy's task, if not given."""
    params: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """File of a robot's physical parameters (.toml): that robot is simulated on all sides, at home too."""
    settings: Settings = ()
    """Physical parameters in all worlds, such as contact_friction=0.8; over those of --params."""
    from_settings: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="from-set", metavar="NAME=VALUE [...]"),
    ] = ()
    """Physical parameters at home, over those of --set."""
    to_settings: Annotated[
        tuple[tuple[str, ...], ...],
        tyro.conf.UseAppendAction,
        tyro.conf.arg(name="to-set", metavar="NAME=VALUE [...]"),
    ] = ()
    """Physical parameters in the worlds of --to, over those of --set."""
    to_actuator: Literal["dc", "constraint"] = "dc"
    """Actuator in the worlds of --to; dc: servo and DC motor; constraint: the position motor of physics engines."""
    pushes: bool = False
    """Push the robot at random in all worlds, as its task says how; without this nothing pushes."""
    seed: Seed = 1
    """The one seed: run i starts alike in every world."""
    out: Path = Path("gap")
    """Folder for traces (.npz), tables (.csv) and the figure (.png)."""
    json: bool = False
    """Print one JSON object instead of a table."""
    threads: Threads = 0
    """Threads, or processes, of a simulation; 0 means one a core."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    command = parse(GapCommand, argv, "surefoot gap")
    if not command.policies:
        raise SurefootError("no policy is given; give one or more .onnx files, or names of policies that ship")
    home, away = Side.of_words("--from", command.home), [Side.of_words("--to", words) for words in command.away]
    check_sides(command.out, home, away)
    for option, given, sides in (
        ("--params", command.params, [home, *away]),
        ("--set", command.settings, [home, *away]),
        ("--from-set", command.from_settings, [home]),
        ("--to-set", command.to_settings, away),
        ("--to-actuator", command.to_actuator != "dc", away),
        ("--pushes", command.pushes, [home, *away]),
    ):
        if given:
            check_heeded(option, sides)
    from surefoot.cli.policies import find_policy, find_world, load_policies
    from surefoot.evaluate.recorded import by_policy, find_traces, world_of
    from surefoot.evaluate.sensitivity import episode_duration

    paths = [find_policy(policy) for policy in command.policies]
    makers = {side: find_world(side.world) for side in (home, *away) if side.world}
    candidates, robot = load_policies(paths)
    tasks = [_tasks(command, one.task, robot) for one in candidates]
    names = [one.name for one in candidates]
    found = {side: find_traces(side.folder) for side in (home, *away) if side.folder is not None}
    recorded = {side: by_policy(traces, names, robot.name) for side, traces in found.items()}
    worlds = [world_of(found[side]) if side in found else side.world for side in (home, *away)]
    named = labels(worlds, (home, *away))
    for one, (at_home, _) in zip(candidates, tasks, strict=True):
        check_lengths([trace for given in recorded.values() for trace in given[one.name]], episode_duration(at_home))
    for one in candidates:
        check_name("policy name", one.name)
    import_module("matplotlib")
    command.out.mkdir(parents=True, exist_ok=True)
    runs: dict[str, dict[str, Recorded]] = {one.name: {} for one in candidates}
    for one, (at_home, elsewhere) in zip(candidates, tasks, strict=True):
        for number, (side, label) in enumerate(zip((home, *away), named, strict=True)):
            if side in recorded:
                runs[one.name][label] = recorded[side][one.name]
            else:
                task = elsewhere if number else at_home
                place = command.out / one.name / label
                runs[one.name][label] = _run(command, one, task, side.world, makers[side], place)
    _report(command, candidates, tasks, robot.name, (home, *away), runs)
    return 0


def _tasks(command: GapCommand, task: TaskConfig, robot: RobotDescription) -> tuple[TaskConfig, TaskConfig]:
    """The task of a policy at home, and in the other worlds, lasting as long."""
    from surefoot.cli.policies import adjust_task
    from surefoot.evaluate.gap import away_task, home_task
    from surefoot.evaluate.sensitivity import episode_duration

    duration = command.duration or episode_duration(task)
    at_home = adjust_task(
        home_task(task),
        robot,
        (*command.settings, *command.from_settings),
        command.pushes,
        simulator=Simulator(params=command.params),
    )
    elsewhere = adjust_task(
        away_task(task),
        robot,
        (*command.settings, *command.to_settings),
        command.pushes,
        simulator=Simulator(actuator=command.to_actuator, params=command.params),
    )
    # Returns over different times could not be compared, whatever the control step of each world.
    steps = [duration / float(one.nominal(robot).control_step[0]) for one in (at_home, elsewhere)]
    at_home, elsewhere = (
        replace(one, max_steps=max(round(count), 1)) for one, count in zip((at_home, elsewhere), steps, strict=True)
    )
    return at_home, elsewhere


def _run(
    command: GapCommand, one: Candidate, task: TaskConfig, world: str, make_world: SimulationFactory, folder: Path
) -> Recorded:
    """Run a policy in a world and keep the traces in a folder."""
    from surefoot.cli.progress import progress_bar
    from surefoot.evaluate.recorded import save_runs
    from surefoot.evaluate.rollout import run_episodes

    names = {"world_name": world, "policy_name": one.name}
    with progress_bar(f"{one.name} in {folder.name}: {command.runs} runs") as progress:
        traces = run_episodes(
            one.policy, task, command.runs, make_world, command.seed, command.threads, progress, **names
        )
    return save_runs(folder, traces)


def _report(
    command: GapCommand,
    candidates: list[Candidate],
    tasks: list[tuple[TaskConfig, TaskConfig]],
    robot: str,
    sides: tuple[Side, ...],
    runs: dict[str, dict[str, Recorded]],
) -> None:
    """Measure the runs of each policy in each world; write tables and figure, and print what came out."""
    from surefoot.evaluate.gap import PolicyGap
    from surefoot.evaluate.runs import Runs
    from surefoot.report.gap_figures import gap_figure, side_by_side
    from surefoot.tables import plain_value, print_files, print_table, write_csv

    gaps, episodes = [], []
    for name, worlds in runs.items():
        home, *away = (Runs.of_traces([trace for _, trace in found], world) for world, found in worlds.items())
        gaps.append(PolicyGap(name, home, tuple(away)))
        for part in (home, *away):
            for (path, _), row in zip(worlds[part.world], part.rows(), strict=True):
                episodes.append({"policy": name, "world": part.world, **row, "trace": path})
    pooled = [PolicyGap.pooled("all policies", gaps)] if len(gaps) > 1 else []
    rows = {gap.name: gap.rows() for gap in (*gaps, *pooled)}
    out = command.out
    files = [
        write_csv(out / "gap.csv", [row for part in rows.values() for row in part]),
        write_csv(out / "episodes.csv", episodes),
        gap_figure([*gaps, *pooled], out / "gap.png"),
    ]
    for name, worlds in runs.items():
        traces = {world: [trace for _, trace in found] for world, found in worlds.items()}
        files.append(side_by_side(traces, out / name / "runs.png", name))
    if not command.json:
        title = f"Reality gap: return in {gaps[0].home.world} less return elsewhere, ± one standard error"
        print_table([row for gap in (*gaps, *pooled) for row in gap.text_rows()], title, 2)
        print_files(files, out)
        return
    plain = {name: [{k: plain_value(v) for k, v in row.items()} for row in part] for name, part in rows.items()}
    told = {
        "robot": robot,
        "from": str(sides[0]),
        "to": [str(side) for side in sides[1:]],
        "runs": command.runs,
        "seed": command.seed,
        "pushes": command.pushes,
        "policies": [
            {
                "policy": one.name,
                "policy_file": str(one.path),
                "config_hash": one.policy.contract.config_hash,
                "home": _described(at_home),
                "away": _described(elsewhere),
                "worlds": plain[one.name],
            }
            for one, (at_home, elsewhere) in zip(candidates, tasks, strict=True)
        ],
        "pooled": plain[pooled[0].name] if pooled else None,
        "files": [str(file) for file in files],
    }
    print(json.dumps(told, allow_nan=False))


def _described(task: TaskConfig) -> dict[str, Any]:
    """Return the robot on one side, as JSON holds it."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}
