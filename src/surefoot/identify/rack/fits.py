"""Fits of the experiments on a rack.

Motor experiment: the parameters of servo, motors and legs are fitted by replaying the recording in simulation. Latency
experiment: responses to spikes measure the age of the readings directly (Tan et al. 2018, section V-A); a fit by replay
also gives it, together with the latency of the servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator.motor import motor_current, motor_torque
from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.model import GAIN_DEVIATION, TORQUE_GAIN
from surefoot.identify.rack.model import (
    FULL_MISFIT,
    LIMIT,
    fit_on_rack,
    moving_legs,
    pwm_readings,
    rack_estimates,
    replay_errors,
)
from surefoot.identify.recording import Recording
from surefoot.identify.replay import Replayer, Segment, segment_from_recording
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series
from surefoot.robot import PhysicalParams, RobotDescription

RACK_TILT = 0.002
"""Standard deviation [rad] of a rack's tilt: 0.1 degrees, the resolution of a spirit level."""
VOLTAGE_DEVIATION = 0.02
"""Standard deviation [V] of the battery voltage at rest: sensor error, and charge used during the experiment."""
MIN_RESPONSES = 8
"""Minimum number of clear responses to spikes."""
AGE_TOLERANCE = 0.001
"""Difference [s] between the age of readings by spikes and by replay above which a note is returned."""
SPIKES = ("spikes", Mode.PWM)
"""Name and mode of the phases with spikes."""
WINDOW = 0.014
"""Time after the first motion [s] whose readings are fitted; later, the motion caused by the spike has decayed."""
PRE_WINDOW = 0.010
"""Time before a spike [s] whose readings are fitted."""
MAX_AGE, AGE_STEP = 0.08, 0.0002
"""Maximum age of readings, and grid step of the search over ages [s]."""
MAX_EXTRAPOLATION = 1.2
"""Voltage at full duty, relative to the highest recorded net voltage, above which a note is returned."""
MIN_SPEED_RATIO = 8.0
"""Minimum speed of a clear response, relative to the noise of the speeds."""


def estimate_imu(recording: Recording) -> list[ParameterEstimate]:
    """Return bias and noise of the IMU's roll and pitch, from a base that is held level and still."""
    tilt = recording.roll_pitch_yaw[:, :2]
    count = len(tilt)
    noise = float(np.sqrt(np.mean(tilt.var(axis=0, ddof=1))))
    bias = float(np.hypot(noise / np.sqrt(count), RACK_TILT))
    spread = float(np.hypot(noise / np.sqrt(4 * count), 1e-5 + 0.004 * noise))
    return [
        *(ParameterEstimate("imu_bias", float(tilt[:, axis].mean()), bias, "rad", axis) for axis in range(2)),
        ParameterEstimate("imu_noise", noise, spread, "rad", low=0.0),
    ]


def estimate_voltage(recording: Recording) -> ParameterEstimate:
    """Return the battery voltage before the motors move."""
    return ParameterEstimate(
        "voltage", float(np.mean(recording.voltage[recording.resting])), VOLTAGE_DEVIATION, "V", low=0.0
    )


