"""Clocks: waiting in real time, running the robot in lockstep, and the age of frames between two clocks."""

from __future__ import annotations

import math

import pytest

from surefoot.deploy.clock import SYNC_WINDOW, ClockSync, LockstepClock, MonotonicClock
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.errors import SurefootError


def test_the_monotonic_clock_starts_at_zero_and_waits():
    clock = MonotonicClock()
    before = clock.now()
    assert 0.0 <= before < 1.0
    clock.wait_until(before - 10.0)
    assert clock.now() < before + 5.0
    clock.wait_until(clock.now() + 0.02)
    assert clock.now() >= before + 0.02


def test_time_in_lockstep_advances_only_while_waiting():
    clock = LockstepClock()
    assert clock.now() == 0.0
    clock.wait_until(0.006)
    clock.wait_until(0.005)
    assert clock.now() == 0.006


def test_a_robot_that_does_not_answer_in_lockstep_is_an_error(toy, monkeypatch):
    clock = LockstepClock()
    monkeypatch.setattr(SerialLink(toy, toy.codec, clock), "await_pong", lambda: False)
    with pytest.raises(SurefootError, match="emulator started with --lockstep"):
        clock.wait_until(0.1)


def test_the_fastest_frame_sets_the_offset():
    sync = ClockSync()
    for sent, arrived in ((1.0, 101.005), (1.1, 101.102), (1.2, 101.209)):
        sync.add(sent, arrived)
    assert sync.offset == pytest.approx(100.002)
    assert sync.age(1.2, 101.209) == pytest.approx(0.007)
    assert sync.age(1.1, 101.102) == pytest.approx(0.0)


def test_the_offset_is_infinite_without_a_frame():
    sync = ClockSync()
    assert sync.offset == math.inf
    sync.add(0.0, 5.0)
    sync.reset()
    assert sync.offset == math.inf


def test_a_fast_frame_counts_only_within_the_window():
    sync = ClockSync()
    sync.add(0.0, 50.0)
    sync.add(SYNC_WINDOW, 50.0 + SYNC_WINDOW + 0.004)
    assert sync.offset == pytest.approx(50.0)
    sync.add(SYNC_WINDOW + 2.0, 50.0 + SYNC_WINDOW + 2.004)
    assert sync.offset == pytest.approx(50.004)


def test_the_drift_of_clocks_is_followed_in_bounded_memory():
    """50 ppm over a minute is 3 ms; the error of the age stays below the drift in the window."""
    sync, drift = ClockSync(), 50e-6
    for k in range(6000):
        sent = 0.01 * k
        sync.add(sent, 7.0 + sent * (1.0 + drift))
    assert 0.0 <= sync.age(sent, 7.0 + sent * (1.0 + drift)) <= 1.2 * drift * SYNC_WINDOW
    assert len(sync._buckets) <= SYNC_WINDOW + 2
