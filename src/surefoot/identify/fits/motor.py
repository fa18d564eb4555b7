"""The motor experiment's fit: the recording is replayed in simulation until servo, motors and legs answer alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator.motor import motor_current, motor_torque
from surefoot.arrays import Array
from surefoot.deploy.wire.messages import Mode
from surefoot.identify.accuracy import with_floor
from surefoot.identify.fitting import Fit, Unknown, fit_least_squares
from surefoot.identify.rack_model import NOISE, TORQUE_GAIN, RackModel
from surefoot.identify.recording import Recording, read_at
from surefoot.identify.registry import FitProgress
from surefoot.identify.replay import Replayer, Stretch, stretch_of
from surefoot.identify.result import Check, Estimate, Identification, Series
from surefoot.robot import PhysicalParams, RobotDescription

GAIN = 0.01
"""Standard deviation of a motor's torque report's relative error: a current sense resistor of 1 %. It is what carries
the scale of all forces: motion alone can't tell a strong motor on heavy legs from a weak one on light ones."""
LATENCIES = np.arange(0.0, 0.081, 0.002)
"""Control latencies [s] from which the best one is where the fit begins: fits with sines have several valleys."""
LEVEL = 0.002
"""Standard deviation [rad] of how level a rack is: a spirit level's bubble of .1 degrees."""
VOLTAGE = 0.02
"""Standard deviation [V] of what a battery at rest is said to have: sensor, and charge used meanwhile."""
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


def motor_unknowns(
    robot: RobotDescription, known: PhysicalParams, latency: float, motors: NDArray[np.int64]
) -> list[Unknown]:
    """What there is to find, from what was known before.

    Args:
        robot: its legs and what it allows.
        known: one row.
        latency: control latency to begin with [s].
        motors: those of legs that moved.
    """
    unknowns = []
    for name, size in _SIZES.items():
        start = latency if name == "control_latency" else float(getattr(known, name)[0])
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
    stretch: Stretch,
    known: PhysicalParams,
    tell: FitProgress,
    every: int = 5,
) -> tuple[Fit, RackModel]:
    """Fit everything that a robot on its rack tells to a stretch of a recording."""
    scan = RackModel(robot, recording, stretch, [], known, Replayer(robot, 1), 3 * every)
    fits = []
    for latency in scan.latency_valleys(LATENCIES)[:STARTS]:
        tell(f"starting from a control latency of {1e3 * latency:.0f} ms", float("nan"))
        unknowns = motor_unknowns(robot, known, latency, scan.kept)
        fits.append(_fit_rounds(robot, recording, stretch, known, unknowns, tell, every))
        if fits[-1][1].noise[0] < GOOD:
            break
    return min(fits, key=lambda found: float(found[1].noise[0]))


def _fit_rounds(
    robot: RobotDescription,
    recording: Recording,
    stretch: Stretch,
    known: PhysicalParams,
    unknowns: list[Unknown],
    tell: FitProgress,
    every: int,
) -> tuple[Fit, RackModel]:
    """Fit from one start, again with as much noise as the fit before has left, until that holds."""
    replayer = Replayer(robot, len({u.colour for u in unknowns if u.colour is not None}) + 10)
    noise, start = NOISE, None
    for _ in range(_ROUNDS):
        model = RackModel(robot, recording, stretch, unknowns, known, replayer, every, noise)
        fit = fit_least_squares(model, start, tell=lambda k, cost: tell(f"iteration {k}", cost))
        # What the model can't explain counts as noise, or it would be taken for knowledge.
        left = np.sqrt(np.mean(fit.residuals.reshape(3, -1) ** 2, axis=1))
        if np.all(left < 1.15):
            break
        noise, start = np.maximum(left, 1.0) * noise, fit.values
    return fit, model


def rack_estimates(robot: RobotDescription, fit: Fit, known: PhysicalParams) -> list[Estimate]:
    """Estimates of physical parameters from a fit on the rack; motors that were not fitted are not told."""
    estimates = []
    for u, value, deviation, told in zip(fit.unknowns, fit.values, fit.deviation, fit.told, strict=True):
        if u.name != TORQUE_GAIN:
            deviation = with_floor(u.name, float(value), float(deviation))
            estimates.append(Estimate.of_parameter(robot, u.name, float(value), deviation, u.index, bool(told)))
    fitted = {(e.name, e.index) for e in estimates}
    for motor in range(robot.num_motors):
        for name in _MOTOR_SIZES:
            if (name, motor) not in fitted:
                low, high = robot.allowed[name]
                value = float(getattr(known, name)[0, motor])
                estimates.append(Estimate.of_parameter(robot, name, value, (high - low) / 4, motor, told=False))
    return estimates


