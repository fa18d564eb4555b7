"""The motor experiment's fit: the recording is replayed in simulation until servo, motors and legs answer alike."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.actuator.motor import motor_current, motor_torque
from surefoot.deploy.wire.messages import Mode
from surefoot.identify.accuracy import with_floor
from surefoot.identify.fitting import Fit, Unknown, fit_least_squares
from surefoot.identify.quality import check_recording
from surefoot.identify.rack_model import TORQUE_GAIN, Noise, RackModel
from surefoot.identify.recording import Recording
from surefoot.identify.registry import FitProgress
from surefoot.identify.replay import Replayer, Stretch, stretch_of
from surefoot.identify.rest import imu_estimates, rest_voltage
from surefoot.identify.result import Check, Estimate, Identification, Series
from surefoot.robot import PhysicalParams, RobotDescription

Array = NDArray[np.float64]

GAIN = 0.01
"""Standard deviation of a motor's torque report's relative error: a current sense resistor of 1 %. It is what carries
the scale of all forces: motion alone can't tell a strong motor on heavy legs from a weak one on light ones."""
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
_NAMES = ("motor angles", "motor speeds", "motor torques")
_UNITS = ("mrad", "rad/s", "N m")
_SCALES = (1e3, 1.0, 1.0)


def motor_unknowns(
    robot: RobotDescription, known: PhysicalParams, latency: float, still: frozenset[int]
) -> list[Unknown]:
    """What there is to find, from what was known before.

    Args:
        robot: its legs and what it allows.
        known: one row.
        latency: control latency to begin with [s].
        still: motors that did not move, and those beside them.
    """
    unknowns = []
    sizes = {
        "torque_constant": 0.1,
        "resistance": 0.2,
        "servo_kp": 1.0,
        "servo_kd": 0.015,
        "servo_latency": 0.01,
        "control_latency": 0.01,
        "leg_mass_ratio": 1.0,
        "leg_inertia_ratio": 1.0,
    }
    for name, size in sizes.items():
        low, high = robot.allowed[name]
        start = latency if name == "control_latency" else float(getattr(known, name)[0])
        unknowns.append(Unknown(name, start, low, high, _TINY * size))
    each = {"motor_strength": 1.0, "motor_friction": 0.1, "motor_viscous_friction": 0.01}
    for motor in range(robot.num_motors):
        if motor in still:
            continue
        which = int(np.argwhere(robot.leg_motor_index == motor)[0][1])
        for colour, (name, size) in enumerate(each.items()):
            low, high = robot.allowed[name]
            start = float(getattr(known, name)[0, motor])
            unknowns.append(Unknown(name, start, low, high, _TINY * size, motor, colour=2 * colour + which))
        unknowns.append(Unknown(TORQUE_GAIN, 0.0, -0.5, 0.5, 1e-4, motor, GAIN, colour=6 + which))
    return unknowns


def fit_on_rack(
    robot: RobotDescription,
    recording: Recording,
    stretch: Stretch,
    known: PhysicalParams,
    tell: FitProgress | None,
    every: int = 5,
) -> tuple[Fit, RackModel]:
    """Fit everything that a robot on its rack tells to a stretch of a recording."""
    unknowns_for_latency = [Unknown("control_latency", 0.02, *robot.allowed["control_latency"], 1e-8)]
    scan = RackModel(robot, recording, [stretch], unknowns_for_latency, known, every=3 * every,
                     replayer=Replayer(robot, 1, rack=True))  # fmt: skip
    still = frozenset(range(robot.num_motors)) - frozenset(scan.kept.tolist())
    best: tuple[Fit, RackModel] | None = None
    for latency in scan.latency_valleys(LATENCIES)[:STARTS]:
        if tell is not None:
            tell(f"starting from a control latency of {1e3 * latency:.0f} ms", float("nan"))
        unknowns = motor_unknowns(robot, known, latency, still)
        found = _fit_rounds(robot, recording, stretch, known, unknowns, tell, every)
        if best is None or found[1].noise.angle < best[1].noise.angle:
            best = found
        if best[1].noise.angle < GOOD:
            break
    if best is None:
        raise RuntimeError("no start")
    return best


def _fit_rounds(
    robot: RobotDescription,
    recording: Recording,
    stretch: Stretch,
    known: PhysicalParams,
    unknowns: list[Unknown],
    tell: FitProgress | None,
    every: int,
) -> tuple[Fit, RackModel]:
    """Fit from one start, again with as much noise as the fit before has left, until that holds."""
    noise = Noise()
    replayer = Replayer(robot, len({u.colour for u in unknowns if u.colour is not None}) + 10, rack=True)
    start, fit, model = None, None, None
    for _ in range(_ROUNDS):
        model = RackModel(robot, recording, [stretch], unknowns, known, noise, every, replayer)
        fit = fit_least_squares(
            model, start, tell=None if tell is None else lambda k, cost: tell(f"iteration {k}", cost)
        )
        # What the model can't explain counts as noise, or it would be taken for knowledge.
        left = np.sqrt(np.mean(fit.residuals.reshape(3, -1) ** 2, axis=1))
        if np.all(left < 1.15):
            break
        grown = np.maximum(left, 1.0) * [noise.angle, noise.velocity, noise.torque]
        noise, start = Noise(*grown.tolist()), fit.values
    if fit is None or model is None:
        raise RuntimeError("no round of fitting")
    return fit, model


