"""The microcontroller's program, in Python and in C: every rule of the protocol, on a clock of the test."""

from __future__ import annotations

import random
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from cobs import cobs
from compiled_firmware import compiled, needs_gcc, needs_qemu
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from surefoot.deploy import messages
from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.board.signals import MotorOrder, Sensors, Vitals
from surefoot.deploy.messages import Fault, Handshake, Hello, Message, Mode, Packet, Ping, Pong, Position, Reason, State
from surefoot.deploy.serial.codec import HEADER, NUMBERS, VERSION, Codec
from surefoot.deploy.serial.frames import CRC_BYTES, Decoder, encode_frame
from surefoot.emulator.firmware_process import FirmwareProcess
from surefoot.emulator.serial.serial_host_link import SerialHostLink

MS = 1000
ME, OTHER = 7, 8
TARGET = np.full(8, 1.5)
CODEC = Codec(8)


class NoHosts:
    """The hosts' end of a line that a test reads by itself."""

    unread = 0


class CompiledFirmware(FirmwareProcess):
    """The program in C, with those attributes of the one in Python that the tests use."""

    def __init__(self, robot: Any, handshake: Handshake, limits: Limits, *target: str) -> None:
        super().__init__(compiled(robot, limits, handshake, *target), robot.name, robot.num_motors)
        self.handshake = handshake

    def tick(self, now: int, vitals: Vitals) -> MotorOrder:  # type: ignore[override]
        zeros, attitude = np.zeros(8), np.array([0.0, vitals.tilt, 0.0])
        temperature = np.array([25.0, vitals.temperature, *[25.0] * 6])
        seen = Sensors(vitals.motor_angle, zeros, zeros, attitude, zeros[:3], 0.0, vitals.voltage, temperature)
        super().tick(now, seen, vitals.hazard, vitals.sit)
        return MotorOrder(self.mode, self.order) if self.armed else MotorOrder(Mode.DISARMED, zeros)

    @property
    def watch(self) -> CompiledFirmware:
        return self


class Bench:
    """A microcontroller whose sensors the test sets, with a servo step every millisecond.

    Messages of a host reach the program as they are (`where` is "messages"), as bytes over a "serial line", or as
    bytes the program in "C", on this computer or on an STM32F405 in "QEMU".
    """

    def __init__(self, robot: Any, where: str, **changes: Any) -> None:
        limits = replace(Limits.from_robot(robot), **changes)
        handshake = make_handshake(robot, limits, "test 1", 0.001)
        self.where, self.in_c = where, where in ("C", "QEMU")
        if self.in_c:
            target = ("board-qemu",) if where == "QEMU" else ()
            self.firmware: Any = CompiledFirmware(robot, handshake, limits, *target)
        else:
            self.firmware = Firmware(handshake, limits)
        self.line = SerialHostLink(NoHosts(), 8) if where == "serial line" else None
        self.host = Decoder(Codec(8))
        self.now = self.number = 0
        self.vitals = Vitals(np.arange(8) / 10, 0.0, 16.0, 25.0)
        self.order: MotorOrder | None = None
        self.sent: list[Packet] = []
        """What the robot has sent, oldest first."""
        self.sensors = Sensors(*(np.zeros(8),) * 3, np.zeros(3), np.zeros(3), 5.0, 16.0, np.full(8, 25.0))

    def take(self) -> list[Packet]:
        """Return what the robot has sent since, as the host receives it."""
        packets = self.firmware.take()
        if self.line is not None:
            for packet in packets:
                self.line.send(self.now, packet)
            packets = self.host.feed(self.line.take(self.now))
        self.sent += packets
        return packets

    def run(self, milliseconds: int) -> list[Packet]:
        """Let time pass; return what the robot sends meanwhile."""
        before = len(self.sent)
        for _ in range(milliseconds):
            self.order = self.firmware.tick(self.now, self.vitals)
            self.now += MS
            self.firmware.report(self.now, lambda: self.sensors)
            self.take()
        return self.sent[before:]

    def send(self, message: Message, sent: float | None = None, number: int | None = None) -> list[Message]:
        """Send a message, by default now and with the next number; return the answers."""
        sent = self.now / 1e6 + 100.0 if sent is None else sent
        if number is None:
            self.number = number = self.number + 1
        if self.where == "messages":
            self.firmware.receive(self.now, Packet(message, number, sent))
        else:
            self.put(encode_frame(self.host.codec, message, number, sent))
        return [packet.message for packet in self.take()]

    def put(self, data: bytes) -> None:
        """Put bytes on the line to the robot."""
        if self.line is None:
            self.firmware.receive(self.now, data) if self.in_c else self.firmware.watch.note_damage()
            return
        self.line.inbound.send(self.now, data)
        while self.line.next_arrival <= self.now:
            self.line.receive(self.now, self.firmware)

    def arm(self, mode: Mode = Mode.POSITION, period: float = 0.006, after: float = 0.003) -> list[Message]:
        return self.send(messages.Arm(ME, int(mode), period, after))

    def command(self, times: int, every: int = 6) -> None:
        """Commands in good order."""
        for _ in range(times):
            self.send(Position(ME, TARGET))
            self.run(every)

    @property
    def mode(self) -> tuple[Mode, Reason]:
        return self.firmware.mode, self.firmware.reason


