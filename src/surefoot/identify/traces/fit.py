"""Physical parameters from recorded runs, without an experiment.

Walking is chaotic over seconds, so no body is simulated: the motors' own law (`identify.trace_model`) is fitted to the
torques that they reported, along the angles and speeds that were read. A part of the runs is kept back to try it on.

Torques depend on voltage, torque constant and resistance through U / R and K_t / R alone: whoever wants all three gets
them for a voltage as it was known before, and intervals that count what is not known about that.

The base's mass follows from a steady walk, for legs of a known mass. Forces on the feet follow from torques and motion
(`identify.inverse_dynamics`), one moment a control step. Impacts between two readings are not seen, but motors feel
them before and after, and over many strides the vertical momentum comes back to what it was:

    sum of the masses = mean of the vertical forces / g
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.actuator import motor_friction
from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.identify.fitting import GAIN, Fit, Unknown, fit_least_squares
from surefoot.identify.ground.inverse_dynamics import InverseDynamics, Motion
from surefoot.identify.recording import digest_of, read_at
from surefoot.identify.result import FitProgress, ignore_progress
from surefoot.identify.result import Check, Identification, ParameterEstimate, Series, indexed_name, with_floor
from surefoot.identify.traces.data import (
    TraceSegment,
    check_traces,
    make_segments,
    split_segments,
    time_jumps,
    torque_timings,
)
from surefoot.identify.traces.model import (
    EXPLAINED,
    LATENCIES,
    MASS,
    NAMES,
    NOISE,
    SPREAD,
    USUAL,
    VOLTAGE_CHANGE,
    TorqueModel,
    latency_valleys,
    unknowns_of,
)
from surefoot.robot import GRAVITY, PhysicalParams, RobotDescription
from surefoot.task.trace import EpisodeTrace

INTERPOLATED = 1.5e-4
"""Least standard deviation of latencies that are found between readings 6 ms apart [s], as in runs of emulated
robots."""
STILL = 0.03
"""Range of angles [rad] below which a motor does not move, so that nothing is known of its strength."""
AT_LIMIT = 0.9
"""Share of the time with the greatest torque from which a motor tells nothing but its strength."""
MIN_WALK = 3.0
"""Least length of a trace [s] whose mean force is taken for the weight."""
WALK_START = 1.0
"""Time [s] at the start of a run that is left out: the robot is not in its gait yet."""
TILT = 0.4
"""Roll or pitch [rad] from which the ground may touch more of a robot than its feet."""
WEIGHT_ERROR = 0.016
"""Relative standard deviation of a weight that is found so. In trots of emulated robots it was off by .9 % in the mean
square and 1.6 % at most, in gallops by up to 2.6 %."""
FORCE_BLOCK = 0.5
"""Length [s] of the blocks of time whose forces are taken to be independent."""
_FORCE_ROWS = 1500
_DIFFERENCE = 0.0015


def fit_traces(
    robot: RobotDescription,
    traces: Sequence[EpisodeTrace],
    names: Sequence[str] | None,
    known: PhysicalParams,
    report: FitProgress = ignore_progress,
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
    # When the robot reported its torques is found from the data too: the way that explains them best.
    ways = range(max(len(torque_timings(robot, trace)) for trace in traces))
    tried = [make_segments(robot, traces, bounds, timing) for timing in ways]
    found_valleys = [latency_valleys(robot, split_segments(segments)[0], bounds, known) for segments in tried]
    valleys, segments = min(zip(found_valleys, tried, strict=True), key=lambda one: one[0][0][0])
    trial = _TraceFit(robot, segments, wanted, known, report)
    notes = trial.notes_on_traces(traces)
    fit = trial.fit(valleys)
    final = trial.drop_unidentifiable(fit)
    estimates = trial.estimates(fit, final)
    found = Identification("traces", robot.name, tuple(estimates)).params(robot, known)
    check, series = trial.check(found, final)
    if MASS in wanted:
        total, ratio, deviation = _walking_mass(robot, segments, found)
        estimates.append(ParameterEstimate(MASS, ratio, with_floor(MASS, ratio, deviation), "1", low=0.0))
        notes.append(
            f"the robot weighs {total:.2f} kg in all; {MASS} is what the base has of it if leg_mass_ratio is "
            f"{float(known.leg_mass_ratio[0]):g}, as it was known"
        )
    columns = ("time", "motor_angle", "motor_velocity", "motor_torque", "target")
    return Identification(
        "traces",
        robot.name,
        tuple(estimates),
        (check,),
        _correlations(fit, estimates),
        (*notes, *trial.notes_on_estimates(estimates)),
        (series,),
        digest=digest_of(
            {f"{k:06d} {name}": getattr(trace, name) for k, trace in enumerate(traces) for name in columns}
        ),
        date=str(next((trace.meta["date"] for trace in reversed(traces) if trace.meta.get("date")), "")),
    )


def _correlations(fit: Fit, estimates: Sequence[ParameterEstimate]) -> tuple[tuple[str, str, float], ...]:
    """Return pairs that can hardly be told apart.

    What does not come from the fit, such as errors of the torques' reports, is no motor's business but its own.
    """
    whole = {item.label: item.deviation**2 for item in estimates}
    covariance = fit.covariance.copy()
    variances = [whole.get(u.label, v) for u, v in zip(fit.unknowns, np.diag(covariance), strict=True)]
    np.fill_diagonal(covariance, variances)
    pairs = replace(fit, covariance=covariance).strongest_correlations(20)
    return tuple([pair for pair in pairs if {label.partition("[")[0] for label in pair[:2]} <= set(NAMES)][:5])


class _TraceFit:
    """A fit of the motors' law to segments of traces; refused if no motor moves."""

    def __init__(
        self,
        robot: RobotDescription,
        segments: Sequence[TraceSegment],
        wanted: tuple[str, ...],
        known: PhysicalParams,
        report: FitProgress,
    ) -> None:
        self.robot, self.wanted, self.known, self.report = robot, wanted, known, report
        self.fitted, self.held = split_segments(segments)
        self.motors = [name for name in wanted if name != MASS]
        self.noise = NOISE
        """Standard deviation with which torques are compared [N m]; `fit` raises it to what it can't explain."""
        angles = np.concatenate([segment.trace.motor_angle for segment in self.fitted])
        self.moving = np.ptp(angles, axis=0) > STILL
        if not self.moving.any():
            raise SurefootError(
                f"no motor moves by {STILL:g} rad or more in the traces; give traces of a robot that walks"
            )

    def _solve(self, unknowns: Sequence[Unknown], start: Array, what: str = "") -> Fit:
        model = TorqueModel(self.robot, self.fitted, unknowns, self.known, self.moving, self.noise)
        report = (lambda step, cost: self.report(f"{what}, step {step}", cost)) if what else None
        return fit_least_squares(model, start, report)

    def fit(self, valleys: Sequence[tuple[float, float, float]]) -> Fit:
        """Return the best fit of all valleys of the latencies."""
        fits = []
        for _, late, servo in valleys:
            unknowns = unknowns_of(self.robot, self.motors, self.known, (late, servo), self.moving, self.fitted)
            start = np.array([servo if u.name == "servo_latency" else u.start for u in unknowns])
            fits.append(self._solve(unknowns, start, f"latencies near {1e3 * late:.0f} and {1e3 * servo:.0f} ms"))
        best = min(fits, key=_cost_with_priors)
        # What the model can't explain counts as noise, or it would be taken for knowledge. Noise of readings is in what
        # is always left; what comes on top does not average out, and so counts for more than its share.
        grown = NOISE * (np.sqrt(np.mean(best.residuals**2)) * NOISE / EXPLAINED) ** 2
        if grown < 1.2 * NOISE:
            return best
        self.noise = float(grown)
        return self._solve(best.unknowns, best.values, "once more")

    def drop_unidentifiable(self, fit: Fit) -> Fit:
        """Fit again with unidentifiable parameters at their prior values, so that all give the recorded torques."""
        kept = [bool(told) or u.name not in NAMES for u, told in zip(fit.unknowns, fit.identifiable, strict=True)]
        if all(kept):
            return fit
        return self._solve([u for u, keep in zip(fit.unknowns, kept, strict=True) if keep], fit.values[kept])

    def estimates(self, fit: Fit, final: Fit) -> list[ParameterEstimate]:
        """Return values of the final fit, with the deviations of the one in which nothing was held."""
        values = {u.label: float(v) for u, v in zip(final.unknowns, final.values, strict=True)}
        spread = {
            u.label: (float(d), bool(t)) for u, d, t in zip(fit.unknowns, fit.deviation, fit.identifiable, strict=True)
        }
        estimates = []
        for name in self.motors:
            for index in range(self.robot.num_motors) if name == "motor_strength" else (None,):
                label, before = indexed_name(name, index), getattr(self.known, name)[0]
                value = values.get(label, float(np.mean(before) if index is None else before[index]))
                extra = GAIN * value if index is not None else 0.0
                if name in LATENCIES:
                    extra = float(np.hypot(self.fitted[0].timing.spread, INTERPOLATED))
                # A motor at rest has as wide an interval as before.
                own, told = spread.get(label, (SPREAD * value, False))
                deviation = with_floor(name, value, float(np.hypot(own, extra)))
                estimates.append(ParameterEstimate.within_bounds(self.robot, name, value, deviation, index, told))
        return estimates

    def check(self, found: PhysicalParams, fit: Fit) -> tuple[Check, Series]:
        """Return how well torques that were not fitted follow from what was known and from what was found."""
        robot, held, first = self.robot, self.held, self.held[0]
        more = [(u, v) for u, v in zip(fit.unknowns, fit.values, strict=True) if u.name not in NAMES]
        # A battery that was kept back is taken to have what the last one that was fitted had.
        changes = [(u, v) for u, v in more if u.name == VOLTAGE_CHANGE and first.number][-1:]
        more = [(u, v) for u, v in more if u.name != VOLTAGE_CHANGE]
        more += [(replace(u, index=segment.number), v) for segment in held for u, v in changes]
        measured = np.concatenate([segment.torque for segment in held])
        modelled = []
        for params, others in ((self.known, []), (found, more)):
            model = TorqueModel(robot, held, [u for u, _ in others], params, self.moving)
            modelled.append(np.concatenate([torque[0] for torque in model.torques(np.array([[v for _, v in others]]))]))
        before, after = (float(np.sqrt(np.mean((way - measured)[:, self.moving] ** 2))) for way in modelled)
        motor = int(np.argmax(np.where(self.moving, np.std(measured, axis=0), -1.0)))
        rows = slice(0, min(len(first.rows), round(1.0 / first.trace.meta["control_step"])))
        labels = f"{robot.motor_names[motor]}, not fitted", "time [s]", "torque [N m]"
        time, (torque, was, now) = first.trace.time[first.rows[rows]], (v[rows, motor] for v in (measured, *modelled))
        return Check("motor torques", before, after, "N m"), Series(*labels, time, torque, was, now)

    def notes_on_traces(self, traces: Sequence[EpisodeTrace]) -> list[str]:
        """Return what is odd about the data."""
        notes, segments, names = [], [*self.fitted, *self.held], self.robot.motor_names
        for number, trace in enumerate(traces, 1):
            jumps = np.flatnonzero(time_jumps(trace))
            if len(jumps):
                notes.append(
                    f"trace {number}: time jumps {len(jumps)} times, first at {trace.time[jumps[0]]:.2f} s; "
                    "rows around jumps are left out"
                )
            if missed := len(trace.meta.get("missed_steps", [])):
                notes.append(f"trace {number}: {missed} control steps were missed; rows around them are left out")
            if not any(segment.number == number - 1 for segment in segments):
                notes.append(f"trace {number}: {trace.duration:.2f} s are too short, or full of gaps; it is left out")
        if "motor_strength" in self.wanted:
            still = np.flatnonzero(~self.moving).tolist()
            notes += [f"{names[motor]} never moves, so its strength is not identifiable" for motor in still]
        torque = np.concatenate([np.abs(segment.torque) for segment in segments])
        full = np.mean(torque > 0.97 * torque.max(axis=0), axis=0)
        notes += [
            f"{names[motor]} gives its greatest torque in {100 * full[motor]:.0f} % of the steps: "
            "it tells nothing of servo, latencies and battery"
            for motor in np.flatnonzero(self.moving & (full > AT_LIMIT)).tolist()
        ]
        return notes

    def notes_on_estimates(self, estimates: Sequence[ParameterEstimate]) -> list[str]:
        """Return what the traces do not tell, and what depends on what."""
        notes = []
        if untold := [e.label for e in estimates if not e.identifiable]:
            notes.append(f"the traces do not tell {choices(untold)}: what was known before is kept")
        if {"voltage", "torque_constant", "resistance"} <= set(self.wanted):
            volts = next(e.value for e in estimates if e.name == "voltage")
            notes.append(
                f"torque_constant and resistance go with a voltage of {volts:g} V, which traces do not tell beside "
                "them; measure the battery, say so, and leave voltage out, and their intervals shrink"
            )
        if self.held[0].timing.spread:
            lead = float(self.held[0].trace.meta["lead"])
            notes.append(
                f"the robot told its readings in real time, {1e3 * lead:g} ms before they were used: a control latency "
                "below that is not seen, and acts as that"
            )
        return notes


