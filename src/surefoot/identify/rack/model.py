"""Fit by replay of a recording on the rack: servo, motors, friction, leg mass and inertia, both latencies."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator.motor import motor_torque
from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.fitting import Fit, fit_least_squares
from surefoot.identify.model import GAIN_DEVIATION, TORQUE_GAIN, Nuisance, Observations, ReplayModel, Unknown
from surefoot.identify.recording import Recording, interpolate_columns
from surefoot.identify.replay import ReplayedReadings, Replayer, Segment
from surefoot.identify.result import FitProgress, ParameterEstimate, add_model_error
from surefoot.robot import PhysicalParams, RobotDescription

NOISE = np.array([2e-4, 0.05, 0.02])
"""Standard deviations of the noise of angles [rad], speeds [rad/s] and torques [N m]."""
LATENCIES = np.arange(0.0, 0.081, 0.002)
"""Initial values of the control latency [s] to search over: fits to sines have several local minima."""
MAX_STARTS = 3
"""Maximum number of local minima from which fits are started."""
GOOD_ANGLE_ERROR = 0.002
"""Error of angles [rad] below which no further start is tried: ten times the error of an encoder, and a hundredth of
the error in a wrong local minimum."""
_RELATIVE_STEP = 1e-6
"""Step of finite differences relative to a parameter's typical size; simulations on the rack are smooth enough."""
_MAX_ROUNDS = 3
_CONSISTENT = 1.15
"""Ratio of residuals to the assumed noise below which the noise is consistent."""
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
LIMIT = "voltage_clip"
"""Unknown of motors whose controller limits the current."""
_LIMITS = np.append(np.geomspace(0.15, 0.98, 25), 1.0)
"""Grid of the search for a limit, relative to the highest net voltage in the recording."""
_RESISTANCES, _CONSTANTS = np.geomspace(0.5, 4.0, 13), (0.9, 1.0, 1.1)
"""Resistances and torque constants of this search, relative to the description's."""
_LATENCY_ERRORS = np.arange(-0.002, 0.003, 0.001)
"""Errors [s] of the control latency that this search allows for: twice the step of `LATENCIES`."""
_LIMIT_GAIN = 0.97
"""Error of the torques with a limit, relative to the error without one, below which a limit is fitted. It is 0.51 to
0.93 for robots 209 to 212 of studies/identified.yaml, which have one, and 0.999 to 1 for 201, 203 and 206 without."""
_MOTOR_SIZES = {"motor_strength": 1.0, "motor_friction": 0.1, "motor_viscous_friction": 0.01}
UNMODELLED = {
    "leg_mass_ratio": 0.015,
    "leg_inertia_ratio": 0.05,
    "motor_friction": 0.06,
    "motor_viscous_friction": 0.4,
    "servo_kp": 0.02,
    "servo_kd": 0.03,
}
"""Relative standard deviations for robots that do not repeat their model's motion: friction and play of the knees act
in part like friction of the motors and inertia of the legs, another torque curve like other gains. They were set on the
robots of results/identified."""
UNMODELLED_NEAR_0 = {"motor_viscous_friction": 4e-4}
"""The same as absolute standard deviations [N m s/rad]."""
FULL_MISFIT = 3.0
"""Misfit from which these deviations count fully; for a robot that is built like its model it is 1."""


def moving_legs(robot: RobotDescription, recording: Recording) -> NDArray[np.int64]:
    """Return the motors of the legs in which all motors move, because a still motor affects the other motor of its leg.

    Raises:
        SurefootError: every leg has a motor that never moves.
    """
    still = recording.still_motors
    moving = [motor for pair in robot.leg_motor_index.tolist() if still.isdisjoint(pair) for motor in pair]
    if not moving:
        raise SurefootError("every leg has a motor that never moves: nothing can be identified")
    return np.array(sorted(moving))


