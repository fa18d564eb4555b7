"""Late readings against signals whose past is known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.actuator import DelayLine
from surefoot.errors import SurefootError


def ramp(time):
    """Two straight lines, (2,)."""
    return np.array([3.0 * time + 1.0, -2.0 * time])


def recorded(times, num_envs: int = 1, capacity: int = 64) -> DelayLine:
    line = DelayLine(num_envs, 2, capacity)
    for time in times:
        line.push(time, np.tile(ramp(time), (num_envs, 1)))
    return line


@pytest.mark.parametrize("latency", [0.0, 1.0, 2.0, 5.0])
def test_a_latency_of_whole_samples_reads_a_sample(latency: float):
    line = recorded(np.arange(10.0))
    assert np.array_equal(line.read(9.0, latency), [ramp(9.0 - latency)])


@pytest.mark.parametrize("latency", [0.25, 1.5, 3.7])
def test_between_samples_it_interpolates(latency: float):
    line = recorded(np.arange(10.0))
    np.testing.assert_allclose(line.read(9.0, latency), [ramp(9.0 - latency)], rtol=1e-14)


# The table in the module's docstring, with O_k = k + 10.
@pytest.mark.parametrize(("latency", "expected"), [(0.0, [10, 11, 12]), (1.0, [10, 10, 11]), (1.5, [10, 10, 10.5])])
def test_readings_as_the_docstring_says(latency: float, expected: list[float]):
    line, seen = DelayLine(1, 1), []
    for k in range(3):
        line.push(float(k), [[k + 10.0]])
        seen.append(line.read(float(k), latency)[0, 0])
    assert seen == expected


def test_before_history_exists_the_oldest_sample_is_held():
    line = recorded([0.0, 1.0])
    assert np.array_equal(line.read(1.0, 50.0), [ramp(0.0)])


def test_after_the_newest_sample_it_is_held():
    assert np.array_equal(recorded([0.0, 1.0]).read(1.4, 0.0), [ramp(1.0)])


def test_each_robot_has_its_own_latency():
    line = recorded(np.arange(10.0), num_envs=3)
    latency = np.array([0.0, 2.5, 7.0])
    np.testing.assert_allclose(line.read(9.0, latency), ramp(9.0 - latency).T, rtol=1e-14)


def test_each_robot_has_its_own_clock():
    line = DelayLine(2, 1)
    for k in range(5):
        line.push([1.0 * k, 0.1 * k], [[1.0 * k], [0.1 * k]])
    np.testing.assert_allclose(line.read([4.0, 0.4], [0.5, 0.25]), [[3.5], [0.15]])


def test_irregular_times():
    line = recorded([0.0, 0.1, 0.9, 1.0, 3.5])
    for at in (0.05, 0.5, 0.95, 2.0, 3.4):
        np.testing.assert_allclose(line.read(3.5, 3.5 - at), [ramp(at)], rtol=1e-13)


def test_a_full_line_keeps_the_last_samples():
    line = recorded(np.arange(100.0), capacity=4)
    for latency in (0.0, 0.5, 2.9, 3.0):
        np.testing.assert_allclose(line.read(99.0, latency), [ramp(99.0 - latency)], rtol=1e-13)


def test_a_latency_beyond_a_full_line_is_refused():
    with pytest.raises(SurefootError, match=r"latency is 3.5 s; 4 samples do not reach that far back"):
        recorded(np.arange(100.0), capacity=4).read(99.0, 3.5)


def test_clear_forgets_only_the_robots_asked_for():
    line = recorded(np.arange(3.0), num_envs=2)
    line.clear([1])
    line.push([3.0, 0.0], [ramp(3.0), [7.0, 8.0]])
    np.testing.assert_allclose(line.read([3.0, 0.0], 1.0), [ramp(2.0), [7.0, 8.0]])


@given(
    gaps=st.lists(st.floats(1e-3, 1.0), min_size=1, max_size=30),
    share=st.floats(0, 1),
    slope=st.floats(-100, 100),
    offset=st.floats(-100, 100),
)
def test_a_straight_line_is_read_exactly(gaps: list[float], share: float, slope: float, offset: float):
    times = np.cumsum([0.0, *gaps])
    line = DelayLine(1, 1, 64)
    for time in times:
        line.push(time, [[slope * time + offset]])
    latency = share * times[-1]
    expected = slope * (times[-1] - latency) + offset
    assert line.read(times[-1], latency)[0, 0] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("latency", [-0.001, float("nan")])
def test_a_latency_that_is_none_is_refused(latency: float):
    with pytest.raises(SurefootError, match=r"latency is .* must not be below 0"):
        recorded([0.0, 1.0]).read(1.0, latency)


def test_reading_before_the_first_sample_is_refused():
    with pytest.raises(SurefootError, match="nothing was pushed yet"):
        DelayLine(1, 2).read(0.0, 0.0)


@pytest.mark.parametrize("time", [1.0, 0.5])
def test_time_that_does_not_go_forward_is_refused(time: float):
    line = recorded([0.0, 1.0])
    with pytest.raises(SurefootError, match="times must go forward"):
        line.push(time, [ramp(time)])


def test_a_capacity_of_one_is_refused():
    with pytest.raises(SurefootError, match="capacity is 1"):
        DelayLine(1, 2, 1)
