"""Greeting a robot, refusals, and what is known of it."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.deploy.clock import LockstepClock
from surefoot.deploy.connection import LEAD, RobotConnection
from surefoot.deploy.messages import Arm, Mode
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.serial_link import Link
from surefoot.emulator.firmware import Firmware
from surefoot.errors import SurefootError


def operator_of(toy, session: int) -> RobotConnection:
    clock = LockstepClock()
    return RobotConnection(Link(toy, toy.codec, clock), clock, session)


def test_a_greeting_is_answered_and_states_follow(connection):
    handshake = connection.connect(state_period=0.006)
    assert handshake.session == 77
    assert handshake.robot == "minitaur"
    assert connection.wait_for(lambda: connection.states >= 3, 0.1)
    assert connection.state.mode == Mode.DISARMED
    assert connection.state_age() <= 0.006 + 1e-9


def test_a_robot_can_be_greeted_again_after_it_was_switched_on_anew(toy, connection):
    connection.connect(state_period=0.006)
    connection.wait_for(lambda: False, 0.1)
    toy.firmware = Firmware(toy.codec, toy.firmware.introduction, toy.firmware.limits)
    again = connection.connect(state_period=0.006)
    assert again.session == 77
    states = connection.states
    assert connection.wait_for(lambda: connection.states >= states + 3, 0.1)


def test_what_a_robot_tells_another_operator_is_forgotten(toy, connection):
    before = operator_of(toy, 5)
    before.connect(state_period=0.006)
    toy.run_to(50_000)
    connection.clock.wait_until(0.05)
    connection.update()
    assert connection.state.session == 5
    toy.firmware.owner = 0
    connection.connect(state_period=0.5)
    assert connection.state is None


def test_a_greeting_that_comes_twice_changes_nothing(toy, connection):
    said = []
    say = toy._say

    def keep():
        before = len(toy._out)
        say()
        said.append(bytes(toy._out[before:]))

    toy._say = keep
    first = connection.connect(state_period=0.006)
    connection.wait_for(lambda: connection.states > 3, 0.1)
    state, sync = connection.state, connection.sync.offset
    for data in said:
        toy._out += data
    connection.update()
    assert connection.handshake is first
    assert connection.state is state
    assert connection.sync.offset == sync


def test_silence_is_told_in_one_line(toy, monkeypatch):
    connection = operator_of(toy, 5)
    monkeypatch.setattr(connection.link, "send", lambda message: 0)
    monkeypatch.setattr(connection.clock, "wait_until", lambda moment: setattr(connection.clock, "_now", moment))
    with pytest.raises(SurefootError, match="no robot answers within 2 s; check port, cable"):
        connection.connect()


def test_a_second_operator_is_refused_and_the_first_keeps_the_robot(toy, connection):
    connection.connect()
    connection.arm(Mode.POSITION, 0.006)
    stranger = operator_of(toy, 78)
    with pytest.raises(SurefootError, match="the robot refuses: another operator has the robot"):
        stranger.connect()
    assert toy.firmware.owner == 77


def test_a_robot_of_another_protocol_is_named(toy, connection):
    connection.link.decoder.codec = Codec(8)
    connection.link.decoder.codec.schema ^= 1
    with pytest.raises(SurefootError, match="speaks version 1 and schema 0x"):
        connection.connect()


def test_armed_states_come_when_the_next_command_is_due(connection):
    connection.connect()
    connection.arm(Mode.POSITION, 0.006)
    start = connection.clock.now()
    for k in range(10):
        connection.command(Mode.POSITION, np.full(8, 2.0))
        before = connection.states
        connection.clock.wait_until(start + (k + 1) * 0.006)
        connection.update()
        assert connection.states == before + 1
        assert connection.state.mode == Mode.POSITION
        assert connection.state_age() == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("period", [0.006, 0.005, 1 / 180, 0.0070001])
def test_a_state_is_never_due_after_the_next_command(period, connection):
    """Times of sending are whole microseconds; a period need not be."""
    connection.connect()
    connection.arm(Mode.POSITION, period)
    start = connection.clock.now()
    for k in range(200):
        connection.command(Mode.POSITION, np.full(8, 2.0))
        before = connection.states
        connection.clock.wait_until(start + (k + 1) * period)
        connection.update()
        assert connection.states >= before + 1


def test_the_lead_is_what_the_robot_is_asked_for(toy, connection):
    connection.connect()
    connection.arm(Mode.POSITION, 0.006, lead=LEAD)
    arm = next(message for _, message in toy.heard if isinstance(message, Arm))
    assert arm.command_period == pytest.approx(0.006)
    assert arm.report_after == pytest.approx(0.006 - LEAD)


def test_the_newest_state_grows_old_when_the_robot_falls_silent(toy, connection):
    connection.connect(state_period=0.006)
    connection.wait_for(lambda: connection.states > 2, 0.1)
    toy.sensors = lambda time, readings: readings
    toy.firmware.next_state = None
    connection.wait_for(lambda: False, 0.03)
    assert connection.state_age() > 0.024


def test_goodbye_frees_the_robot(toy, connection):
    connection.connect()
    connection.arm(Mode.POSITION, 0.006)
    connection.close()
    assert toy.firmware.mode == Mode.DISARMED
    assert toy.firmware.owner == 0
