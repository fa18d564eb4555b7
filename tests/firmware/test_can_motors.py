"""The driver of motors on a CAN bus with simulated drives, with and without the board's program.

The board's program and the driver are compiled for this computer. Frames are those of the actuators' manuals: to a
drive position (16 bits), speed, kp, kd and torque (12 each); from it its number, position (16), speed, torque (12
each), temperature and error (8 each).
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc, needs_qemu

from surefoot.deploy import messages
from surefoot.deploy.board.limits import Limits
from surefoot.deploy.messages import Message, Mode, Reason, State
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.firmware.project import firmware_handshake, write_sources
from surefoot.robot import RobotDescription

pytestmark = needs_gcc
ROBOT = RobotDescription.load("go2")
HANDSHAKE = firmware_handshake(ROBOT, Limits.from_robot(ROBOT))
POSE = (HANDSHAKE.angle_low + HANDSHAKE.angle_high) / 2
MOTORS, DT = 12, HANDSHAKE.servo_period
RANGES = ((-12.5, 12.5), (-45.0, 45.0), (0.0, 500.0), (0.0, 5.0), (-24.0, 24.0))
"""Ranges of position [rad], speed [rad/s], kp [N m/rad], kd [N m s/rad] and torque [N m]."""
BITS = (16, 12, 12, 12, 12)
STEPS = [(high - low) / (2**bits - 1) for (low, high), bits in zip(RANGES, BITS, strict=True)]
"""Resolution of each."""
SWITCH_ON = b"\xff" * 7 + b"\xfc"
HARNESS = """
#include <string.h>
#include "board.h"
#include "can_bus.h"
#include "drivers.h"
#include "hal.h"
static can_frame in[64], out[32];
static int arrived, taken, waiting;
static uint8_t line[4096];
static size_t line_size;
uint64_t now;
void hal_start(void) { start_motors(); }
uint64_t hal_time(void) { return now; }
void hal_idle(void) {}
size_t hal_read_line(uint8_t *bytes, size_t room) { (void)bytes; (void)room; return 0; }
bool hal_write_line(const uint8_t *bytes, size_t size) { if (size > sizeof(line) - line_size) return false;
    memcpy(line + line_size, bytes, size); line_size += size; return true; }
void hal_read_imu(float angles[3], float rates[3]) { memset(angles, 0, 12); memset(rates, 0, 12); }
float hal_read_voltage(void) { return 30.0f; }
uint8_t hal_sit(const char **text) { (void)text; return 0; }
void hal_start_watchdog(uint32_t microseconds) { (void)microseconds; }
void hal_feed_watchdog(void) {}
void can_start(void) {}
void can_clear(void) { waiting = 0; }
bool can_send(const can_frame *frame) { if (waiting == 32) return false; out[waiting++] = *frame; return true; }
bool can_receive(can_frame *frame) { if (taken == arrived) return false; *frame = in[taken++]; return true; }
void put(unsigned id, const uint8_t *data, unsigned length) { if (taken == arrived) taken = arrived = 0;
    in[arrived].id = (uint16_t)id; in[arrived].length = (uint8_t)length; memcpy(in[arrived++].data, data, length); }
int get(uint8_t *data) { if (waiting == 0 || out[0].length != 8) return -1; memcpy(data, out[0].data, 8);
    int id = out[0].id; memmove(out, out + 1, (size_t)--waiting * sizeof(out[0])); return id; }
