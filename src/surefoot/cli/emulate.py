"""`surefoot emulate`: emulate a robot behind a pseudo-terminal or DDS topics."""

from __future__ import annotations

import contextlib
import sys
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from surefoot.cli.helpers.options import MapPort, Repeated, Settings, Terrain, changed_option, files_by_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Seed, Within
from surefoot.errors import SurefootError, choices
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription, parse_settings
from surefoot.robot.params import GAINS
from surefoot.robot.params_file import load_params, write_params
from surefoot.task.height_scan import ScanConfig
from surefoot.world.registry import check_takes_params, worlds_with_params

if TYPE_CHECKING:
    from surefoot.cli.helpers.viewer import EmulateViewer
    from surefoot.deploy.dds.bus import Bus
    from surefoot.emulator.board import EmulatedBoard
    from surefoot.emulator.fault_table import InjectedFault
    from surefoot.emulator.plant import Plant
    from surefoot.emulator.real_time import RealTimeLoop, Summary
    from surefoot.emulator.serial.lockstep import LockstepLoop
    from surefoot.emulator.serial.serial_host_link import HostPort, SerialHostLink

STRIDE = 3
"""Servo steps that the physics may advance at once in real time; single steps take 1.5 times as long in Bullet."""


@dataclass(frozen=True)
class EmulateCommand:
    """Emulate a robot (microcontroller and physics): print the name of a pseudo-terminal, and serve the wire protocol.

    With --link dds the emulator is a Unitree Go2 with its DDS topics on a network interface. The physics runs in real
    time or, with --lockstep, at the times in the received frames. Ctrl-C ends the emulator and prints a summary.
    `--fault help` lists the faults that can be injected.
    """

    world: Annotated[str, tyro.conf.arg(help=f"World (simulator): {choices(worlds_with_params())}.")] = "mujoco"
    robot: str = DEFAULT_ROBOT
    """Name or folder of the robot."""
    params: Path | None = None
    """File of physical parameters (.toml), or the name of one released with the robot. Defaults to the data sheet."""
    settings: Settings = ()
    """Physical parameters to change, such as motor_strength=0.8."""
    hidden_seed: Seed | None = None
    """Randomize the physical parameters with this seed, and do not print them."""
    hidden_ranges: Annotated[
        str,
        tyro.conf.arg(
            help="Table of their ranges. With ensemble, seeds 1 to 20 are the robots of world ensemble, and 21 to 60 "
            "the robots of ensemble-test.",
        ),
    ] = "table1"
    faults: Annotated[Repeated, tyro.conf.arg(name="fault", metavar="NAME[=VALUE][@TIME] [...]")] = ()
    """Faults to inject, such as drop=0.01, or unplug=1.5 (seconds after the robot is first armed); help lists them."""
    lockstep: bool = False
    """Advance according to the times in the received frames instead of the computer's clock."""
    rack: bool = False
    """Hold the base in the air."""
    ideal_sensors: bool = False
    """Disable quantization, noise and drift of encoders and IMU, and the voltage drop of the battery."""
    accelerometer: bool = False
    """Send the readings of an accelerometer over the serial link, as boards with one do; a Go2 always does."""
    terrain: Terrain = "flat"
    height_map: MapPort = None
    """UDP port of this computer to which the height map around the robot is sent, 50 times per second."""
    scan: ScanConfig = field(default_factory=ScanConfig)
    """Errors of the height map; the delay is a number of maps."""
    seed: Seed = 0
    """Seed of noise, random faults and random terrain."""
    baud: Annotated[float, Within(0, 1e8)] = 921600.0
    """Bits per second of the serial line in real time; 0: bytes are transferred without delay."""
    symlink: Path | None = None
    """Symbolic link to the pseudo-terminal; it is removed at the end."""
    socket: Path | None = None
    """Unix socket for --port of other commands, instead of a pseudo-terminal, which is late on a busy computer."""
    link: Literal["serial", "dds"] = "serial"
    """Link to hosts: a pseudo-terminal, or the DDS topics of a Go2."""
    interface: str = ""
    """Network interface of the topics, such as lo; required with --link dds."""
    domain: Annotated[int, Within(0, 232)] = 0
    """DDS domain of the topics; robots use 0."""
    motion_service: Annotated[
        Literal["released", "lying", "standing"],
        tyro.conf.arg(
            help="State of the Go2's own controller at the start: released, or active with the robot lying or standing "
            "up. It is active when a real robot starts.",
        ),
    ] = "released"
    out: tuple[Path, ...] = ()
    """Files to write: simulated motion capture at 200 Hz (.csv), and the parameters of --hidden-seed (.toml)."""
    duration: Annotated[float, Within(0, 1e7, exclusive=True)] | None = None
    """End after this robot time [s]. By default the emulator runs until Ctrl-C."""
    firmware: Annotated[
        Path | None,
        tyro.conf.arg(
            help="Firmware in C that the emulated microcontroller runs: a program compiled by `make` in a folder "
            "of `surefoot robot firmware new`. Defaults to surefoot's implementation in Python.",
        ),
    ] = None
    viewer: bool = False
    """Show the robot in a window."""

    @property
    def files(self) -> dict[str, Path]:
        """Files of --out, by suffix."""
        return files_by_suffix(self.out, (".csv", ".toml"))


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(EmulateCommand, argv, "surefoot emulate")
    words = [word for group in command.faults for word in group]
    if "help" in words:
        from surefoot.emulator.fault_table import describe

        print("\n".join(describe()))
        return 0
    _check(command)
    from surefoot.emulator.fault_table import parse_faults

    robot = RobotDescription.load(command.robot)
    faults = parse_faults(words, command.lockstep, robot.num_motors, command.link)
    if "tilt" in faults and command.rack:
        raise SurefootError("fault tilt requires a robot that can fall; it can't be combined with --rack")
    check_takes_params(command.world)
    if command.link == "dds":
        _check_go2(robot)
    if command.viewer:
        from surefoot.cli.helpers.viewer import has_display

        if not has_display():
            raise SurefootError("viewer: there is no display (DISPLAY is not set); run without --viewer")
    return _run(command, robot, faults)