def replay_errors(
    readings: ReplayedReadings, recording: Recording, segment: Segment, every: int = 1, gain: Array | float = 1.0
) -> Array:
    """Return simulated minus recorded angles [rad], speeds [rad/s] and torques [N m] of K robots (K, 3, T, M).

    Every `every`-th state is compared. Simulated torques are multiplied by a gain (K, 1, M).
    """
    states = segment.states[::every]
    errors = [
        readings.motor_angle[:, ::every] - recording.motor_angle[states],
        readings.motor_velocity[:, ::every] - recording.motor_velocity[states],
        readings.motor_torque[:, ::every] * gain - recording.motor_torque[states],
    ]
    return np.stack(errors, axis=1)


def rack_observations(
    robot: RobotDescription,
    recording: Recording,
    segment: Segment,
    replayer: Replayer,
    every: int = 3,
    noise: Array = NOISE,
) -> Observations:
    """Return every `every`-th state of a segment as observations, without legs that have a motor that never moves.

    `noise` holds the standard deviations of angles, speeds and torques (3,). Observations are labelled by leg, because
    legs do not affect each other on a rack.
    """
    motors = moving_legs(robot, recording)

    def errors(params: PhysicalParams, nuisance: Nuisance) -> Array:
        gain = np.ones((params.num_envs, 1, robot.num_motors))
        for (_, motor), column in nuisance.items():
            gain[:, 0, motor] += column
        return replay_errors(replayer.run(segment, params), recording, segment, every, gain)[..., motors]

    time = segment.state_time[::every]
    return Observations(
        errors,
        np.broadcast_to(noise[:, None, None], (3, len(time), len(motors))),
        time[:, None],
        {"leg": np.array([np.argwhere(robot.leg_motor_index == motor)[0, 0] for motor in motors])},
    )


def rank_latencies(
    robot: RobotDescription, recording: Recording, segment: Segment, prior: PhysicalParams, every: int
) -> list[float]:
    """Return the local minima [s] of the angle error over `LATENCIES`, best first.

    All other parameters are as in `prior`. The latency only changes how the simulation is read, so that a single
    simulation is enough.
    """
    angles = Replayer(robot, 1).angles_with_latencies(segment, prior, LATENCIES)[:, ::every]
    errors = (angles - recording.motor_angle[segment.states[::every]])[..., moving_legs(robot, recording)]
    costs = np.mean(errors**2, axis=(1, 2))
    padded = np.pad(costs, 1, constant_values=np.inf)
    lowest = np.flatnonzero((costs <= padded[:-2]) & (costs <= padded[2:]))
    return LATENCIES[lowest[np.argsort(costs[lowest])]].tolist()


def rack_unknowns(
    robot: RobotDescription, prior: PhysicalParams, latency: float, motors: NDArray[np.int64]
) -> list[Unknown]:
    """Return the unknowns of a fit of some motors, starting at the prior (one row) and a control latency [s]."""
    unknowns = []
    for name, size in _SIZES.items():
        start = latency if name == "control_latency" else float(np.mean(getattr(prior, name)[0]))
        unknowns.append(Unknown(name, start, *robot.allowed[name], _RELATIVE_STEP * size))
    for motor in motors.tolist():
        leg, place = np.argwhere(robot.leg_motor_index == motor)[0].tolist()
        motor_unknown = partial(Unknown, index=motor, affects=("leg", leg))
        for number, (name, size) in enumerate(_MOTOR_SIZES.items()):
            start = float(getattr(prior, name)[0, motor])
            step, colour = _RELATIVE_STEP * size, 2 * number + place
            unknowns.append(motor_unknown(name, start, *robot.allowed[name], step, colour=colour))
        unknowns.append(motor_unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, 1e-4, prior=GAIN_DEVIATION, colour=6 + place))
    return unknowns