IN_C = pytest.param("C", marks=needs_gcc)
WHERE = ("messages", "serial line", IN_C)


@pytest.fixture(params=WHERE)
def bench(robot, request) -> Bench:
    return Bench(robot, request.param)


@pytest.fixture
def owned(bench) -> Bench:
    bench.send(Hello(ME, 0.010))
    bench.run(1)
    return bench


@pytest.fixture
def armed(owned) -> Bench:
    assert owned.arm() == []
    owned.run(1)
    assert owned.mode == (Mode.POSITION, Reason.NONE)
    return owned


def fault_of(messages: list[Message]) -> tuple[int, Reason]:
    (message,) = messages
    assert isinstance(message, Fault)
    assert message.text
    return message.session, Reason(message.reason)


def test_a_hello_is_answered_by_the_handshake_and_frames_are_counted_from_one(bench, robot):
    (sent,) = bench.send(Hello(ME, 0.010))
    assert isinstance(sent, Handshake)
    assert (sent.session, sent.robot, sent.motor_names) == (ME, "minitaur", robot.motor_names)
    np.testing.assert_array_equal(sent.motor_signs, robot.motor_sign)
    assert sent.servo_period == 0.001
    np.testing.assert_allclose([sent.servo_kp, sent.servo_kd], [[1.0] * 8, [0.015] * 8])
    assert (sent.command_timeout, sent.rearm_after) == (0.050, 0.5)
    # Leg space: extension 0.6 to 2.7, swing up to 1; and 1 rad of room.
    np.testing.assert_allclose([sent.angle_low[0], sent.angle_high[0]], [-1.4, 4.7])
    bench.run(30)
    assert [frame.sequence for frame in bench.sent] == list(range(1, len(bench.sent) + 1))


@pytest.mark.parametrize(
    ("where", "room"),
    [*(("serial line", room) for room in (1.0, 1.01, 1.02, 1.03)), pytest.param("C", 1.01, marks=needs_gcc)],
)
def test_a_command_at_the_limits_of_the_handshake_is_obeyed(robot, monkeypatch, where, room):
    monkeypatch.setattr("surefoot.robot.description.ANGLE_ROOM", room)
    bench = Bench(robot, where)
    (sent,) = bench.send(Hello(ME, 0.010))
    bench.arm()
    for angles in (sent.angle_low, sent.angle_high):
        target = angles.astype(np.float32).astype(np.float64)  # as the host receives it
        assert bench.send(Position(ME, target)) == []
        bench.run(1)
        assert bench.firmware.mode == Mode.POSITION
        np.testing.assert_array_equal(bench.order.values, target)
    bench.send(Position(ME, np.nextafter(sent.angle_high.astype(np.float32), np.float32(9))))
    assert bench.firmware.reason == Reason.COMMAND