def imu_estimates(recording: Recording) -> list[Estimate]:
    """Constant error of roll and pitch, and the noise on them, of a base that is held level and still."""
    tilt = recording.roll_pitch_yaw[:, :2]
    count = len(tilt)
    noise = float(np.sqrt(np.mean(tilt.var(axis=0, ddof=1))))
    bias = float(np.hypot(noise / np.sqrt(count), LEVEL))
    spread = float(np.hypot(noise / np.sqrt(4 * count), 1e-5 + 0.004 * noise))
    return [
        *(Estimate("imu_bias", float(tilt[:, axis].mean()), bias, "rad", axis) for axis in range(2)),
        Estimate("imu_noise", noise, spread, "rad", low=0.0),
    ]


def rest_voltage(recording: Recording) -> Estimate:
    """Voltage of the battery before motors moved."""
    resting = recording.voltage[: max(int(recording.meta["resting_states"]), 1)]
    return Estimate("voltage", float(np.mean(resting)), VOLTAGE, "V", low=0.0)


def fit_motor(
    robot: RobotDescription,
    recording: Recording,
    known: PhysicalParams,
    sensors: dict[str, Any],
    tell: FitProgress,
) -> Identification:
    """What the motor experiment tells.

    Raises:
        SurefootError: data too poor to tell anything.
    """
    fitted, checked = recording.phases("fit"), recording.phases("check")
    fit, model = fit_on_rack(robot, recording, stretch_of(recording, fitted[0], fitted[-1]), known, tell)
    estimates = (*rack_estimates(robot, fit, known), *imu_estimates(recording), rest_voltage(recording))
    gains = np.zeros(robot.num_motors)
    for unknown, value in zip(fit.unknowns, fit.values, strict=True):
        if unknown.name == TORQUE_GAIN:
            gains[unknown.index] = value
    found = Identification("motor", robot.name, estimates).params(robot, known)
    checks: tuple[Check, ...] = ()
    series: tuple[Series, ...] = ()
    if checked:
        checks, series = _check(robot, recording, known, found, gains, stretch_of(recording, checked[0], checked[-1]))
    untold = [e.label for e in estimates if not e.told]
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
    stretch: Stretch,
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """How well a stretch that was not fitted is repeated with what was known, and with what was found."""
    replayer, motor = Replayer(robot, 1), 0
    model = RackModel(robot, recording, stretch, [], known, replayer, every=1)
    told = [replayer.run(stretch, params) for params in (known, found)]
    before, after = (np.sqrt(np.mean(model.errors(one)[0] ** 2, axis=(1, 2))).tolist() for one in told)

    def series(label: str, quantity: str, gain: float) -> Series:
        was, now = (getattr(one, quantity)[0, :, motor] for one in told)
        measured = getattr(recording, quantity)[stretch.states, motor]
        title = f"{robot.motor_names[motor]}, not fitted"
        return Series(title, "time [s]", label, stretch.state_time, measured, was, now * gain)

    return (
        Check("motor angles", 1e3 * before[0], 1e3 * after[0], "mrad"),
        Check("motor speeds", before[1], after[1], "rad/s"),
        Check("motor torques", before[2], after[2], "N m"),
    ), (series("angle [rad]", "motor_angle", 1.0), series("torque [N m]", "motor_torque", 1 + gains[motor]))


def _curve(
    robot: RobotDescription,
    recording: Recording,
    model: RackModel,
    found: PhysicalParams,
    gains: Array,
) -> Series:
    """Torque over current: what motors reported while they got a duty, less their own strength, beside the sheet's."""
    stretch, motors = model.stretch, model.kept
    order = np.searchsorted(stretch.order_tick * robot.timing.servo_step, stretch.state_time - 1e-4) - 1
    driven = stretch.kind[order] == Mode.PWM
    kept = stretch.states[driven]
    # A state's speeds are older than its torques by the control latency.
    later = recording.time[kept] + float(found.control_latency[0])
    speed = read_at(later, recording.time, recording.motor_velocity[:, motors])
    before = np.maximum(kept - 1, 0)
    current = motor_current(
        stretch.order[order][driven][:, motors], speed, recording.voltage[before][:, None], found.torque_constant[0],
        found.resistance[0], robot.actuator.voltage_clip,
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