class RackFit(NamedTuple):
    """A fit, and the noise of angles, speeds and torques (3,) that it assumed, including errors of the model."""

    fit: Fit
    noise: Array

    @property
    def misfit(self) -> float:
        """Root mean square error of the fitted model, relative to the noise of the sensors; at least 1."""
        return float(np.sqrt(np.mean((self.noise / NOISE) ** 2)))

    @property
    def residual(self) -> Array:
        """Ratios of the residuals of angles, speeds and torques (3,) to the noise that the fit assumed."""
        return np.asarray(np.sqrt(np.mean(self.fit.residuals.reshape(3, -1) ** 2, axis=1)))

    def with_residual_noise(self) -> RackFit:
        """Return the fit with errors of the model as noise; otherwise intervals would be too narrow."""
        return self._replace(noise=np.maximum(self.residual, 1.0) * self.noise)


def fit_on_rack(
    robot: RobotDescription,
    recording: Recording,
    segment: Segment,
    prior: PhysicalParams,
    report: FitProgress,
    every: int = 5,
    find_limit: bool = False,
) -> RackFit:
    """Fit all parameters that are identifiable on a rack to every `every`-th state of a segment.

    With `find_limit` a limit of the current is fitted if the torques show one, see `start_with_limit`.
    """
    motors = moving_legs(robot, recording)

    def fit(unknowns: Sequence[Unknown], noise: Array = NOISE, start: Array | None = None) -> RackFit:
        observations = [rack_observations(robot, recording, segment, replayer, every, noise)]
        model = ReplayModel(unknowns, prior, observations, replayer.num_envs)
        return RackFit(fit_least_squares(model, start, lambda k, cost: report(f"iteration {k}", cost)), noise)

    def repeat(one: RackFit) -> RackFit:
        """Repeat a fit with the residual noise of the last one until the noise is consistent."""
        for _ in range(_MAX_ROUNDS - 1):
            if np.all(one.residual < _CONSISTENT):
                break
            one = fit(one.fit.unknowns, one.with_residual_noise().noise, one.fit.values)
        return one

    latencies = rank_latencies(robot, recording, segment, prior, 3 * every)
    start = start_with_limit(robot, recording, segment, prior, latencies[0]) if find_limit else None
    if start is not None:
        report(f"with a limit of the net voltage, of about {start.voltage_clip[0]:.1f} V", float("nan"))
    limit = [] if start is None else [_limit_unknown(robot, start)]
    starts = {
        latency: [*rack_unknowns(robot, start or prior, latency, motors), *limit] for latency in latencies[:MAX_STARTS]
    }
    colours = [unknown.colour for unknown in starts[latencies[0]]]
    # All starts have the same unknowns, so one batch of robots serves every fit.
    replayer = Replayer(robot, len(set(colours)) + colours.count(None) + 1)
    fits: list[RackFit] = []
    for latency, unknowns in starts.items():
        report(f"starting from a control latency of {1e3 * latency:.0f} ms", float("nan"))
        fits.append(fit(unknowns))
        if fits[-1].with_residual_noise().noise[0] < GOOD_ANGLE_ERROR:
            break
    return repeat(min(fits, key=lambda one: float(one.residual[0])))


def start_with_limit(
    robot: RobotDescription, recording: Recording, segment: Segment, prior: PhysicalParams, latency: float
) -> PhysicalParams | None:
    """Return the prior with a limit of the net voltage, resistance and strengths that predict torques, if there is one.

    In PWM phases the net voltage of a motor is known. A limit L of it, a resistance R and a strength s predict the
    torque s table(clip(net, -L, L) / R). Another torque curve looks like another resistance and strength, and only a
    limit like a limit: there is one if it reduces the error of the best resistance clearly. A fit from the prior would
    hardly find it, because at first no reading depends on it.

    Args:
        robot: the robot.
        recording: the recording.
        segment: its segment.
        prior: parameters before the fit, one row.
        latency: control latency [s].
    """
    motors = moving_legs(robot, recording)
    resistances = np.clip(prior.resistance[0] * _RESISTANCES, *robot.allowed["resistance"])
    values, with_limit, without = dict[str, Array](), np.inf, np.inf
    readings = [pwm_readings(robot, recording, segment, motors, max(latency + error, 0.0)) for error in _LATENCY_ERRORS]
    constants = prior.torque_constant[0] * np.array(_CONSTANTS)
    for (states, duty, speed, voltage), constant in itertools.product(readings, constants):
        net = duty * voltage - constant * speed
        limits = _LIMITS * np.abs(net).max(initial=0.0)
        if not limits.any():
            return None
        measured = recording.motor_torque[states][:, motors]
        current = np.clip(net, -limits[:, None, None, None], limits[:, None, None, None]) / resistances[:, None, None]
        unit = motor_torque(current, 1.0, *robot.torque_table)
        strengths = np.sum(unit * measured, axis=2) / np.sum(unit**2, axis=2)
        strengths = np.clip(strengths, *robot.allowed["motor_strength"])
        errors = np.sqrt(np.mean((strengths[:, :, None] * unit - measured) ** 2, axis=(2, 3)))
        best = np.unravel_index(np.argmin(errors), errors.shape)
        without = min(without, float(errors[-1].min()))
        if errors[best] < with_limit:
            with_limit, strength = float(errors[best]), prior.motor_strength.copy()
            strength[0, motors] = strengths[best]
            limit = np.clip(limits[best[0]], *robot.allowed[LIMIT])
            values = {LIMIT: limit, "resistance": resistances[best[1]], "motor_strength": strength}
    return prior.with_values(robot, **values) if with_limit < _LIMIT_GAIN * without else None