def test_states_come_at_the_requested_period_and_stop_with_the_session(owned):
    sent = owned.run(100)
    assert [round(frame.time * 1e3) for frame in sent] == list(range(10, 101, 10))
    state = sent[0].message
    assert isinstance(state, State)
    assert (state.session, state.mode, state.command, state.energy) == (ME, Mode.DISARMED, 0, 0.0)
    owned.send(Hello(ME, 0.020))
    assert len(owned.run(100)) == 5
    owned.send(messages.Bye(ME))
    assert owned.run(100) == []


def test_the_emulator_has_no_session_before_hello(bench):
    assert bench.run(50) == []
    assert fault_of(bench.send(messages.Arm(ME, 1, 0.006, 0.003))) == (ME, Reason.SESSION)
    assert fault_of(bench.send(Hello(0, 0.01))) == (0, Reason.SESSION)
    assert bench.mode == (Mode.DISARMED, Reason.NONE)


def test_pings_are_answered_for_anybody_whatever_their_number(armed):
    assert armed.send(Ping(12), number=1) == [Pong(12)]
    assert armed.send(Ping(13), number=1) == [Pong(13)]
    armed.send(Ping(14), number=10**6)
    armed.command(3)
    assert armed.mode == (Mode.POSITION, Reason.NONE)
    assert armed.firmware.watch.old_numbers == 0


def test_armed_motors_hold_their_angles_or_have_no_duty_until_a_command(owned):
    assert owned.order.mode == Mode.DISARMED
    owned.arm()
    owned.vitals = replace(owned.vitals, motor_angle=np.linspace(1, 2, 8))
    owned.run(1)
    assert owned.order.mode == Mode.POSITION
    owned.vitals = replace(owned.vitals, motor_angle=np.zeros(8))
    owned.run(3)
    np.testing.assert_allclose(owned.order.values, np.linspace(1, 2, 8), rtol=1e-7)
    owned.send(Position(ME, TARGET))
    owned.run(1)
    np.testing.assert_array_equal(owned.order.values, TARGET)
    owned.send(messages.Disarm(ME))
    owned.arm(Mode.PWM)
    owned.run(1)
    assert owned.order.mode == Mode.PWM
    assert not owned.order.values.any()
    owned.send(messages.Pwm(ME, np.full(8, -0.5)))
    owned.run(1)
    np.testing.assert_array_equal(owned.order.values, np.full(8, -0.5))


def test_states_follow_each_command_and_keep_its_period_in_silence(armed):
    start = armed.now
    armed.send(Position(ME, TARGET))
    number = armed.number
    sent = armed.run(20)
    # 3 ms after the command, and then every 6 ms.
    assert [round(frame.time * 1e6) - start for frame in sent] == [3 * MS, 9 * MS, 15 * MS]
    assert [frame.message.command for frame in sent] == [number] * 3
    np.testing.assert_allclose([frame.message.command_age for frame in sent], [0.003, 0.009, 0.015])


def test_arming_again_changes_the_times_only(armed):
    armed.send(Position(ME, TARGET))
    armed.run(2)
    assert armed.arm(period=0.010, after=0.010) == []
    start = armed.now
    armed.run(1)
    np.testing.assert_array_equal(armed.order.values, TARGET)
    assert round(armed.run(12)[0].time * 1e6) - start == 10 * MS
    assert fault_of(armed.arm(Mode.PWM)) == (ME, Reason.MODE)
    assert armed.mode == (Mode.POSITION, Reason.NONE)


@pytest.mark.parametrize(
    ("mode", "period", "after", "reason"),
    [
        *((Mode.POSITION, *times, Reason.COMMAND) for times in ((0.001, 0.001), (0.051, 0.01), (0.006, 0.007))),
        *((mode, 0.006, 0.003, Reason.MODE) for mode in (Mode.DISARMED, Mode.FAULT, 17)),
    ],
)
def test_arming_in_another_mode_or_with_periods_beyond_the_limits_is_refused(owned, mode, period, after, reason):
    assert fault_of(owned.arm(mode, period, after)) == (ME, reason)
    assert owned.mode == (Mode.DISARMED, Reason.NONE)


