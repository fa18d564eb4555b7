"""`surefoot emulate`: a process that is the microcontroller and the robot, behind a pseudo-terminal."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from surefoot.cli.helpers.options import Repeated, Settings, World, files_by_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Seed, Within
from surefoot.errors import SurefootError
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params_file import load_params, write_params

if TYPE_CHECKING:
    from surefoot.cli.helpers.viewer import EmulateViewer
    from surefoot.emulator.faults import InjectedFault
    from surefoot.emulator.real_time import RealTime, Summary
    from surefoot.emulator.serial.lockstep import Lockstep
    from surefoot.emulator.serial.pty_port import PtyPort

STRIDE = 3
"""Servo steps that physics may advance at once in real time; one by one they cost half as much again in Bullet."""


@dataclass(frozen=True)
class EmulateCommand:
    """Emulate a robot: open a pseudo-terminal, print its name, and serve the wire protocol there until interrupted.

    The physics runs in real time; with --lockstep it follows the times in the frames that arrive instead. One line at
    the end sums up the run. --fault help lists the faults.
    """

    world: World = "mujoco"
    robot: str = DEFAULT_ROBOT
    """Name or folder of the robot."""
    params: Path | None = None
    """File of physical parameters (.toml), or the name of one that ships with the robot; the data sheet's, if not
    given."""
    settings: Settings = ()
    """Physical parameters that differ, such as motor_strength=0.8."""
    hidden_seed: Seed | None = None
    """Draw physical parameters that are not printed."""
    hidden_ranges: str = "table1"
    """Table of ranges to draw them from; with ensemble, seeds 1 to 20 are the robots of world ensemble, and 21 to 60
    those of ensemble-test."""
    faults: Annotated[Repeated, tyro.conf.arg(name="fault", metavar="NAME[=VALUE][@TIME] [...]")] = ()
    """What goes wrong, such as drop=0.01, or unplug=1.5 (s after the robot is first armed); help lists them."""
    lockstep: bool = False
    """Follow the times in the frames that arrive, instead of the computer's clock."""
    rack: bool = False
    """Hold the base in the air."""
    ideal_sensors: bool = False
    """Encoders and IMU without quantization, noise and drift, a battery that does not sag."""
    seed: Seed = 0
    """Seed of noise, and of faults at random."""
    baud: Annotated[float, Within(0, 1e8)] = 921600.0
    """Bits a second of the serial line, in real time; 0: bytes take no time."""
    link: Path | None = None
    """Symbolic link to the pseudo-terminal, removed at the end."""
    out: tuple[Path, ...] = ()
    """Files to write: what a motion capture system sees of the robot, 200 times a second (.csv), and the physical
    parameters that --hidden-seed draws (.toml), for checking later."""
    duration: Annotated[float, Within(0, 1e7, above=True)] | None = None
    """End after so much robot time [s]."""
    viewer: bool = False
    """Show the robot in a window."""

    @property
    def files(self) -> dict[str, Path]:
        """Files of --out by suffix."""
        return files_by_suffix(self.out, (".csv", ".toml"))


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(EmulateCommand, argv, "surefoot emulate")
    words = [word for group in command.faults for word in group]
    if "help" in words:
        from surefoot.emulator.faults import describe

        print("\n".join(describe()))
        return 0
    _check(command)
    from surefoot.emulator.faults import parse_faults
    from surefoot.world.registry import check_takes_params

    robot = RobotDescription.load(command.robot)
    faults = parse_faults(words, command.lockstep, robot.num_motors)
    if "tilt" in faults and command.rack:
        raise SurefootError("fault tilt needs a robot that can fall; it does not go with --rack")
    check_takes_params(command.world)
    if command.viewer:
        from surefoot.cli.helpers.viewer import has_display

        if not has_display():
            raise SurefootError("viewer: there is no display here (DISPLAY is not set); run without --viewer")
    return _run(command, robot, faults)


def _check(command: EmulateCommand) -> None:
    if command.baud and command.baud < 9600:
        raise SurefootError(f"baud is {command.baud:g}; it must be 9600 or more, or 0")
    files = command.files
    if ".toml" in files and command.hidden_seed is None:
        raise SurefootError(f"out {files['.toml']} is for hidden parameters; give --hidden-seed too")
    if command.hidden_seed is not None and (command.params is not None or command.settings):
        raise SurefootError("hidden_seed draws the parameters; it does not go with --params and --set")
    for path in files.values():
        if path.exists():
            raise SurefootError(f"out {path} exists; give another name")