def fit_motor(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the motor experiment; see `Experiment.fit`."""
    segment = _segment(recording, "fit")
    result = fit_on_rack(robot, recording, segment, prior, report, find_limit=True)
    fit = result.fit
    estimates = (*rack_estimates(robot, result, prior), *estimate_imu(recording), estimate_voltage(recording))
    gains = np.zeros(robot.num_motors)
    for unknown, value in zip(fit.unknowns, fit.values, strict=True):
        if unknown.name == TORQUE_GAIN:
            gains[unknown.index] = value
    params = Identification("motor", robot.name, estimates).params(robot, prior)
    checks: tuple[Check, ...] = ()
    series: tuple[Series, ...] = ()
    if recording.phases("check"):
        checks, series = _check(robot, recording, (prior, params), gains)
    curve = _torque_curve(robot, recording, segment, params, gains)
    notes = _limit_notes(estimates, params, float(curve.x.max(initial=0.0) * params.resistance[0]))
    if result.misfit > FULL_MISFIT:
        notes.append(
            f"the fitted robot does not repeat the recording: its errors are {result.misfit:.0f} times the noise of "
            "the sensors. Something differs that is no parameter (play or friction of other joints, the shape of the "
            "motors' torque curve, the servo's law): intervals are wider for it, and may still be too narrow"
        )
    if unidentifiable := [e.label for e in estimates if not e.identifiable]:
        notes.append(f"not identifiable from these data: {', '.join(unidentifiable)}")
    if bounded := sorted({e.name for e in estimates if e.identifiable and e.value >= e.high}):
        notes.append(
            f"{', '.join(bounded)} at the highest value that the robot's description allows: other estimates make up "
            "for it, and intervals may be too narrow; raise the value in [allowed] of robot.toml"
        )
    return Identification(
        "motor",
        robot.name,
        estimates,
        checks,
        tuple(fit.strongest_correlations()),
        tuple(notes),
        (*series, curve),
        {"torque_gain": gains.tolist(), "torque_accuracy": GAIN_DEVIATION / float(np.sqrt(robot.num_motors))},
    )


def _limit_notes(estimates: Sequence[ParameterEstimate], params: PhysicalParams, highest: float) -> list[str]:
    """Return what the recording tells about a limit of the current, and what it can't tell.

    Args:
        estimates: the estimates.
        params: the robot's parameters with the estimates, one row.
        highest: highest net voltage in the recording [V].
    """
    if any(item.name == LIMIT and item.identifiable for item in estimates):
        return [
            f"the motors' torque does not grow above a net voltage of {params.voltage_clip[0]:.1f} V: their controller "
            "limits the current, or they saturate"
        ]
    stall = float(min(params.voltage[0], params.voltage_clip[0]))
    if stall <= MAX_EXTRAPOLATION * highest:
        return []
    return [
        f"no net voltage above {highest:.1f} V was recorded, and a motor at rest has {stall:.1f} V at full duty: a "
        "limit of the current in between would not show, and a policy that uses higher torques relies on the "
        "description"
    ]


def _segment(recording: Recording, use: str) -> Segment:
    phases = recording.require_phases(use)
    return segment_from_recording(recording, phases[0], phases[-1])


def _check(
    robot: RobotDescription, recording: Recording, params: tuple[PhysicalParams, PhysicalParams], gains: Array
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Return the errors on held-out phases with the prior and the estimated parameters, and curves of one motor."""
    replayer, motor, segment = Replayer(robot, 1), 0, _segment(recording, "check")
    replays = [replayer.run(segment, one) for one in params]
    motors = moving_legs(robot, recording)
    before, after = (
        np.sqrt(np.mean(replay_errors(one, recording, segment)[0][..., motors] ** 2, axis=(1, 2))).tolist()
        for one in replays
    )

    def series(label: str, quantity: str, gain: float) -> Series:
        prior_curve, fitted_curve = (getattr(one, quantity)[0, :, motor] for one in replays)
        measured = getattr(recording, quantity)[segment.states, motor]
        title = f"{robot.motor_names[motor]}, not fitted"
        return Series(title, "time [s]", label, segment.state_time, measured, prior_curve, fitted_curve * gain)

    return (
        Check("motor angles", 1e3 * before[0], 1e3 * after[0], "mrad"),
        Check("motor speeds", before[1], after[1], "rad/s"),
        Check("motor torques", before[2], after[2], "N m"),
    ), (series("angle [rad]", "motor_angle", 1.0), series("torque [N m]", "motor_torque", 1 + gains[motor]))


def _torque_curve(
    robot: RobotDescription, recording: Recording, segment: Segment, params: PhysicalParams, gains: Array
) -> Series:
    """Return torque over current: reported torque of PWM phases over motor strength, and the data sheet's curve."""
    motors = moving_legs(robot, recording)
    states, duty, speed, voltage = pwm_readings(robot, recording, segment, motors, float(params.control_latency[0]))
    current = motor_current(
        duty, speed, voltage, params.torque_constant[0], params.resistance[0], params.voltage_clip[0]
    )
    torque = np.abs(recording.motor_torque[states][:, motors]) / (params.motor_strength[0] * (1 + gains))[motors]
    magnitude = np.abs(current).ravel()
    edges = np.arange(0.0, magnitude.max(initial=0.0) + 2.0, 2.0)
    place = np.digitize(magnitude, edges) - 1
    bins = [place == k for k in range(len(edges)) if np.sum(place == k) >= 20]
    x = np.array([np.mean(magnitude[inside]) for inside in bins])
    measured = np.array([np.mean(torque.ravel()[inside]) for inside in bins])
    nominal = np.asarray(motor_torque(x, 1.0, *robot.torque_table))
    labels = "torque of a motor of nominal strength", "current [A]", "torque [N m]"
    return Series(*labels, x, measured, np.full(len(x), np.nan), nominal, points=True)


@dataclass(frozen=True)
class SpikeResponses:
    """Delays of K clear motor responses to duty spikes."""

    age: Array
    """Age of the readings in a state at the time of sending it (K,) [s]."""
    host: Array
    """Time from sending the spike to receiving the first state with motion, on the host's clock (K,) [s]."""
    total: int
    """Number of responses that were evaluated: spikes times motors."""


def fit_latency(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the latency experiment; see `Experiment.fit`."""
    spikes = measure_spikes(recording)
    if len(spikes.age) < MIN_RESPONSES:
        raise SurefootError(
            f"only {len(spikes.age)} of {spikes.total} responses to spikes are clear; at least {MIN_RESPONSES} are "
            f"needed: do the motors move at all?"
        )
    lead = float(recording.meta["lead"])
    result = fit_on_rack(robot, recording, _segment(recording, "fit"), prior, report, every=3)
    latencies = ("servo_latency", "control_latency")
    estimates = {e.name: e for e in rack_estimates(robot, result, prior) if e.name in latencies}
    at_robot, at_host = _median("spike_at_robot", spikes.age), _median("spike_at_host", spikes.host)
    age, replayed = at_robot.value + lead, estimates["control_latency"].value
    notes = [
        f"readings are {1e3 * at_robot.value:.2f} ms old when the robot sends them; this computer sees the motion "
        f"{1e3 * at_host.value:.2f} ms after it sends a spike ({len(spikes.age)} of {spikes.total} responses are "
        f"clear); control_latency includes {1e3 * lead:g} ms from sending a state to its use"
    ]
    if abs(age - replayed) > AGE_TOLERANCE:
        notes.insert(
            0, f"readings are {1e3 * age:.1f} ms old according to spikes, {1e3 * replayed:.1f} ms according to replay"
        )
    counts, edges = np.histogram(
        1e3 * spikes.age, np.linspace(1e3 * spikes.age.min() - 0.2, 1e3 * spikes.age.max() + 0.2, 25)
    )
    nothing = np.full(len(counts), np.nan)
    histogram = Series(
        *("responses to spikes", "age of readings [ms]", "spikes"),
        *((edges[1:] + edges[:-1]) / 2, counts.astype(float), nothing, nothing),
        points=True,
    )
    return Identification(
        "latency",
        robot.name,
        (*estimates.values(), at_robot, at_host, estimate_voltage(recording)),
        correlations=tuple(
            pair for pair in result.fit.strongest_correlations(20) if any(name in pair for name in latencies)
        ),
        notes=tuple(notes),
        series=(histogram,),
    )


def measure_spikes(recording: Recording) -> SpikeResponses:
    """Fit the response of each motor to each spike.

    A torque from time 0 to T moves a free motor by v t^2 / (2 T) until T, and by v (t - T/2) later; braking adds
    c (t - T)^2. A reading at time t shows the motion at t - age.
    """
    dt = float(recording.meta["servo_period"])
    ages, hosts, total = [], [], 0
    driven = np.abs(recording.sent_value).max(axis=1) > 0
    groups = [k for k, phase in enumerate(recording.meta["phases"]) if (phase["name"], phase["mode"]) == SPIKES]
    for c in np.flatnonzero(driven[:-1] & np.isin(recording.sent_phase[:-1], groups)):
        begin, end = dt * recording.servo_step(recording.arrival[c : c + 2])
        near = (recording.time > begin - PRE_WINDOW) & (recording.time < begin + MAX_AGE + WINDOW)
        since, angles, speeds = (values[near] for values in (recording.time - begin, recording.motor_angle,
                                                             recording.motor_velocity))  # fmt: skip
        age, clear = _response_age(since, angles, speeds, float(end - begin))
        host = np.interp(begin + age, recording.time, recording.host_time) - recording.sent_time[c]
        total += len(age)
        ages += age[clear].tolist()
        hosts += host[clear].tolist()
    return SpikeResponses(np.array(ages), np.array(hosts), total)


def _response_age(since: Array, angles: Array, speeds: Array, length: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the age of each motor's readings (M,) [s] by the best fit of its response, and whether it clearly moved.

    Args:
        since: time of each reading since the spike began (T,) [s].
        angles: motor angles (T, M) [rad].
        speeds: motor speeds (T, M) [rad/s].
        length: length of the spike [s].
    """
    age, clear = np.zeros(angles.shape[1]), np.zeros(angles.shape[1], np.bool_)
    before_spike = since <= 0
    before = np.median(speeds[before_spike], axis=0)
    # The noise is pooled over all motors, because each one has only a few readings.
    noise = float(np.std(speeds[before_spike] - before)) + 1e-9
    for motor in range(angles.shape[1]):
        # Rough estimate of the start of the motion: the reading at which half of the maximum speed is reached.
        gained = np.abs(speeds[:, motor] - before[motor])
        rough = float(since[int(np.argmax(gained > gained.max() / 2))])
        if gained.max() < MIN_SPEED_RATIO * noise or rough < 0:
            continue
        used = (since > rough - PRE_WINDOW) & (since < rough + WINDOW)
        ages = rough + np.arange(-0.006, 0.003, AGE_STEP)
        costs = [_response_cost(since[used], angles[used, motor], one, length) for one in ages]
        best = int(np.argmin(costs))
        if not 0 < best < len(ages) - 1:
            continue
        low, middle, high = costs[best - 1 : best + 2]
        curvature = low - 2 * middle + high
        age[motor] = ages[best] + (AGE_STEP * 0.5 * (low - high) / curvature if curvature > 0 else 0.0)
        clear[motor] = True
    return age, clear


def _response_cost(since: Array, angles: Array, age: float, length: float) -> float:
    """Return the sum of squared residuals [rad2] of one motor's angles (T,) for an assumed age of its readings."""
    t = np.maximum(since - age, 0.0)
    distance = np.where(t < length, t * t / (2 * length), t - length / 2)
    basis = np.stack([np.ones_like(t), since, distance, np.maximum(t - length, 0.0) ** 2], axis=1)
    coefficients, *_ = np.linalg.lstsq(basis, angles, rcond=None)
    return float(np.sum((angles - basis @ coefficients) ** 2))


def _median(name: str, values: Array) -> ParameterEstimate:
    """Return the median of values; its standard error is 1.25 times the mean's, from the interquartile range."""
    spread = float(np.subtract(*np.percentile(values, [75, 25]))) / 1.349
    deviation = 1.2533 * max(spread, 1e-6) / np.sqrt(len(values))
    return ParameterEstimate(name, float(np.median(values)), deviation, "s", low=0.0)