def test_disarm_and_bye_damp_in_good_order(armed):
    armed.send(messages.Disarm(ME))
    armed.run(1)
    assert armed.mode == (Mode.DISARMED, Reason.NONE)
    assert armed.order.mode == Mode.DISARMED
    assert armed.arm() == []  # without waiting
    armed.send(messages.Bye(ME))
    assert (armed.firmware.mode, armed.firmware.owner) == (Mode.DISARMED, 0)


def test_silence_damps_after_50_ms(armed):
    armed.command(1, every=0)
    start = armed.now
    armed.run(50)
    assert armed.mode == (Mode.POSITION, Reason.NONE)
    sent = armed.run(1)
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)
    assert armed.order.mode == Mode.DISARMED
    fault, state = (frame.message for frame in sent)
    assert (fault.session, fault.reason) == (ME, Reason.TIMEOUT)
    assert (state.mode, state.reason) == (Mode.FAULT, Reason.TIMEOUT)
    assert sent[0].time * 1e6 - start == 50 * MS


def test_pings_do_not_reset_the_watchdog(armed):
    for _ in range(60):
        armed.send(Ping(1))
        armed.run(1)
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)


def test_a_fault_stays_until_armed_after_500_ms_of_clean_link(armed):
    armed.run(60)
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)
    assert fault_of(armed.arm()) == (ME, Reason.NOT_CLEAN)
    armed.run(1000)  # silence is not clean; a refusal a second ago counts no more among the ten that are answered
    for step in range(11):
        answers = armed.arm()
        if step < 10:
            assert fault_of(answers) == (ME, Reason.NOT_CLEAN)
            assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)
            armed.run(50)
    assert armed.mode == (Mode.POSITION, Reason.NONE)


def test_a_damaged_frame_makes_the_link_unclean(armed):
    armed.run(60)
    for _ in range(9):
        armed.send(Ping(1))
        armed.run(50)
    armed.put(b"\0\x05abc\0")
    armed.send(Ping(1))
    for _ in range(9):
        armed.run(50)
        assert fault_of(armed.arm()) == (ME, Reason.NOT_CLEAN)
    armed.run(50)
    assert armed.arm() == []


def test_a_reason_outlives_its_session(armed):
    armed.run(60)
    armed.send(messages.Disarm(ME))
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)
    armed.send(messages.Bye(ME))
    assert armed.mode == (Mode.DISARMED, Reason.TIMEOUT)
    armed.number = 0
    armed.send(Hello(OTHER, 0.01))
    assert fault_of(armed.send(messages.Arm(OTHER, 1, 0.006, 0.003))) == (OTHER, Reason.NOT_CLEAN)


def test_the_operator_can_damp_at_once(armed):
    assert fault_of(armed.send(messages.Damp(ME))) == (ME, Reason.HOST)
    armed.run(1)
    assert armed.order.mode == Mode.DISARMED
    assert armed.mode == (Mode.FAULT, Reason.HOST)


def test_the_first_fault_is_kept(armed):
    armed.run(60)
    armed.send(messages.Damp(ME))
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 4.8, -1.5])
def test_a_command_beyond_the_angles_or_not_finite_damps_at_once(armed, bad):
    target = TARGET.copy()
    target[3] = bad
    assert fault_of(armed.send(Position(ME, target))) == (ME, Reason.COMMAND)
    armed.run(1)
    assert armed.order.mode == Mode.DISARMED


@pytest.mark.parametrize("bad", [np.nan, 1.01, -1.01])
def test_a_duty_beyond_one_damps_at_once(owned, bad):
    owned.arm(Mode.PWM)
    assert fault_of(owned.send(messages.Pwm(ME, np.full(8, bad)))) == (ME, Reason.COMMAND)


