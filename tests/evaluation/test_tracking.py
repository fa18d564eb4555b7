"""Tracking errors of commands, for synthetic motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scripted_world import COMMAND_LIMITS as LIMITS

from surefoot.errors import SurefootError
from surefoot.evaluation.runs import command_metrics
from surefoot.evaluation.tracking import (
    GRID_SIZE,
    Tracking,
    command_grid,
    distance_along,
    measured_velocity,
    settled_mask,
)
from surefoot.task.trace import EpisodeTrace

STEP = 0.02


MakeTrace = Callable[[np.ndarray, np.ndarray, np.ndarray], EpisodeTrace]


@pytest.fixture
def trace_of(make_run: Callable[..., EpisodeTrace]) -> MakeTrace:
    """Return a function that makes traces from speeds (T, 2) in the heading frame, yaw (T + 1,) and commands (T, 3)."""

    def make(speed: np.ndarray, yaw: np.ndarray, command: np.ndarray) -> EpisodeTrace:
        steps = len(speed)
        cos, sin = np.cos(yaw[:-1]), np.sin(yaw[:-1])
        world = np.stack([cos * speed[:, 0] - sin * speed[:, 1], sin * speed[:, 0] + cos * speed[:, 1]], -1)
        position, quat = np.zeros((steps + 1, 3)), np.zeros((steps + 1, 4))
        position[1:, :2] = np.cumsum(world * STEP, axis=0)
        quat[:, 0], quat[:, 3] = np.cos(yaw / 2), np.sin(yaw / 2)
        arrays = {"base_position_world": position, "base_quat_world": quat, "command": command}
        return make_run(steps=steps, step=STEP, arrays=arrays)

    return make


def test_measured_velocity_is_in_the_heading_frame(trace_of: MakeTrace) -> None:
    yaw = np.linspace(3.0, 3.5, 101)  # through pi
    speed = np.tile([0.4, -0.1], (100, 1))
    measured = measured_velocity(trace_of(speed, yaw, np.zeros((100, 3))))
    assert measured[:, :2] == pytest.approx(speed)
    assert measured[:, 2] == pytest.approx(0.5 / (100 * STEP))


def test_an_oscillation_within_a_stride_is_only_an_instantaneous_error(trace_of: MakeTrace) -> None:
    steps, count = 500, 25  # a stride of 0.5 s
    wave = 0.2 * np.sin(2 * np.pi * np.arange(steps) / count)
    speed = np.stack([0.5 + wave, np.full(steps, 0.03)], -1)
    command = np.tile([0.5, 0.0, 0.1], (steps, 1))
    errors = Tracking.from_traces([trace_of(speed, np.zeros(steps + 1), command)], count * STEP)
    assert errors.rmse == pytest.approx([0.2 / np.sqrt(2), 0.03, 0.1], rel=2e-3)  # incomplete strides count
    assert errors.rmse_stride == pytest.approx([0.0, 0.03, 0.1], abs=1e-6)


def test_the_second_after_a_change_of_command_is_left_out(trace_of: MakeTrace) -> None:
    steps = 200
    command = np.zeros((steps, 3))
    command[100:, 0] = 1.0
    speed = np.zeros((steps, 2))
    speed[150:, 0] = 1.0  # follows a second later
    trace = trace_of(speed, np.zeros(steps + 1), command)
    settled = settled_mask(trace)
    assert np.flatnonzero(~settled[:100]).tolist() == list(range(49))
    assert np.flatnonzero(~settled[100:]).tolist() == list(range(49))
    # One step before the robot's response counts: step 149 ends one second after the change.
    errors = Tracking.from_traces([trace], 0.5)
    assert errors.rmse[0] == pytest.approx(np.sqrt(1 / settled.sum()))


def test_distance_along_commands_is_in_their_direction(trace_of: MakeTrace) -> None:
    # 1 s to the left at 0.3 m/s with 0.1 m/s across; then 1 s on the spot, which covers no distance. The robot turns.
    speed = np.concatenate([np.tile([0.1, 0.3], (50, 1)), np.tile([0.2, 0.0], (50, 1))])
    command = np.concatenate([np.tile([0.0, 0.5, 0.1], (50, 1)), np.tile([0.0, 0.0, 0.7], (50, 1))])
    trace = trace_of(speed, np.linspace(0.0, 1.0, 101), command)
    assert distance_along(trace) == pytest.approx(0.3)


def test_errors_are_nan_without_commands(trace_of: MakeTrace) -> None:
    trace = replace(trace_of(np.zeros((60, 2)), np.zeros(61), np.zeros((60, 3))), command=np.empty(0))
    assert np.isnan(trace.command).all()
    errors = Tracking.from_traces([trace], 0.5)
    assert errors.to_mapping()["rmse"] == {"forward": None, "sideways": None, "yaw_rate": None}


def test_unmeasured_motion_is_no_failure(trace_of: MakeTrace) -> None:
    command = np.tile([0.5, 0.0, 0.0], (100, 1))
    good = trace_of(command[:, :2], np.zeros(101), command)
    assert command_metrics([good])["success"] == 1.0
    unknown = replace(good, base_position_world=np.full_like(good.base_position_world, np.nan))
    assert command_metrics([unknown])["success"] is None
    assert command_metrics([good, unknown])["success"] == 1.0
    # A run that fell has failed, whatever is known of its motion.
    fell = replace(unknown, meta=unknown.meta | {"ended": "fall"})
    assert command_metrics([good, fell])["success"] == 0.5
    # One row without a position leaves out two control steps.
    position = good.base_position_world.copy()
    position[70] = np.nan
    gap = replace(good, base_position_world=position)
    assert command_metrics([gap])["success"] is None
    np.testing.assert_allclose(Tracking.from_traces([gap], 0.1).rmse, 0.0, atol=1e-9)


def test_commands_are_stored_in_a_traces_file(trace_of: MakeTrace, tmp_path) -> None:
    trace = trace_of(np.zeros((60, 2)), np.zeros(61), np.tile([0.5, 0.0, 0.1], (60, 1)))
    back = EpisodeTrace.load(trace.save(tmp_path / "run.npz"))
    assert np.array_equal(back.command, trace.command)
    plain = EpisodeTrace.load(replace(trace, command=np.empty(0)).save(tmp_path / "plain.npz"))
    assert np.isnan(plain.command).all()
    with np.load(tmp_path / "plain.npz") as members:
        assert "command" not in members.files


def test_a_grid_covers_the_range_of_the_commands() -> None:
    rows = command_grid(LIMITS)
    turning, sideways = rows[: GRID_SIZE * GRID_SIZE], rows[GRID_SIZE * GRID_SIZE :]
    assert len(set(turning)) == GRID_SIZE * GRID_SIZE
    assert {y for _, y, _ in turning} == {0.0} == {w for _, _, w in sideways}
    for column, name in ((0, "forward"), (2, "yaw_rate")):
        values = [row[column] for row in turning]
        assert (min(values), max(values)) == getattr(LIMITS, name)
    # Straight commands are already in the grid.
    assert len(set(rows)) == len(rows) == GRID_SIZE * (2 * GRID_SIZE - 1)
    assert {(x, y) for x, y, _ in sideways} >= {(LIMITS.high[0], LIMITS.low[1]), (LIMITS.low[0], LIMITS.high[1])}
    assert len(command_grid(replace(LIMITS, sideways=(0.0, 0.0)))) == GRID_SIZE * GRID_SIZE
    with pytest.raises(SurefootError, match="this policy has no commands to follow"):
        command_grid(None)