size_t get_line(uint8_t *bytes) { size_t size = line_size; memcpy(bytes, line, size); line_size = 0; return size; }
"""


class MotorCommand(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in ("effort", "target", "kp", "kd", "feedforward")]


class Drive:
    """A drive and its motor with an inertia of 0.02 kg m2: follows the last command while on, and answers each frame.

    After 20 ms without a frame it discards the command.
    """

    def __init__(self, angle: float) -> None:
        self.angle, self.speed, self.torque = angle, 0.0, 0.0
        self.command = np.zeros(5)
        """Position, speed, kp, kd, torque."""
        self.commands: list[np.ndarray] = []
        """All received commands."""
        self.on = self.mute = False
        self.error, self.temperature, self.waited = 0, 31, 0

    def receive(self, data: bytes) -> bytes:
        """Process a frame; return the answer without the drive's number."""
        self.waited = 0
        if data == SWITCH_ON:
            self.on = True
        else:
            bits, self.command = int.from_bytes(data, "big"), np.zeros(5)
            for k in reversed(range(5)):
                self.command[k] = RANGES[k][0] + STEPS[k] * (bits & (2 ** BITS[k] - 1))
                bits >>= BITS[k]
            self.commands.append(self.command)
            self.act()
        p, v, t = (
            round((np.clip(number, *RANGES[k]) - RANGES[k][0]) / STEPS[k])
            for k, number in ((0, self.angle), (1, self.speed), (4, self.torque))
        )
        return bytes([*(p << 24 | v << 12 | t).to_bytes(5, "big"), self.temperature, self.error])

    def act(self) -> None:
        """Set the torque from the last command."""
        angle, speed, kp, kd, torque = self.command
        wanted = torque + kp * (angle - self.angle) + kd * (speed - self.speed)
        self.torque = float(np.clip(wanted, *RANGES[4])) if self.on and not self.error else 0.0

    def step(self) -> None:
        """Simulate a servo step, with ten steps of the drive's own loop."""
        self.waited += 1
        if self.waited > 0.02 / DT:
            self.command = np.zeros(5)
        for _ in range(10):
            self.act()
            self.speed += DT / 10 * self.torque / 0.02
            self.angle += DT / 10 * self.speed


class Board:
    """The board's program with the driver, a bus and its drives; time advances with servo steps."""

    def __init__(self, library: Path) -> None:
        self.c = ctypes.CDLL(str(library))
        self.drives = [Drive(angle) for angle in POSE]
        self.room = 1000
        """Number of frames that the bus transmits per servo step."""
        self.answer_id = lambda number: 0
        self.number = 0
        self.host, self.states, self.faults = Decoder(Codec(MOTORS)), list[State](), list[messages.Fault]()

    def exchange(self) -> list[tuple[int, bytes]]:
        """Transmit frames to the drives and their answers back; return the received frames, by identifier."""
        data, carried = (ctypes.c_uint8 * 8)(), []
        while len(carried) < self.room and (number := self.c.get(data)) >= 0:
            carried.append((number, bytes(data)))
            answer = self.drives[number - 1].receive(bytes(data))
            if not self.drives[number - 1].mute:
                self.put(self.answer_id(number), bytes([number]) + answer)
        return carried

    def put(self, name: int, data: bytes) -> None:
        """Send a frame to the board."""
        self.c.put(name, data, len(data))

    def read(self) -> np.ndarray:
        """Angles, speeds and torques (3, M) read by the driver."""
        seen = np.zeros((3, MOTORS), np.float32)
        self.c.hal_read_motors(*(row.ctypes.data_as(ctypes.c_void_p) for row in seen))
        return seen

    def drive(self, commands: Iterable[dict[str, float]]) -> list[tuple[int, bytes]]:
        """Drive the motors with the driver only; return the frames."""
        self.c.hal_drive_motors((MotorCommand * MOTORS)(*(MotorCommand(**command) for command in commands)))
        return self.exchange()

    def wait(self) -> None:
        """Simulate a servo step."""
        ctypes.c_uint64.in_dll(self.c, "now").value += round(1e6 * DT)

    def send(self, message: Message) -> None:
        """Send a message from the host."""
        self.number += 1
        now = ctypes.c_uint64.in_dll(self.c, "now").value / 1e6
        frame = encode_frame(self.host.codec, message, self.number, now)
        self.c.board_receive(frame, ctypes.c_size_t(len(frame)))

    def run(self, steps: int, target: np.ndarray | None = None) -> None:
        """Run servo steps, each with a command if there is a target."""
        line = (ctypes.c_uint8 * 4096)()
        for _ in range(steps):
            if target is not None:
                self.send(messages.Position(7, target))
            elif self.number:
                self.send(messages.Ping(1))
            self.c.board_tick()
            self.exchange()
            self.wait()
            for drive in self.drives:
                drive.step()
            self.c.board_report()
            for packet in self.host.feed(bytes(line[: self.c.get_line(line)])):
                for kind, received in ((State, self.states), (messages.Fault, self.faults)):
                    received.append(packet.message) if isinstance(packet.message, kind) else None  # type: ignore[attr-defined]

    def arm(self) -> tuple[Mode, Reason]:
        """Request that the robot arms; return its mode and reason."""
        self.send(messages.Arm(7, Mode.POSITION, 0.006, 0.001))
        self.run(2, POSE)
        return self.mode

    @property
    def mode(self) -> tuple[Mode, Reason]:
        return Mode(self.states[-1].mode), Reason(self.states[-1].reason)


