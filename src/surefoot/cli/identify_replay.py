"""`surefoot identify replay`: replay the commands of a recorded run on a simulated robot, and compare the readings."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any

import tyro

from surefoot.cli.helpers.options import Json, RobotName, Settings, World, check_suffix
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.evaluation.recorded import load_robot
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.robot_params_file import read_gains
from surefoot.robot import RobotDescription
from surefoot.robot.params import GAINS
from surefoot.robot.params_file import ParamValue, find_params, load_params, read_params
from surefoot.tables import plain_value
from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class ReplayCommand:
    """Replay the commands of a recorded run, at their recorded times, on a simulated robot; compare the readings.

    Errors are root mean squares, computed from 0.3 s on: over all joints that move [rad], for each motor, and for each
    channel of the IMU. The robot stands on the ground or, with --rack, hangs on a rack.
    """

    trace: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="TRACE")]
    """Trace file, or an .npz file with the arrays time, command, motor_angle and imu."""
    robot: RobotName = None
    params: Annotated[str | None, tyro.conf.arg(metavar="NAME|FILE")] = None
    """File of physical parameters (.toml), or the name of one released with the robot. Defaults to the data sheet."""
    settings: Settings = ()
    """Physical parameters to change, such as contact_friction=0.8; they override --params."""
    world: World = "mujoco"
    rack: bool = False
    """The recorded robot hung with its base fixed."""
    beside: Path | None = None
    """Another recording of the same commands to compare and plot, such as from another simulator."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FIGURE")] = None
    """Figure to write (.png): angles and errors over time."""
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(ReplayCommand, argv, "surefoot identify replay")
    check_suffix("out", command.out, ".png")
    if command.out is not None:
        import_module("matplotlib")
    if command.robot is None:
        robot = load_robot(command.trace, EpisodeTrace.load(command.trace))
    else:
        robot = RobotDescription.load(command.robot)
    from surefoot.identify.motion.replay_errors import compare_motions, replay_motion
    from surefoot.identify.motion.traces import read_motion
    from surefoot.identify.replay import Replayer
    from surefoot.world.registry import check_takes_params

    check_takes_params(command.world)
    log = replace(read_motion(command.trace, robot), rack=command.rack)
    gains, source = _gains(log, robot, command)
    params = load_params(robot, command.params, command.settings, gains)
    other = None if command.beside is None else compare_motions(log, read_motion(command.beside, robot))
    replayer = Replayer(robot, 1, command.rack, command.world, torques=False)
    errors = replay_motion(log, robot, params, replayer)
    report: dict[str, Any] = {
        "rms": errors.rms,
        "rms_by_motor": dict(zip(robot.motor_names, map(plain_value, errors.by_motor.tolist()), strict=True)),
        "rms_imu": {name: plain_value(value) for name, value in errors.by_imu.items()},
        "moving": [name for name, moves in zip(robot.motor_names, log.moving_joints, strict=True) if moves],
        "gains": {name: getattr(params, name)[0].tolist() for name in GAINS},
        "gains_from": source,
        "world": command.world,
        "rack": command.rack,
        "timing": log.timing(),
    }
    if other is not None:
        report["beside"] = {"file": str(command.beside), "rms": other.rms}
    if command.out is not None:
        from surefoot.report.figures.replay import draw_replay

        draw_replay(command.out, robot, errors, other, "" if command.beside is None else command.beside.stem)
        report["figure"] = str(command.out)
    if command.json:
        print_json(report)
        return 0
    gains_text = " and ".join(f"{name} {_numbers(report['gains'][name])}" for name in GAINS)
    print(f"gains: {gains_text}, from {source}")
    print(f"root mean square over the joints that move: {errors.rms:.4f} rad")
    for name, value in report["rms_by_motor"].items():
        moves = "" if name in report["moving"] else "  (at rest)"
        print(f"  {name:<24} {'not read' if value is None else f'{value:.4f} rad'}{moves}")
    for name, value in report["rms_imu"].items():
        unit = "rad/s" if name.endswith("rate") else "rad"
        print(f"  {name:<24} {'not read' if value is None else f'{value:.4f} {unit}'}")
    if other is not None:
        print(f"{command.beside}: {other.rms:.4f} rad, until {other.motion.time[-1]:.1f} s")
    if command.out is not None:
        print(f"figure: {command.out}")
    return 0


def _gains(log: RecordedMotion, robot: RobotDescription, command: ReplayCommand) -> tuple[dict[str, ParamValue], str]:
    """Return the gains of a replay, before changes by --set, and their source."""
    gains: dict[str, ParamValue] = {}
    source = "the data sheet"
    if command.params is not None:
        file = read_params(find_params(command.params, robot), robot)
        gains = read_gains(file)
        if gains or set(GAINS) & set(file.names):
            source = str(command.params)
    if log.gains:
        gains, source = {**gains, **log.gains}, "the log"
    if any(word.partition("=")[0] in GAINS for words in command.settings for word in words):
        source = "--set"
    return gains, source


def _numbers(values: list[float]) -> str:
    """Return one value per motor as text: the common value, or the range."""
    low, high = min(values), max(values)
    return f"{low:.4g}" if low == high else f"{low:.4g} to {high:.4g}"
