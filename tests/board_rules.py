"""Rules of the board in one table: each is a sequence of steps that every program of a board must pass.

A step triggers something on a `Bench`, or compares the robot's behaviour with the rule.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from board_bench import ME, MS, OTHER, Bench

from surefoot.deploy.messages import (
    Arm,
    Bye,
    Damp,
    Disarm,
    Fault,
    Handshake,
    Hello,
    Message,
    Mode,
    Ping,
    Pong,
    Position,
    Pwm,
    Reason,
    State,
)

Step = Callable[[Bench], None]
TARGET = np.full(8, 1.5)
HELD = np.arange(8) / 10
"""Initial angles of the motors [rad]."""
NAN, INF = np.nan, np.inf


# Actions.


def send(
    message: Message,
    *answers: Reason | Message | type[Message],
    number: int | None = None,
    sent: float | None = None,
    late: float = 0.0,
) -> Step:
    """Send a message, and compare the answers: faults by their reasons.

    Args:
        message: what is sent.
        answers: all expected answers; a class if its content does not matter.
        number: sequence number, relative to the last one (0, -1, ...). Defaults to the next one.
        sent: sending time on the operator's clock [s]. Defaults to now.
        late: time by which it is sent earlier [s].
    """

    def step(bench: Bench) -> None:
        at = bench.number + number if number is not None and number <= 0 else number
        got = bench.send(message, bench.now / 1e6 + 100.0 - late if sent is None else sent, at)
        assert len(got) == len(answers), got
        for one, expected in zip(got, answers, strict=True):
            if isinstance(expected, Reason):
                assert isinstance(one, Fault)
                assert one.text
                assert (one.session, Reason(one.reason)) == (getattr(message, "session", 0), expected)
            elif isinstance(expected, type):
                assert isinstance(one, expected)
                assert one.session == message.session  # type: ignore[attr-defined]
            else:
                assert one == expected

    return step


def send_unasked(message: Message) -> Step:
    """Send a message, and ignore the answer."""
    return lambda bench: bench.send(message) and None


def arm(
    *answers: Reason, mode: int = Mode.POSITION, period: float = 0.006, after: float = 0.003, session: int = ME
) -> Step:
    return send(Arm(session, int(mode), period, after), *answers)


def put(data: bytes) -> Step:
    return lambda bench: bench.put(data)


def feel(**changes: Any) -> Step:
    """Change the readings of the sensors."""

    def step(bench: Bench) -> None:
        bench.vitals = replace(bench.vitals, **changes)

    return step


def run(
    milliseconds: int,
    states: Sequence[int] | None = None,
    faults: dict[int, Reason] | None = None,
    ages: Sequence[float] | None = None,
) -> Step:
    """Advance time; compare the times of states and faults [ms], and the ages of the last command in the states [s]."""

    def step(bench: Bench) -> None:
        start = bench.now
        sent = [(round(packet.time * 1e6 - start) / MS, packet.message) for packet in bench.run(milliseconds)]
        reports = [(at, message) for at, message in sent if isinstance(message, State)]
        if states is not None:
            assert [at for at, _ in reports] == list(states)
        if faults is not None:
            assert {at: Reason(message.reason) for at, message in sent if isinstance(message, Fault)} == faults
        if ages is not None:
            np.testing.assert_allclose([message.command_age for _, message in reports], ages)
            assert {message.command for _, message in reports} == {bench.number}

    return step


# Expectations.


def in_mode(mode: Mode, reason: Reason = Reason.NONE, owner: int | None = None) -> Step:
    def step(bench: Bench) -> None:
        assert bench.mode == (mode, reason)
        assert owner is None or bench.firmware.owner == owner

    return step


def motor_command(mode: Mode, values: np.ndarray | None = None) -> Step:
    """Compare the command sent to the motors."""

    def step(bench: Bench) -> None:
        assert bench.motor_command is not None
        assert bench.motor_command.mode == mode
        if values is not None:
            np.testing.assert_allclose(bench.motor_command.values, values, rtol=1e-7)

    return step


def state(**fields: Any) -> Step:
    """Compare fields of the newest state."""

    def step(bench: Bench) -> None:
        newest = [packet.message for packet in bench.sent if isinstance(packet.message, State)][-1]
        assert {name: getattr(newest, name) for name in fields} == fields

    return step


def counted(**counts: int) -> Step:
    """Compare the counts of commands with old numbers, stale commands and sent faults."""

    def step(bench: Bench) -> None:
        faults = sum(isinstance(packet.message, Fault) for packet in bench.sent)
        seen = {"old_numbers": bench.firmware.link_monitor.old_numbers, "stale": bench.firmware.stale, "faults": faults}
        assert {name: seen[name] for name in counts} == counts

    return step


def said(text: str) -> Step:
    """Compare the text of the newest fault."""

    def step(bench: Bench) -> None:
        assert [packet.message.text for packet in bench.sent if isinstance(packet.message, Fault)][-1] == text

    return step


# The rules.


@dataclass(frozen=True)
class Rule:
    """Steps, and limits of the board that differ from the robot's."""

    steps: tuple[Step, ...]
    limits: dict[str, float] = field(default_factory=dict)


