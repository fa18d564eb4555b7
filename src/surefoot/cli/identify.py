"""`surefoot identify`: experiments on a robot, parameters from them or from recorded runs, and the motor figure.

Exit codes: 0 done; 2 refused before anything moved, or data that tell nothing; 3 the experiment was stopped.
"""

from __future__ import annotations

import datetime
import sys
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

from surefoot.cli.helpers.identify_run import ExperimentCommand, run_experiment
from surefoot.cli.helpers.options import Json, Seed, check_folder, check_suffix
from surefoot.cli.helpers.output import print_json, table_lines
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Within
from surefoot.errors import SurefootError, choices
from surefoot.identify.overlay import Known, read_known
from surefoot.identify.recording import COMPLETE, Recording, load_recording
from surefoot.identify.registry import EXPERIMENTS, Experiment
from surefoot.robot import FiveBar, RobotDescription

STOPPED = 3
"""Exit code of an experiment that did not come to its end."""
RECORDING = "recording.npz"
RUNS = Path("runs/identify")
FROM_TRACE = "--from-trace"
FIGURE = "motor-figure"
_USAGE = """usage: surefoot identify EXPERIMENT --port PORT ...
       surefoot identify EXPERIMENT --recording FOLDER ...
       surefoot identify --from-trace FOLDER ...

Find a robot's physical parameters by experiments, and write them to a file for surefoot train --params FILE.

experiments on a robot, in this order, each with --params FILE of what is known already:
{experiments}

without an experiment:
{others}

surefoot identify EXPERIMENT --help tells what it takes."""


@dataclass(frozen=True)
class TracesCommand:
    """Find a robot's physical parameters from traces of its runs, without an experiment.

    The last runs, at least one, are kept back to try the fit on; of a single run its last quarter.
    """

    from_trace: Path
    """Trace file (.npz), or a folder of them. Of robots with joint actuators: logs of commands and angles."""
    fit: tuple[str, ...] = ()
    """Physical parameters to find; all that traces tell, if not given. The others are taken as they are known."""
    params: Path | None = None
    """File of what is known of the robot (.toml); what is found is written to it. robot.toml in --out, if not given."""
    out: Path | None = None
    """Folder for the report; runs/identify/traces-TIME, if not given."""
    robot: str | None = None
    """Name or folder of the robot's description; the traces' robot, if not given."""
    rack: tuple[str, ...] = ()
    """Logs, by the names of their files, of a robot that hung with its base held still."""
    hold_out: tuple[str, ...] = ()
    """Logs, by the names of their files, that are not fitted but replayed with what was found."""
    seconds: Annotated[float, Within(0.5, 3600)] = 2.3
    """How much of each log is fitted [s], from its start."""
    search: Annotated[int, Within(0, 100_000)] = 0
    """Generations of CMA-ES that look for a start before logs are fitted."""
    seed: Seed = 1
    json: Json = False


def check_identifiable(robot: RobotDescription) -> None:
    """Refuse a robot that the experiments and fits are not made for."""
    if robot.actuator.kind != "dc" or not isinstance(robot.leg_geometry, FiveBar):
        raise SurefootError(f"identify takes robots with five-bar legs and DC motors; {robot.name} has others")


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_usage(), file=sys.stdout if argv else sys.stderr)
        return 0 if argv else 2
    word = argv[0]
    if word == FIGURE:
        code: int = import_module("surefoot.cli.helpers.identify_motor_figure").main(argv[1:])
        return code
    if word.partition("=")[0] == FROM_TRACE:
        return _from_trace(argv)
    if word in EXPERIMENTS:
        return _experiment(word, argv[1:])
    named = choices([*EXPERIMENTS, FIGURE])
    raise SurefootError(f"'{word}' is no experiment; choices: {named}, or {FROM_TRACE} FOLDER")


def _usage() -> str:
    experiments = {name: f"{one.what} (on {'rack' if one.rack else 'ground'})" for name, one in EXPERIMENTS.items()}
    others = {
        f"{FROM_TRACE} FOLDER": "motors and delays from traces of runs; a robot with joint actuators from logs",
        FIGURE: "one motor follows a sine: servo and DC motor, constraint motor, and a recording",
    }
    width = max(map(len, [*experiments, *others]))
    return _USAGE.format(experiments=table_lines(experiments, width), others=table_lines(others, width))


def _from_trace(argv: list[str]) -> int:
    command = parse(TracesCommand, argv, "surefoot identify")
    _check_files(command)
    if command.robot is not None and (robot := RobotDescription.load(command.robot)).actuator.kind == "joint":
        return _from_logs(command, robot)
    for name in ("rack", "hold_out", "search"):
        if getattr(command, name):
            raise SurefootError(
                f"--{name.replace('_', '-')} is of logs of a robot with joint actuators; name it: --robot"
            )
    from surefoot.evaluate.recorded import find_traces

    traces = find_traces(command.from_trace)
    robot = RobotDescription.load(command.robot or str(traces[0][1].meta["robot"]))
    check_identifiable(robot)
    known = read_known(command.params, robot)
    from surefoot.cli.helpers.identify_results import check_installed, fitting, report, write

    check_installed()
    from surefoot.identify.traces.fit import fit_traces

    with fitting("traces") as say:
        found = fit_traces(robot, [trace for _, trace in traces], command.fit or None, known.params, say)
    folder = command.out or _new_folder("traces")
    files = write(robot, known, found, command.params or folder / "robot.toml", folder, str(command.from_trace))
    report(robot, known, found, files, {"traces": [str(path) for path, _ in traces]}, command.json)
    return 0


