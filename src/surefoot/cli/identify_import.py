"""`surefoot identify import`: a trace from a log that others recorded."""

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
from surefoot.robot.params import parse_settings

GAINS = ("servo_kp", "servo_kd")


@dataclass(frozen=True)
class ImportCommand:
    """Make a trace of somebody's log, row by row; what the log does not have is missing in the trace.

    Without --map the log is an .npz file with arrays time, command, motor_angle and imu in the robot's own order. Of a
    Go2, it may be a bag with /lowstate and /lowcmd, or a CSV file of its states.
    """

    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """Log: .npz, .csv, .pkl, .pt, .parquet, .mcap, .bag, or the folder of a ROS 2 bag."""
    robot: str
    """Name or folder of the robot's description."""
    out: Path
    """Trace to write (.npz)."""
    map: Path | None = None
    """Which column is which motor, with units, signs and clock (.yaml)."""
    between: Annotated[tuple[float, float] | None, tyro.conf.arg(metavar="START END")] = None
    """Part of the log that becomes the trace [s], from its first row on."""
    settings: Settings = ()
    """Gains with which the robot was recorded, such as servo_kp=20 servo_kd=1.5: kept in the trace."""
    any_checksum: bool = False
    """Take messages of a Go2 whose checksum is wrong, too."""
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
        motion = motion.between(*command.between)
    if gains := parse_settings([word for group in command.settings for word in group]):
        if bad := [name for name in gains if name not in GAINS]:
            raise SurefootError(f"--set names {bad[0]}, and a log has gains: {choices(GAINS)}")
        PhysicalParams.nominal(robot).with_values(robot, **gains)
        motion = replace(motion, gains={**motion.gains, **gains})
    # States are imported without commands, those of a Go2 with commands in some rows too.
    states = motion.read_at_row or not np.isfinite(motion.command).any()
    timing = (motion if states else motion.checked()).timing()
    notes, missing = [*motion.meta.get("notes", []), *check_log(motion, robot)], motion.missing()
    if not np.isfinite(motion.command).any():
        missing = ["command", *missing]
    trace_from_motion(motion, robot).save(command.out)
    if command.json:
        print_json({"trace": str(command.out), "missing": missing, "timing": timing, "notes": notes})
        return 0
    steps = [1e3 * timing[f"{name}_step"] for name in ("least", "median", "greatest")]
    print(f"{timing['rows']} rows, {timing['seconds']:.2f} s; steps of {steps[0]:.2f} to {steps[2]:.2f} ms, ", end="")
    print(f"{steps[1]:.2f} in the middle")
    print(f"{100 * timing['repeated_times']:.1f} % of the times and ", end="")
    print(f"{100 * timing['repeated_readings']:.1f} % of the readings repeat the row before; they are kept")
    if missing:
        print(f"missing: {choices(missing)}")
    for note in notes:
        print(note)
    print(f"wrote {command.out}")
    print(show_command([command.out]))
    return 0