def _params(command: EmulateCommand, robot: RobotDescription) -> PhysicalParams:
    if command.hidden_seed is None:
        return load_params(robot, command.params, command.settings)
    from surefoot.robot.randomization import draw_hidden, load_ranges

    params = draw_hidden(robot, load_ranges(command.hidden_ranges, robot=robot.folder), command.hidden_seed)
    if (path := command.files.get(".toml")) is not None:
        write_params(path, robot, params, {"origin": {"hidden_seed": command.hidden_seed}})
    return params


def _servo_every(robot: RobotDescription, fault: InjectedFault | None) -> int:
    """Return the physics steps between two steps of the servo, with its fault if it has one."""
    if fault is None:
        return 1
    step = robot.timing.servo_step
    every = round(fault.value / step)
    if every < 1 or abs(fault.value / step - every) > 1e-6:
        raise SurefootError(f"fault slow-servo is {fault.value:g}; it must be whole servo steps of {step:g} s")
    return every


def make_loop(
    command: EmulateCommand, robot: RobotDescription, faults: dict[str, InjectedFault], port: PtyPort, summary: Summary
) -> RealTime | Lockstep:
    """Return the loop that runs the robot, warmed up."""
    from surefoot import __version__
    from surefoot.deploy.board.limits import Limits, make_handshake
    from surefoot.deploy.serial.serial_link import LEAD
    from surefoot.emulator.board import Board
    from surefoot.emulator.hardware import PowerConfig, SensorConfig
    from surefoot.emulator.plant import Plant
    from surefoot.emulator.real_time import RealTime
    from surefoot.emulator.serial.lockstep import PATIENCE, Lockstep
    from surefoot.emulator.serial.serial_host_link import SerialHostLink

    every = _servo_every(robot, faults.get("slow-servo"))
    sensors, power = (SensorConfig.ideal(), PowerConfig.ideal()) if command.ideal_sensors else (None, None)
    params, limits = _params(command, robot), Limits.from_robot(robot)
    plant = Plant(robot, params, command.seed, sensors, power, command.rack, command.world, every)
    handshake = make_handshake(robot, limits, f"surefoot emulator {__version__}", robot.timing.servo_step)
    if command.lockstep:
        link = SerialHostLink(port, robot.num_motors, faults, seed=command.seed, patience=PATIENCE)
        return Lockstep(Board(plant, handshake, link, limits, faults), link, port, summary)
    link = SerialHostLink(port, robot.num_motors, faults, command.baud, command.seed, lead=LEAD)
    load = faults["overload"].value if "overload" in faults else 0.0
    return RealTime(Board(plant, handshake, link, limits, faults, STRIDE), summary, load)


def _run(command: EmulateCommand, robot: RobotDescription, faults: dict[str, InjectedFault]) -> int:
    from surefoot.deploy.pacer import undisturbed
    from surefoot.emulator.capture_writer import CaptureWriter
    from surefoot.emulator.real_time import Summary
    from surefoot.emulator.serial.pty_port import PtyPort
    from surefoot.stop_signals import StopSignals

    summary = Summary()

    def end(_: int) -> None:
        summary.stop = True

    port = PtyPort(command.link, held=not command.lockstep)
    observers: list[CaptureWriter | EmulateViewer] = []
    with StopSignals(on_signal=end, respect_nohup=True):
        try:
            loop = make_loop(command, robot, faults, port, summary)
            board = loop.board
            if (path := command.files.get(".csv")) is not None:
                observers.append(CaptureWriter(path, board.plant, later=not command.lockstep))
            if command.viewer:
                from surefoot.cli.helpers.viewer import EmulateViewer

                observers.append(EmulateViewer(command.robot, board.plant))
            board.on_step = [observer.see for observer in observers]
            # A microcontroller has a processor of its own, so the emulator comes before other processes.
            with contextlib.nullcontext() if command.lockstep else undisturbed():
                print(f"robot on {port.path}", flush=True)
                loop.run(command.duration)
        finally:
            port.close()
            for observer in observers:
                observer.close()
                if isinstance(observer, CaptureWriter) and observer.file.stopped:
                    print(f"surefoot: motion capture stopped: {observer.file.stopped}", file=sys.stderr)
    print(f"surefoot: {summary.text(board)}", file=sys.stderr)
    return 0
