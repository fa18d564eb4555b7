"""A robot on its rack as a model to be fitted: servo, motors, friction, legs' mass and inertia, both latencies."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.fitting import BLOCK, GAIN, TORQUE_GAIN, Fit, Unknown, fit_least_squares, params_of
from surefoot.identify.recording import Recording
from surefoot.identify.result import FitProgress
from surefoot.identify.replay import ReplayedReadings, Replayer, Segment
from surefoot.identify.result import ParameterEstimate, with_floor
from surefoot.robot import PhysicalParams, RobotDescription

NOISE = np.array([2e-4, 0.05, 0.02])
"""Standard deviations of readings of angles [rad], speeds [rad/s] and torques [N m]."""
LATENCIES = np.arange(0.0, 0.081, 0.002)
"""Control latencies [s] from which the best one is where the fit begins: fits with sines have several valleys."""
_TINY = 1e-6
"""Steps of finite differences, in shares of a parameter's usual size; simulations on the rack are that smooth."""
STARTS = 3
"""Valleys of the latency from which fits are begun, at most."""
GOOD = 0.002
"""Error of angles [rad] below which a fit is not tried from another start: ten times an encoder's, a hundredth of what
a wrong valley leaves."""
_ROUNDS = 3
_SIZES = {
    "torque_constant": 0.1,
    "resistance": 0.2,
    "servo_kp": 1.0,
    "servo_kd": 0.015,
    "servo_latency": 0.01,
    "control_latency": 0.01,
    "leg_mass_ratio": 1.0,
    "leg_inertia_ratio": 1.0,
}
_MOTOR_SIZES = {"motor_strength": 1.0, "motor_friction": 0.1, "motor_viscous_friction": 0.01}


def moving_legs(robot: RobotDescription, recording: Recording) -> NDArray[np.int64]:
    """Motors of legs both of whose motors move: beside one that stands still the other one does something else too."""
    still = recording.still_motors
    kept = [motor for pair in robot.leg_motor_index.tolist() if still.isdisjoint(pair) for motor in pair]
    if not kept:
        raise SurefootError("every leg has a motor that never moves: the data tell nothing")
    return np.array(sorted(kept))


class RackModel:
    """Residuals of angles, speeds and torques of a robot on its rack; legs with a motor that never moves are left out.

    Args:
        robot: its description.
        recording: of an experiment on the rack.
        segment: which part of it.
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
        segment: Segment,
        unknowns: Sequence[Unknown],
        base: PhysicalParams,
        replayer: Replayer,
        every: int = 3,
        noise: Array = NOISE,
    ) -> None:
        self.robot, self.recording, self.segment, self.base = robot, recording, segment, base
        self.unknowns, self.replayer, self.every, self.noise = unknowns, replayer, every, noise
        self.kept = moving_legs(robot, recording)
        times = segment.state_time[::every]
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
        return self.errors(self.replayer.run(self.segment, params_of(self.base, self.unknowns, values)), gain)

    def errors(self, told: ReplayedReadings, gain: Array | float = 1.0) -> Array:
        """Angles [rad], speeds [rad/s], torques [N m] that K robots told, less those recorded (K, 3, T, kept motors).

        Torque reports are multiplied by a gain (K, 1, M).
        """
        recording, kept, every = self.recording, self.segment.states[:: self.every], self.every
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
        angles = self.replayer.angles_with_latencies(self.segment, self.base, latencies)[:, :: self.every]
        errors = (angles - self.recording.motor_angle[self.segment.states[:: self.every]])[..., self.kept]
        costs = np.mean(errors**2, axis=(1, 2))
        padded = np.pad(costs, 1, constant_values=np.inf)
        lowest = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
        return latencies[lowest[np.argsort(costs[lowest])]].tolist()


def motor_unknowns(
    robot: RobotDescription, known: PhysicalParams, latency: float, motors: NDArray[np.int64]
) -> list[Unknown]:
    """What there is to find of motors of legs that moved, from what was known (one row) and a control latency [s]."""
    unknowns = []
    for name, size in _SIZES.items():
        start = latency if name == "control_latency" else float(np.mean(getattr(known, name)[0]))
        unknowns.append(Unknown(name, start, *robot.allowed[name], _TINY * size))
    for motor in motors.tolist():
        which = int(np.argwhere(robot.leg_motor_index == motor)[0][1])
        for colour, (name, size) in enumerate(_MOTOR_SIZES.items()):
            start = float(getattr(known, name)[0, motor])
            unknowns.append(Unknown(name, start, *robot.allowed[name], _TINY * size, motor, colour=2 * colour + which))
        unknowns.append(Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, 1e-4, motor, GAIN, colour=6 + which))
    return unknowns


def fit_on_rack(
    robot: RobotDescription,
    recording: Recording,
    segment: Segment,
    known: PhysicalParams,
    report: FitProgress,
    every: int = 5,
) -> tuple[Fit, RackModel]:
    """Fit everything that a robot on its rack tells to a segment of a recording."""
    scan = RackModel(robot, recording, segment, [], known, Replayer(robot, 1), 3 * every)
    fits = []
    for latency in scan.latency_valleys(LATENCIES)[:STARTS]:
        report(f"starting from a control latency of {1e3 * latency:.0f} ms", float("nan"))
        unknowns = motor_unknowns(robot, known, latency, scan.kept)
        fits.append(_fit_rounds(robot, recording, segment, known, unknowns, report, every))
        if fits[-1][1].noise[0] < GOOD:
            break
    return min(fits, key=lambda found: float(found[1].noise[0]))


def _fit_rounds(
    robot: RobotDescription,
    recording: Recording,
    segment: Segment,
    known: PhysicalParams,
    unknowns: list[Unknown],
    report: FitProgress,
    every: int,
) -> tuple[Fit, RackModel]:
    """Fit from one start, again with as much noise as the fit before has left, until that holds."""
    replayer = Replayer(robot, len({u.colour for u in unknowns if u.colour is not None}) + 10)
    noise, start = NOISE, None
    for _ in range(_ROUNDS):
        model = RackModel(robot, recording, segment, unknowns, known, replayer, every, noise)
        fit = fit_least_squares(model, start, report=lambda k, cost: report(f"iteration {k}", cost))
        # What the model can't explain counts as noise, or it would be taken for knowledge.
        left = np.sqrt(np.mean(fit.residuals.reshape(3, -1) ** 2, axis=1))
        if np.all(left < 1.15):
            break
        noise, start = np.maximum(left, 1.0) * noise, fit.values
    return fit, model


def rack_estimates(robot: RobotDescription, fit: Fit, known: PhysicalParams) -> list[ParameterEstimate]:
    """Estimates of physical parameters from a fit on the rack; motors that were not fitted are not identifiable."""
    estimates = []
    for u, value, deviation, told in zip(fit.unknowns, fit.values, fit.deviation, fit.identifiable, strict=True):
        if u.name != TORQUE_GAIN:
            deviation = with_floor(u.name, float(value), float(deviation))
            estimates.append(
                ParameterEstimate.within_bounds(robot, u.name, float(value), deviation, u.index, bool(told))
            )
    fitted = {(e.name, e.index) for e in estimates}
    for motor in range(robot.num_motors):
        for name in _MOTOR_SIZES:
            if (name, motor) not in fitted:
                low, high = robot.allowed[name]
                value = float(getattr(known, name)[0, motor])
                estimates.append(
                    ParameterEstimate.within_bounds(robot, name, value, (high - low) / 4, motor, identifiable=False)
                )
    return estimates
