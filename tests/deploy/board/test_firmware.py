"""The microcontroller's program in Python and in C: every rule of the protocol, on a simulated clock."""

from __future__ import annotations

import random
import zlib
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from board_bench import IN_C, IN_QEMU, ME, OTHER, PROGRAMS, Bench
from board_rules import Rule, every_rule
from cobs import cobs
from compiled_firmware import needs_gcc
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from surefoot.deploy import messages
from surefoot.deploy.messages import Arm, Fault, Handshake, Hello, Message, Mode, Ping, Pong, Position, Reason
from surefoot.deploy.serial.codec import HEADER, NUMBERS, VERSION, Codec
from surefoot.deploy.serial.frames import CRC_BYTES, encode_frame

CODEC = Codec(8)


@pytest.mark.parametrize("where", [*PROGRAMS, IN_QEMU])
@every_rule
def test_the_board_keeps_the_rule(robot, where: str, rule: Rule):
    bench = Bench(robot, where, **rule.limits)
    for step in rule.steps:
        step(bench)


@pytest.mark.parametrize("where", PROGRAMS)
def test_a_hello_is_answered_by_the_handshake_and_frames_are_counted_from_one(robot, where: str):
    bench = Bench(robot, where)
    (sent,) = bench.send(Hello(ME, 0.010))
    assert isinstance(sent, Handshake)
    assert (sent.session, sent.robot, sent.motor_names) == (ME, "minitaur", robot.motor_names)
    np.testing.assert_array_equal(sent.motor_signs, robot.motor_sign)
    assert sent.servo_period == 0.001
    np.testing.assert_allclose([sent.servo_kp, sent.servo_kd], [[1.0] * 8, [0.015] * 8])
    assert (sent.command_timeout, sent.rearm_after) == (0.050, 0.5)
    # Leg space: extension 0.6 to 2.7, swing up to 1, with a margin of 1 rad.
    np.testing.assert_allclose([sent.angle_low[0], sent.angle_high[0]], [-1.4, 4.7])
    bench.run(30)
    assert [frame.sequence for frame in bench.sent] == list(range(1, len(bench.sent) + 1))


@pytest.mark.parametrize(
    ("where", "room"),
    [*(("serial line", room) for room in (1.0, 1.01, 1.02, 1.03)), pytest.param("C", 1.01, marks=needs_gcc)],
)
def test_commands_at_the_limits_of_the_handshake_are_accepted(robot, monkeypatch, where, room):
    monkeypatch.setattr("surefoot.robot.description.ANGLE_MARGIN", room)
    bench = Bench(robot, where)
    (sent,) = bench.send(Hello(ME, 0.010))
    bench.send(Arm(ME, int(Mode.POSITION), 0.006, 0.003))
    for angles in (sent.angle_low, sent.angle_high):
        target = angles.astype(np.float32).astype(np.float64)  # as the host receives it
        assert bench.send(Position(ME, target)) == []
        bench.run(1)
        assert bench.firmware.mode == Mode.POSITION
        np.testing.assert_array_equal(bench.motor_command.values, target)
    bench.send(Position(ME, np.nextafter(sent.angle_high.astype(np.float32), np.float32(9))))
    assert bench.firmware.reason == Reason.COMMAND


@pytest.mark.parametrize("where", ["serial line", IN_C])
def test_the_robot_accepts_texts_that_are_not_utf8(robot, where: str):
    bench = Bench(robot, where)
    bench.send(Hello(ME, 0.010))
    body = CODEC.pack(Fault(ME, 1, "x" * 80)).replace(b"x" * 80, b"\xff" * 80)
    bench.put(raw_frame(CODEC, Fault, body, 10**6))
    seen = bench.line.statistics if bench.line else bench.firmware.statistics
    assert (seen.received, seen.damaged, seen.unknown) == (2, 0, 0)


