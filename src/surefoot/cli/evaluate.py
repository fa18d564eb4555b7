"""`surefoot evaluate`: measure policies in simulation, compare several, or measure recorded runs."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import takewhile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from surefoot.api.episodes import draw_episode, print_summaries
from surefoot.cli import evaluate_policies, evaluate_sensitivity
from surefoot.cli.helpers.options import Count, Json, Threads, changed_option, make_figures_folder
from surefoot.cli.helpers.output import print_json, show_command
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.ranges import RangeOptions, take_ranges
from surefoot.cli.helpers.simulator import RunOptions, describe_simulator
from surefoot.configuration import Duration, to_mapping
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from surefoot.api.results import Evaluation, Policy
    from surefoot.robot import RobotDescription


@dataclass(frozen=True)
class EvaluateCommand(RunOptions):
    """Run a policy for several episodes and print its speed, power, return and gait, or measure recorded runs.

    With --randomize TABLE (table1, none, or a YAML file) the physical parameters are randomized in every episode;
    --randomize.NAME LOW HIGH sets the range of one parameter, such as --randomize.control-latency 0.010 0.030.
    --trace FILE computes the same metrics for a recorded run of a robot or a simulation, without simulating.

    To compare several policies with the same commands and robots, see surefoot evaluate POLICY POLICY --help. To find
    the physical parameters that break a policy, see surefoot evaluate sensitivity --help.
    """

    policy: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="POLICY")] = None
    """Path of a policy file (.onnx), run folder or handcrafted gait (.yaml), or the name of a released policy."""
    trace: tuple[Path, ...] = ()
    """Recorded runs to measure instead of a policy: trace files (.npz), or folders of them."""
    episodes: Count = 20
    """Number of episodes, which run in parallel."""
    duration: Duration | None = None
    """Duration of an episode [s]. Defaults to the policy's task."""
    json: Json = False
    command_grid: bool = False
    """Run one episode per point of a grid of constant velocity commands; with --out also draw a heat map of errors."""
    command: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="FORWARD SIDEWAYS YAW_RATE")] = None
    """Constant velocity command [m/s, m/s, rad/s] instead of random commands."""
    thermal_protection: bool = False
    """Switch off motors that overheat."""
    out: Path | None = None
    """Folder for traces (.npz), a footfall diagram and a plot of the first episode (.png)."""
    threads: Threads = 0


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    if argv[:1] == ["sensitivity"]:
        return evaluate_sensitivity.main(argv[1:])
    policies = list(takewhile(lambda word: not word.startswith("-"), argv))
    if len(policies) > 1 or any(word.partition("=")[0] == "--conditions" for word in argv):
        return evaluate_policies.main(argv)
    words, ranges = take_ranges(argv)
    command = parse(EvaluateCommand, words, "surefoot evaluate")
    if command.trace:
        evaluation, robot, about = _load_traces(command, ranges != RangeOptions(None, {}))
        reward: dict[str, float] = {}
    elif command.policy is None:
        raise SurefootError("neither POLICY nor --trace is given; give one of them")
    else:
        evaluation, robot, about, reward = _simulate(command, ranges)
    summary, traces = evaluation.summary, evaluation.traces
    summary["faults"] = sum(trace.meta["ended"] == "fault" for trace in traces)
    if command.trace:
        summary["stopped"] = sum(trace.meta["ended"] == "stopped" for trace in traces)
    summary |= about | {"robot": robot.name}
    if "estimated" in summary:
        from surefoot.evaluation.estimated_motion import estimate_intervals

        summary["estimated_intervals"] = estimate_intervals(traces, summary)
    if command.out is not None:
        from surefoot.evaluation.recorded import save_runs

        files = [] if command.trace else [path for path, _ in save_runs(command.out, traces, "episode")]
        figures = draw_episode(command.out, traces[0], robot)
        if command.command_grid:
            from surefoot.report.figures.tracking import tracking_figure

            figures.append(tracking_figure(traces, command.out / "tracking.png"))
        summary["files"] = [str(file) for file in [*files, *figures]]
    if command.json:
        print_json(summary)
    else:
        print_summaries({f"{summary['policy']} in {summary['world']}": summary}, reward)
        if "estimated" in summary:
            from surefoot.evaluation.estimated_motion import NOTE, interval_text

            print(NOTE)
            print(interval_text(summary["estimated_intervals"]))
        for file in summary.get("files", []):
            if file.endswith(".png"):
                print(f"wrote {file}")
        if command.out is not None and not command.trace:
            print(show_command([command.out / "episode_000.npz"]))
    return 0