def _check(command: EmulateCommand) -> None:
    if command.link == "dds":
        if not command.interface:
            raise SurefootError("link dds requires the network interface of the topics; give --interface, such as lo")
        for option in ("lockstep", "symlink", "socket", "firmware", "accelerometer"):
            if getattr(command, option):
                raise SurefootError(f"{option} applies to the serial link; it can't be combined with --link dds")
    elif command.interface or command.domain or command.motion_service != "released":
        raise SurefootError("interface, domain and motion_service apply to a DDS link; give --link dds as well")
    elif command.symlink is not None and command.socket is not None:
        raise SurefootError("symlink and socket can't be combined; a symbolic link refers to a pseudo-terminal")
    if command.firmware is not None and command.accelerometer:
        raise SurefootError("accelerometer can't be combined with --firmware; the firmware in C sends no accelerometer")
    if command.firmware is not None and any(word.startswith(GAINS) for group in command.settings for word in group):
        raise SurefootError("set changes a gain of the servo; a firmware has its own gains, in robot.h")
    if command.baud and command.baud < 9600:
        raise SurefootError(f"baud is {command.baud:g}; it must be 9600 or more, or 0")
    files = command.files
    if ".toml" in files and command.hidden_seed is None:
        raise SurefootError(f"out {files['.toml']} is for hidden parameters; give --hidden-seed as well")
    if command.hidden_seed is not None and (command.params is not None or command.settings):
        raise SurefootError("hidden_seed randomizes the parameters; it can't be combined with --params or --set")
    for path in files.values():
        if path.exists():
            raise SurefootError(f"out {path} exists; give another name")


def _check_go2(robot: RobotDescription) -> None:
    """Reject a robot whose motors differ from the Go2's messages."""
    from surefoot.deploy.dds.low_level import MOTOR_NAMES

    if robot.motor_names != MOTOR_NAMES or robot.actuator.kind != "joint":
        raise SurefootError(f"link dds is for a Unitree Go2; robot {robot.name} has other motors, give --robot go2")


