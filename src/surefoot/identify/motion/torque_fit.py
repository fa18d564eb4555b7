"""Physical parameters from recorded runs, without an experiment.

Walking is chaotic over seconds, so no body is simulated: the motors' own law (`identify.motion.torque_model`) is fitted
to the torques that they reported, along the angles and speeds that were read. A part of the runs is held out for a
check.

Torques depend on voltage, torque constant and resistance through U / R and K_t / R alone: a fit of all three takes the
prior voltage, with intervals that include the voltage's deviation.
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
    ignore_progress,
    indexed_name,
    add_model_error,
)
from surefoot.robot import PhysicalParams, RobotDescription

INTERPOLATION_DEVIATION = 1.5e-4
"""Least standard deviation of latencies between readings 6 ms apart [s], as in runs of emulated robots."""
MIN_MOTION = 0.03
"""Range of angles [rad] below which a motor does not move, so that its strength is not identifiable."""
MAX_SATURATION = 0.9
"""Share of the time with the greatest torque from which only a motor's strength is identifiable."""


def fit_torques(
    robot: RobotDescription,
    motions: Sequence[RecordedMotion],
    names: Sequence[str] | None,
    prior: PhysicalParams,
    report: FitProgress = ignore_progress,
) -> Identification:
    """Identify physical parameters from recorded runs of a robot.

    Args:
        robot: its description.
        motions: runs, oldest first. The last quarter of them, at least one, is held out; of a single one its last
            quarter in time.
        names: which of `NAMES` to identify, `DEFAULT_NAMES` if not given; the others stay as in the prior.
        prior: parameters before, one row.
        report: callback with the fit's progress.

    Raises:
        SurefootError: unknown names, no traces, traces that don't fit the robot or are too short, or motors at rest.
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
    # When the robot reported its torques is estimated too: the timing that explains them best.
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
            f"the robot weighs {total:.2f} kg in all; {MASS} is the base's part of it if leg_mass_ratio is "
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
    """Return pairs that are hardly distinguishable; errors from outside the fit are independent."""
    whole = {item.label: item.deviation**2 for item in estimates}
    covariance = fit.covariance.copy()
    np.fill_diagonal(
        covariance, [whole.get(u.label, v) for u, v in zip(fit.unknowns, np.diag(covariance), strict=True)]
    )
    pairs = replace(fit, covariance=covariance).strongest_correlations(20)
    return tuple([pair for pair in pairs if {label.partition("[")[0] for label in pair[:2]} <= set(NAMES)][:5])


class _TorqueFit:
    """A fit of the motors' law to segments of traces; refused if no motor moves."""

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
        """Standard deviation with which torques are compared [N m]; `fit` raises it to the model's own error."""
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
        """Return the best fit of all local minima of the latencies."""
        fits, names = [], [name for name in self.names if name != MASS]
        for _, late, servo in minima:
            unknowns = torque_unknowns(self.robot, names, self.prior, (late, servo), self.moving, self.fitted)
            start = np.array([servo if u.name == "servo_latency" else u.start for u in unknowns])
            fits.append(self._solve(unknowns, start, f"latencies near {1e3 * late:.0f} and {1e3 * servo:.0f} ms"))
        best = min(fits, key=_cost_with_priors)
        # Errors of the model count as noise, or intervals would be too narrow. Noise of readings is a part of the
        # remaining error; the rest does not average out, and so counts for more than its share.
        grown = NOISE * (np.sqrt(np.mean(best.residuals**2)) * NOISE / REMAINING_ERROR) ** 2
        if grown < 1.2 * NOISE:
            return best
        self.noise = float(grown)
        return self._solve(best.unknowns, best.values, "once more")

    def drop_unidentifiable(self, fit: Fit) -> Fit:
        """Fit again with unidentifiable parameters at their prior values, so that all together give the torques."""
        kept = [bool(seen) or u.name not in NAMES for u, seen in zip(fit.unknowns, fit.identifiable, strict=True)]
        if all(kept):
            return fit
        return self._solve([u for u, keep in zip(fit.unknowns, kept, strict=True) if keep], fit.values[kept])

    def estimates(self, fit: Fit, final: Fit) -> list[ParameterEstimate]:
        """Return values of the fit `final` with standard deviations of `fit`, in which no parameter was fixed."""
        values = {u.label: float(v) for u, v in zip(final.unknowns, final.values, strict=True)}
        columns = zip(fit.unknowns, fit.deviation, fit.identifiable, strict=True)
        spread = {u.label: (float(deviation), bool(seen)) for u, deviation, seen in columns}
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
                # A motor at rest keeps the prior's interval.
                own, identifiable = spread.get(label, (RELATIVE_DEVIATION * value, False))
                deviation = add_model_error(name, value, float(np.hypot(own, extra)))
                estimates.append(
                    ParameterEstimate.within_bounds(self.robot, name, value, deviation, index, identifiable)
                )
        return estimates

    def check(self, params: PhysicalParams, fit: Fit) -> tuple[Check, Series]:
        """Return errors of held-out torques with the prior parameters and with the estimates."""
        robot, held, first = self.robot, self.held_out, self.held_out[0]
        others = {(u.name, u.index): np.array([v]) for u, v in zip(fit.unknowns, fit.values, strict=True)}
        others = {key: value for key, value in others.items() if key[0] not in NAMES}
        # A held-out battery is taken to be as the last one that was fitted.
        changes = [value for (name, _), value in others.items() if name == VOLTAGE_CHANGE and first.number]
        others = {key: value for key, value in others.items() if key[0] != VOLTAGE_CHANGE}
        others |= {(VOLTAGE_CHANGE, segment.number): value for segment in held for value in changes[-1:]}
        measured = np.concatenate([segment.torque for segment in held])
        predicted = [
            np.concatenate([predict_torque(robot, segment, one, nuisance)[0] for segment in held])
            for one, nuisance in ((self.prior, {}), (params, others))
        ]
        before, after = (float(np.sqrt(np.mean((one - measured)[:, self.moving] ** 2))) for one in predicted)
        motor = int(np.argmax(np.where(self.moving, np.std(measured, axis=0), -1.0)))
        rows = slice(0, min(len(first.rows), round(1.0 / first.motion.control_step)))
        labels = f"{robot.motor_names[motor]}, not fitted", "time [s]", "torque [N m]"
        time, (torque, was, now) = (
            first.motion.read_time[first.rows[rows]],
            (v[rows, motor] for v in (measured, *predicted)),
        )
        return Check("motor torques", before, after, "N m"), Series(*labels, time, torque, was, now)

    def describe_motions(self, motions: Sequence[RecordedMotion]) -> list[str]:
        """Return notes on defects of the data."""
        notes, segments, names = [], [*self.fitted, *self.held_out], self.robot.motor_names
        for number, motion in enumerate(motions, 1):
            time, jumps = motion.read_time, np.flatnonzero(time_jumps(motion))
            if len(jumps):
                notes.append(
                    f"trace {number}: time jumps {len(jumps)} times, first at {time[jumps[0]]:.2f} s; "
                    "rows around jumps are left out"
                )
            if missed := len(motion.meta.get("missed_steps", [])):
                notes.append(f"trace {number}: {missed} control steps were missed; rows around them are left out")
            if not any(segment.number == number - 1 for segment in segments):
                notes.append(f"trace {number}: {time[-1]:.2f} s are too short, or full of gaps; it is left out")
        if "motor_strength" in self.names:
            still = np.flatnonzero(~self.moving).tolist()
            notes += [f"{names[motor]} never moves: its strength is not identifiable" for motor in still]
        torque = np.concatenate([np.abs(segment.torque) for segment in segments])
        full = np.mean(torque > 0.97 * torque.max(axis=0), axis=0)
        return notes + [
            f"{names[motor]} gives its greatest torque in {100 * full[motor]:.0f} % of the steps: only its strength is "
            "identifiable, not servo, latencies and battery"
            for motor in np.flatnonzero(self.moving & (full > MAX_SATURATION)).tolist()
        ]

    def describe_estimates(self, estimates: Sequence[ParameterEstimate]) -> list[str]:
        """Return notes on what is not identifiable, and what depends on what."""
        notes = []
        if open_ := [e.label for e in estimates if not e.identifiable]:
            notes.append(f"not identifiable from the traces: {choices(open_)}; prior values are kept")
        if {"voltage", "torque_constant", "resistance"} <= set(self.names):
            volts = next(e.value for e in estimates if e.name == "voltage")
            notes.append(
                f"torque_constant and resistance are for a voltage of {volts:g} V, which is not identifiable beside "
                "them; measure the battery, set it with --params, leave voltage out, and their intervals shrink"
            )
        if self.held_out[0].timing.spread:
            lead = float(self.held_out[0].motion.meta["lead"])
            notes.append(
                f"the robot sent its readings in real time, {1e3 * lead:g} ms before they were used: a smaller control "
                "latency is not seen, and acts as that"
            )
        return notes


def _cost_with_priors(fit: Fit) -> float:
    offs = [(v - u.start) / u.prior for u, v in zip(fit.unknowns, fit.values, strict=True) if u.prior]
    return float(np.sum(fit.residuals**2) + np.sum(np.square(offs)))
