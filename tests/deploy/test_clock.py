"""Clocks: the real one waits as long as it is told, the one in lockstep takes the robot along."""

from __future__ import annotations

import pytest

from surefoot.deploy.clock import LockstepClock, MonotonicClock
from surefoot.deploy.link import Link
from surefoot.deploy.wire.messages import Ping
from surefoot.errors import SurefootError


def test_the_monotonic_clock_starts_at_zero_and_waits_no_less_than_asked():
    clock = MonotonicClock()
    assert 0.0 <= clock.now() < 1.0
    moment = clock.now() + 0.02
    clock.wait_until(moment)
    assert clock.now() >= moment


def test_a_moment_that_has_passed_is_not_waited_for():
    clock = MonotonicClock()
    before = clock.now()
    clock.wait_until(before - 10.0)
    assert clock.now() < before + 5.0


def test_time_in_lockstep_passes_only_while_waiting():
    clock = LockstepClock()
    assert clock.now() == 0.0
    clock.wait_until(0.006)
    clock.wait_until(0.005)
    assert clock.now() == 0.006


def test_the_robot_is_pinged_through_to_the_moment(toy):
    clock = LockstepClock()
    Link(toy, toy.codec, clock)
    clock.wait_until(0.25)
    assert toy.heard == [(0.25, Ping(1))]


def test_a_robot_that_does_not_follow_is_told_in_one_line():
    clock = LockstepClock()
    clock.ping_through = lambda patience: False
    with pytest.raises(SurefootError, match="emulator run with --lockstep"):
        clock.wait_until(0.1)