def _params(command: EmulateCommand, robot: RobotDescription) -> PhysicalParams:
    if command.hidden_seed is None:
        if changed_option(command, ("hidden_ranges",)) is not None:
            raise SurefootError("--hidden-ranges is given without --hidden-seed, which draws from them")
        return load_params(robot, command.params, command.settings)
    from surefoot.robot.randomization import draw_hidden, load_ranges

    params = draw_hidden(robot, load_ranges(command.hidden_ranges, robot=robot.folder), command.hidden_seed)
    if (path := command.files.get(".toml")) is not None:
        write_params(path, robot, params, {"origin": {"hidden_seed": command.hidden_seed}})
    return params


def _servo_stride(robot: RobotDescription, fault: InjectedFault | None) -> int:
    """Return the number of physics steps per servo step, more than 1 with the fault slow-servo."""
    if fault is None:
        return 1
    step = robot.timing.servo_step
    stride = round(fault.value / step)
    if stride < 1 or abs(fault.value / step - stride) > 1e-6:
        raise SurefootError(f"fault slow-servo is {fault.value:g}; it must be a multiple of the servo step, {step:g} s")
    return stride


def make_plant(command: EmulateCommand, robot: RobotDescription, servo_every: int = 1) -> Plant:
    """Return the simulated body of the robot."""
    from surefoot.emulator.hardware import PowerConfig, SensorConfig
    from surefoot.emulator.plant import Plant
    from surefoot.world.terrain import make_terrain

    sensors, power = SensorConfig(), PowerConfig.from_robot(robot)
    if command.ideal_sensors:
        sensors, power = SensorConfig.ideal(), PowerConfig.ideal(robot)
    params, ground = _params(command, robot), make_terrain(command.terrain, command.seed)
    accelerometer = command.accelerometer or command.link == "dds"
    return Plant(
        robot, params, command.seed, sensors, power, command.rack, command.world, servo_every, ground, accelerometer
    )


def make_loop(
    command: EmulateCommand, robot: RobotDescription, faults: dict[str, InjectedFault], port: HostPort, summary: Summary
) -> RealTimeLoop | LockstepLoop:
    """Return the loop that runs the robot behind a pseudo-terminal or a socket; its kernels are compiled."""
    from surefoot.deploy.serial.serial_link import LEAD
    from surefoot.emulator.real_time import RealTimeLoop
    from surefoot.emulator.serial.lockstep import HOST_TIMEOUT, LockstepLoop
    from surefoot.emulator.serial.serial_host_link import SerialHostLink

    plant = make_plant(command, robot, servo_every=_servo_stride(robot, faults.get("slow-servo")))
    line = partial(
        SerialHostLink, port, robot.num_motors, faults, seed=command.seed, accelerometer=command.accelerometer
    )
    if command.lockstep:
        link = line(patience=HOST_TIMEOUT)
        return LockstepLoop(_make_board(command, plant, link, faults), link, port, summary)
    link = line(baud=command.baud, lead=LEAD)
    return RealTimeLoop(_make_board(command, plant, link, faults), summary, _load(faults))


def _make_board(
    command: EmulateCommand, plant: Plant, link: SerialHostLink, faults: dict[str, InjectedFault]
) -> EmulatedBoard:
    """Return the emulated board, which runs a firmware in C or surefoot's implementation in Python."""
    from surefoot import __version__
    from surefoot.deploy.board.limits import Limits, make_handshake
    from surefoot.emulator.board import Board

    robot = plant.robot
    if command.firmware is not None:
        from surefoot.emulator.firmware_board import FirmwareBoard

        return FirmwareBoard(plant, command.firmware, link, faults)
    limits = Limits.from_robot(robot)
    handshake = make_handshake(robot, limits, f"surefoot emulator {__version__}", robot.timing.servo_step)
    # Gains given by --set become the firmware's gains, such as the gains with which a policy was trained.
    settings = parse_settings([word for group in command.settings for word in group])
    gains = {name: getattr(plant.params, name)[0] for name in GAINS if name in settings}
    handshake = replace(handshake, **gains)
    return Board(plant, handshake, link, limits, faults, 1 if command.lockstep else STRIDE)


