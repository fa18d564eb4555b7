"""Delayed readings of signals with a closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.actuator.delay import push_kernel, read_kernel


class History:
    """History of one robot with samples of two values."""

    def __init__(self, times=(), capacity: int = 64) -> None:
        self.times, self.samples, self.count = np.zeros(capacity), np.zeros((capacity, 2)), 0
        for time in times:
            self.push(time, ramp(time))

    def push(self, time: float, sample: np.ndarray) -> None:
        push_kernel(self.times, self.samples, self.count, time, sample)
        self.count += 1

    def read(self, time: float, width: int = 2, yaw: int = -1) -> np.ndarray:
        out = np.empty(width)
        read_kernel(self.times, self.samples, self.count, time, width, yaw, out)
        return out


def ramp(time: float) -> np.ndarray:
    """Return the values of two linear functions (2,)."""
    return np.array([3.0 * time + 1.0, -2.0 * time])


@pytest.mark.parametrize("latency", [0.0, 1.0, 2.0, 5.0])
def test_a_latency_of_whole_samples_reads_a_sample(latency: float):
    assert np.array_equal(History(np.arange(10.0)).read(9.0 - latency), ramp(9.0 - latency))


@pytest.mark.parametrize(
    ("times", "at"),
    [
        (np.arange(10.0), [8.75, 7.5, 5.3]),
        ([0.0, 0.1, 0.9, 1.0, 3.5], [0.05, 0.5, 0.95, 2.0, 3.4]),
    ],
)
def test_readings_between_samples_are_interpolated(times, at: list[float]):
    history = History(times)
    np.testing.assert_allclose([history.read(time) for time in at], [ramp(time) for time in at], rtol=1e-13)


# The table in the module's docstring, with O_k = k + 10.
@pytest.mark.parametrize(("latency", "expected"), [(0.0, [10, 11, 12]), (1.0, [10, 10, 11]), (1.5, [10, 10, 10.5])])
def test_the_readings_of_the_docstrings_table(latency: float, expected: list[float]):
    history, seen = History(), []
    for k in range(3):
        history.push(float(k), np.array([k + 10.0, 0.0]))
        seen.append(history.read(k - latency, width=1)[0])
    assert seen == expected


# Between 3.1 and -3.1 rad are 0.083 rad through pi; a quarter of it is 0.0208, three quarters 0.0624.
@pytest.mark.parametrize(("at", "expected"), [(0.25, 3.12080), (0.75, -3.12080), (1.25, -3.12080), (1.75, 3.12080)])
def test_yaw_is_interpolated_through_pi(at: float, expected: float):
    history = History()
    for k, yaw in enumerate((3.1, -3.1, 3.1)):
        history.push(float(k), np.array([yaw, yaw]))
    plain, wrapped = history.read(at, yaw=1)
    assert wrapped == pytest.approx(expected, abs=1e-5)
    assert abs(plain) < 3.1  # another reading is not an angle


@pytest.mark.parametrize(("at", "held"), [(-49.0, 0.0), (1.4, 1.0)])
def test_the_oldest_and_the_newest_sample_are_held(at: float, held: float):
    assert np.array_equal(History([0.0, 1.0]).read(at), ramp(held))


def test_a_full_history_keeps_the_last_samples():
    history = History(np.arange(100.0), capacity=4)
    for latency in (0.0, 0.5, 2.9, 3.0):
        np.testing.assert_allclose(history.read(99.0 - latency), ramp(99.0 - latency), rtol=1e-13)
    assert np.array_equal(history.read(95.5), ramp(96.0))


@given(
    gaps=st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=30),
    fraction=st.floats(0, 1),
    slope=st.floats(-100, 100),
    offset=st.floats(-100, 100),
)
def test_a_straight_line_is_read_exactly(gaps: list[float], fraction: float, slope: float, offset: float):
    times, history = np.cumsum([0.0, *gaps]), History()
    for time in times:
        history.push(time, np.array([slope * time + offset, 0.0]))
    at = fraction * times[-1]
    assert history.read(at)[0] == pytest.approx(slope * at + offset, abs=1e-9)
