"""Connecting to a robot, rejections, and its latest state."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.clock import LockstepClock
from surefoot.deploy.messages import Arm, Mode
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.serial_link import LEAD, SerialLink
from surefoot.errors import SurefootError


def operator_of(toy, session: int) -> RobotLink:
    clock = LockstepClock()
    return SerialLink(toy, toy.codec, clock, session)


def test_the_robot_answers_with_a_handshake_and_then_states(link):
    handshake = link.connect(state_period=0.006)
    assert handshake.session == 77
    assert handshake.robot == "minitaur"
    assert link.wait_for(lambda: link.states >= 3, 0.1)
    assert link.state.mode == Mode.DISARMED
    assert link.state_age() <= 0.006 + 1e-9


def test_a_restarted_robot_can_be_connected_again(toy, link):
    link.connect(state_period=0.006)
    link.wait_for(lambda: False, 0.1)
    toy.firmware = Firmware(toy.firmware.handshake, toy.firmware.limits)
    again = link.connect(state_period=0.006)
    assert again.session == 77
    states = link.states
    assert link.wait_for(lambda: link.states >= states + 3, 0.1)


def test_states_for_another_operator_are_discarded(toy, link):
    before = operator_of(toy, 5)
    before.connect(state_period=0.006)
    toy.run_to(50_000)
    link.clock.wait_until(0.05)
    link.update()
    assert link.state.session == 5
    toy.firmware.owner = 0
    link.connect(state_period=0.5)
    assert link.state is None


def test_a_repeated_handshake_changes_nothing(toy, link):
    sent = []
    send = toy._send

    def keep():
        before = len(toy._out)
        send()
        sent.append(bytes(toy._out[before:]))

    toy._send = keep
    first = link.connect(state_period=0.006)
    link.wait_for(lambda: link.states > 3, 0.1)
    state, sync = link.state, link.sync.offset
    for data in sent:
        toy._out += data
    link.update()
    assert link.handshake is first
    assert link.state is state
    assert link.sync.offset == sync


def test_a_robot_that_does_not_answer_is_an_error(toy, monkeypatch):
    link = operator_of(toy, 5)
    monkeypatch.setattr(link, "send", lambda message: 0)
    monkeypatch.setattr(link.clock, "wait_until", lambda moment: setattr(link.clock, "_now", moment))
    with pytest.raises(SurefootError, match="no robot answers within 2 s; check port, cable"):
        link.connect()


def test_a_second_operator_is_rejected_and_the_first_keeps_the_robot(toy, link):
    link.connect()
    link.arm(Mode.POSITION, 0.006)
    stranger = operator_of(toy, 78)
    with pytest.raises(SurefootError, match="the robot rejects the connection: another operator uses the robot"):
        stranger.connect()
    assert toy.firmware.owner == 77


def test_a_robot_with_another_protocol_is_reported(toy, link):
    link.decoder.codec = Codec(8)
    link.decoder.codec.schema ^= 1
    with pytest.raises(SurefootError, match="has version 1 and schema 0x"):
        link.connect()


@pytest.mark.parametrize("period", [0.006, 0.005, 1 / 180, 0.0070001])
def test_an_armed_robot_sends_a_state_just_before_the_next_command(period, link):
    """Sending times are whole microseconds; periods may not be."""
    link.connect()
    link.arm(Mode.POSITION, period)
    start = link.clock.now()
    for k in range(200):
        link.command(Mode.POSITION, np.full(8, 2.0))
        before = link.states
        link.clock.wait_until(start + (k + 1) * period)
        link.update()
        assert link.states >= before + 1
        assert link.state.mode == Mode.POSITION
        assert link.state_age() <= 1.5e-6


def test_states_are_requested_the_lead_before_the_next_command(toy, link):
    link.connect()
    link.arm(Mode.POSITION, 0.006, lead=LEAD)
    arm = next(message for _, message in toy.received if isinstance(message, Arm))
    assert arm.command_period == pytest.approx(0.006)
    assert arm.report_after == pytest.approx(0.006 - LEAD)


def test_the_newest_state_ages_when_the_robot_is_silent(toy, link):
    link.connect(state_period=0.006)
    link.wait_for(lambda: link.states > 2, 0.1)
    toy.sensors = lambda time, readings: readings
    toy.firmware.next_state = None
    link.wait_for(lambda: False, 0.03)
    assert link.state_age() > 0.024


def test_closing_disarms_and_frees_the_robot(toy, link):
    link.connect()
    link.arm(Mode.POSITION, 0.006)
    link.close()
    assert toy.firmware.mode == Mode.DISARMED
    assert toy.firmware.owner == 0