def build(folder: Path, *changes: tuple[str, str], robot: RobotDescription = ROBOT) -> Path:
    """Return the compiled program, with changes of the driver."""
    write_sources(folder, robot)
    (folder / "harness.c").write_text(HARNESS)
    source = (driver := folder / "drivers" / "can_motors.c").read_text()
    for old, new in changes:
        assert old in source
        source = source.replace(old, new)
    driver.write_text(source)
    words = ["gcc", "-std=c11", "-O1", "-shared", "-fPIC", "-Wall", "-Wextra", "-Wconversion", "-Werror"]
    words += ["-fsanitize=undefined", "-fsanitize-undefined-trap-on-error"]
    words += [f"-I{folder / name}" for name in ("core", "drivers")]
    sources = driver, folder / "core" / "board.c", folder / "harness.c"
    subprocess.run(
        [*words, *map(str, sources), "-lm", "-o", str(folder / "board.so")],
        check=True,
        stderr=subprocess.PIPE,
        text=True,
    )
    return folder / "board.so"


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("can"))


@pytest.fixture
def board(library: Path, tmp_path: Path) -> Board:
    # Each library file has its own variables.
    return Board(Path(shutil.copy(library, tmp_path / "board.so")))


@pytest.fixture
def armed(board: Board) -> Board:
    """The armed board, with its drives on and in their pose."""
    board.c.board_start()
    board.run(5)
    board.send(messages.Hello(7, 0.002))
    board.run(5)
    assert board.arm() == (Mode.POSITION, Reason.NONE)
    return board


# Frames.


def test_frames_have_the_bytes_of_the_manual(board):
    """Worked by hand: 1 rad is 13.5/25 of 65535, 35388.9, or 8A3D; 20 N m/rad is 163.8 of 4095, or 0A4; and so on."""
    zero, some, most = map(bytes.fromhex, ("8000800000000800", "8A3D8000A43338FF", "FFFF800FFFFFFFFF"))
    commands = [{}, {"target": 1.0, "kp": 20.0, "kd": 1.0, "feedforward": 3.0}]
    commands += [{"target": 12.5, "kp": 500.0, "kd": 5.0, "feedforward": 24.0}] * 10
    frames = board.drive(commands)
    assert frames[::2] == [(number, SWITCH_ON) for number in range(1, 13)]
    assert frames[1::2] == [(1, zero), (2, some), *((number, most) for number in range(3, 13))]
    # -1 rad is 30146.1, 10 rad/s 2502.5 (the drive's 9C6 is 9.989 rad/s), -6 N m 1535.6 or 600.
    board.put(0, bytes.fromhex("0475C29C66001E00"))
    np.testing.assert_allclose(board.read()[:, 3], [-1.0, 9.989, -6.0], atol=0.006)
    temperature = np.zeros(MOTORS, np.float32)
    board.c.hal_read_temperatures(temperature.ctypes.data_as(ctypes.c_void_p))
    assert temperature[3] == 30.0


def test_numbers_go_both_ways_within_the_resolution(board):
    rng = np.random.default_rng(1)
    for _ in range(30):
        sent = np.array([rng.uniform(*limits, MOTORS) for limits in RANGES])
        for drive, angle, speed in zip(board.drives, sent[0], sent[1], strict=True):
            drive.angle, drive.speed = angle, speed
        names = "target", "kp", "kd", "feedforward"
        board.drive(dict(zip(names, map(float, sent[[0, 2, 3, 4], m]), strict=True)) for m in range(MOTORS))
        got = np.array([drive.command for drive in board.drives]).T
        sent[1] = 0.0
        half = np.array(STEPS)[:, None] * 0.505
        assert (np.abs(got - sent) <= half).all()
        seen = [[drive.angle, drive.speed, drive.torque] for drive in board.drives]
        assert (np.abs(board.read() - np.transpose(seen)) <= half[[0, 1, 4]]).all()
        board.wait()