def _simulate(
    command: EvaluateCommand, range_options: RangeOptions
) -> tuple[Evaluation, RobotDescription, dict[str, Any], dict[str, float]]:
    """Run the policy; return its evaluation, the robot, the settings of the run, and its reward weights."""
    from surefoot.api.evaluation import run_evaluation
    from surefoot.api.results import load
    from surefoot.world.registry import find_world

    find_world(command.world)
    policy = load(str(command.policy), robot=command.robot)
    ranges = range_options.apply(policy.robot.folder)
    condition = command.condition(
        ranges,
        duration=command.duration,
        command_rows=_command_rows(command, policy),
        thermal_protection=command.thermal_protection,
    )
    task = condition.apply(policy.task, policy.robot)
    make_figures_folder(command.out)
    episodes = len(condition.command_rows) if command.command_grid else command.episodes
    evaluation = run_evaluation(replace(policy, task=task), episodes, command.world, command.seed, command.threads)
    parameters = [word.split("=")[0] for group in command.settings for word in group]
    about = {
        "seed": command.seed,
        "pushes": task.pushes.enabled,
        "push_force": command.push_force,
        "terrain": command.terrain,
        "command": command.command,
        "randomize": to_mapping(ranges),
        "set": command.simulator.latencies | {name: task.params[name] for name in parameters},
        **describe_simulator(task),
        "policy_file": str(policy.path),
        "config_hash": policy.config_hash,
    }
    return evaluation, policy.robot, about, task.reward


def _command_rows(command: EvaluateCommand, policy: Policy) -> tuple[tuple[float, float, float], ...]:
    """Return the constant commands, one per episode; empty if commands are random or read from a file."""
    sources = {"command": command.command, "command-grid": command.command_grid or None, "commands": command.commands}
    if len(options := [f"--{name}" for name, value in sources.items() if value is not None]) > 1:
        raise SurefootError(f"{' and '.join(options)} are given; give one of them")
    if not (command.command_grid or command.command):
        return ()
    from surefoot.evaluation.tracking import check_command, command_grid

    limits = policy.task.commands.limits(policy.robot)
    return command_grid(limits) if command.command is None else (check_command(command.command, limits),)


def _load_traces(command: EvaluateCommand, has_ranges: bool) -> tuple[Evaluation, RobotDescription, dict[str, Any]]:
    """Measure recorded runs of one robot; return their evaluation, the robot, and the trace files."""
    allowed = ("trace", "robot", "out", "json", "simulator")
    own, simulator = ([item.name for item in fields(part)] for part in (command, command.simulator))
    changed = changed_option(command, set(own).difference(allowed)) or changed_option(command.simulator, simulator)
    if changed or has_ranges:
        option = "a policy" if changed == "--policy" else changed or "--randomize"
        raise SurefootError(f"--trace and {option} are given; recorded runs are measured without a simulation")
    from surefoot.api.results import Evaluation
    from surefoot.evaluation.estimated_motion import is_estimated, with_estimated_motion
    from surefoot.evaluation.recorded import find_traces, load_robot
    from surefoot.robot import RobotDescription

    recorded = [one for path in command.trace for one in find_traces(path)]
    robot = load_robot(*recorded[0]) if command.robot is None else RobotDescription.load(command.robot)
    for path, trace in recorded:
        if trace.meta["robot"] != robot.name:
            raise SurefootError(
                f"trace file {path}: was recorded on robot '{trace.meta['robot']}', not on '{robot.name}'; "
                "runs that are measured together must be from the same robot"
            )
    make_figures_folder(command.out)
    traces = [with_estimated_motion(trace, robot) for _, trace in recorded]
    about: dict[str, Any] = {"traces": [str(path) for path, _ in recorded]}
    if estimated := [str(path) for (path, _), trace in zip(recorded, traces, strict=True) if is_estimated(trace)]:
        about["estimated"] = estimated
    return Evaluation.from_traces(traces, robot), robot, about
