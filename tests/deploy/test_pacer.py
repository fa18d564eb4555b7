"""Timing of the control loop on a simulated clock, and real-time priority."""

from __future__ import annotations

import gc
import os
import sys

import pytest

from surefoot.deploy.pacer import LoopTiming, Pacer, real_time_priority


class HandClock:
    """A clock that wakes up late once."""

    def __init__(self) -> None:
        self.time = 10.0
        self.late = 0.0

    def now(self) -> float:
        return self.time

    def wait_until(self, moment: float) -> None:
        self.time = max(self.time, moment) + self.late
        self.late = 0.0


def test_steps_come_at_whole_periods():
    pacer = Pacer(HandClock(), 0.006)
    ticks = [pacer.next() for _ in range(4)]
    assert [tick.index for tick in ticks] == [0, 1, 2, 3]
    assert [tick.due for tick in ticks] == pytest.approx([10.0, 10.006, 10.012, 10.018])
    assert all(tick.missed == 0 for tick in ticks)


@pytest.mark.parametrize(("late", "missed"), [(0.001, 0), (0.0059, 0), (0.0061, 1), (0.0125, 2), (0.0181, 3)])
def test_a_step_late_by_a_period_is_missed_and_due_times_do_not_shift(late, missed):
    clock = HandClock()
    pacer = Pacer(clock, 0.006)
    pacer.next()
    clock.late = late
    tick = pacer.next()
    assert (tick.index, tick.missed) == (1 + missed, missed)
    assert tick.late == pytest.approx(late)
    assert tick.due == pytest.approx(10.006 + 0.006 * missed)
    following = pacer.next()
    assert following.index == tick.index + 1
    assert following.due == pytest.approx(tick.due + 0.006)


def test_a_restart_replaces_the_next_step():
    clock = HandClock()
    pacer = Pacer(clock, 0.006)
    for _ in range(3):
        pacer.next()
    pacer.restart()
    assert pacer.next().due == pytest.approx(10.018)
    clock.time = 11.0
    pacer.restart()
    tick = pacer.next()
    assert (tick.index, tick.missed) == (0, 0)
    assert tick.due == pytest.approx(11.0)


def test_metrics_are_in_milliseconds():
    timing = LoopTiming(100)
    assert timing.metrics()["lateness_median_ms"] is None
    for k in range(101):
        timing.add(k * 1e-5, 1e-3 + k * 1e-5, 2e-4 if k % 2 else float("nan"), k * 1e-4, 0, True)
    timing.add(0.0, 0.0, float("nan"), 0.0, 2, False)
    metrics = timing.metrics()
    assert (metrics["steps"], metrics["missed"], metrics["stale"]) == (102, 2, 1)
    assert metrics["lateness_median_ms"] == pytest.approx(0.495)
    assert metrics["lateness_max_ms"] == pytest.approx(0.99)
    assert metrics["sent_max_ms"] == pytest.approx(1.99)
    assert metrics["inference_median_ms"] == pytest.approx(0.2)
    assert (metrics["state_age_median_ms"], metrics["state_age_max_ms"]) == pytest.approx((4.95, 9.9))
    assert timing.last(2).tolist() == pytest.approx([0.98e-3, 0.99e-3])


def test_real_time_priority_disables_garbage_collection_and_ends_after_an_exception():
    before = sys.getswitchinterval()

    def fail() -> None:
        with real_time_priority():
            assert not gc.isenabled()
            assert sys.getswitchinterval() < before
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert gc.isenabled()
    assert sys.getswitchinterval() == pytest.approx(before)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER


def test_real_time_priority_works_without_permission(monkeypatch):
    def refused(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(os, "sched_setscheduler", refused)
    monkeypatch.setattr(os, "setpriority", refused)
    with real_time_priority():
        assert not gc.isenabled()
    assert gc.isenabled()