def test_values_out_of_range_are_clipped_and_nan_gives_no_torque(board):
    beyond = {"target": 1e9, "kp": 1e9, "kd": np.inf, "feedforward": 25.0}
    board.drive([beyond] * 6 + [{name: -number for name, number in beyond.items()}] * 6)
    ends = np.array(RANGES)
    for drives, column in ((board.drives[:6], 1), (board.drives[6:], 0)):
        for drive in drives:
            np.testing.assert_allclose(drive.command[[0, 2, 3, 4]], ends[[0, 2, 3, 4], column])
    board.drive(
        [{"target": 1.0, "kp": 20.0, "kd": 1.0, "feedforward": 3.0} | {name: np.nan for name in beyond}] * 6
        + [{"target": np.nan, "kp": 20.0, "kd": 1.0}] * 6
    )
    for drive in board.drives:
        assert drive.command[2] == 0.0
        assert abs(drive.command[4]) < STEPS[4]


def test_directions_zeros_and_offsets_of_the_owner_are_applied(tmp_path):
    board = Board(
        build(
            tmp_path,
            ("zero[SUREFOOT_MOTORS] = {0}", "zero[SUREFOOT_MOTORS] = {0.5f, -0.25f}"),
            ("direction[SUREFOOT_MOTORS] = {", "direction[SUREFOOT_MOTORS] = {-1.0f, 1.0f, -1.0f, "),
            ("[0 ... SUREFOOT_MOTORS - 1] = 1.0f", "[3 ... SUREFOOT_MOTORS - 1] = 1.0f"),
            ("TEMPERATURE_OFFSET 0", "TEMPERATURE_OFFSET (-40)"),
        )
    )
    for drive in board.drives:
        drive.angle, drive.speed, drive.temperature = 1.0, 2.0, 71
    board.drive([{"target": 1.5, "feedforward": 3.0}] * MOTORS)
    assert [round(float(drive.command[0]), 3) for drive in board.drives[:4]] == [-1.0, 1.75, -1.5, 1.5]
    assert [round(float(drive.command[4]), 1) for drive in board.drives[:4]] == [-3.0, 3.0, -3.0, 3.0]
    seen = board.read()[:, :4]
    np.testing.assert_allclose(seen[0], [-0.5, 0.75, -1.0, 1.0], atol=2e-4)
    np.testing.assert_allclose(seen[1], [-2.0, 2.0, -2.0, 2.0], atol=0.012)
    np.testing.assert_allclose(seen[2], 3.0, atol=0.013)
    temperature = np.zeros(MOTORS, np.float32)
    board.c.hal_read_temperatures(temperature.ctypes.data_as(ctypes.c_void_p))
    assert set(temperature) == {31.0}


def test_only_answers_with_the_identifier_of_the_master_or_the_drive_count(board):
    assert np.isnan(board.read()[:2]).all()
    for number, name, length in ((99, 0, 8), (0, 0, 8), (1, 5, 8), (1, 0, 6), (1, 0, 0)):
        board.put(name, bytes([number, *[255] * 7])[:length])
    assert np.isnan(board.read()[:2]).all()
    board.answer_id = lambda number: number
    board.drive([{}] * MOTORS)
    np.testing.assert_allclose(board.read()[0], POSE, atol=STEPS[0])


# With the board's program.


def test_the_board_switches_drives_on_and_they_follow_its_commands(armed):
    assert all(drive.on for drive in armed.drives)
    target = POSE + 0.3
    armed.run(250, target)
    assert armed.mode == (Mode.POSITION, Reason.NONE)
    last = armed.states[-1]
    np.testing.assert_allclose(last.motor_angle, target, atol=0.01)
    np.testing.assert_allclose(last.motor_angle, [drive.angle for drive in armed.drives], atol=0.01)
    assert set(last.temperature) == {31}
    command = np.array([drive.command for drive in armed.drives])
    np.testing.assert_allclose(command[:, 0], target, atol=STEPS[0])
    np.testing.assert_allclose(command[:, 2], HANDSHAKE.servo_kp, atol=STEPS[2])
    np.testing.assert_allclose(command[:, 3], HANDSHAKE.servo_kd, atol=STEPS[3])


