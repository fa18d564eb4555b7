"""A robot with joint actuators against its logs: the unknowns, and residuals of whole simulated robots.

Unlike `identify.trace_model`, which follows torques that motors told, this needs commands and angles alone. Robots are
simulated on the ground, or on a rack, for the first seconds of each log; all candidates at once.

A number for each motor is what all have in common, times or plus what is its own; what is its own is small beforehand:
the logs of some legs must tell of others.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.identify.fitting import BLOCK, Unknown
from surefoot.identify.logs.errors import imu_of
from surefoot.identify.logs.robot_log import IMU, SKIPPED, RobotLog
from surefoot.identify.replay import Replayer, segment_from_log
from surefoot.robot import PhysicalParams, RobotDescription

MOVING_NOISE = 0.006
"""Standard deviation with which angles of joints that move are compared [rad]: readings of unknown age, at up to 3.8
rad/s, are off by as much."""
STILL_NOISE = 0.04
"""The same for joints that stand: friction holds them where they came to rest before the log."""
TILT_NOISE = 0.03
"""The same for roll and pitch [rad]."""
START_NOISE = 2.0
"""Times so much in the first `SKIPPED` seconds."""
SPACING = 0.011
"""Least time between rows that are compared [s]."""
SECONDS = 2.3
"""Length of each log that is fitted [s], from its start."""
BATCH = 20
"""Candidates that are simulated at once."""
RATIO = "damping_ratio"
"""servo_kd over servo_kp [s]: what decides how far a joint lags behind its command."""
FRICTION_RATIO = "friction_ratio"
"""Coulomb friction of one motor over that of all."""


@dataclass(frozen=True)
class Rule:
    """How a number is looked for."""

    spread: float
    """Standard deviation of what is known of it beforehand; relative to where it begins, if `relative`."""
    relative: bool = True
    each: bool = False
    """Whether each motor, or axis, has its own."""
    step: float = 0.02
    """For finite differences, like `spread`."""
    begin: float | None = None
    """Where to begin; what is known, if not given."""


RULES = {
    "servo_kp": Rule(0.1),
    RATIO: Rule(0.05),
    "motor_friction": Rule(0.7),
    FRICTION_RATIO: Rule(0.1, each=True, step=0.05),
    "load_friction": Rule(0.3),
    "motor_viscous_friction": Rule(1.0, step=0.1),
    "speed_filter": Rule(0.5),
    "rotor_inertia": Rule(0.4),
    "torque_limit": Rule(0.2, step=0.05),
    "control_latency": Rule(0.5),
    "motor_offset": Rule(0.008, relative=False, each=True, step=0.004),
    "base_mass_ratio": Rule(0.01),
    "base_offset": Rule(0.005, relative=False, each=True, step=0.002),
    "leg_mass_ratio": Rule(0.05),
    "contact_friction": Rule(0.3),
    "contact_stiffness": Rule(0.5, step=0.05),
    "contact_shear_ratio": Rule(0.7, step=0.05, begin=0.2),
}
"""Numbers that can be looked for. Masses are known to some percent, actuators as their sheet or a first fit has them;
encoders to half a degree, which is less than a hand zeroes them to: with more, what two logs of some legs told of
other legs was wrong, and logs held out were further off. Legs give way sideways: feet begin softer along the ground."""
_LEAST = {"motor_viscous_friction": 0.005, "load_friction": 0.1, "speed_filter": 0.005}
"""Where what a data sheet has as 0 begins."""
_FACTOR = 8.0
"""A number that is known relatively stays within this factor of where it begins."""


def unknowns_of(robot: RobotDescription, known: PhysicalParams, names: Sequence[str]) -> list[Unknown]:
    """Return the unknowns of `names` of `RULES`, around what is known (one row).

    Raises:
        SurefootError: another name.
    """
    if bad := [name for name in names if name not in RULES]:
        raise SurefootError(f"logs do not tell '{bad[0]}'; choices: {choices(RULES)}")
    found = []
    for name in dict.fromkeys(names):
        rule = RULES[name]
        values = _values(robot, known, name)
        low, high = robot.allowed.get(name, (0.0, np.inf))
        low = max(low, 0.0) if rule.relative else low
        for index in range(len(values)) if rule.each else [None]:
            start = float(np.mean(values) if index is None else values[index])
            start = start if rule.begin is None else rule.begin
            if rule.relative:
                start = max(start, _LEAST.get(name, 1e-6))
                least, most = max(low, start / _FACTOR), min(high, start * _FACTOR)
                size = start
            else:
                reach = 6 * rule.spread
                least, most, size = max(low, start - reach), min(high, start + reach), 1.0
            found.append(Unknown(name, start, least, most, rule.step * size, index, rule.spread * size))
    return found


def _values(robot: RobotDescription, known: PhysicalParams, name: str) -> Array:
    if name == RATIO:
        return np.atleast_1d(np.mean(known.servo_kd[0]) / np.mean(known.servo_kp[0]))
    if name == FRICTION_RATIO:
        mean = float(np.mean(known.motor_friction[0]))
        return known.motor_friction[0] / mean if mean > 0 else np.ones(robot.num_motors)
    if name == "base_offset":
        return known.base_offset[0, :2]  # its height shows in nothing that moves so little
    return np.atleast_1d(getattr(known, name)[0])


def params_of_logs(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Return physical parameters, a row for each candidate (K, n), from one row of `base`."""
    params = base.rows(np.zeros(len(values), np.int64))
    given = {(unknown.name, unknown.index): values[:, i] for i, unknown in enumerate(unknowns)}
    for (name, index), column in given.items():
        if name in (RATIO, FRICTION_RATIO):
            continue
        array = getattr(params, name)
        if index is None:
            array.T[...] = column
        else:
            array[:, index] = column
    if (RATIO, None) in given:
        params.servo_kd[:] = params.servo_kp * given[RATIO, None][:, None]
    elif ("servo_kp", None) in given:
        params.servo_kd[:] = params.servo_kp * (base.servo_kd[0] / base.servo_kp[0])
    for (name, index), column in given.items():
        if name == FRICTION_RATIO:
            params.motor_friction[:, index] *= column
    return params