def _cost_with_priors(fit: Fit) -> float:
    offs = [(v - u.start) / u.prior for u, v in zip(fit.unknowns, fit.values, strict=True) if u.prior]
    return float(np.sum(fit.residuals**2) + np.sum(np.square(offs)))


def _walking_mass(
    robot: RobotDescription, segments: Sequence[TraceSegment], params: PhysicalParams
) -> tuple[float, float, float]:
    """Return the mass [kg] of a robot that walks, and the base's ratio to the description's with its deviation."""
    usable = [walk for walk in map(_walk, segments) if walk is not None]
    if not usable:
        raise SurefootError(
            f"base_mass_ratio: no trace has {MIN_WALK:g} s upright after its first {WALK_START:g} s; give longer "
            "walks, or leave it out"
        )
    light = InverseDynamics(robot, replace(params, base_mass_ratio=np.ones(1)))
    base = light.base_mass
    legs = light.mass - base
    every = max(sum(len(segment.rows) for segment in usable) // _FORCE_ROWS, 1)
    means, spreads, lengths = [], [], []
    for segment in usable:
        times, vertical = _vertical_force(light, segment, params, every)
        # A window that begins and ends at nothing does not count what momentum the robot gained from start to end.
        weight = np.sin(np.pi * (np.arange(len(times)) + 0.5) / len(times)) ** 2
        means.append(float(np.average(vertical, weights=weight)))
        blocks = ((times - times[0]) / FORCE_BLOCK).astype(np.int64)
        inside = [np.mean(vertical[blocks == k]) for k in range(int(blocks[-1]))]
        spreads.append(float(np.std(inside, ddof=1) / np.sqrt(len(inside))))
        lengths.append(float(times[-1] - times[0]))
    share = np.array(lengths) / np.sum(lengths)
    total = float(np.sum(share * means)) / GRAVITY
    if not total > legs:
        raise SurefootError(
            f"base_mass_ratio: the feet carry {total:.2f} kg in the mean, less than the legs' {legs:.2f} kg; "
            "give walks on the ground, or leave it out"
        )
    random = float(np.sqrt(np.sum((share * spreads) ** 2))) / GRAVITY
    systematic = np.hypot(WEIGHT_ERROR, GAIN / np.sqrt(robot.num_motors)) * total
    return total, (total - legs) / base, float(np.hypot(random, systematic)) / base


def _walk(segment: TraceSegment) -> TraceSegment | None:
    """Return the part in which the robot is in its gait and upright, if it is long enough."""
    trace = segment.trace
    fallen = np.flatnonzero(np.abs(trace.roll_pitch_yaw[:, :2]).max(axis=1) > TILT)
    end = fallen[0] if len(fallen) else trace.num_steps
    rows = segment.rows[(trace.time[segment.rows] > WALK_START) & (segment.rows < end)]
    length = float(np.ptp(trace.time[rows])) if len(rows) else 0.0
    return replace(segment, rows=rows) if length >= MIN_WALK else None


def _vertical_force(
    dynamics: InverseDynamics, segment: TraceSegment, params: PhysicalParams, every: int
) -> tuple[Array, Array]:
    """Return times (n,) [s] and the sum of the vertical forces on the feet (n,) [N]."""
    thin = replace(segment, rows=segment.rows[::every])
    trace, late = segment.trace, float(params.control_latency[0])
    angle, speed = thin.motion(0.0, late)
    acceleration = (thin.motion(-_DIFFERENCE, late)[1] - thin.motion(_DIFFERENCE, late)[1]) / (2 * _DIFFERENCE)
    at, times, rates = trace.time[thin.rows] - thin.timing.age, trace.time - late, trace.angular_velocity_base
    tilt, rate = read_at(at, times, trace.roll_pitch_yaw[:, :2]), read_at(at, times, rates)
    turning = read_at(at, times, np.gradient(rates, trace.time, axis=0))
    torque = thin.torque + motor_friction(speed, params.motor_friction[0], params.motor_viscous_friction[0])
    forces = dynamics.forces(Motion(angle, speed, acceleration, torque, tilt, rate, turning))
    forward, up = forces.force.sum(axis=1).T
    return at, (up * np.cos(tilt[:, 0]) * np.cos(tilt[:, 1])) - forward * np.sin(tilt[:, 1])
