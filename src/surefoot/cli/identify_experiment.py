"""`surefoot identify EXPERIMENT`: on a robot, or once more from what was recorded.

Exit codes: 0 done; 2 refused before anything moved, or data that tell nothing; 3 the experiment was stopped.
"""

from __future__ import annotations

import datetime
import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.cli.parsing import parse
from surefoot.configuration import Within
from surefoot.deploy.link import BAUD
from surefoot.errors import SurefootError
from surefoot.identify.overlay import Known, read_known
from surefoot.identify.recording import COMPLETE, Recording, load_recording
from surefoot.identify.registry import EXPERIMENTS, Experiment
from surefoot.robot import RobotDescription

STOPPED = 3
"""Exit code of an experiment that did not come to its end."""
RECORDING = "recording.npz"
RUNS = Path("runs/identify")


@dataclass(frozen=True)
class ExperimentCommand:
    """Run an experiment on a robot, or take a recording of one, and find the physical parameters that it tells.

    What is going to happen is shown, and asked for, before a motor moves. The recording is kept however the experiment
    ends; --record-only leaves the fit to another computer, such as one with MuJoCo. Exit codes: 0 done, 2 refused
    before anything moved or data that tell nothing, 3 stopped.
    """

    port: str | None = None
    """Serial port or pseudo-terminal of the robot, such as /dev/ttyUSB0."""
    recording: Path | None = None
    """Take this recording instead of a robot: the folder of an experiment, or its file."""
    params: Path | None = None
    """File of what is known of the robot (.toml); what is found is written to it. robot.toml in --out, if not given."""
    out: Path | None = None
    """Folder for recording and report; runs/identify/EXPERIMENT-TIME or the recording's, if not given."""
    record_only: bool = False
    """Record and do not fit; needs the bare install only."""
    yes: bool = False
    """Do not ask before motors move."""
    lockstep: bool = False
    """The robot is an emulator that runs with --lockstep."""
    baud: Annotated[int, Within(9600, 100_000_000)] = BAUD
    """Bits a second of a serial port."""
    robot: str = "minitaur"
    """Name or folder of the robot's description."""
    json: bool = False
    """Print one JSON object."""


def main(name: str, argv: list[str]) -> int:
    """Run an experiment's command with the words after its name; returns the exit code."""
    command = parse(ExperimentCommand, argv, f"surefoot identify {name}", config=(tyro.conf.FlagCreatePairsOff,))
    _check(command)
    experiment, robot = EXPERIMENTS[name], RobotDescription.load(command.robot)
    known = read_known(command.params, robot)
    if command.recording is not None:
        path = command.recording / RECORDING if command.recording.is_dir() else command.recording
        recording, folder = load_recording(path, robot, name), command.out or path.parent
        _warn(command, experiment, known)
    else:
        folder = command.out or RUNS / f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
        path = folder / RECORDING
        _check_free(folder, path)
        if not command.record_only:
            from surefoot.cli.identify_results import check_installed

            check_installed(f"surefoot identify {name} --record-only")
            _warn(command, experiment, known)
        recording = _record(command, experiment, robot, path)
        if recording.meta["ended"] != COMPLETE or command.record_only:
            return _tell_recording(command, recording, path)
    return _fit(command, experiment, robot, known, recording, path, folder)


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
    if command.params is not None and command.params.suffix.lower() != ".toml":
        raise SurefootError(f"params {command.params}: the name must end in .toml")


def _check_free(folder: Path, path: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise SurefootError(f"out is {folder}; it must be a folder")
    if path.exists():
        raise SurefootError(f"{path} exists and is not written over; give another folder with --out")


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


def _record(command: ExperimentCommand, experiment: Experiment, robot: RobotDescription, path: Path) -> Recording:
    from surefoot.cli.identify_run import Session, run_experiment

    session = Session(str(command.port), command.lockstep, command.baud, command.yes, command.json)
    return run_experiment(session, experiment.plan(robot), robot, path)


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
        print(json.dumps(told))
    else:
        said = "recorded" if whole else f"stopped after {recording.duration:.1f} s: {ended}; recorded until then"
        print(f"{recording.meta['experiment']} experiment {said}: {path}", file=sys.stdout if whole else sys.stderr)
        if whole:
            print(f"to fit it: surefoot identify {recording.meta['experiment']} --recording {path.parent}")
    return 0 if whole else STOPPED


def _fit(
    command: ExperimentCommand,
    experiment: Experiment,
    robot: RobotDescription,
    known: Known,
    recording: Recording,
    path: Path,
    folder: Path,
) -> int:
    from surefoot.cli.identify_results import check_installed, fitting, tell, write

    check_installed()
    with fitting(experiment.name) as say:
        found = experiment.fit(robot, recording, known.params, known.sensors, say)
    params = command.params or folder / "robot.toml"
    files = write(robot, known, found, params, folder, str(path))
    told = {"recording": str(path), "ended": COMPLETE, "lacks": list(known.lacks(experiment.before))}
    tell(robot, known, found, files, told, command.json)
    return 0