PING = send(Ping(1), Pong(1))
GOOD = send(Position(ME, TARGET))
OLD = Position(ME, 0 * TARGET)
CONNECTED = (send(Hello(ME, 0.010), Handshake), run(1))
ARMED = (*CONNECTED, arm(), run(1), in_mode(Mode.POSITION))
CLEAN = (PING, run(50)) * 11
"""550 ms without errors on the link."""
DAMPED = (run(60), in_mode(Mode.FAULT, Reason.TIMEOUT))


def command(times: int, every: int = 6) -> tuple[Step, ...]:
    """Send commands at regular intervals."""
    return (GOOD, run(every)) * times


def delayed(seconds: float) -> tuple[Step, ...]:
    """Send a ping without delay, and a delayed command."""
    return PING, send(Position(ME, TARGET), late=seconds)


def one_angle(angle: float) -> np.ndarray:
    return np.where(np.arange(8) == 3, angle, TARGET)


def damps_itself(milliseconds: int, reason: Reason, **readings: Any) -> tuple[Step, ...]:
    """Steps of a robot with bad readings: it does not arm while they last, even with a perfect link."""
    good = {"tilt": 0.0, "voltage": 16.0, "temperature": 25.0}
    return (
        *(*ARMED, feel(**readings)),
        *(in_mode(Mode.POSITION), GOOD, run(1)) * milliseconds,
        *(in_mode(Mode.FAULT, reason), *CLEAN, arm(reason)),
        *(feel(**good), run(1), arm()),
    )