@pytest.mark.parametrize("where", ["serial line", IN_C])
def test_another_schema_is_rejected_ten_times_per_second_and_changes_nothing(robot, where):
    bench, other = Bench(robot, where), Codec(8)
    other.schema ^= 1
    for number in range(1, 31):
        bench.put(encode_frame(other, Hello(ME, 0.01), number, 0.0))
        bench.run(1)
    assert [(p.message.session, p.message.reason) for p in bench.sent] == [(0, Reason.SCHEMA)] * 10
    assert bench.firmware.owner == 0


def raw_frame(codec: Codec, kind: type[Message], payload: bytes, number: int) -> bytes:
    """Return a complete frame with arbitrary bytes as payload."""
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
    st.builds(Arm, sessions, st.integers(0, 255), periods, periods),
    st.builds(Arm, st.just(ME), st.just(1), st.just(0.006), st.just(0.003)),
    st.builds(Position, sessions, arrays),
    st.builds(messages.Pwm, sessions, arrays),
    st.builds(messages.Damp, sessions),
    st.builds(messages.Disarm, sessions),
    st.builds(messages.Bye, sessions),
    st.builds(Fault, sessions, st.integers(0, 255), st.text(max_size=20)),
)


@pytest.mark.parametrize("where", PROGRAMS)
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
        if bench.motor_command is not None and bench.motor_command.mode == Mode.POSITION:
            assert ((bench.motor_command.values >= low) & (bench.motor_command.values <= high)).all()
        elif bench.motor_command is not None and bench.motor_command.mode == Mode.PWM:
            assert (np.abs(bench.motor_command.values) <= 1).all()


def random_message(rng: random.Random) -> Message | bytes:
    """Return a random message of a host, usually a valid one."""
    session = rng.choices([ME, OTHER, 0], [40, 2, 1])[0]
    number = rng.choices([1.5, rng.uniform(-2, 6), rng.choice([np.nan, np.inf, 4.7, -1.4, 900.0])], [60, 1, 1])[0]
    values = np.where(np.arange(8) == rng.randrange(8), number, 0.9).astype(np.float32)
    period = rng.choices([0.006, 0.05, rng.uniform(0.0, 0.1), 4000.0], [30, 3, 1, 1])[0]
    kinds = {
        Hello(session, rng.choice([0.0, 0.01, 0.02, 4000.0])): 2,
        Ping(rng.randrange(2**32)): 6,
        Pong(3): 1,
        Arm(session, rng.choice([1] * 8 + [2, 2, 9]), period, rng.choice([0.0, 0.003, period])): 6,
        messages.Damp(session): 1,
        messages.Disarm(session): 1,
        messages.Bye(session): 1,
        Fault(session, 3, "text"): 1,
    }
    commands = [Position(session, values), messages.Pwm(session, values / 5.0), rng.randbytes(rng.randrange(60))]
    return rng.choices([*kinds, *commands], [*kinds.values(), 60, 5, 1])[0]


@pytest.mark.parametrize("where", [IN_C, IN_QEMU])
def test_both_programs_have_the_same_answers(robot, where):
    rng, benches = random.Random(0), [Bench(robot, "serial line"), Bench(robot, where)]
    one, other = benches
    good = (0.0, 16.0, 25.0)
    script: list[Any] = []
    for _ in range(15):  # rounds that usually start with an armed robot
        script += [(b"", 1100, good), (Hello(ME, 0.01), 50, good)] + [(Ping(1), 50, good)] * 11
        script.append((Arm(ME, rng.choice([1, 1, 2]), 0.006, 0.003), 1, good))
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
        assert one.firmware.has_operator(one.now) == other.firmware.has_operator(one.now)
        assert len(one.sent) == len(other.sent)
        if one.motor_command is not None:
            np.testing.assert_array_equal(one.motor_command.values.astype(np.float32), other.motor_command.values)
    for mine, its in zip(one.sent, other.sent, strict=True):
        assert (mine.sequence, mine.time) == (its.sequence, its.time)
        assert CODEC.pack(mine.message) == CODEC.pack(its.message), (mine, its)
    faults = {packet.message.reason for packet in one.sent if isinstance(packet.message, Fault)}
    assert len(faults) >= 9