def _from_logs(command: TracesCommand, robot: RobotDescription) -> int:
    """Fit a whole robot with joint actuators to logs."""
    from surefoot.identify.logs.robot_log import read_log

    paths = sorted(command.from_trace.glob("*.npz")) if command.from_trace.is_dir() else [command.from_trace]
    if not paths:
        raise SurefootError(f"folder {command.from_trace} holds no logs (.npz)")
    logs = {path.name.removesuffix(".npz"): read_log(path, robot) for path in paths}
    for option, names in (("rack", command.rack), ("hold-out", command.hold_out)):
        if bad := [name for name in names if name not in logs]:
            raise SurefootError(f"--{option} names '{bad[0]}'; logs: {choices(logs)}")
    known = read_known(command.params, robot)
    from surefoot.cli.helpers.identify_results import check_installed, fitting, report, write

    check_installed()
    from surefoot.identify.logs.fit import fit_logs
    from surefoot.identify.logs.model import LogRun

    runs = {name: LogRun(log, name in command.rack) for name, log in logs.items()}
    fitted = [run for name, run in runs.items() if name not in command.hold_out]
    held = [runs[name] for name in command.hold_out]
    options: dict[str, Any] = {"seconds": command.seconds, "search": command.search, "seed": command.seed}
    with fitting("logs") as say:
        found = fit_logs(robot, fitted, held, command.fit or None, known.params, **options, report=say)
    folder = command.out or _new_folder("logs")
    files = write(robot, known, found, command.params or folder / "robot.toml", folder, str(command.from_trace.name))
    report(robot, known, found, files, {"logs": [str(path) for path in paths]}, command.json)
    return 0


def _experiment(name: str, argv: list[str]) -> int:
    command = parse(ExperimentCommand, argv, f"surefoot identify {name}")
    _check(command)
    experiment, robot = EXPERIMENTS[name], RobotDescription.load(command.robot)
    check_identifiable(robot)
    known = read_known(command.params, robot)
    from surefoot.cli.helpers.identify_results import check_installed, fitting, report, write

    if command.recording is not None:
        path = command.recording / RECORDING if command.recording.is_dir() else command.recording
        recording, folder = load_recording(path, robot, name), command.out or path.parent
        _warn(command, experiment, known)
    else:
        folder = command.out or _new_folder(name)
        path = folder / RECORDING
        if path.exists():
            raise SurefootError(f"{path} exists and is not written over; give another folder with --out")
        if not command.record_only:
            check_installed(f"surefoot identify {name} --record-only")
            _warn(command, experiment, known)
        recording = run_experiment(command, experiment.plan(robot), robot, path)
        if recording.meta["ended"] != COMPLETE or command.record_only:
            return _tell_recording(command, recording, path)
    check_installed()
    with fitting(name) as say:
        found = experiment.fit(robot, recording, known.params, known.sensors, say)
    files = write(robot, known, found, command.params or folder / "robot.toml", folder, str(path))
    told = {"recording": str(path), "ended": COMPLETE, "lacks": list(known.lacks(experiment.before))}
    report(robot, known, found, files, told, command.json)
    return 0


def _check(command: ExperimentCommand) -> None:
    if (command.port is None) == (command.recording is None):
        given = "none" if command.port is None else "both"
        raise SurefootError(f"--port of a robot, or --recording of an experiment: give one of them; {given} is given")
    if command.recording is not None:
        for name in ("record_only", "yes", "lockstep"):
            if getattr(command, name):
                option = name.replace("_", "-")
                raise SurefootError(f"--recording and --{option} don't go together; a recording needs no robot")
    if command.record_only and command.params is not None:
        raise SurefootError("--record-only and --params don't go together; what is known is needed when it is fitted")
    _check_files(command)


def _check_files(command: ExperimentCommand | TracesCommand) -> None:
    check_suffix("params", command.params, ".toml")
    check_folder(command.out)


def _new_folder(name: str) -> Path:
    return RUNS / f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"


def _warn(command: ExperimentCommand, experiment: Experiment, known: Known) -> None:
    """Say which experiments should have come before."""
    lacks = known.lacks(experiment.before)
    if lacks:
        where = f"{command.params} has no results of it" if command.params is not None else "no --params FILE is given"
        print(
            f"surefoot: warning: {experiment.name} should come after {' and '.join(lacks)}, and {where}; the data "
            "sheet stands in",
            file=sys.stderr,
        )


def _tell_recording(command: ExperimentCommand, recording: Recording, path: Path) -> int:
    """Say what was recorded, of an experiment that is not fitted."""
    ended = str(recording.meta["ended"])
    whole = ended == COMPLETE
    if command.json:
        told = {
            "experiment": recording.meta["experiment"],
            "robot": recording.meta["robot"],
            "ended": ended,
            "duration": recording.duration,
            "recording": str(path),
            "digest": recording.digest,
        }
        print_json(told)
    else:
        said = "recorded" if whole else f"stopped after {recording.duration:.1f} s: {ended}; recorded until then"
        print(f"{recording.meta['experiment']} experiment {said}: {path}", file=sys.stdout if whole else sys.stderr)
        if whole:
            print(f"to fit it: surefoot identify {recording.meta['experiment']} --recording {path.parent}")
    return 0 if whole else STOPPED
