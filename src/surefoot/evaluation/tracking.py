"""Tracking errors of velocity commands, from traces: speeds in the heading frame, and yaw rate."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.robot.commands import COMMANDS, CommandLimits
from surefoot.rotations import in_heading_frame, quat_yaw
from surefoot.tables import plain_value
from surefoot.task.command_tracking import is_success, step_distances
from surefoot.task.trace import EpisodeTrace
from surefoot.task.velocity_tracking import DEFAULT_STRIDE

GRID_SIZE = 7
"""Number of commands along each side of a grid."""
SETTLING_TIME = 1.0
"""Time [s] that is left out after a change of the command, since no robot can follow a step at once."""


@dataclass(frozen=True)
class Tracking:
    """Root mean square errors of forward and sideways speed [m/s] and yaw rate [rad/s]; NaN without data."""

    rmse: Array
    """Instantaneous error (3,), of the mean velocity in each control step."""
    rmse_stride: Array
    """Stride-averaged error (3,), of the velocity averaged over a stride."""

    @classmethod
    def from_traces(cls, traces: Iterable[EpisodeTrace], stride: float | None = None) -> Tracking:
        """Return the tracking errors of recorded runs with commands.

        Control steps within `SETTLING_TIME` after a change of the command are left out, also those in which the motion
        was not measured, and so are strides that contain one.

        Args:
            traces: the runs.
            stride: stride period [s]; defaults to the gait's period.
        """
        steps, strides = [np.empty((0, 3))], [np.empty((0, 3))]
        for trace in traces:
            errors = measured_velocity(trace) - trace.command
            settled = settled_mask(trace) & np.isfinite(errors).all(axis=1)
            steps.append(errors[settled])
            period = stride or trace.meta["gait_period"] or DEFAULT_STRIDE
            count = max(round(period / trace.meta["control_step"]), 1)
            if len(errors) >= count:
                complete = np.lib.stride_tricks.sliding_window_view(settled, count).all(axis=-1)
                means = np.lib.stride_tricks.sliding_window_view(errors, count, axis=0).mean(axis=-1)
                strides.append(means[complete])
        return cls(*(_rms(np.concatenate(errors)) for errors in (steps, strides)))

    def to_mapping(self) -> dict[str, dict[str, object]]:
        """Return the errors by command, for JSON."""
        return {
            name: dict(zip(COMMANDS, map(plain_value, values.tolist()), strict=True))
            for name, values in (("rmse", self.rmse), ("rmse_stride", self.rmse_stride))
        }


def command_grid(limits: CommandLimits | None) -> tuple[tuple[float, float, float], ...]:
    """Return a grid of commands over a policy's range.

    It combines forward speed with yaw rate and, if the policy can walk sideways, forward with sideways speed.

    Raises:
        SurefootError: the policy has no commands.
    """
    if limits is None:
        raise SurefootError("--command-grid is given; this policy has no commands to follow")
    forward, sideways, turn = (
        np.linspace(low, high, GRID_SIZE) for low, high in zip(limits.low, limits.high, strict=True)
    )
    rows = [(float(x), 0.0, float(w)) for w in turn for x in forward]
    if np.ptp(sideways) > 0:
        rows += [(float(x), float(y), 0.0) for y in sideways for x in forward if y]
    return tuple(rows)


def check_command(command: tuple[float, float, float], limits: CommandLimits | None) -> tuple[float, float, float]:
    """Return a command (forward and left speed [m/s], yaw rate [rad/s]) if it is within the policy's range.

    Raises:
        SurefootError: the policy has no commands, or the command is out of its range.
    """
    if limits is None:
        raise SurefootError("--command is given; this policy has no commands to follow")
    for name, value, low, high in zip(COMMANDS, command, limits.low, limits.high, strict=True):
        if not low <= value <= high:
            raise SurefootError(f"--command: {name} is {value:g}; this policy follows {low:g} to {high:g}")
    return command


def distance_along(trace: EpisodeTrace) -> float:
    """Return the distance that a run covered along its commands [m]; steps without a commanded speed count as 0."""
    return float(_step_distances(trace)[1].sum())


def is_successful(trace: EpisodeTrace) -> bool | None:
    """Return whether a run ended without a fall and covered 0.7 to 1.25 times the commanded path.

    None if it did not fall and its motion was not measured.
    """
    commanded, covered = (distances.sum() for distances in _step_distances(trace))
    is_complete = trace.meta["ended"] == "time"
    if is_complete and not np.isfinite(covered):
        return None
    return bool(is_success(commanded, covered, np.asarray(is_complete)))


def _step_distances(trace: EpisodeTrace) -> tuple[Array, Array]:
    return step_distances(
        np.nan_to_num(trace.command[:, :2]), measured_velocity(trace)[:, :2], np.diff(trace.elapsed, prepend=0.0)
    )


def measured_velocity(trace: EpisodeTrace) -> Array:
    """Return the mean forward and left speed [m/s] and yaw rate [rad/s] of each control step (T, 3)."""
    return mean_velocity(np.diff(trace.elapsed, prepend=0.0), trace.base_position_world, trace.base_quat_world)


def mean_velocity(step: Array, position: Array, quat: Array) -> Array:
    """Return mean forward and left speed in the heading frame [m/s] and yaw rate [rad/s] between poses (T, 3).

    Args:
        step: durations between poses (T,) [s].
        position: positions of the base in the world frame (T + 1, 3) [m].
        quat: orientations of the base in the world frame (T + 1, 4), w x y z.
    """
    yaw = quat_yaw(quat)
    velocity = np.diff(position, axis=0) / step[:, None]
    turned = (np.diff(yaw) + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([in_heading_frame(velocity, yaw[:-1])[:, :2], turned / step])


def settled_mask(trace: EpisodeTrace) -> np.ndarray:
    """Return for each control step whether its command has been constant for `SETTLING_TIME` (T,)."""
    changed = np.any(np.diff(trace.command, axis=0, prepend=np.nan) != 0, axis=1)
    time = trace.elapsed
    since = time - np.maximum.accumulate(np.where(changed, np.concatenate([[0.0], time[:-1]]), 0.0))
    settled: np.ndarray = np.isfinite(trace.command).all(axis=1) & (since >= SETTLING_TIME - 1e-9)
    return settled


def _rms(errors: Array) -> Array:
    return np.sqrt((errors**2).mean(axis=0)) if len(errors) else np.full(3, np.nan)