def test_three_commands_with_old_numbers_in_a_row_damp(armed):
    armed.command(2)
    number = armed.number
    for step, old in enumerate((number, number - 1, 1)):
        assert armed.mode == (Mode.POSITION, Reason.NONE)
        answers = armed.send(Position(ME, 0 * TARGET), number=old)
        assert bool(answers) == (step == 2)
        armed.run(1)
    assert armed.mode == (Mode.FAULT, Reason.STALE)
    assert armed.firmware.watch.old_numbers == 3


def test_two_old_numbers_between_good_ones_are_dropped_and_counted(armed):
    for _ in range(10):
        armed.command(1)
        for _ in range(2):
            armed.send(Position(ME, 0 * TARGET), number=1)
    sent = armed.run(10)
    assert armed.mode == (Mode.POSITION, Reason.NONE)
    np.testing.assert_array_equal(armed.order.values, TARGET)
    assert sent[0].message.dropped == 20


def test_commands_older_than_three_periods_are_dropped(armed):
    sent = armed.now / 1e6 + 100.0
    armed.send(Position(ME, TARGET), sent)
    armed.run(6)
    # 18 ms late is three periods: just in time. 18.1 ms is not.
    armed.send(Position(ME, TARGET + 0.125), sent - 0.018 + 0.006)
    armed.run(6)
    np.testing.assert_array_equal(armed.order.values, TARGET + 0.125)
    for step in range(3):
        assert armed.mode == (Mode.POSITION, Reason.NONE)
        armed.send(Position(ME, TARGET + 0.25), sent - 0.0181 + 0.012 + 0.006 * step)
        armed.run(6)
    assert armed.mode == (Mode.FAULT, Reason.STALE)
    assert armed.firmware.stale == 3


def test_the_quickest_frame_of_ten_seconds_is_the_measure_of_age(armed):
    # A first frame that came 30 ms sooner than all that follow makes them old; after 11 s it is forgotten.
    def later(delay: float) -> None:
        armed.send(Ping(0))
        armed.send(Position(ME, TARGET), armed.now / 1e6 + 100.0 - delay)

    later(0.0)
    armed.run(6)
    for _ in range(2):
        later(0.030)
        armed.run(6)
    assert armed.firmware.stale == 2
    later(0.0)
    for _ in range(12 * 50):
        later(0.015)
        armed.run(20)
    later(0.030)
    assert armed.firmware.stale == 2
    assert armed.mode == (Mode.POSITION, Reason.NONE)


@pytest.mark.parametrize(
    ("change", "milliseconds", "reason"),
    [
        ({"tilt": 1.01}, 1, Reason.TILT),
        ({"tilt": np.nan}, 1, Reason.TILT),
        ({"temperature": 90.1}, 1, Reason.TEMPERATURE),
        ({"voltage": 12.4}, 501, Reason.BATTERY),
        ({"voltage": np.nan}, 501, Reason.BATTERY),
        ({"temperature": np.nan}, 1, Reason.TEMPERATURE),
    ],
)
def test_the_robot_damps_itself(armed, change, milliseconds, reason):
    good, armed.vitals = armed.vitals, replace(armed.vitals, **change)
    for step in range(milliseconds):
        assert armed.mode == (Mode.POSITION, Reason.NONE), step
        armed.send(Position(ME, TARGET))
        armed.run(1)
    assert armed.mode == (Mode.FAULT, reason)
    # As long as it is so, it does not arm however clean the link is.
    for _ in range(11):
        armed.send(Ping(1))
        armed.run(50)
    assert fault_of(armed.arm()) == (ME, reason)
    armed.vitals = good
    armed.run(1)
    assert armed.arm() == []


def test_a_short_sag_of_the_voltage_does_not_damp(armed):
    for voltage in (12.4, 12.6) * 5:
        armed.vitals = replace(armed.vitals, voltage=voltage)
        armed.command(80)
    assert armed.mode == (Mode.POSITION, Reason.NONE)


