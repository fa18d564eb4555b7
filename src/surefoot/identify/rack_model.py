"""A robot on its rack as a model to be fitted: servo, motors, friction, legs' mass and inertia, both latencies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.fitting import Unknown
from surefoot.identify.recording import Recording
from surefoot.identify.replay import Replayed, Replayer, Stretch
from surefoot.robot import PhysicalParams, RobotDescription

BLOCK = 0.25
"""Length [s] of the blocks of time within which residuals may hang together."""
TORQUE_GAIN = "torque_gain"
"""Unknown relative error of a motor's torque report; nothing that a simulation needs."""
NOISE = np.array([2e-4, 0.05, 0.02])
"""Standard deviations of readings of angles [rad], speeds [rad/s] and torques [N m]."""


def params_of(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Physical parameters, a row for each candidate (K, n), from one row of `base`."""
    params = base.rows(np.zeros(len(values), np.int64))
    for i, unknown in enumerate(unknowns):
        if unknown.name not in PhysicalParams.names():
            continue
        array = getattr(params, unknown.name)
        if unknown.index is None:
            array.T[...] = values[:, i]
        else:
            array[:, unknown.index] = values[:, i]
    return params


def moving_legs(robot: RobotDescription, recording: Recording) -> NDArray[np.int64]:
    """Motors of legs both of whose motors move: beside one that stands still the other one does something else too.

    Raises:
        SurefootError: there is no such leg.
    """
    still = recording.still_motors
    kept = [motor for pair in robot.leg_motor_index.tolist() if still.isdisjoint(pair) for motor in pair]
    if not kept:
        raise SurefootError("every leg has a motor that never moves: the data tell nothing")
    return np.array(sorted(kept))


class RackModel:
    """Residuals of angles, speeds and torques of a robot on its rack; legs with a motor that never moves are left out.

    Args:
        robot: its description.
        recording: of the motor experiment, or another one on the rack.
        stretch: which part of it.
        unknowns: what is to be found.
        base: all that is not, one row.
        replayer: simulated robots.
        every: only every so manieth state is looked at.
        noise: standard deviations of angles, speeds and torques (3,).
    """

    def __init__(
        self,
        robot: RobotDescription,
        recording: Recording,
        stretch: Stretch,
        unknowns: Sequence[Unknown],
        base: PhysicalParams,
        replayer: Replayer,
        every: int = 3,
        noise: Array = NOISE,
    ) -> None:
        self.robot, self.recording, self.stretch, self.base = robot, recording, stretch, base
        self.unknowns, self.replayer, self.every, self.noise = unknowns, replayer, every, noise
        self.kept = moving_legs(robot, recording)
        times = stretch.state_time[::every]
        shape = (3, len(times), len(self.kept))
        self.blocks = np.broadcast_to((times / BLOCK).astype(np.int64)[None, :, None], shape).ravel()
        self._motor = np.broadcast_to(self.kept, shape).ravel()
        self._leg = np.empty(robot.num_motors, np.int64)
        for leg, pair in enumerate(robot.leg_motor_index):
            self._leg[pair] = leg

    def touched(self, unknown: int) -> NDArray[np.bool_] | None:
        """Residuals of the leg to which a motor belongs: on a rack legs do not feel each other."""
        index = self.unknowns[unknown].index
        return None if index is None else self._leg[self._motor] == self._leg[index]

    def residuals(self, values: Array) -> Array:
        """Residuals (K, m) of K candidates."""
        size = self.replayer.num_envs
        errors = np.concatenate([self._errors(values[k : k + size]) for k in range(0, len(values), size)])
        return (errors / self.noise[:, None, None]).reshape(len(values), -1)

    def _errors(self, values: Array) -> Array:
        gain = np.ones((len(values), 1, self.robot.num_motors))
        for i, unknown in enumerate(self.unknowns):
            if unknown.name == TORQUE_GAIN:
                gain[:, 0, unknown.index] += values[:, i]
        return self.errors(self.replayer.run(self.stretch, params_of(self.base, self.unknowns, values)), gain)

    def errors(self, told: Replayed, gain: Array | float = 1.0) -> Array:
        """Simulated less recorded angles [rad], speeds [rad/s], torques [N m] (K, 3, T, kept motors).

        Args:
            told: what K simulated robots told of the stretch.
            gain: by which their torque reports are multiplied (K, 1, M).
        """
        recording, kept, every = self.recording, self.stretch.states[:: self.every], self.every
        errors = [
            told.motor_angle[:, ::every] - recording.motor_angle[kept],
            told.motor_velocity[:, ::every] - recording.motor_velocity[kept],
            told.motor_torque[:, ::every] * gain - recording.motor_torque[kept],
        ]
        return np.stack(errors, axis=1)[..., self.kept]

    def latency_valleys(self, latencies: Array) -> list[float]:
        """Control latencies [s] whose readings are nearer than those of their neighbours, the nearest one first.

        All else is as in `base`: only the reading differs, so that one simulation serves for all.
        """
        angles = self.replayer.read_late(self.stretch, self.base, latencies)[:, :: self.every]
        errors = (angles - self.recording.motor_angle[self.stretch.states[:: self.every]])[..., self.kept]
        costs = np.mean(errors**2, axis=(1, 2))
        padded = np.pad(costs, 1, constant_values=np.inf)
        lowest = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
        return latencies[lowest[np.argsort(costs[lowest])]].tolist()