RULES = {
    "states come at the requested period and stop with the session": Rule(
        (
            *(*CONNECTED, run(100, range(9, 100, 10)), state(session=ME, mode=Mode.DISARMED, command=0, energy=0.0)),
            *(send(Hello(ME, 0.020), Handshake), run(100, range(9, 100, 20))),
            *(send(Bye(ME)), run(100, ())),
        )
    ),
    "there is no session before hello": Rule(
        (run(50, (), {}), arm(Reason.SESSION), send(Hello(0, 0.01), Reason.SESSION), in_mode(Mode.DISARMED))
    ),
    "pings are answered for anybody whatever their number": Rule(
        (
            *ARMED,
            *(send(Ping(token), Pong(token), number=number) for token, number in ((12, 1), (13, 1), (14, 10**6))),
            *(*command(3), in_mode(Mode.POSITION), counted(old_numbers=0)),
        )
    ),
    "armed motors hold their angles until a command": Rule(
        (
            *(
                *CONNECTED,
                motor_command(Mode.DISARMED),
                arm(),
                feel(motor_angle=1 + HELD),
                run(1),
                motor_command(Mode.POSITION),
            ),
            *(feel(motor_angle=0 * HELD), run(3), motor_command(Mode.POSITION, (1 + HELD).astype(np.float32))),
            *(GOOD, run(1), motor_command(Mode.POSITION, TARGET)),
        )
    ),
    "armed motors have no duty until a command": Rule(
        (
            *(*CONNECTED, arm(mode=Mode.PWM), run(1), motor_command(Mode.PWM, 0 * TARGET)),
            *(send(Pwm(ME, TARGET - 2)), run(1), motor_command(Mode.PWM, TARGET - 2)),
        )
    ),
    "states follow each command and keep its period in silence": Rule(
        (*ARMED, GOOD, run(20, (3, 9, 15), ages=(0.003, 0.009, 0.015)))
    ),
    "arming again changes the times only": Rule(
        (
            *(*ARMED, GOOD, run(2), arm(period=0.010, after=0.010), run(1), motor_command(Mode.POSITION, TARGET)),
            *(run(12, (9,)), arm(Reason.MODE, mode=Mode.PWM), in_mode(Mode.POSITION)),
        )
    ),
    "arming in another mode or with periods beyond the limits is rejected": Rule(
        (
            *CONNECTED,
            *(arm(Reason.COMMAND, period=p, after=a) for p, a in ((0.001, 0.001), (0.051, 0.01), (0.006, 0.007))),
            *(arm(Reason.MODE, mode=mode) for mode in (Mode.DISARMED, Mode.FAULT, 17)),
            in_mode(Mode.DISARMED),
        )
    ),
    "a robot without PWM mode cannot be armed for it": Rule(
        (*CONNECTED, arm(Reason.MODE, mode=Mode.PWM), arm(), in_mode(Mode.POSITION)), {"duty": 0.0}
    ),
    "disarm and bye damp the motors normally": Rule(
        (
            *(*ARMED, send(Disarm(ME)), run(1), in_mode(Mode.DISARMED), motor_command(Mode.DISARMED)),
            *(arm(), send(Bye(ME)), in_mode(Mode.DISARMED, owner=0)),
        )
    ),
    "silence damps after 50 ms": Rule(
        (
            *(*ARMED, GOOD, run(50, faults={}), in_mode(Mode.POSITION)),
            *(run(1, (1,), {0: Reason.TIMEOUT}), in_mode(Mode.FAULT, Reason.TIMEOUT), motor_command(Mode.DISARMED)),
            state(mode=Mode.FAULT, reason=Reason.TIMEOUT, session=ME),
        )
    ),
    "pings do not reset the watchdog": Rule((*ARMED, *(PING, run(1)) * 60, in_mode(Mode.FAULT, Reason.TIMEOUT))),
    # A rejection a second ago counts no more among the ten that are answered; silence is not clean.
    "a fault stays until armed after 500 ms of clean link": Rule(
        (
            *(*ARMED, *DAMPED, arm(Reason.NOT_CLEAN), run(1000)),
            *(arm(Reason.NOT_CLEAN), in_mode(Mode.FAULT, Reason.TIMEOUT), run(50)) * 10,
            *(arm(), in_mode(Mode.POSITION)),
        )
    ),
    "a damaged frame makes the link unclean": Rule(
        (
            *(*ARMED, *DAMPED, *(PING, run(50)) * 9, put(b"\0\x05abc\0"), PING),
            *(*(run(50), arm(Reason.NOT_CLEAN)) * 9, run(50), arm()),
        )
    ),
    "a reason outlives its session": Rule(
        (
            *(*ARMED, *DAMPED, send(Disarm(ME)), in_mode(Mode.FAULT, Reason.TIMEOUT)),
            *(send(Bye(ME)), in_mode(Mode.DISARMED, Reason.TIMEOUT)),
            *(send(Hello(OTHER, 0.01), Handshake), arm(Reason.NOT_CLEAN, session=OTHER)),
        )
    ),
    "the operator can damp at once": Rule(
        (*ARMED, send(Damp(ME), Reason.HOST), run(1), motor_command(Mode.DISARMED), in_mode(Mode.FAULT, Reason.HOST))
    ),
    "the first fault is stored": Rule((*ARMED, *DAMPED, send(Damp(ME)), in_mode(Mode.FAULT, Reason.TIMEOUT))),
    **{
        f"an angle of {angle} damps at once": Rule(
            (
                *(*ARMED, send(Position(ME, one_angle(angle)), Reason.COMMAND), run(1)),
                *(motor_command(Mode.DISARMED), in_mode(Mode.FAULT, Reason.COMMAND)),
            )
        )
        for angle in (NAN, INF, -INF, 4.8, -1.5)
    },
    **{
        f"a duty of {duty} damps at once": Rule(
            (*CONNECTED, arm(mode=Mode.PWM), send(Pwm(ME, 0 * TARGET + duty), Reason.COMMAND))
        )
        for duty in (NAN, 1.01, -1.01)
    },
    "the first command may turn the motors a little": Rule(
        (
            *(*CONNECTED, arm(), send(Position(ME, HELD + 0.04)), in_mode(Mode.POSITION)),
            *(GOOD, in_mode(Mode.POSITION)),  # later ones may jump
        ),
        {"first_torque": 0.05},  # of a gain of 1
    ),
    "the first command may not jump": Rule(
        (*CONNECTED, arm(), send(Position(ME, HELD + 0.06), Reason.COMMAND), in_mode(Mode.FAULT, Reason.COMMAND)),
        {"first_torque": 0.05},
    ),
    "three consecutive commands with old numbers damp": Rule(
        (
            *(*ARMED, *command(2)),
            *(send(OLD, number=0), run(1), in_mode(Mode.POSITION)),
            *(send(OLD, number=-1), run(1), in_mode(Mode.POSITION)),
            *(send(OLD, Reason.STALE, number=1), run(1), in_mode(Mode.FAULT, Reason.STALE), counted(old_numbers=3)),
        )
    ),
    "two old numbers between good ones are dropped and counted": Rule(
        (
            *(*ARMED, *(*command(1), send(OLD, number=1), send(OLD, number=1)) * 10),
            *(run(10), in_mode(Mode.POSITION), motor_command(Mode.POSITION, TARGET), state(dropped=20)),
        )
    ),
    "commands older than three periods are dropped": Rule(
        (
            *(*ARMED, *command(1)),
            *(send(Position(ME, TARGET + 0.125), late=0.018), run(6), motor_command(Mode.POSITION, TARGET + 0.125)),
            *(send(Position(ME, TARGET), late=0.0181), run(6), in_mode(Mode.POSITION)) * 2,
            *(send(Position(ME, TARGET), Reason.STALE, late=0.0181), in_mode(Mode.FAULT, Reason.STALE)),
            counted(stale=3),
        )
    ),
    # A first frame that came 30 ms sooner than all that follow makes them old; after 11 s it is forgotten.
    "ages are relative to the fastest frame of ten seconds": Rule(
        (
            *(*ARMED, *delayed(0.0), run(6), *(*delayed(0.030), run(6)) * 2, counted(stale=2)),
            *(*delayed(0.0), *(*delayed(0.015), run(20)) * 600),
            *(*delayed(0.030), counted(stale=2), in_mode(Mode.POSITION)),
        )
    ),
    "a tilt damps": Rule(damps_itself(1, Reason.TILT, tilt=1.01)),
    "a tilt that is NaN damps": Rule(damps_itself(1, Reason.TILT, tilt=NAN)),
    "a hot motor damps": Rule(damps_itself(1, Reason.TEMPERATURE, temperature=90.1)),
    "a temperature that is NaN damps": Rule(damps_itself(1, Reason.TEMPERATURE, temperature=NAN)),
    "a battery low for 500 ms damps": Rule(damps_itself(501, Reason.BATTERY, voltage=12.4)),
    "a voltage that is NaN damps": Rule(damps_itself(501, Reason.BATTERY, voltage=NAN)),
    "a short sag of the voltage does not damp": Rule(
        (
            *ARMED,
            *(feel(voltage=12.4), *command(80), feel(voltage=12.6), *command(80)) * 5,
            in_mode(Mode.POSITION),
        )
    ),
    "further hazards damp and prevent arming": Rule(
        (
            *(*ARMED, feel(hazard=(Reason.MOTOR_OFF, "a motor is off"))),
            *(run(1, faults={0: Reason.MOTOR_OFF}), said("a motor is off"), in_mode(Mode.FAULT, Reason.MOTOR_OFF)),
            *(*CLEAN, arm(Reason.MOTOR_OFF)),
        )
    ),
    "a request to sit is sent once and leaves the motors armed": Rule(
        (
            *(*ARMED, feel(sit=(Reason.REMOTE, "a stick was moved"))),
            *(run(20, faults={0: Reason.REMOTE}), said("a stick was moved"), state(reason=Reason.REMOTE)),
            *(in_mode(Mode.POSITION, Reason.REMOTE), *command(2), motor_command(Mode.POSITION, TARGET)),
        )
    ),
    "a second operator is rejected and the first keeps the robot": Rule(
        (
            *ARMED,
            *(
                send(Hello(OTHER, 0.01), Reason.BUSY, number=900),
                send(Position(OTHER, 0 * TARGET), Reason.SESSION, number=901),
                send(Damp(OTHER), Reason.SESSION, number=902),
                *command(1),
            )
            * 5,
            *(in_mode(Mode.POSITION, owner=ME), motor_command(Mode.POSITION, TARGET)),
        )
    ),
    "another operator may connect after a second of silence": Rule(
        (
            *(*ARMED, run(999), in_mode(Mode.FAULT, Reason.TIMEOUT)),
            *(send(Hello(OTHER, 0.01), Reason.BUSY, sent=3.0, number=1), run(1)),
            *(send(Hello(OTHER, 0.01), Handshake, sent=3.0, number=1), in_mode(Mode.DISARMED, Reason.TIMEOUT, OTHER)),
            arm(Reason.SESSION),
        )
    ),
    "a hello of the same session is answered again": Rule(
        (*ARMED, send(Hello(ME, 0.01), Handshake), in_mode(Mode.POSITION))
    ),
    "commands for another mode are rejected": Rule(
        (
            *(*CONNECTED, send(Position(ME, TARGET), Reason.MODE), arm(), send(Pwm(ME, TARGET / 2), Reason.MODE)),
            *(in_mode(Mode.POSITION), run(10), state(dropped=2)),
        )
    ),
    "rejections are sent at most ten times per second": Rule(
        (*(send_unasked(Position(OTHER, TARGET)), run(5)) * 400, counted(faults=20))
    ),
    "a second operator is answered at most ten times per second": Rule(
        (
            *CONNECTED,
            *(send(Hello(OTHER, 0.01), Reason.BUSY, number=900),) * 10,
            *(send(Hello(OTHER, 0.01), number=900),) * 20,
        )
    ),
}
every_rule = pytest.mark.parametrize("rule", [pytest.param(rule, id=name) for name, rule in RULES.items()])
