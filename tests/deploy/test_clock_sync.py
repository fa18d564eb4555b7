"""The age of what a robot says, by two clocks that start at different times."""

from __future__ import annotations

import math

import pytest

from surefoot.deploy.clock import WINDOW, ClockSync


def test_the_quickest_frame_sets_the_offset():
    sync = ClockSync()
    for sent, arrived in ((1.0, 101.005), (1.1, 101.102), (1.2, 101.209)):
        sync.add(sent, arrived)
    assert sync.offset == pytest.approx(100.002)
    assert sync.age(1.2, 101.209) == pytest.approx(0.007)
    assert sync.age(1.1, 101.102) == pytest.approx(0.0)


def test_nothing_is_known_at_first_and_after_forgetting():
    sync = ClockSync()
    assert sync.offset == math.inf
    sync.add(0.0, 5.0)
    sync.forget()
    assert sync.offset == math.inf


def test_a_quick_frame_counts_for_the_window_and_no_longer():
    sync = ClockSync()
    sync.add(0.0, 50.0)
    sync.add(WINDOW, 50.0 + WINDOW + 0.004)
    assert sync.offset == pytest.approx(50.0)
    sync.add(WINDOW + 2.0, 50.0 + WINDOW + 2.004)
    assert sync.offset == pytest.approx(50.004)


def test_clocks_that_run_apart_are_followed():
    """50 ppm over a minute is 3 ms; the age stays below what the window allows."""
    sync, drift = ClockSync(), 50e-6
    for k in range(6000):
        sent = 0.01 * k
        sync.add(sent, 7.0 + sent * (1.0 + drift))
    assert 0.0 <= sync.age(sent, 7.0 + sent * (1.0 + drift)) <= 1.2 * drift * WINDOW


def test_memory_is_bounded():
    sync = ClockSync()
    for k in range(10_000):
        sync.add(0.1 * k, 0.1 * k)
    assert len(sync._buckets) <= WINDOW + 2