def rack_estimates(robot: RobotDescription, fit: Fit, known: PhysicalParams) -> list[Estimate]:
    """Estimates of physical parameters from a fit on the rack; motors that were not fitted are not told."""
    estimates = []
    told = fit.told
    for i, unknown in enumerate(fit.unknowns):
        if unknown.name == TORQUE_GAIN:
            continue
        unit = PhysicalParams.unit(unknown.name)
        value = float(fit.values[i])
        estimates.append(
            Estimate(
                unknown.name,
                value,
                with_floor(unknown.name, value, float(fit.deviation[i])),
                unit,
                unknown.index,
                bool(told[i]),
                unknown.low,
                unknown.high,
            )
        )
    fitted = {(e.name, e.index) for e in estimates}
    for motor in range(robot.num_motors):
        for name in ("motor_strength", "motor_friction", "motor_viscous_friction"):
            if (name, motor) not in fitted:
                low, high = robot.allowed[name]
                unit = PhysicalParams.unit(name)
                value = float(getattr(known, name)[0, motor])
                estimates.append(Estimate(name, value, (high - low) / 4, unit, motor, False, low, high))
    return estimates


def fit_motor(
    robot: RobotDescription,
    recording: Recording,
    known: PhysicalParams,
    sensors: dict[str, Any],
    tell: FitProgress | None,
) -> Identification:
    """What the motor experiment tells.

    Raises:
        SurefootError: data too poor to tell anything.
    """
    notes = list(check_recording(recording, robot))
    fitted, checked = recording.phases("fit"), recording.phases("check")
    stretch = stretch_of(recording, fitted[0], fitted[-1])
    fit, model = fit_on_rack(robot, recording, stretch, known, tell)
    estimates = [*rack_estimates(robot, fit, known), *imu_estimates(recording), rest_voltage(recording)]
    gains = np.zeros(robot.num_motors)
    for i, unknown in enumerate(fit.unknowns):
        if unknown.name == TORQUE_GAIN and unknown.index is not None:
            gains[unknown.index] = fit.values[i]
    found = Identification("motor", robot.name, tuple(estimates)).params(robot, known)
    checks: tuple[Check, ...] = ()
    series: tuple[Series, ...] = ()
    if checked:
        checks, series = _check(robot, recording, known, found, gains, stretch_of(recording, checked[0], checked[-1]))
    series = (*series, _curve(robot, recording, model, found, gains))
    untold = [e.label for e in estimates if not e.told]
    if untold:
        notes.append(f"the data do not tell {', '.join(untold)}")
    return Identification(
        "motor",
        robot.name,
        tuple(estimates),
        checks,
        tuple(fit.strongest_correlations()),
        tuple(notes),
        series,
        {"torque_gain": gains.tolist(), "torque_accuracy": GAIN / float(np.sqrt(robot.num_motors))},
        recording.digest,
        str(recording.meta["date"]),
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
    replayer = Replayer(robot, 1, rack=True)
    errors, told = [], []
    for params in (known, found):
        model = RackModel(robot, recording, [stretch], [], params, every=1, replayer=replayer)
        errors.append(np.sqrt(np.mean(model.errors(np.empty((1, 0)))[0] ** 2, axis=(1, 2))))
        told.append(replayer.run(stretch, params))
    checks = tuple(
        Check(name, float(scale * errors[0][k]), float(scale * errors[1][k]), unit)
        for k, (name, unit, scale) in enumerate(zip(_NAMES, _UNITS, _SCALES, strict=True))
    )
    kept, motor = stretch.states, 0
    time = stretch.state_time
    name = robot.motor_names[motor]
    series = (
        Series(
            f"{name}, not fitted", "time [s]", "angle [rad]", time, recording.motor_angle[kept, motor],
            told[0].motor_angle[0, :, motor], told[1].motor_angle[0, :, motor],
        ),
        Series(
            f"{name}, not fitted", "time [s]", "torque [N m]", time, recording.motor_torque[kept, motor],
            told[0].motor_torque[0, :, motor], told[1].motor_torque[0, :, motor] * (1 + gains[motor]),
        ),
    )  # fmt: skip
    return checks, series


def _curve(
    robot: RobotDescription,
    recording: Recording,
    model: RackModel,
    found: PhysicalParams,
    gains: Array,
) -> Series:
    """Torque over current: what motors reported while they got a duty, less their own strength, beside the sheet's."""
    stretch = model.stretches[0]
    latency = float(found.control_latency[0])
    motors = model.kept
    order = np.searchsorted(stretch.order_tick * robot.timing.servo_step, stretch.state_time - 1e-4) - 1
    driven = stretch.kind[order] == Mode.PWM
    kept = stretch.states[driven]
    # A state's speeds are older than its torques by the control latency.
    later = recording.time[kept] + latency
    speed = np.stack(
        [np.interp(later, recording.time, column) for column in recording.motor_velocity.T[motors]], axis=1
    )
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