def _limit_unknown(robot: RobotDescription, start: PhysicalParams) -> Unknown:
    value = float(start.voltage_clip[0])
    return Unknown(LIMIT, value, *robot.allowed[LIMIT], _RELATIVE_STEP * value)


def pwm_readings(
    robot: RobotDescription, recording: Recording, segment: Segment, motors: NDArray[np.int64], latency: float
) -> tuple[NDArray[np.int64], Array, Array, Array]:
    """Return what some motors do in the states of a segment's PWM phases, in which their servos are off.

    Args:
        robot: the robot.
        recording: the recording.
        segment: its segment.
        motors: indices of the motors (m,).
        latency: control latency [s].

    Returns:
        Indices of the states (T,), duties (T, m), speeds at the time of the torques [rad/s] (T, m), and battery
        voltage [V] (T, 1).
    """
    index = np.searchsorted(segment.command_tick * robot.timing.servo_step, segment.state_time - 1e-4) - 1
    driven = (index >= 0) & (segment.kind[index] == Mode.PWM)
    states = segment.states[driven]
    # The speeds of a state are older than its torques by the control latency without the lead.
    age = max(latency - segment.lead, 0.0)
    speed = interpolate_columns(recording.time[states] + age, recording.time, recording.motor_velocity[:, motors])
    voltage = recording.voltage[np.maximum(states - 1, 0)][:, None]
    return states, segment.command[index][driven][:, motors], speed, voltage


def rack_estimates(robot: RobotDescription, result: RackFit, prior: PhysicalParams) -> list[ParameterEstimate]:
    """Return estimates of the physical parameters; parameters of motors that were not fitted are not identifiable."""
    estimates, fit = [], result.fit
    unmodelled = min((result.misfit - 1.0) / (FULL_MISFIT - 1.0), 1.0)
    for u, value, deviation, identifiable in zip(
        fit.unknowns, fit.values.tolist(), fit.deviation.tolist(), fit.identifiable.tolist(), strict=True
    ):
        if u.name != TORQUE_GAIN:
            deviation = add_model_error(u.name, value, deviation)
            more = math.hypot(UNMODELLED.get(u.name, 0.0) * value, UNMODELLED_NEAR_0.get(u.name, 0.0))
            deviation = math.hypot(deviation, unmodelled * more)
            estimates.append(ParameterEstimate.within_bounds(robot, u.name, value, deviation, u.index, identifiable))
    fitted = {u.index for u in fit.unknowns}
    for motor in sorted(set(range(robot.num_motors)) - fitted):
        for name in _MOTOR_SIZES:
            low, high = robot.allowed[name]
            value = float(getattr(prior, name)[0, motor])
            estimates.append(ParameterEstimate.within_bounds(robot, name, value, (high - low) / 4, motor, False))
    return estimates
