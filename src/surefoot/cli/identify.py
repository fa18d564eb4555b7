"""`surefoot identify`: identify a robot's physical parameters by experiments, or from recorded runs and logs.

Exit codes: 0: completed; 2: rejected before anything moved, or no parameter is identifiable from the data; 3: the
experiment was stopped, or the fitted robot does not reproduce the logs.
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from surefoot.cli.helpers.identify_logs import TracesCommand, identify_from_logs, new_folder
from surefoot.cli.helpers.identify_run import ExperimentCommand, run_experiment, show_plan
from surefoot.cli.helpers.options import changed_option, check_folder, check_suffix
from surefoot.cli.helpers.output import (
    Actions,
    make_console,
    next_command,
    print_json,
    print_warning,
    run_action,
    table_lines,
)
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError, suggest
from surefoot.identify.recording import COMPLETE, Recording, load_recording, recorded_robot
from surefoot.identify.registry import EXPERIMENTS, Experiment
from surefoot.identify.robot_params_file import missing_experiments, read_prior
from surefoot.robot import DEFAULT_ROBOT, FiveBar, RobotDescription
from surefoot.robot.params import parse_settings
from surefoot.robot.params_file import ParamsFile

STOPPED = 3
"""Exit code of an experiment that was stopped."""
RECORDING = "recording.npz"
TRACE = "--trace"
LOG_OPTIONS = ("rack", "hold_out", "generations", "settings", "plan", "duration", "seed")
"""Options of `identify --trace` that only logs of a robot with joint actuators have."""
ACTIONS: Actions = {
    "replay": ("replay the commands of a recorded run in simulation, and compare", "surefoot.cli.identify_replay"),
    "import": ("convert a log to a trace; formats: NPZ, CSV, pickle, torch, Parquet, MCAP, ROS bag",
               "surefoot.cli.identify_import"),
    "motor-figure": ("let a motor follow a sine or a recording with both motor models, and plot it",
                     "surefoot.cli.helpers.identify_motor_figure"),
}  # fmt: skip
"""Subcommands that need no experiment: purpose, and the module that runs it."""
_USAGE = """usage: surefoot identify EXPERIMENT --port PORT ...
       surefoot identify EXPERIMENT --recording FOLDER ...
       surefoot identify --trace FOLDER ...
       surefoot identify replay TRACE ...
       surefoot identify import LOG ...

Identify a robot's physical parameters by experiments, and write them to a file for surefoot train --params FILE.

experiments on a robot, to run in this order, each with --params FILE, the results so far:
{experiments}

without an experiment:
{others}

