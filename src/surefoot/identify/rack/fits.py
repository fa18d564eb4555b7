"""Fits of the experiments on a rack.

Motor: the recording is replayed in simulation until servo, motors and legs respond alike. Latency: responses to spikes
measure the readings' age directly (Tan et al. 2018, section V-A); a replay gives it too, and the servo's latency.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator.motor import motor_current, motor_torque
from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.model import GAIN_DEVIATION, TORQUE_GAIN
from surefoot.identify.rack.model import fit_on_rack, moving_legs, rack_estimates, replay_errors
from surefoot.identify.recording import Recording, read_at
from surefoot.identify.replay import Replayer, Segment, segment_from_recording
from surefoot.identify.result import Check, FitProgress, Identification, ParameterEstimate, Series
from surefoot.robot import PhysicalParams, RobotDescription

RACK_TILT = 0.002
"""Standard deviation [rad] of a rack's tilt: a spirit level's bubble of .1 degrees."""
VOLTAGE_DEVIATION = 0.02
"""Standard deviation [V] of a battery's voltage at rest: sensor, and charge used meanwhile."""
MIN_RESPONSES = 8
"""Clear responses to spikes that are needed."""
AGE_TOLERANCE = 0.001
"""Difference [s] of the readings' age, by spikes and by replay, from which a note is given."""
SPIKES = ("spikes", Mode.PWM)
"""Name and mode of the phases that have spikes."""
WINDOW = 0.014
"""Time after the first motion [s] whose readings are fitted; later the spike's speed has faded."""
PRE_WINDOW = 0.010
"""Time before a spike [s] whose readings are fitted."""
MAX_AGE, AGE_STEP = 0.08, 0.0002
"""Greatest age, and step between ages that are tried [s]."""
MIN_SPEED_RATIO = 8.0
"""Least speed of a clear response, over the noise of speeds."""


def estimate_imu(recording: Recording) -> list[ParameterEstimate]:
    """Return the constant error of roll and pitch, and their noise, of a base that is held level and still."""
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
    """Return the voltage of the battery before motors move."""
    return ParameterEstimate(
        "voltage", float(np.mean(recording.voltage[recording.resting])), VOLTAGE_DEVIATION, "V", low=0.0
    )