def test_a_second_operator_is_refused_and_the_first_keeps_the_robot(armed):
    numbers = armed.number
    for _ in range(5):
        assert fault_of(armed.send(Hello(OTHER, 0.01), number=900)) == (OTHER, Reason.BUSY)
        assert fault_of(armed.send(Position(OTHER, 0 * TARGET), number=901)) == (OTHER, Reason.SESSION)
        assert fault_of(armed.send(messages.Damp(OTHER), number=902)) == (OTHER, Reason.SESSION)
        armed.command(1)
    assert armed.number == numbers + 5
    assert armed.mode == (Mode.POSITION, Reason.NONE)
    np.testing.assert_array_equal(armed.order.values, TARGET)


def test_another_operator_may_connect_after_a_second_of_silence(armed):
    armed.run(999)
    assert armed.mode == (Mode.FAULT, Reason.TIMEOUT)
    # Last heard 1.001 s ago, when it was armed.
    assert fault_of(armed.send(Hello(OTHER, 0.01), sent=3.0, number=1)) == (OTHER, Reason.BUSY)
    armed.run(1)
    (sent,) = armed.send(Hello(OTHER, 0.01), sent=3.0, number=1)
    assert isinstance(sent, Handshake)
    assert sent.session == OTHER
    assert armed.mode == (Mode.DISARMED, Reason.TIMEOUT)
    assert fault_of(armed.send(messages.Arm(ME, 1, 0.006, 0.003))) == (ME, Reason.SESSION)


def test_a_hello_of_the_same_session_is_answered_again(armed):
    assert isinstance(armed.send(Hello(ME, 0.01))[0], Handshake)
    assert armed.mode == (Mode.POSITION, Reason.NONE)


def test_commands_for_another_mode_are_refused(owned):
    assert fault_of(owned.send(Position(ME, TARGET))) == (ME, Reason.MODE)
    owned.arm()
    assert fault_of(owned.send(messages.Pwm(ME, TARGET / 2))) == (ME, Reason.MODE)
    assert owned.mode == (Mode.POSITION, Reason.NONE)
    assert owned.run(10)[-1].message.dropped == 2


def test_refusals_are_sent_ten_times_a_second(bench):
    refusals = [len(bench.send(Position(OTHER, TARGET))) + len(bench.run(5)) for _ in range(400)]
    assert sum(refusals) == 20


def test_a_second_operator_is_answered_ten_times_a_second(owned):
    answers = [owned.send(Hello(OTHER, 0.01), number=900) for _ in range(30)]
    assert [fault_of(answer) for answer in answers[:10]] == [(OTHER, Reason.BUSY)] * 10
    assert answers[10:] == [[]] * 20


@pytest.mark.parametrize("bench", ["serial line", IN_C], indirect=True)
def test_a_text_that_is_not_utf8_is_no_unknown_frame_at_the_robot(armed):
    body = armed.host.codec.pack(Fault(ME, 1, "x" * 80)).replace(b"x" * 80, b"\xff" * 80)
    armed.put(raw_frame(armed.host.codec, Fault, body, 10**6))
    seen = armed.line.statistics if armed.line else armed.firmware.statistics
    assert (seen.received, seen.damaged, seen.unknown) == (3, 0, 0)


@pytest.mark.parametrize("where", ["serial line", IN_C])
def test_another_schema_is_refused_ten_times_a_second_and_changes_nothing(robot, where):
    bench, other = Bench(robot, where), Codec(8)
    other.schema ^= 1
    for number in range(1, 31):
        bench.put(encode_frame(other, Hello(ME, 0.01), number, 0.0))
        bench.run(1)
    assert [(p.message.session, p.message.reason) for p in bench.sent] == [(0, Reason.SCHEMA)] * 10
    assert bench.firmware.owner == 0


def raw_frame(codec: Codec, kind: type[Message], payload: bytes, number: int) -> bytes:
    """Return a whole frame with a payload of any bytes."""
    body = HEADER.pack(VERSION, NUMBERS[kind], codec.schema, number, 200_000_000) + payload
    return b"\0" + cobs.encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")) + b"\0"


