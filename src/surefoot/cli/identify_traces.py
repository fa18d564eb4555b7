"""`surefoot identify --from-trace FOLDER`: physical parameters from runs that were recorded."""

from __future__ import annotations

import datetime
from dataclasses import dataclass
from pathlib import Path

import tyro

from surefoot.cli.identify_experiment import RUNS
from surefoot.cli.identify_results import check_installed, fitting, tell, write
from surefoot.cli.parsing import parse
from surefoot.errors import SurefootError
from surefoot.evaluate.recorded import find_traces
from surefoot.identify.overlay import read_known
from surefoot.robot import RobotDescription


@dataclass(frozen=True)
class TracesCommand:
    """Find a robot's physical parameters from traces of its runs, without an experiment.

    The last runs, at least one, are kept back to try the fit on; of a single run its last quarter.
    """

    from_trace: Path
    """Trace file (.npz), or a folder of them."""
    fit: tuple[str, ...] = ()
    """Physical parameters to find; all that traces tell, if not given. The others are taken as they are known."""
    params: Path | None = None
    """File of what is known of the robot (.toml); what is found is written to it. robot.toml in --out, if not given."""
    out: Path | None = None
    """Folder for the report; runs/identify/traces-TIME, if not given."""
    robot: str | None = None
    """Name or folder of the robot's description; the traces' robot, if not given."""
    json: bool = False
    """Print one JSON object."""


def main(argv: list[str]) -> int:
    """Run the command with all of its words; returns the exit code."""
    command = parse(TracesCommand, argv, "surefoot identify", config=(tyro.conf.FlagCreatePairsOff,))
    if command.params is not None and command.params.suffix.lower() != ".toml":
        raise SurefootError(f"params {command.params}: the name must end in .toml")
    if command.out is not None and command.out.exists() and not command.out.is_dir():
        raise SurefootError(f"out is {command.out}; it must be a folder")
    traces = find_traces(command.from_trace)
    robot = RobotDescription.load(command.robot or str(traces[0][1].meta["robot"]))
    known = read_known(command.params, robot)
    check_installed()
    from surefoot.identify.from_trace import fit_traces

    with fitting("traces") as say:
        found = fit_traces(robot, [trace for _, trace in traces], command.fit or None, known.params, say)
    folder = command.out or RUNS / f"traces-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    params = command.params or folder / "robot.toml"
    files = write(robot, known, found, params, folder, str(command.from_trace))
    tell(robot, known, found, files, {"traces": [str(path) for path, _ in traces]}, command.json)
    return 0
