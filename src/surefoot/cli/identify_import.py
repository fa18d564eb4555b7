"""`surefoot identify import`: convert a log to a trace."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from surefoot.cli.helpers.options import Json, Settings, check_suffix
from surefoot.cli.helpers.output import print_json, show_command
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError, choices
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS, parse_settings


@dataclass(frozen=True)
class ImportCommand:
    """Convert a log to a trace, row by row; columns that the log lacks are missing in the trace.

    Without --map the log must be an .npz file with the arrays time, command, motor_angle and imu in the robot's motor
    order. A log of a Go2 may also be a ROS bag with /lowstate and /lowcmd, or a CSV file of its states.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Log file: .npz, .csv, .pkl, .pt, .parquet, .mcap, .bag, or the folder of a ROS 2 bag."""
    robot: str
    """Name of a released robot, or the folder of a robot."""
    out: Path
    """Trace file to write (.npz)."""
    map: Path | None = None
    """File (.yaml) that maps columns to motors, with their units, signs and clock."""
    between: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="START END")] = None
    """Time interval of the log to convert [s], relative to its first row."""
    settings: Settings = ()
    """Gains of the recorded robot, such as servo_kp=20 servo_kd=1.5; they are stored in the trace."""
    any_checksum: bool = False
    """Also accept messages of a Go2 with a wrong checksum."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(ImportCommand, argv, "surefoot identify import")
    check_suffix("out", command.out, ".npz")
    robot = RobotDescription.load(command.robot)
    from surefoot.identify.motion.importing import import_log
    from surefoot.identify.motion.log_checks import check_log
    from surefoot.identify.motion.traces import trace_from_motion

    motion = import_log(command.file, robot, command.map, command.any_checksum)
    if command.between is not None:
        motion = motion.crop(*command.between)
    if gains := parse_settings([word for group in command.settings for word in group]):
        if bad := [name for name in gains if name not in GAINS]:
            raise SurefootError(f"--set names {bad[0]}; a log has only the gains {choices(GAINS)}")
        PhysicalParams.nominal(robot).with_values(robot, **gains)
        motion = replace(motion, gains={**motion.gains, **gains})
    # Logs of states are imported without checking commands, also of a Go2 with commands in some rows.
    states = motion.read_at_row or not np.isfinite(motion.command).any()
    timing = (motion if states else motion.require_replayable()).timing()
    notes, missing = [*motion.meta.get("notes", []), *check_log(motion, robot)], motion.missing()
    if not np.isfinite(motion.command).any():
        missing = ["command", *missing]
    trace_from_motion(motion, robot).save(command.out)
    if command.json:
        print_json({"trace": str(command.out), "missing": missing, "timing": timing, "notes": notes})
        return 0
    steps = [1e3 * timing[f"{name}_step"] for name in ("least", "median", "greatest")]
    print(f"{timing['rows']} rows, {timing['seconds']:.2f} s; steps of {steps[0]:.2f} to {steps[2]:.2f} ms, ", end="")
    print(f"median {steps[1]:.2f}")
    print(f"{100 * timing['repeated_times']:.1f} % of the times and ", end="")
    print(f"{100 * timing['repeated_readings']:.1f} % of the readings equal the previous row's; they are kept")
    if missing:
        print(f"missing: {choices(missing)}")
    for note in notes:
        print(note)
    print(f"wrote {command.out}")
    print(show_command([command.out]))
    return 0