def make_dds_loop(
    command: EmulateCommand, robot: RobotDescription, faults: dict[str, InjectedFault], bus: Bus, summary: Summary
) -> RealTimeLoop:
    """Return the loop that runs a Go2 behind its DDS topics; its kernels are compiled."""
    from surefoot.deploy.dds.low_level import STATE_PERIOD
    from surefoot.deploy.serial.serial_link import LEAD
    from surefoot.emulator.dds.board import Go2Board
    from surefoot.emulator.dds.link import LowLevelLink
    from surefoot.emulator.dds.motion_service import EmulatedMotionService
    from surefoot.emulator.dds.own_controller import OwnController
    from surefoot.emulator.real_time import RealTimeLoop

    plant, controller = make_plant(command, robot), OwnController()
    if command.motion_service != "released":
        controller.activate()
    if command.motion_service == "standing":
        controller.stand_up()
    service = None if "no-service" in faults else EmulatedMotionService(bus, controller, plant)
    # A deployment uses the newest state so long before its step; that state is half a period old on average.
    lead = LEAD + STATE_PERIOD / 2
    board = Go2Board(plant, LowLevelLink(bus), lead, controller, service, faults, command.seed)
    return RealTimeLoop(board, summary, _load(faults))


def _load(faults: dict[str, InjectedFault]) -> float:
    return faults["overload"].value if "overload" in faults else 0.0


def _run(command: EmulateCommand, robot: RobotDescription, faults: dict[str, InjectedFault]) -> int:
    from surefoot.deploy.pacer import real_time_priority
    from surefoot.emulator.capture_writer import CaptureWriter
    from surefoot.emulator.map_sender import MapSender
    from surefoot.emulator.real_time import Summary
    from surefoot.emulator.serial.pty_port import PtyPort
    from surefoot.emulator.serial.socket_server_port import SocketServerPort
    from surefoot.stop_signals import StopSignals

    summary = Summary()

    def end(_: int) -> None:
        summary.stop = True

    loop: RealTimeLoop | LockstepLoop
    observers: list[CaptureWriter | EmulateViewer | MapSender] = []
    with StopSignals(on_signal=end, respect_nohup=True), contextlib.ExitStack() as stack:
        if command.link == "dds":
            from surefoot.deploy.dds.bus import Bus

            loop = make_dds_loop(command, robot, faults, Bus(command.interface, command.domain), summary)
            place = f"{command.interface}, DDS domain {command.domain}"
        else:
            port: HostPort = (
                PtyPort(command.symlink, held=not command.lockstep)
                if command.socket is None
                else SocketServerPort(command.socket)
            )
            stack.callback(port.close)
            loop, place = make_loop(command, robot, faults, port, summary), port.path
        board = loop.board
        try:
            if (path := command.files.get(".csv")) is not None:
                observers.append(CaptureWriter(path, board.plant, later=not command.lockstep))
            if command.height_map is not None:
                observers.append(MapSender(command.height_map, board.plant, command.scan, command.seed))
            if command.viewer:
                from surefoot.cli.helpers.viewer import EmulateViewer

                observers.append(EmulateViewer(command.robot, board.plant, command.terrain, command.seed))
            board.on_step = [observer.update for observer in observers]
            # A microcontroller has its own processor, so the emulator gets priority over other processes.
            with contextlib.nullcontext() if command.lockstep else real_time_priority():
                print(f"robot on {place}", flush=True)
                loop.run(command.duration)
        finally:
            for observer in observers:
                observer.close()
                if isinstance(observer, CaptureWriter) and observer.file.error:
                    print(f"surefoot: motion capture stopped: {observer.file.error}", file=sys.stderr)
    print(f"surefoot: {summary.text(board)}", file=sys.stderr)
    return 0