surefoot identify EXPERIMENT --help lists its options, and likewise for replay, import and motor-figure."""


def check_identifiable(robot: RobotDescription, experiment: Experiment | None = None) -> None:
    """Reject a robot with legs or motors that the experiment, or the fit to traces, does not support."""
    if experiment is not None and experiment.for_joint_actuators:
        if robot.actuator.kind != "joint" or robot.loops:
            raise SurefootError(f"{experiment.name} is for robots with joint actuators; {robot.name} has other ones")
        return
    if robot.actuator.kind != "dc" or not isinstance(robot.leg_geometry, FiveBar):
        raise SurefootError(f"identify is for robots with five-bar legs and DC motors; {robot.name} has other ones")


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if argv else sys.stderr)
        return 0 if argv else 2
    word = argv[0]
    if word in ACTIONS:
        return run_action(argv, "identify", ACTIONS)
    if word.startswith("--"):
        # --help works without a value of --trace.
        return _identify_from_traces(["--help"] if {"-h", "--help"} & set(argv) else argv)
    if word in EXPERIMENTS:
        return _run_experiment(EXPERIMENTS[word], argv[1:])
    raise SurefootError(f"'{word}' is not an experiment; {suggest(word, [*EXPERIMENTS, *ACTIONS])}, or {TRACE} FOLDER")


def _usage() -> str:
    experiments = {name: f"{one.measures} (on {'rack' if one.rack else 'ground'})" for name, one in EXPERIMENTS.items()}
    others = {
        f"{TRACE} FOLDER": "fit motors and latencies to traces of runs; fit a robot with joint actuators to logs",
        **{name: purpose for name, (purpose, _) in ACTIONS.items()},
    }
    width = max(map(len, [*experiments, *others]))
    return _USAGE.format(experiments=table_lines(experiments, width), others=table_lines(others, width))


def _identify_from_traces(argv: list[str]) -> int:
    command = parse(TracesCommand, argv, "surefoot identify")
    check_suffix("params", command.params, ".toml")
    check_folder(command.out)
    if command.robot is not None and (robot := RobotDescription.load(command.robot)).actuator.kind == "joint":
        return identify_from_logs(command, robot)
    if (option := changed_option(command, LOG_OPTIONS)) is not None:
        raise SurefootError(f"{option} is for logs of a robot with joint actuators; name the robot with --robot")
    from surefoot.evaluation.recorded import find_traces, load_robot

    traces = find_traces(command.trace)
    robot = load_robot(*traces[0]) if command.robot is None else RobotDescription.load(command.robot)
    check_identifiable(robot)
    prior = read_prior(command.params, robot)
    from surefoot.cli.helpers.identify_results import check_installed, fit_progress, save_and_print

    check_installed()
    from surefoot.identify.motion.torque_fit import fit_torques
    from surefoot.identify.motion.traces import deployed_motion

    motions = [deployed_motion(path.name, trace) for path, trace in traces]

    with fit_progress("traces") as report:
        result = fit_torques(robot, motions, command.fit or None, prior.params, report)
    folder, source = command.out or new_folder("traces"), str(command.trace)
    more = {"traces": [str(path) for path, _ in traces]}
    save_and_print(robot, prior, result, command.params, folder, source, more, command.json)
    return 0


def _run_experiment(experiment: Experiment, argv: list[str]) -> int:
    name = experiment.name
    command = parse(ExperimentCommand, argv, f"surefoot identify {name}")
    if command.plan:
        return _print_plan(command, experiment)
    _check_options(command)
    path = command.recording
    if path is not None and path.is_dir():
        path /= RECORDING
    robot = RobotDescription.load(command.robot or DEFAULT_ROBOT)
    if path is not None and command.robot is None:
        robot = recorded_robot(path)
    check_identifiable(robot, experiment)
    prior = read_prior(command.params, robot)
    from surefoot.cli.helpers.identify_results import check_installed, fit_progress, save_and_print

    if path is not None:
        recording, folder = load_recording(path, robot, name), command.out or path.parent
        _warn_of_missing(command, experiment, prior)
    else:
        folder = command.out or new_folder(name)
        path = folder / RECORDING
        if path.exists():
            raise SurefootError(f"{path} exists and is not overwritten; give another folder with --out")
        if not command.record_only:
            check_installed(f"surefoot identify {name} --record-only")
            _warn_of_missing(command, experiment, prior)
        recording = run_experiment(command, experiment.plan(robot), robot, path)
        if recording.meta["ended"] != COMPLETE or command.record_only:
            return _print_recording(command, recording, path)
    check_installed()
    with fit_progress(name) as report:
        result = experiment.fit(robot, recording, prior.params, dict(prior.tables.get("sensors", {})), report)
    missing = list(missing_experiments(prior, experiment.prerequisites))
    more = {"recording": str(path), "ended": COMPLETE, "lacks": missing}
    save_and_print(robot, prior, result, command.params, folder, str(path), more, command.json)
    return 0


def _print_plan(command: ExperimentCommand, experiment: Experiment) -> int:
    """Print the plan of the experiment air, and the accuracy that it would achieve."""
    if not experiment.for_joint_actuators or command.robot is None:
        raise SurefootError(
            "--plan is for the experiment air and a named robot: surefoot identify air --plan --robot NAME"
        )
    robot = RobotDescription.load(command.robot)
    check_identifiable(robot, experiment)
    plan, stated = experiment.plan(robot), parse_settings([word for group in command.settings for word in group])
    prior = read_prior(command.params, robot).params.with_values(robot, **stated)
    if not command.json:
        show_plan(plan, robot.name, (-math.inf, math.inf), make_console())
    from surefoot.cli.helpers.identify_results import check_installed, print_expected_accuracy

    check_installed()
    from surefoot.identify.motion.expected_accuracy import planned_motion, predict_accuracy

    foresight = predict_accuracy(robot, [planned_motion(plan)], prior, tuple(stated))
    print_expected_accuracy(robot, foresight, prior, "this plan", command.json)
    return 0


def _check_options(command: ExperimentCommand) -> None:
    robot = command.port is not None or command.link == "dds"
    if robot == (command.recording is not None):
        number = "both are" if robot else "neither is"
        raise SurefootError(f"give either --port of a robot or --recording of an experiment; {number} given")
    if robot:
        command.check_link()
        command.gains()
    else:
        without = "it can't be combined with --recording, which needs no robot"
        command.reject_link(without)
        if (option := changed_option(command, ("record_only", "yes", "settings"))) is not None:
            raise SurefootError(f"{option} is given; {without}")
    if command.record_only and command.params is not None:
        raise SurefootError("--record-only and --params can't be combined; only the fit uses parameters")
    check_suffix("params", command.params, ".toml")
    check_folder(command.out)


def _warn_of_missing(command: ExperimentCommand, experiment: Experiment, prior: ParamsFile) -> None:
    """Print a warning if experiments that should precede this one are missing."""
    if missing := missing_experiments(prior, experiment.prerequisites):
        where = f"{command.params} has no results of it" if command.params is not None else "--params FILE is not given"
        print_warning(
            f"{experiment.name} should be run after {' and '.join(missing)}, but {where}; the parameters of the data "
            "sheet are used"
        )


def _print_recording(command: ExperimentCommand, recording: Recording, path: Path) -> int:
    """Print the outcome of an experiment that was recorded but not fitted."""
    name, ended = recording.meta["experiment"], str(recording.meta["ended"])
    complete = ended == COMPLETE
    if command.json:
        outcome = {"experiment": name, "robot": recording.meta["robot"], "ended": ended, "recording": str(path)}
        print_json({**outcome, "duration": recording.duration, "digest": recording.digest})
    else:
        what = "recorded" if complete else f"stopped after {recording.duration:.1f} s: {ended}; recorded until then"
        print(f"{name} experiment {what}: {path}", file=sys.stdout if complete else sys.stderr)
        if complete:
            print(next_command("fit it", "identify", name, "--recording", path.parent))
    return 0 if complete else STOPPED