numbers = st.floats(width=32)
sessions = st.sampled_from([0, ME, OTHER, 2**16 - 1])
arrays = st.lists(numbers, min_size=8, max_size=8).map(np.array)
periods = st.floats(0.0, 4000.0)
any_message = st.one_of(
    st.builds(Hello, sessions, periods),
    st.builds(Ping, st.integers(0, 2**32 - 1)),
    st.builds(Pong, st.integers(0, 2**32 - 1)),
    st.builds(messages.Arm, sessions, st.integers(0, 255), periods, periods),
    st.builds(messages.Arm, st.just(ME), st.just(1), st.just(0.006), st.just(0.003)),
    st.builds(Position, sessions, arrays),
    st.builds(messages.Pwm, sessions, arrays),
    st.builds(messages.Damp, sessions),
    st.builds(messages.Disarm, sessions),
    st.builds(messages.Bye, sessions),
    st.builds(Fault, sessions, st.integers(0, 255), st.text(max_size=20)),
)


@pytest.mark.parametrize("where", WHERE)
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(st.one_of(any_message, st.binary(max_size=80)), st.integers(0, 60), st.integers(1, 2**32 - 1)),
        max_size=40,
    )
)
def test_no_message_crashes_the_firmware_or_exceeds_its_limits(robot, where, talk):
    bench = Bench(robot, where)
    bench.send(Hello(ME, 0.01))
    low, high = bench.firmware.handshake.angle_low, bench.firmware.handshake.angle_high
    for sent, pause, number in talk:
        if isinstance(sent, bytes):
            bench.put(sent)
        else:
            bench.send(sent, number=number)
        bench.run(pause)
        if bench.order is not None and bench.order.mode == Mode.POSITION:
            assert ((bench.order.values >= low) & (bench.order.values <= high)).all()
        elif bench.order is not None and bench.order.mode == Mode.PWM:
            assert (np.abs(bench.order.values) <= 1).all()


def random_message(rng: random.Random) -> Message | bytes:
    """Return what a host may send, mostly in good order."""
    session = rng.choices([ME, OTHER, 0], [40, 2, 1])[0]
    number = rng.choices([1.5, rng.uniform(-2, 6), rng.choice([np.nan, np.inf, 4.7, -1.4, 900.0])], [60, 1, 1])[0]
    values = np.where(np.arange(8) == rng.randrange(8), number, 0.9).astype(np.float32)
    period = rng.choices([0.006, 0.05, rng.uniform(0.0, 0.1), 4000.0], [30, 3, 1, 1])[0]
    kinds = {
        Hello(session, rng.choice([0.0, 0.01, 0.02, 4000.0])): 2,
        Ping(rng.randrange(2**32)): 6,
        Pong(3): 1,
        messages.Arm(session, rng.choice([1] * 8 + [2, 2, 9]), period, rng.choice([0.0, 0.003, period])): 6,
        messages.Damp(session): 1,
        messages.Disarm(session): 1,
        messages.Bye(session): 1,
        Fault(session, 3, "text"): 1,
    }
    commands = [Position(session, values), messages.Pwm(session, values / 5.0), rng.randbytes(rng.randrange(60))]
    return rng.choices([*kinds, *commands], [*kinds.values(), 60, 5, 1])[0]