@dataclass(frozen=True, eq=False)
class LogRun:
    """A log, and whether the robot hung on a rack."""

    log: RobotLog
    rack: bool = False


class LogModel:
    """Residuals of simulated robots against logs; a `fitting.Model`.

    Args:
        robot: its description.
        runs: the logs.
        unknowns: what is to be found.
        known: everything else, one row.
        seconds: how much of each log is compared, from its start.
    """

    def __init__(
        self,
        robot: RobotDescription,
        runs: Sequence[LogRun],
        unknowns: Sequence[Unknown],
        known: PhysicalParams,
        seconds: float = SECONDS,
    ) -> None:
        self.robot, self.known = robot, known
        self.unknowns: Sequence[Unknown] = list(unknowns)
        self._runs = [LogRun(run.log.until(seconds), run.rack) for run in runs]
        self._replayers = {
            rack: Replayer(robot, BATCH, rack, torques=False) for rack in {run.rack for run in self._runs}
        }
        self._rows = [_compared(run.log) for run in self._runs]
        self._noise = [_noise(run, rows) for run, rows in zip(self._runs, self._rows, strict=True)]
        self._kept = [np.isfinite(noise) & _told(run.log)[rows] for run, rows, noise in self._parts()]
        blocks = []
        for number, (run, rows, noise) in enumerate(self._parts()):
            block = (run.log.time[rows] / BLOCK).astype(np.int64) + number * 1_000_000
            blocks.append(np.broadcast_to(block[:, None], noise.shape)[self._kept[number]])
        self.blocks: NDArray[np.int64] = np.concatenate(blocks)

    def _parts(self) -> list[tuple[LogRun, NDArray[np.int64], Array]]:
        return list(zip(self._runs, self._rows, self._noise, strict=True))

    def touched(self, unknown: int) -> None:
        """Return that an unknown may touch every residual."""

    def residuals(self, values: Array) -> Array:
        """Residuals (K, m) of K candidates (K, n), in standard deviations of `MOVING_NOISE` and the others."""
        parts = []
        for first in range(0, len(values), BATCH):
            params = params_of_logs(self.known, self.unknowns, values[first : first + BATCH])
            columns = []
            for number, (run, rows, noise) in enumerate(self._parts()):
                told = self._replayers[run.rack].run(segment_from_log(run.log, self.robot), params)
                off = np.concatenate([told.motor_angle, imu_of(told)[:, :, :2]], axis=2)[:, rows]
                off -= _readings(run.log)[rows]
                # Attitudes of such IMUs drift from log to log: how they change counts.
                off[:, :, -2:] -= off[:, :, -2:].mean(axis=1, keepdims=True)
                off /= noise
                columns.append(off[:, self._kept[number]])
            parts.append(np.concatenate(columns, axis=1))
        # A candidate that falls apart is as bad as one that is off by 100 standard deviations everywhere.
        return np.clip(np.nan_to_num(np.concatenate(parts), nan=100.0), -100.0, 100.0)


def _readings(log: RobotLog) -> Array:
    """Return the angles of motors and the base's roll and pitch (T, M + 2)."""
    return np.concatenate([log.motor_angle, log.imu[:, :2]], axis=1)


def _told(log: RobotLog) -> NDArray[np.bool_]:
    return np.isfinite(_readings(log))


def _compared(log: RobotLog) -> NDArray[np.int64]:
    """Return rows of fresh readings that are `SPACING` or more apart."""
    kept, last = [], -np.inf
    for row in np.flatnonzero(log.fresh).tolist():
        if log.read_time[row] - last >= SPACING:
            kept.append(row)
            last = log.read_time[row]
    return np.array(kept, np.int64)


def _noise(run: LogRun, rows: NDArray[np.int64]) -> Array:
    """Return the noise of each reading (n, M + 2); infinite where it tells nothing: of what hangs still."""
    log = run.log
    resting = np.inf if run.rack else STILL_NOISE
    noise = np.where(log.moving, MOVING_NOISE, resting)
    noise = np.concatenate([noise, [np.inf if run.rack else TILT_NOISE] * len(IMU[:2])])
    early = log.time[rows] < log.time[0] + SKIPPED
    return np.where(early[:, None], START_NOISE, 1.0) * noise


def check_robot(robot: RobotDescription) -> None:
    """Refuse a robot with other motors than joint actuators."""
    if robot.actuator.kind != "joint":
        raise SurefootError(
            f"the motors of {robot.name} are of kind {robot.actuator.kind}; logs tell of joint actuators"
        )
