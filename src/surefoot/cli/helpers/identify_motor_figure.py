"""`surefoot identify motor-figure`: compare two motor models that follow a sine or a recording."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Annotated

from surefoot.cli.helpers.options import Json, Settings, World, files_by_suffix
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Duration, Within
from surefoot.robot import DEFAULT_ROBOT


@dataclass(frozen=True)
class MotorFigureCommand:
    """Let one motor of a robot on its rack follow a sine with both motor models, and plot the angles.

    With --log the targets are taken from the recording, and errors are relative to its measured angles, which are also
    plotted. Without it errors are relative to the target, and show the lag of each model.
    """

    log: Path | None = None
    """Recording of a motor: a CSV file with the columns time [s], target [rad] and angle [rad]."""
    out: tuple[Path, ...] = (Path("motor_figure.png"),)
    """Files to write: the figure (.png), and the simulated motion of the DC motor as a recording (.csv)."""
    motor: str | None = None
    """Name of the motor. Defaults to the robot's first motor."""
    amplitude: Annotated[float, Within(-10, 10)] = 0.3
    """Amplitude of the sine without --log [rad]."""
    frequency: Annotated[float, Within(0, 1000, exclusive=True)] = 3.0
    """Frequency of the sine without --log [Hz]."""
    duration: Duration = 1.0
    """Duration of the sine without --log [s]."""
    settings: Settings = ()
    """Physical parameters to change, such as resistance=0.2."""
    robot: str = DEFAULT_ROBOT
    """Name or folder of the robot."""
    world: World = "mujoco"
    json: Json = False


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(MotorFigureCommand, argv, "surefoot identify motor-figure")
    files = files_by_suffix(command.out, (".png", ".csv"))
    if ".png" in files:
        import_module("matplotlib")
    from surefoot.identify.motor_figure import MotorLog, motor_index, run_motor_experiment
    from surefoot.report.figures.runs import STYLES, motor_figure
    from surefoot.robot import RobotDescription, parse_settings
    from surefoot.world.registry import find_world

    robot = RobotDescription.load(command.robot)
    make_world = find_world(command.world)
    motor = command.motor or robot.motor_names[0]
    index = motor_index(robot, motor)
    if command.log is not None:
        log = MotorLog.read(command.log)
    else:
        middle, step = float(robot.resting_angles[index]), robot.timing.control_step
        log = MotorLog.sine(middle, command.amplitude, command.frequency, command.duration, step)
    params = parse_settings([word for group in command.settings for word in group])
    angles = run_motor_experiment(robot, make_world, log, index, params)
    errors = {name: log.error(angle) for name, angle in angles.items()}
    title = f"{motor} of {robot.name} on the rack, in {command.world}"
    against = log.name if command.log is not None else "target"
    if ".png" in files:
        motor_figure(files[".png"], log.time, log.target, log.angle, angles, errors, title)
    if ".csv" in files:
        MotorLog(log.name, log.time, log.target, angles["dc"]).write(files[".csv"])
    if command.json:
        report = {"motor": motor, "robot": robot.name, "world": command.world, "against": against, "rms_error": errors}
        print_json({**report, "files": command.out})
        return 0
    for name, error in errors.items():
        print(f"{STYLES[name][1]}: {error:.4f} rad RMS relative to {against}")
    print(f"wrote {', '.join(map(str, command.out))}")
    return 0