def silence(board: Board) -> None:
    """A drive receives frames, but its answers are lost."""
    board.drives[7].mute = True


def report_error(board: Board) -> None:
    """A drive has switched itself off, and reports it."""
    board.drives[7].error = 5


def switch_off(board: Board) -> None:
    """The bus is off and transmits nothing."""
    board.room = 0


def fill(board: Board) -> None:
    """The bus is full: other frames leave room for seven per servo step."""
    board.room = 7


def overheat(board: Board) -> None:
    """A drive reports 120 degC."""
    board.drives[7].temperature = 120


@pytest.mark.parametrize(
    ("fault", "reason", "text"),
    [
        (silence, Reason.MOTOR_OFF, "the drive of motor 07 does not answer"),
        (report_error, Reason.MOTOR_OFF, "the drive of motor 07 reports an error"),
        (switch_off, Reason.MOTOR_OFF, "the drive of motor 00 does not answer"),
        (fill, Reason.MOTOR_OFF, "the drive of motor 07 does not answer"),
        (overheat, Reason.TEMPERATURE, "a motor is at 120 degC; the limit is 88"),
    ],
    ids=("silent", "error", "bus off", "bus full", "hot"),
)
def test_a_fault_damps_all_motors_until_it_ends_and_the_robot_is_armed_again(armed, fault, reason, text):
    armed.run(10, POSE + 0.1)
    before = len(armed.drives[0].commands)
    fault(armed)
    # 10 ms of silence, the answers in transit, and the step that detects it.
    armed.run(7, POSE + 0.1)
    assert armed.mode == (Mode.FAULT, reason)
    assert armed.faults[-1].text == text
    ended = armed.drives[0].commands[before + 6 :]
    assert not any(command[2] for command in ended)
    heard = [drive for number, drive in enumerate(armed.drives) if number < armed.room]
    for drive in heard:
        assert drive.command[2] == 0.0
        assert drive.command[3] == pytest.approx(HANDSHAKE.servo_kd[0], abs=STEPS[3])
        assert abs(drive.command[4]) < STEPS[4]
    # It cannot be armed during the fault; drives that the bus does not reach have damped themselves.
    armed.run(round(HANDSHAKE.rearm_after / DT))
    assert not any(drive.command[2] for drive in armed.drives)
    armed.send(messages.Arm(7, Mode.POSITION, 0.006, 0.001))
    armed.run(1)
    assert armed.mode == (Mode.FAULT, reason)
    assert armed.faults[-1].text == text
    # After the fault no drive gets an outdated command; a drive that had no power is switched on.
    commands = [len(drive.commands) for drive in armed.drives]
    armed.room = 1000
    for drive in armed.drives:
        drive.mute, drive.error, drive.temperature = False, 0, 31
        drive.on = fault is not switch_off
    armed.run(20)
    assert not any(
        command[2] for drive, count in zip(armed.drives, commands, strict=True) for command in drive.commands[count:]
    )
    assert armed.mode == (Mode.FAULT, reason)
    assert armed.arm() == (Mode.POSITION, Reason.NONE)
    assert all(drive.on and drive.command[2] for drive in armed.drives)


def test_a_missing_drive_prevents_arming(board):
    board.c.board_start()
    board.drives[11].mute = True
    board.send(messages.Hello(7, 0.002))
    board.run(20)
    assert board.arm() == (Mode.DISARMED, Reason.NONE)
    assert board.faults[0].reason == Reason.MOTOR_OFF
    assert board.faults[0].text == "the drive of motor 11 does not answer"
    assert np.isnan(board.states[-1].motor_angle[11])
    assert all(drive.command[2] == 0.0 for drive in board.drives)


def test_the_driver_is_not_for_motors_whose_gains_are_duties(tmp_path: Path):
    with pytest.raises(subprocess.CalledProcessError) as failed:
        build(tmp_path, robot=RobotDescription.load("minitaur"))
    assert "the gains of this robot are duties of DC motors" in failed.value.stderr


@needs_qemu
def test_the_firmware_fits_the_stm32f405():
    drivers = "drivers/can_motors.c stm32f4/can_bus.c drivers/no_sensors.c"
    assert compiled(ROBOT, None, None, "board.elf", f"DRIVERS={drivers}").exists()
