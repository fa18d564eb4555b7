"""A robot on its rack as a model to be fitted: servo, motors, friction, legs' mass and inertia, both latencies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.identify.fitting import Unknown
from surefoot.identify.recording import Recording
from surefoot.identify.replay import Replayer, Stretch
from surefoot.robot import PhysicalParams, RobotDescription

Array = NDArray[np.float64]

BLOCK = 0.25
"""Length [s] of the blocks of time within which residuals may hang together."""
TORQUE_GAIN = "torque_gain"
"""Unknown relative error of a motor's torque report; nothing that a simulation needs."""


@dataclass(frozen=True)
class Noise:
    """Standard deviations of readings."""

    angle: float = 2e-4
    """[rad]"""
    velocity: float = 0.05
    """[rad/s]"""
    torque: float = 0.02
    """[N m]"""


def params_of(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Physical parameters, a row for each candidate (K, n), from one row of `base`."""
    count = len(values)
    params = base.rows(np.zeros(count, np.int64))
    for i, unknown in enumerate(unknowns):
        if unknown.name not in PhysicalParams.names():
            continue
        array = getattr(params, unknown.name)
        if unknown.index is None:
            array[...] = values[:, i] if array.ndim == 1 else values[:, i, None]
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
        stretches: which parts of it.
        unknowns: what is to be found.
        base: all that is not, one row.
        noise: of the readings.
        every: only every so manieth state is looked at.
        replayer: to be used again.
    """

    def __init__(
        self,
        robot: RobotDescription,
        recording: Recording,
        stretches: list[Stretch],
        unknowns: list[Unknown],
        base: PhysicalParams,
        noise: Noise | None = None,
        every: int = 3,
        replayer: Replayer | None = None,
    ) -> None:
        self.robot, self.recording, self.base = robot, recording, base
        self.unknowns: Sequence[Unknown] = unknowns
        self.noise, self.every, self.stretches = noise or Noise(), every, stretches
        self.replayer = replayer or Replayer(robot, len(unknowns) + 1, rack=True)
        self._gains = [i for i, u in enumerate(unknowns) if u.name == TORQUE_GAIN]
        self.kept = moving_legs(robot, recording)
        times = np.concatenate([stretch.state_time[::every] + 1e3 * k for k, stretch in enumerate(stretches)])
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
        parts = self.errors(values)
        noise = np.array([self.noise.angle, self.noise.velocity, self.noise.torque])[None, :, None, None]
        return (parts / noise).reshape(len(values), -1)

    def errors(self, values: Array) -> Array:
        """Simulated less recorded angles [rad], speeds [rad/s], torques [N m] (K, 3, T, kept motors) of candidates."""
        size = self.replayer.num_envs
        return np.concatenate([self._errors(values[k : k + size]) for k in range(0, len(values), size)])

    def _errors(self, values: Array) -> Array:
        params = params_of(self.base, self.unknowns, values)
        gain = np.ones((len(values), 1, self.robot.num_motors))
        for i in self._gains:
            gain[:, 0, self.unknowns[i].index] += values[:, i]
        parts = []
        for stretch in self.stretches:
            told, kept = self.replayer.run(stretch, params), stretch.states[:: self.every]
            recording = self.recording
            parts.append(
                np.stack(
                    [
                        told.motor_angle[:, :: self.every] - recording.motor_angle[kept],
                        told.motor_velocity[:, :: self.every] - recording.motor_velocity[kept],
                        told.motor_torque[:, :: self.every] * gain - recording.motor_torque[kept],
                    ],
                    axis=1,
                )
            )
        return np.concatenate(parts, axis=2)[..., self.kept]

    def latency_valleys(self, latencies: Array) -> list[float]:
        """Control latencies [s] whose readings are nearer than those of their neighbours, the nearest one first.

        All else is as in `base`: only the reading differs, so that one simulation serves for all.
        """
        costs = np.zeros(len(latencies))
        for stretch in self.stretches:
            kept = stretch.states[:: self.every]
            angles = self.replayer.read_late(stretch, self.base, latencies)[:, :: self.every]
            errors = (angles - self.recording.motor_angle[kept])[..., self.kept]
            costs += np.mean(errors**2, axis=(1, 2))
        padded = np.pad(costs, 1, constant_values=np.inf)
        lowest = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
        return latencies[lowest[np.argsort(costs[lowest])]].tolist()
