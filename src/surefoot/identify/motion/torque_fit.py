"""Identification of DC motors, delays and battery from recorded runs, without an experiment.

Walking is chaotic over seconds, so the body is not simulated. Instead, the motor model (`identify.motion.torque_model`)
is fitted to the reported torques along the recorded angles and speeds. Some of the runs are held out for a check.

Torques depend on voltage U, torque constant K_t and resistance R only through U / R and K_t / R. A fit of all three
uses the prior voltage, and its intervals include the uncertainty of the voltage.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, suggest
from surefoot.identify.fitting import Fit, fit_least_squares
from surefoot.identify.model import GAIN_DEVIATION, ReplayModel, Unknown
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.torque_model import (
    DEFAULT_NAMES,
    LATENCIES,
    MASS,
    NAMES,
    NOISE,
    RELATIVE_DEVIATION,
    REMAINING_ERROR,
    VOLTAGE_CHANGE,
    predict_torque,
    rank_latencies,
    torque_observations,
    torque_unknowns,
)
from surefoot.identify.motion.torque_rows import (
    TorqueRows,
    check_traces,
    make_segments,
    split_segments,
    time_jumps,
    torque_timings,
)
from surefoot.identify.motion.walking_mass import walking_mass
from surefoot.identify.recording import digest_arrays
from surefoot.identify.result import (
    Check,
    FitProgress,
    Identification,
    ParameterEstimate,
    Series,
    add_model_error,
    ignore_progress,
    indexed_name,
)
from surefoot.robot import PhysicalParams, RobotDescription

INTERPOLATION_DEVIATION = 1.5e-4
"""Standard deviation of latencies due to interpolation of readings 6 ms apart [s], from runs of emulated robots."""
MIN_MOTION = 0.03
"""Range of angles [rad] below which a motor counts as still, so that its strength is not identifiable."""
MAX_SATURATION = 0.9
"""Fraction of time at maximum torque above which only the strength of a motor is identifiable."""


def fit_torques(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    names: Sequence[str] | None,
    prior: PhysicalParams,
    report: FitProgress = ignore_progress,
) -> Identification:
    """Identify physical parameters from recorded runs of a robot.

    Args:
        robot: robot description.
        motions: runs, oldest first. The last quarter of the runs, at least one, is held out; from a single run, the
            last quarter of its time.
        names: parameters to identify, from `NAMES`. Defaults to `DEFAULT_NAMES`; the others stay as in the prior.
        prior: parameters before the fit, one row.
        report: callback with the progress of the fit.

    Raises:
        SurefootError: a name is unknown, there are no traces, traces do not fit the robot or are too short, or no motor
            moves.
    """
    names = tuple(dict.fromkeys(DEFAULT_NAMES if names is None else names))
    if bad := [name for name in names if name not in NAMES]:
        raise SurefootError(f"traces can't identify '{bad[0]}'; {suggest(bad[0], NAMES)}")
    if not names:
        raise SurefootError(f"no parameter is to be identified; choices: {choices(NAMES)}")
    check_traces(robot, motions)
    bounds = {
        name: robot.allowed[name] if name in names else (float(getattr(prior, name)[0]),) * 2 for name in LATENCIES
    }
    # The time at which torques were reported is also estimated, by the timing that explains them best.
    timings = range(max(len(torque_timings(robot, motion)) for motion in motions))
    candidates = [make_segments(robot, motions, bounds, timing) for timing in timings]
    ranked = [rank_latencies(robot, split_segments(segments)[0], bounds, prior) for segments in candidates]
    minima, segments = min(zip(ranked, candidates, strict=True), key=lambda one: one[0][0][0])
    trial = _TorqueFit(robot, segments, names, prior, report)
    notes = trial.describe_motions(motions)
    fit = trial.fit(minima)
    final = trial.drop_unidentifiable(fit)
    estimates = trial.estimates(fit, final)
    params = Identification("traces", robot.name, tuple(estimates)).params(robot, prior)
    check, series = trial.check(params, final)
    if MASS in names:
        total, ratio, deviation = walking_mass(robot, segments, params)
        estimates.append(ParameterEstimate(MASS, ratio, add_model_error(MASS, ratio, deviation), "1", low=0.0))
        notes.append(
            f"the robot weighs {total:.2f} kg in total; {MASS} assumes that leg_mass_ratio is "
            f"{float(prior.leg_mass_ratio[0]):g}, its prior value"
        )
    columns = {"time": "read_time", "target": "command"}
    columns |= {name: name for name in ("motor_angle", "motor_velocity", "motor_torque")}
    return Identification(
        "traces",
        robot.name,
        tuple(estimates),
        (check,),
        _correlations(fit, estimates),
        (*notes, *trial.describe_estimates(estimates)),
        (series,),
        digest=digest_arrays(
            {f"{k:06d} {key}": getattr(one, name) for k, one in enumerate(motions) for key, name in columns.items()}
        ),
        date=str(next((one.meta["date"] for one in reversed(motions) if one.meta.get("date")), "")),
    )


def _correlations(fit: Fit, estimates: Sequence[ParameterEstimate]) -> tuple[tuple[str, str, float], ...]:
    """Return the pairs that are hardly distinguishable; errors that the fit does not include count as independent."""
    variances = {item.label: item.deviation**2 for item in estimates}
    covariance = fit.covariance.copy()
    np.fill_diagonal(
        covariance, [variances.get(u.label, v) for u, v in zip(fit.unknowns, np.diag(covariance), strict=True)]
    )
    pairs = replace(fit, covariance=covariance).strongest_correlations(20)
    return tuple([pair for pair in pairs if {label.partition("[")[0] for label in pair[:2]} <= set(NAMES)][:5])


class _TorqueFit:
    """Fit of the motor model to segments of traces.

    Raises:
        SurefootError: no motor moves.
    """

    def __init__(
        self,
        robot: RobotDescription,
        segments: Sequence[TorqueRows],
        names: tuple[str, ...],
        prior: PhysicalParams,
        report: FitProgress,
    ) -> None:
        self.robot, self.names, self.prior, self.report = robot, names, prior, report
        self.fitted, self.held_out = split_segments(segments)
        self.noise = NOISE
        """Standard deviation of compared torques [N m]; `fit` raises it to the error of the model."""
        angles = np.concatenate([segment.motion.motor_angle for segment in self.fitted])
        self.moving = np.ptp(angles, axis=0) > MIN_MOTION
        if not self.moving.any():
            raise SurefootError(
                f"no motor moves by {MIN_MOTION:g} rad or more in the traces; give traces of a robot that walks"
            )

    def _solve(self, unknowns: Sequence[Unknown], start: Array, what: str = "") -> Fit:
        observations = [torque_observations(self.robot, segment, self.moving, self.noise) for segment in self.fitted]
        report = (lambda step, cost: self.report(f"{what}, step {step}", cost)) if what else None
        return fit_least_squares(ReplayModel(unknowns, self.prior, observations), start, report)

    def fit(self, minima: Sequence[tuple[float, float, float]]) -> Fit:
        """Return the best fit over all local minima of the latencies."""
        fits, names = [], [name for name in self.names if name != MASS]
        for _, control, servo in minima:
            unknowns = torque_unknowns(self.robot, names, self.prior, (control, servo), self.moving, self.fitted)
            start = np.array([servo if u.name == "servo_latency" else u.start for u in unknowns])
            fits.append(self._solve(unknowns, start, f"latencies near {1e3 * control:.0f} and {1e3 * servo:.0f} ms"))
        best = min(fits, key=_cost_with_priors)
        # Model errors count as noise; otherwise intervals would be too narrow. The remaining error includes sensor
        # noise, but the rest of it does not average out and counts more than in proportion, hence the square.
        increased = NOISE * (np.sqrt(np.mean(best.residuals**2)) * NOISE / REMAINING_ERROR) ** 2
        if increased < 1.2 * NOISE:
            return best
        self.noise = float(increased)
        return self._solve(best.unknowns, best.values, "second pass")

    def drop_unidentifiable(self, fit: Fit) -> Fit:
        """Fit again with unidentifiable parameters at their prior values, so that all values are consistent."""
        kept = [bool(known) or u.name not in NAMES for u, known in zip(fit.unknowns, fit.identifiable, strict=True)]
        if all(kept):
            return fit
        return self._solve([u for u, keep in zip(fit.unknowns, kept, strict=True) if keep], fit.values[kept])

    def estimates(self, fit: Fit, final: Fit) -> list[ParameterEstimate]:
        """Return the values of the fit `final`, with the standard deviations of `fit`, which held no parameter."""
        values = {u.label: float(v) for u, v in zip(final.unknowns, final.values, strict=True)}
        columns = zip(fit.unknowns, fit.deviation, fit.identifiable, strict=True)
        spread = {u.label: (float(deviation), bool(known)) for u, deviation, known in columns}
        estimates = []
        for name in self.names:
            if name == MASS:
                continue
            for index in range(self.robot.num_motors) if name == "motor_strength" else (None,):
                label, before = indexed_name(name, index), getattr(self.prior, name)[0]
                value = values.get(label, float(np.mean(before) if index is None else before[index]))
                extra = GAIN_DEVIATION * value if index is not None else 0.0
                if name in LATENCIES:
                    extra = float(np.hypot(self.fitted[0].timing.spread, INTERPOLATION_DEVIATION))
                # A still motor keeps the interval of the prior.
                fitted, identifiable = spread.get(label, (RELATIVE_DEVIATION * value, False))
                deviation = add_model_error(name, value, float(np.hypot(fitted, extra)))
                estimates.append(
                    ParameterEstimate.within_bounds(self.robot, name, value, deviation, index, identifiable)
                )
        return estimates

    def check(self, params: PhysicalParams, fit: Fit) -> tuple[Check, Series]:
        """Return the error of held-out torques with the prior and the estimated parameters, and curves of one motor."""
        robot, held, first = self.robot, self.held_out, self.held_out[0]
        fitted = {(u.name, u.index): np.array([v]) for u, v in zip(fit.unknowns, fit.values, strict=True)}
        nuisance = {key: value for key, value in fitted.items() if key[0] not in NAMES}
        # The battery in held-out traces is assumed to be as in the last fitted trace.
        changes = [value for (name, _), value in nuisance.items() if name == VOLTAGE_CHANGE and first.number]
        nuisance = {key: value for key, value in nuisance.items() if key[0] != VOLTAGE_CHANGE}
        nuisance |= {(VOLTAGE_CHANGE, segment.number): value for segment in held for value in changes[-1:]}
        measured = np.concatenate([segment.torque for segment in held])
        predicted = [
            np.concatenate([predict_torque(robot, segment, one, other)[0] for segment in held])
            for one, other in ((self.prior, {}), (params, nuisance))
        ]
        before, after = (float(np.sqrt(np.mean((one - measured)[:, self.moving] ** 2))) for one in predicted)
        motor = int(np.argmax(np.where(self.moving, np.std(measured, axis=0), -1.0)))
        rows = slice(0, min(len(first.rows), round(1.0 / first.motion.control_step)))
        labels = f"{robot.motor_names[motor]}, not fitted", "time [s]", "torque [N m]"
        time, (torque, prior_curve, fitted_curve) = (
            first.motion.read_time[first.rows[rows]],
            (v[rows, motor] for v in (measured, *predicted)),
        )
        return Check("motor torques", before, after, "N m"), Series(*labels, time, torque, prior_curve, fitted_curve)

    def describe_motions(self, motions: Sequence[RecordedMotion]) -> list[str]:
        """Return notes on defects of the traces."""
        notes, segments, names = [], [*self.fitted, *self.held_out], self.robot.motor_names
        for number, motion in enumerate(motions, 1):
            time, jumps = motion.read_time, np.flatnonzero(time_jumps(motion))
            if len(jumps):
                notes.append(
                    f"trace {number}: time jumps {len(jumps)} times, first at {time[jumps[0]]:.2f} s; rows around "
                    "jumps are left out"
                )
            if missed := len(motion.meta.get("missed_steps", [])):
                notes.append(f"trace {number}: {missed} control steps were missed; rows around them are left out")
            if not any(segment.number == number - 1 for segment in segments):
                notes.append(f"trace {number}: left out, because its {time[-1]:.2f} s are too short or full of gaps")
        if "motor_strength" in self.names:
            still = np.flatnonzero(~self.moving).tolist()
            notes += [f"{names[motor]} never moves: its strength is not identifiable" for motor in still]
        torque = np.concatenate([np.abs(segment.torque) for segment in segments])
        saturated = np.mean(torque > 0.97 * torque.max(axis=0), axis=0)
        return notes + [
            f"{names[motor]} is at its maximum torque in {100 * saturated[motor]:.0f} % of the steps: only its "
            "strength is identifiable, not servo, latencies and battery"
            for motor in np.flatnonzero(self.moving & (saturated > MAX_SATURATION)).tolist()
        ]

    def describe_estimates(self, estimates: Sequence[ParameterEstimate]) -> list[str]:
        """Return notes on parameters that are not identifiable, and on assumptions of the others."""
        notes = []
        if unidentifiable := [e.label for e in estimates if not e.identifiable]:
            notes.append(f"not identifiable from the traces: {choices(unidentifiable)}; prior values are kept")
        if {"voltage", "torque_constant", "resistance"} <= set(self.names):
            volts = next(e.value for e in estimates if e.name == "voltage")
            notes.append(
                f"torque_constant and resistance assume a voltage of {volts:g} V, which can't be identified together "
                "with them. For narrower intervals, measure the battery, set voltage with --params, and do not fit it"
            )
        if self.held_out[0].timing.spread:
            lead = float(self.held_out[0].motion.meta["lead"])
            notes.append(
                f"the robot sent its readings in real time, {1e3 * lead:g} ms before they were used: a control latency "
                "below that can't be observed"
            )
        return notes


def _cost_with_priors(fit: Fit) -> float:
    deviations = [(v - u.start) / u.prior for u, v in zip(fit.unknowns, fit.values, strict=True) if u.prior]
    return float(np.sum(fit.residuals**2) + np.sum(np.square(deviations)))
