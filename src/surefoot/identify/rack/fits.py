"""Fits of the experiments on a rack.

Motor: the recording is replayed in simulation until servo, motors and legs answer alike. Latency: spikes tell the
readings' age directly (Tan et al. 2018, section V-A), a replay tells that and the servo's delay.
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
from surefoot.identify.fitting import GAIN, TORQUE_GAIN
from surefoot.identify.rack.model import RackModel, fit_on_rack, rack_estimates
from surefoot.identify.recording import Recording, read_at
from surefoot.identify.result import FitProgress
from surefoot.identify.replay import Replayer, Segment, segment_from_recording
from surefoot.identify.result import Check, Identification, ParameterEstimate, Series
from surefoot.robot import PhysicalParams, RobotDescription

LEVEL = 0.002
"""Standard deviation [rad] of how level a rack is: a spirit level's bubble of .1 degrees."""
VOLTAGE = 0.02
"""Standard deviation [V] of what a battery at rest is said to have: sensor, and charge used meanwhile."""
FEWEST = 8
"""Clear answers to spikes that are needed."""
DISAGREE = 0.001
"""Difference [s] between what spikes and the replay say of the readings' age from which on it is told."""
SPIKES = ("spikes", Mode.PWM)
"""Name and mode of the phases that have spikes."""
WINDOW = 0.014
"""Time after the first motion [s] whose readings are fitted; later the spike's speed has faded."""
BEFORE = 0.010
"""Time before a spike [s] whose readings are fitted."""
LONGEST, AGE_STEP = 0.08, 0.0002
"""Greatest age that is looked for, and step between ages that are tried [s]."""
CLEAR = 8.0
"""How many times the noise of speeds a spike's speed must be to count."""


def imu_estimates(recording: Recording) -> list[ParameterEstimate]:
    """Constant error of roll and pitch, and the noise on them, of a base that is held level and still."""
    tilt = recording.roll_pitch_yaw[:, :2]
    count = len(tilt)
    noise = float(np.sqrt(np.mean(tilt.var(axis=0, ddof=1))))
    bias = float(np.hypot(noise / np.sqrt(count), LEVEL))
    spread = float(np.hypot(noise / np.sqrt(4 * count), 1e-5 + 0.004 * noise))
    return [
        *(ParameterEstimate("imu_bias", float(tilt[:, axis].mean()), bias, "rad", axis) for axis in range(2)),
        ParameterEstimate("imu_noise", noise, spread, "rad", low=0.0),
    ]


def rest_voltage(recording: Recording) -> ParameterEstimate:
    """Voltage of the battery before motors moved."""
    resting = recording.voltage[: max(int(recording.meta["resting_states"]), 1)]
    return ParameterEstimate("voltage", float(np.mean(resting)), VOLTAGE, "V", low=0.0)


