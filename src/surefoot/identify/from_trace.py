"""What recorded runs tell of a robot's motors and delays, without an experiment.

Walking is chaotic over seconds, so no body is simulated: the motors' own law (`identify.actuator_model`) is fitted to
the torques that they reported, along the angles and speeds that were read. A part of the runs is kept back to try it
on.

Torques depend on voltage, torque constant and resistance through U / R and K_t / R alone: whoever wants all three gets
them for a voltage as it was known before, and intervals that count what is not known about that. The base's mass is
told by a steady walk, for legs of a known mass (`identify.trace_mass`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError, choices
from surefoot.identify.accuracy import with_floor
from surefoot.identify.actuator_model import EXPLAINED, NOISE, VOLTAGE_CHANGE, ActuatorModel
from surefoot.identify.fits.motor import GAIN
from surefoot.identify.fitting import Fit, Unknown, fit_least_squares
from surefoot.identify.recording import digest_of
from surefoot.identify.registry import Tell
from surefoot.identify.result import Check, Estimate, Identification, Series
from surefoot.identify.trace_mass import walking_mass
from surefoot.identify.trace_notes import notes_on_estimates, notes_on_traces
from surefoot.identify.trace_rows import (
    Course,
    Piece,
    Reporting,
    check_length,
    check_traces,
    pieces_of,
    reportings,
    split,
)
from surefoot.identify.trace_unknowns import LATENCIES, MASS, NAMES, SPREAD, USUAL, latency_valleys, unknowns_of
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.trace import EpisodeTrace

Array = NDArray[np.float64]

INTERPOLATED = 1.5e-4
"""Least standard deviation of latencies that are found between readings 6 ms apart [s], as in runs of emulated
robots."""
STILL = 0.03
"""Range of angles [rad] below which a motor does not move, so that it does not tell its strength."""


def fit_traces(
    robot: RobotDescription,
    traces: Sequence[EpisodeTrace],
    names: Sequence[str] | None,
    known: PhysicalParams,
    tell: Tell | None = None,
) -> Identification:
    """Find physical parameters from recorded runs of a robot.

    Args:
        robot: its description.
        traces: runs, oldest first. The last quarter of them, at least one, is kept back; of a single one its last
            quarter in time.
        names: which of `NAMES` to find, `USUAL` if not given; the others are taken as they are known.
        known: what was known before, one row.
        tell: is told how it goes.

    Raises:
        SurefootError: unknown names, no traces, traces that don't fit the robot or are too short, or motors at rest.
    """
    wanted = tuple(dict.fromkeys(USUAL if names is None else names))
    if bad := [name for name in wanted if name not in NAMES]:
        raise SurefootError(f"traces do not tell '{bad[0]}'; choices: {choices(NAMES)}")
    if not wanted:
        raise SurefootError(f"nothing is to be found; choices: {choices(NAMES)}")
    check_traces(robot, traces)
    bounds = {
        name: robot.allowed[name] if name in wanted else (float(getattr(known, name)[0]),) * 2 for name in LATENCIES
    }
    courses = [Course(robot, trace) for trace in traces]
    choice = None
    for kind in range(max(len(reportings(robot, trace)) for trace in traces)):
        pieces = pieces_of(robot, traces, courses, bounds, kind)
        check_length(traces, pieces)
        valleys = latency_valleys(robot, split(pieces)[0], bounds, known)
        if choice is None or valleys[0][0] < choice[0][0][0]:
            choice = valleys, pieces
    if choice is None:
        raise RuntimeError("no way of reporting")
    valleys, pieces = choice
    fitted, held = split(pieces)
    moving = np.ptp(np.concatenate([piece.trace.motor_angle for piece in fitted]), axis=0) > STILL
    if not moving.any():
        raise SurefootError(f"no motor moves by {STILL:g} rad or more in the traces; give traces of a robot that walks")
    notes = notes_on_traces(robot, traces, [*fitted, *held], moving, wanted)
    motors = [name for name in wanted if name != MASS]
    fit, noise = _fit(robot, motors, known, valleys, moving, fitted, tell)
    told = {u.label: bool(t) for u, t in zip(fit.unknowns, fit.told, strict=True)}
    final = _settled(robot, fit, told, fitted, known, moving, noise)
    estimates = _estimates(robot, motors, known, fit, final, told, moving, fitted[0].reporting)
    found = Identification("traces", robot.name, tuple(estimates)).params(robot, known)
    checks, series = _check(robot, held, known, found, final, moving)
    if MASS in wanted:
        mass = walking_mass(robot, pieces, found)
        estimates.append(
            Estimate(MASS, mass.base_ratio, with_floor(MASS, mass.base_ratio, mass.deviation), "1", None, True, 0.0)
        )
        notes.append(
            f"the robot weighs {mass.total:.2f} kg in all; {MASS} is what the base has of it if leg_mass_ratio is "
            f"{float(known.leg_mass_ratio[0]):g}, as it was known"
        )
    notes += notes_on_estimates(estimates, wanted, held)
    arrays = {
        f"{number:06d} {name}": getattr(trace, name)
        for number, trace in enumerate(traces)
        for name in ("time", "motor_angle", "motor_velocity", "motor_torque", "target")
    }
    # What does not come from the fit, such as errors of the torques' reports, is no motor's business but its own.
    whole = {item.label: item.deviation**2 for item in estimates}
    covariance = fit.covariance.copy()
    np.fill_diagonal(
        covariance, [whole.get(u.label, v) for u, v in zip(fit.unknowns, np.diag(covariance), strict=True)]
    )
    pairs = replace(fit, covariance=covariance).strongest_correlations(20)
    pairs = [pair for pair in pairs if {label.partition("[")[0] for label in pair[:2]} <= set(NAMES)]
    return Identification(
        "traces",
        robot.name,
        tuple(estimates),
        checks,
        tuple(pairs[:5]),
        tuple(notes),
        series,
        {},
        digest_of(arrays),
        str(next((trace.meta["date"] for trace in reversed(traces) if trace.meta.get("date")), "")),
    )


def _fit(
    robot: RobotDescription,
    wanted: Sequence[str],
    known: PhysicalParams,
    valleys: Sequence[tuple[float, float, float]],
    moving: NDArray[np.bool_],
    pieces: Sequence[Piece],
    tell: Tell | None,
) -> tuple[Fit, float]:
    """The best fit of all valleys, and the noise [N m] that it leaves torques."""

    def fitted(unknowns: Sequence[Unknown], start: Array, noise: float, what: str) -> Fit:
        def each(step: int, cost: float) -> None:
            if tell is not None:
                tell(f"{what}, step {step}", cost)

        return fit_least_squares(ActuatorModel(robot, pieces, unknowns, known, moving, noise), start, tell=each)

    def whole_cost(fit: Fit) -> float:
        offs = [(v - u.start) / u.prior for u, v in zip(fit.unknowns, fit.values, strict=True) if u.prior]
        return float(np.sum(fit.residuals**2) + np.sum(np.square(offs)))

    fits = []
    for _, late, servo in valleys:
        unknowns = unknowns_of(robot, wanted, known, (late, servo), moving, pieces)
        start = np.array([servo if u.name == "servo_latency" else u.start for u in unknowns])
        fits.append(fitted(unknowns, start, NOISE, f"latencies near {1e3 * late:.0f} and {1e3 * servo:.0f} ms"))
    best = min(fits, key=whole_cost)
    # What the model can't explain counts as noise, or it would be taken for knowledge. Noise of readings is in what is
    # always left; what comes on top does not average out, and so counts for more than its share.
    grown = NOISE * (np.sqrt(np.mean(best.residuals**2)) * NOISE / EXPLAINED) ** 2
    if grown < 1.2 * NOISE:
        return best, NOISE
    return fitted(best.unknowns, best.values, float(grown), "once more"), float(grown)


def _settled(
    robot: RobotDescription,
    fit: Fit,
    told: dict[str, bool],
    pieces: Sequence[Piece],
    known: PhysicalParams,
    moving: NDArray[np.bool_],
    noise: float,
) -> Fit:
    """The fit once more, with what is not told as it was known: all values together then give the recorded torques."""
    kept = [u for u in fit.unknowns if told[u.label] or u.name not in NAMES]
    if len(kept) == len(fit.unknowns):
        return fit
    values = np.array([v for u, v in zip(fit.unknowns, fit.values, strict=True) if u in kept])
    return fit_least_squares(ActuatorModel(robot, pieces, kept, known, moving, noise), values)


def _estimates(
    robot: RobotDescription,
    wanted: Sequence[str],
    known: PhysicalParams,
    fit: Fit,
    final: Fit,
    told: dict[str, bool],
    moving: NDArray[np.bool_],
    reporting: Reporting,
) -> list[Estimate]:
    """Values of the final fit, with the deviations of the one in which nothing was held."""
    values = {u.label: float(v) for u, v in zip(final.unknowns, final.values, strict=True)}
    deviations = {u.label: float(d) for u, d in zip(fit.unknowns, fit.deviation, strict=True)}
    estimates = []
    for name in wanted:
        unit = PhysicalParams.unit(name)
        low, high = robot.allowed[name]
        for index in range(robot.num_motors) if name == "motor_strength" else (None,):
            label = name if index is None else f"{name}[{index}]"
            before = getattr(known, name)[0]
            value = values.get(label, float(before if index is None else before[index]))
            extra = GAIN * value if index is not None else 0.0
            if name in LATENCIES:
                extra = float(np.hypot(reporting.spread, INTERPOLATED))
            # A motor at rest has as wide an interval as before.
            deviation = with_floor(name, value, float(np.hypot(deviations.get(label, SPREAD * value), extra)))
            estimates.append(Estimate(name, value, deviation, unit, index, told.get(label, False), low, high))
    return estimates


def _check(
    robot: RobotDescription,
    held: Sequence[Piece],
    known: PhysicalParams,
    found: PhysicalParams,
    fit: Fit,
    moving: NDArray[np.bool_],
) -> tuple[tuple[Check, ...], tuple[Series, ...]]:
    """Torques of what was not fitted, with what was known and with what was found."""
    side = [(u, v) for u, v in zip(fit.unknowns, fit.values, strict=True) if u.name not in NAMES]
    # A battery that was kept back is taken to have what the last one that was fitted had.
    last = {replace(u, index=held[0].number): v for u, v in side if u.name == VOLTAGE_CHANGE and held[0].number}
    changes = [(replace(u, index=piece.number), v) for piece in held for u, v in list(last.items())[-1:]]
    side = [(u, v) for u, v in side if u.name != VOLTAGE_CHANGE] + changes
    after = ActuatorModel(robot, held, [u for u, _ in side], found, moving)
    before = ActuatorModel(robot, held, [], known, moving)
    measured = np.concatenate([piece.torque for piece in held])
    ways = [
        np.concatenate([torque[0] for torque in model.torques(values)])
        for model, values in ((before, np.empty((1, 0))), (after, np.array([[v for _, v in side]])))
    ]
    errors = [float(np.sqrt(np.mean((way - measured)[:, moving] ** 2))) for way in ways]
    motor = int(np.argmax(np.where(moving, np.std(measured, axis=0), -1.0)))
    piece = held[0]
    rows = slice(0, min(len(piece.rows), round(1.0 / piece.trace.meta["control_step"])))
    series = Series(
        f"{robot.motor_names[motor]}, not fitted",
        "time [s]",
        "torque [N m]",
        piece.trace.time[piece.rows[rows]],
        measured[rows, motor],
        ways[0][rows, motor],
        ways[1][rows, motor],
    )
    return (Check("motor torques", errors[0], errors[1], "N m"),), (series,)