@pytest.mark.parametrize("where", [IN_C, pytest.param("QEMU", marks=needs_qemu)])
def test_both_programs_say_the_same(robot, where):
    rng, benches = random.Random(0), [Bench(robot, "serial line"), Bench(robot, where)]
    one, other = benches
    good = (0.0, 16.0, 25.0)
    script: list[Any] = []
    for _ in range(15):  # rounds that begin with an armed robot, mostly
        script += [(b"", 1100, good), (Hello(ME, 0.01), 50, good)] + [(Ping(1), 50, good)] * 11
        script.append((messages.Arm(ME, rng.choice([1, 1, 2]), 0.006, 0.003), 1, good))
        for _ in range(30):
            pause = rng.choices([0, 6, rng.randrange(60), 600], [5, 80, 3, 1])[0]
            bad = (1.01, 16.0, 25.0), (0.0, 12.0, 25.0), (0.0, 16.0, 90.6)
            script.append((random_message(rng), pause, rng.choices([good, *bad], [90, 1, 1, 1])[0]))
    for sent, pause, (tilt, voltage, temperature) in script:
        number, late = rng.choices([None, 1], [20, 1])[0], rng.choices([0.0, 0.015, 0.03], [20, 1, 1])[0]
        for bench in benches:
            bench.vitals = replace(bench.vitals, tilt=tilt, voltage=voltage, temperature=temperature)
            if isinstance(sent, bytes):
                bench.put(b"\0" + sent + b"\0")
            else:
                bench.send(sent, sent=bench.now / 1e6 + 100.0 - late, number=number)
            bench.run(pause)
        assert one.mode == other.mode
        assert one.firmware.next_state == other.firmware.next_state
        assert one.firmware.is_taken(one.now) == other.firmware.is_taken(one.now)
        assert len(one.sent) == len(other.sent)
        if one.order is not None:
            np.testing.assert_array_equal(one.order.values.astype(np.float32), other.order.values)
    for mine, its in zip(one.sent, other.sent, strict=True):
        assert (mine.sequence, mine.time) == (its.sequence, its.time)
        assert CODEC.pack(mine.message) == CODEC.pack(its.message), (mine, its)
    faults = {packet.message.reason for packet in one.sent if isinstance(packet.message, Fault)}
    assert len(faults) >= 9


def test_what_else_a_body_sees_damps_and_keeps_from_arming(armed):
    hazard = Reason.MOTOR_OFF, "a motor is off"
    armed.vitals = replace(armed.vitals, hazard=hazard)
    (fault,) = [packet.message for packet in armed.run(1) if isinstance(packet.message, Fault)]
    assert (fault.reason, fault.text) == hazard
    assert armed.mode == (Mode.FAULT, Reason.MOTOR_OFF)
    for _ in range(11):
        armed.send(Ping(1))
        armed.run(50)
    assert fault_of(armed.arm()) == (ME, Reason.MOTOR_OFF)


def test_a_request_to_sit_is_sent_once_and_leaves_the_motors_armed(armed):
    armed.vitals = replace(armed.vitals, sit=(Reason.REMOTE, "a stick was moved"))
    sent = [packet.message for packet in armed.run(20)]
    assert [message.text for message in sent if isinstance(message, Fault)] == ["a stick was moved"]
    assert [message.reason for message in sent if isinstance(message, State)][-1] == Reason.REMOTE
    assert armed.mode == (Mode.POSITION, Reason.REMOTE)
    armed.command(2)
    np.testing.assert_array_equal(armed.order.values, TARGET)


@pytest.mark.parametrize("where", ["messages", IN_C])
def test_a_robot_without_duties_does_not_arm_for_them(robot, where):
    bench = Bench(robot, where, duty=0.0)
    bench.send(Hello(ME, 0.010))
    assert fault_of(bench.arm(Mode.PWM)) == (ME, Reason.MODE)
    assert bench.arm() == []


@pytest.mark.parametrize("where", ["messages", IN_C])
@pytest.mark.parametrize(("angle", "mode"), [(0.04, Mode.POSITION), (0.06, Mode.FAULT)])
def test_the_first_command_may_not_jump(robot, where, angle, mode):
    bench = Bench(robot, where, first_torque=0.05)  # a gain of 1
    bench.send(Hello(ME, 0.010))
    bench.run(1)
    bench.arm()
    bench.send(Position(ME, bench.vitals.motor_angle + angle))
    assert bench.firmware.mode == mode
    if mode == Mode.POSITION:
        bench.send(Position(ME, TARGET))  # later ones may
        assert bench.firmware.mode == Mode.POSITION