def fit_motor(
    robot: RobotDescription, recording: Recording, known: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """What the motor experiment tells; see `Experiment.fit`."""
    fitted, checked = recording.phases("fit"), recording.phases("check")
    fit, model = fit_on_rack(robot, recording, segment_from_recording(recording, fitted[0], fitted[-1]), known, report)
    estimates = (*rack_estimates(robot, fit, known), *imu_estimates(recording), rest_voltage(recording))
    gains = np.zeros(robot.num_motors)
    for unknown, value in zip(fit.unknowns, fit.values, strict=True):
        if unknown.name == TORQUE_GAIN:
            gains[unknown.index] = value
    found = Identification("motor", robot.name, estimates).params(robot, known)
    checks: tuple[Check, ...] = ()
    series: tuple[Series, ...] = ()
    if checked:
        checks, series = _check(
            robot, recording, known, found, gains, segment_from_recording(recording, checked[0], checked[-1])
        )
    untold = [e.label for e in estimates if not e.identifiable]
    return Identification(
        "motor",
        robot.name,
        estimates,
        checks,
        tuple(fit.strongest_correlations()),
        (f"the data do not tell {', '.join(untold)}",) if untold else (),
        (*series, _curve(robot, recording, model, found, gains)),
        {"torque_gain": gains.tolist(), "torque_accuracy": GAIN / float(np.sqrt(robot.num_motors))},
    )


def _check(
    robot: RobotDescription,
    recording: Recording,
    known: PhysicalParams,
    found: PhysicalParams,
    gains: Array,
    segment: Segment,
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """How well a segment that was not fitted is repeated with what was known, and with what was found."""
    replayer, motor = Replayer(robot, 1), 0
    model = RackModel(robot, recording, segment, [], known, replayer, every=1)
    told = [replayer.run(segment, params) for params in (known, found)]
    before, after = (np.sqrt(np.mean(model.errors(one)[0] ** 2, axis=(1, 2))).tolist() for one in told)

    def series(label: str, quantity: str, gain: float) -> Series:
        was, now = (getattr(one, quantity)[0, :, motor] for one in told)
        measured = getattr(recording, quantity)[segment.states, motor]
        title = f"{robot.motor_names[motor]}, not fitted"
        return Series(title, "time [s]", label, segment.state_time, measured, was, now * gain)

    return (
        Check("motor angles", 1e3 * before[0], 1e3 * after[0], "mrad"),
        Check("motor speeds", before[1], after[1], "rad/s"),
        Check("motor torques", before[2], after[2], "N m"),
    ), (series("angle [rad]", "motor_angle", 1.0), series("torque [N m]", "motor_torque", 1 + gains[motor]))


def _curve(
    robot: RobotDescription, recording: Recording, model: RackModel, found: PhysicalParams, gains: Array
) -> Series:
    """Torque over current: what motors reported while they got a duty, less their own strength, beside the sheet's."""
    segment, motors = model.segment, model.kept
    order = np.searchsorted(segment.order_tick * robot.timing.servo_step, segment.state_time - 1e-4) - 1
    driven = segment.kind[order] == Mode.PWM
    kept = segment.states[driven]
    # A state's speeds are older than its torques by the control latency.
    later = recording.time[kept] + float(found.control_latency[0])
    speed = read_at(later, recording.time, recording.motor_velocity[:, motors])
    before = np.maximum(kept - 1, 0)
    current = motor_current(
        segment.order[order][driven][:, motors], speed, recording.voltage[before][:, None], found.torque_constant[0],
        found.resistance[0], robot.dc_motor.voltage_clip,
    )  # fmt: skip
    torque = np.abs(recording.motor_torque[kept][:, motors]) / (found.motor_strength[0] * (1 + gains))[motors]
    magnitude = np.abs(current).ravel()
    edges = np.arange(0.0, magnitude.max() + 2.0, 2.0)
    place = np.digitize(magnitude, edges) - 1
    bins = [k for k in range(len(edges)) if np.sum(place == k) >= 20]
    x = np.array([np.mean(magnitude[place == k]) for k in bins])
    measured = np.array([np.mean(torque.ravel()[place == k]) for k in bins])
    sheet = np.asarray(motor_torque(x, 1.0, *robot.torque_table))
    return Series("torque of a motor of nominal strength", "current [A]", "torque [N m]", x, measured,
                  np.full(len(x), np.nan), sheet, points=True)  # fmt: skip


@dataclass(frozen=True)
class Spikes:
    """Delays of K answers to spikes, without those of motors that hardly moved."""

    age: Array
    """Of the readings when states are sent by the robot (K,) [s]."""
    host: Array
    """From sending the spike to the first state that tells of motion, on the host's clock (K,) [s]."""
    tried: int
    """Spikes given to motors."""


def fit_latency(
    robot: RobotDescription, recording: Recording, known: PhysicalParams, sensors: dict[str, Any], report: FitProgress
) -> Identification:
    """What the latency experiment tells; see `Experiment.fit`."""
    spikes = measure_spikes(recording)
    if len(spikes.age) < FEWEST:
        raise SurefootError(
            f"only {len(spikes.age)} of {spikes.tried} answers to spikes are clear; at least {FEWEST} are needed: "
            f"do the motors move at all?"
        )
    lead, fitted = float(recording.meta["lead"]), recording.phases("fit")
    fit, _ = fit_on_rack(
        robot, recording, segment_from_recording(recording, fitted[0], fitted[-1]), known, report, every=3
    )
    kept = ("servo_latency", "control_latency")
    estimates = {e.name: e for e in rack_estimates(robot, fit, known) if e.name in kept}
    at_robot, at_host = _median("spike_at_robot", spikes.age), _median("spike_at_host", spikes.host)
    age, found = at_robot.value + lead, estimates["control_latency"].value
    notes = [
        f"readings are {1e3 * at_robot.value:.2f} ms old when the robot sends them; from sending a spike to reading "
        f"of the motion {1e3 * at_host.value:.2f} ms pass at this computer ({len(spikes.age)} of {spikes.tried} "
        f"spikes answered clearly); control_latency counts {1e3 * lead:g} ms from sending to use"
    ]
    if abs(age - found) > DISAGREE:
        notes.insert(0, f"spikes say that readings are {1e3 * age:.1f} ms old, the replay {1e3 * found:.1f} ms")
    return Identification(
        "latency",
        robot.name,
        (*estimates.values(), at_robot, at_host, rest_voltage(recording)),
        correlations=tuple(pair for pair in fit.strongest_correlations(20) if any(name in pair for name in kept)),
        notes=tuple(notes),
        series=(_series(spikes),),
    )


def measure_spikes(recording: Recording) -> Spikes:
    """Fit each motor's answer to each spike.

    A torque from 0 to T gives a free motor the way v (t^2 / 2T) until T and v (t - T/2) later; braking adds
    c (t - T)^2. Readings of time t are as they were at t - age.
    """
    dt = float(recording.meta["servo_period"])
    ages, hosts, tried = [], [], 0
    driven = np.abs(recording.sent_value).max(axis=1) > 0
    groups = [k for k, phase in enumerate(recording.meta["phases"]) if (phase["name"], phase["mode"]) == SPIKES]
    for c in np.flatnonzero(driven[:-1] & np.isin(recording.sent_phase[:-1], groups)):
        begin, end = dt * recording.servo_step(recording.arrival[c : c + 2])
        kept = (recording.time > begin - BEFORE) & (recording.time < begin + LONGEST + WINDOW)
        best, moved = _first_motion(
            recording.time[kept] - begin,
            recording.motor_angle[kept],
            recording.motor_velocity[kept],
            float(end - begin),
        )
        tried += len(best)
        told = np.interp(begin + best, recording.time, recording.host_time) - recording.sent_time[c]
        ages += best[moved].tolist()
        hosts += told[moved].tolist()
    return Spikes(np.array(ages), np.array(hosts), tried)


def _first_motion(since: Array, angles: Array, speeds: Array, length: float) -> tuple[Array, NDArray[np.bool_]]:
    """Age at which the fit of each motor's readings (T, M) is best (M,) [s], and whether it clearly moved."""
    found, clear = np.zeros(angles.shape[1]), np.zeros(angles.shape[1], np.bool_)
    quiet = since <= 0
    before = np.median(speeds[quiet], axis=0)
    # Of all motors: a handful of readings of one tell their noise badly.
    noise = float(np.std(speeds[quiet] - before)) + 1e-9
    for motor in range(angles.shape[1]):
        # Where its speed has half of what the spike gives it: about when it began to move.
        gained = np.abs(speeds[:, motor] - before[motor])
        at = int(np.argmax(gained > gained.max() / 2))
        rough = float(since[at])
        if gained.max() < CLEAR * noise or rough < 0:
            continue
        used = (since > rough - BEFORE) & (since < rough + WINDOW)
        ages = rough + np.arange(-0.006, 0.003, AGE_STEP)
        costs = [_cost(since[used], angles[used, motor], age, length) for age in ages]
        best = int(np.argmin(costs))
        if not 0 < best < len(ages) - 1:
            continue
        low, middle, high = costs[best - 1 : best + 2]
        curved = low - 2 * middle + high
        found[motor] = ages[best] + (AGE_STEP * 0.5 * (low - high) / curved if curved > 0 else 0.0)
        clear[motor] = True
    return found, clear


def _cost(since: Array, angles: Array, age: float, length: float) -> float:
    """Sum of squares [rad2] that is left of one motor's angles (T,), with an age of its readings."""
    t = np.maximum(since - age, 0.0)
    way = np.where(t < length, t * t / (2 * length), t - length / 2)
    basis = np.stack([np.ones_like(t), since, way, np.maximum(t - length, 0.0) ** 2], axis=1)
    found, *_ = np.linalg.lstsq(basis, angles, rcond=None)
    return float(np.sum((angles - basis @ found) ** 2))


def _median(name: str, values: Array) -> ParameterEstimate:
    """Median, with the deviation that a median has: 1.25 times that of a mean, by the spread between quartiles."""
    spread = float(np.subtract(*np.percentile(values, [75, 25]))) / 1.349
    return ParameterEstimate(
        name, float(np.median(values)), 1.2533 * max(spread, 1e-6) / np.sqrt(len(values)), "s", low=0.0
    )


def _series(spikes: Spikes) -> Series:
    """How the spikes' answers spread."""
    edges = np.linspace(1e3 * spikes.age.min() - 0.2, 1e3 * spikes.age.max() + 0.2, 25)
    count, _ = np.histogram(1e3 * spikes.age, edges)
    middle = (edges[1:] + edges[:-1]) / 2
    nothing = np.full(len(middle), np.nan)
    return Series("answers to spikes", "age of readings [ms]", "spikes", middle, count.astype(float), nothing, nothing,
                  points=True)  # fmt: skip