def fit_motor(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the motor experiment; see `Experiment.fit`."""
    segment = _segment(recording, "fit")
    fit = fit_on_rack(robot, recording, segment, prior, report)
    estimates = (*rack_estimates(robot, fit, prior), *estimate_imu(recording), estimate_voltage(recording))
    gains = np.zeros(robot.num_motors)
    for unknown, value in zip(fit.unknowns, fit.values, strict=True):
        if unknown.name == TORQUE_GAIN:
            gains[unknown.index] = value
    params = Identification("motor", robot.name, estimates).params(robot, prior)
    checks: tuple[Check, ...] = ()
    series: tuple[Series, ...] = ()
    if recording.phases("check"):
        checks, series = _check(robot, recording, (prior, params), gains)
    open_ = [e.label for e in estimates if not e.identifiable]
    return Identification(
        "motor",
        robot.name,
        estimates,
        checks,
        tuple(fit.strongest_correlations()),
        (f"not identifiable from these data: {', '.join(open_)}",) if open_ else (),
        (*series, _torque_curve(robot, recording, segment, params, gains)),
        {"torque_gain": gains.tolist(), "torque_accuracy": GAIN_DEVIATION / float(np.sqrt(robot.num_motors))},
    )


def _segment(recording: Recording, use: str) -> Segment:
    phases = recording.phases(use)
    return segment_from_recording(recording, phases[0], phases[-1])


def _check(
    robot: RobotDescription, recording: Recording, params: tuple[PhysicalParams, PhysicalParams], gains: Array
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Return errors on held-out phases with the prior parameters and with the estimates, and one motor over time."""
    replayer, motor, segment = Replayer(robot, 1), 0, _segment(recording, "check")
    replays = [replayer.run(segment, one) for one in params]
    motors = moving_legs(robot, recording)
    before, after = (
        np.sqrt(np.mean(replay_errors(one, recording, segment)[0][..., motors] ** 2, axis=(1, 2))).tolist()
        for one in replays
    )

    def series(label: str, quantity: str, gain: float) -> Series:
        was, now = (getattr(one, quantity)[0, :, motor] for one in replays)
        measured = getattr(recording, quantity)[segment.states, motor]
        title = f"{robot.motor_names[motor]}, not fitted"
        return Series(title, "time [s]", label, segment.state_time, measured, was, now * gain)

    return (
        Check("motor angles", 1e3 * before[0], 1e3 * after[0], "mrad"),
        Check("motor speeds", before[1], after[1], "rad/s"),
        Check("motor torques", before[2], after[2], "N m"),
    ), (series("angle [rad]", "motor_angle", 1.0), series("torque [N m]", "motor_torque", 1 + gains[motor]))


def _torque_curve(
    robot: RobotDescription, recording: Recording, segment: Segment, params: PhysicalParams, gains: Array
) -> Series:
    """Return torque over current: reports of motors under PWM, over their strength, beside the data sheet's curve."""
    motors = moving_legs(robot, recording)
    order = np.searchsorted(segment.command_tick * robot.timing.servo_step, segment.state_time - 1e-4) - 1
    driven = segment.kind[order] == Mode.PWM
    kept = segment.states[driven]
    # A state's speeds are older than its torques by the control latency.
    later = recording.time[kept] + float(params.control_latency[0])
    speed = read_at(later, recording.time, recording.motor_velocity[:, motors])
    before = np.maximum(kept - 1, 0)
    current = motor_current(
        segment.order[order][driven][:, motors], speed, recording.voltage[before][:, None], params.torque_constant[0],
        params.resistance[0], robot.dc_motor.voltage_clip,
    )  # fmt: skip
    torque = np.abs(recording.motor_torque[kept][:, motors]) / (params.motor_strength[0] * (1 + gains))[motors]
    magnitude = np.abs(current).ravel()
    edges = np.arange(0.0, magnitude.max() + 2.0, 2.0)
    place = np.digitize(magnitude, edges) - 1
    bins = [place == k for k in range(len(edges)) if np.sum(place == k) >= 20]
    x = np.array([np.mean(magnitude[inside]) for inside in bins])
    measured = np.array([np.mean(torque.ravel()[inside]) for inside in bins])
    sheet = np.asarray(motor_torque(x, 1.0, *robot.torque_table))
    labels = "torque of a motor of nominal strength", "current [A]", "torque [N m]"
    return Series(*labels, x, measured, np.full(len(x), np.nan), sheet, points=True)


@dataclass(frozen=True)
class SpikeResponses:
    """Delays of K clear responses to spikes."""

    age: Array
    """Of the readings when the robot sends states (K,) [s]."""
    host: Array
    """From sending the spike to the first state with motion, on the host's clock (K,) [s]."""
    tried: int
    """Number of spikes, times motors."""


def fit_latency(
    robot: RobotDescription, recording: Recording, prior: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """Return the result of the latency experiment; see `Experiment.fit`."""
    spikes = measure_spikes(recording)
    if len(spikes.age) < MIN_RESPONSES:
        raise SurefootError(
            f"only {len(spikes.age)} of {spikes.tried} responses to spikes are clear; at least {MIN_RESPONSES} are "
            f"needed: do the motors move at all?"
        )
    lead = float(recording.meta["lead"])
    fit = fit_on_rack(robot, recording, _segment(recording, "fit"), prior, report, every=3)
    kept = ("servo_latency", "control_latency")
    estimates = {e.name: e for e in rack_estimates(robot, fit, prior) if e.name in kept}
    at_robot, at_host = _median("spike_at_robot", spikes.age), _median("spike_at_host", spikes.host)
    age, replayed = at_robot.value + lead, estimates["control_latency"].value
    notes = [
        f"readings are {1e3 * at_robot.value:.2f} ms old when the robot sends them; from sending a spike to reading "
        f"of the motion {1e3 * at_host.value:.2f} ms pass at this computer ({len(spikes.age)} of {spikes.tried} "
        f"responses are clear); control_latency counts {1e3 * lead:g} ms from sending to use"
    ]
    if abs(age - replayed) > AGE_TOLERANCE:
        notes.insert(0, f"readings are {1e3 * age:.1f} ms old by spikes, {1e3 * replayed:.1f} ms by replay")
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
        correlations=tuple(pair for pair in fit.strongest_correlations(20) if any(name in pair for name in kept)),
        notes=tuple(notes),
        series=(histogram,),
    )


def measure_spikes(recording: Recording) -> SpikeResponses:
    """Fit each motor's response to each spike.

    A torque from 0 to T gives a free motor the distance v (t^2 / 2T) until T and v (t - T/2) later; braking adds
    c (t - T)^2. Readings of time t are as they were at t - age.
    """
    dt = float(recording.meta["servo_period"])
    ages, hosts, tried = [], [], 0
    driven = np.abs(recording.sent_value).max(axis=1) > 0
    groups = [k for k, phase in enumerate(recording.meta["phases"]) if (phase["name"], phase["mode"]) == SPIKES]
    for c in np.flatnonzero(driven[:-1] & np.isin(recording.sent_phase[:-1], groups)):
        begin, end = dt * recording.servo_step(recording.arrival[c : c + 2])
        kept = (recording.time > begin - PRE_WINDOW) & (recording.time < begin + MAX_AGE + WINDOW)
        since, angles, speeds = (values[kept] for values in (recording.time - begin, recording.motor_angle,
                                                             recording.motor_velocity))  # fmt: skip
        age, clear = _response_age(since, angles, speeds, float(end - begin))
        host = np.interp(begin + age, recording.time, recording.host_time) - recording.sent_time[c]
        tried += len(age)
        ages += age[clear].tolist()
        hosts += host[clear].tolist()
    return SpikeResponses(np.array(ages), np.array(hosts), tried)


def _response_age(since: Array, angles: Array, speeds: Array, length: float) -> tuple[Array, NDArray[np.bool_]]:
    """Return the age at which the fit of each motor's readings (T, M) is best (M,) [s], and if it clearly moved."""
    age, clear = np.zeros(angles.shape[1]), np.zeros(angles.shape[1], np.bool_)
    quiet = since <= 0
    before = np.median(speeds[quiet], axis=0)
    # Of all motors: a handful of readings of one are too few.
    noise = float(np.std(speeds[quiet] - before)) + 1e-9
    for motor in range(angles.shape[1]):
        # It starts to move about when it has half of the spike's speed.
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
    """Return the sum of squared errors [rad2] of one motor's angles (T,) for an age of its readings."""
    t = np.maximum(since - age, 0.0)
    distance = np.where(t < length, t * t / (2 * length), t - length / 2)
    basis = np.stack([np.ones_like(t), since, distance, np.maximum(t - length, 0.0) ** 2], axis=1)
    coefficients, *_ = np.linalg.lstsq(basis, angles, rcond=None)
    return float(np.sum((angles - basis @ coefficients) ** 2))


def _median(name: str, values: Array) -> ParameterEstimate:
    """Return a median; its deviation is 1.25 times that of a mean, by the interquartile range."""
    spread = float(np.subtract(*np.percentile(values, [75, 25]))) / 1.349
    deviation = 1.2533 * max(spread, 1e-6) / np.sqrt(len(values))
    return ParameterEstimate(name, float(np.median(values)), deviation, "s", low=0.0)
