"""Least squares with MuJoCo's solver (`mujoco.minimize`, that of `mujoco.sysid`), which takes many candidates at once.

A fit has intervals that allow for residuals that correlate in time, correlations, and which unknowns are identifiable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.model import ReplayModel, Unknown

MIN_COST_DECREASE = 1e-5
"""Relative decrease of the cost that a step must promise; less ends the fit."""
MAX_DEVIATION_RATIO = 0.7
"""Greatest deviation of an identifiable number, as a share of its prior deviation, or of a quarter of its bounds."""
MIN_CORRELATION = 0.8
"""Correlation from which two numbers are hardly distinguishable."""
MAX_ITERATIONS = 25
MAX_HELD_SHIFT = 2.0
"""Greatest deviation that residuals may ask of a held unknown, over that of its prior."""


class _ConvergedError(Exception):
    """Raised from within the solver: its own tolerances are finer than finite differences of a simulation."""


@dataclass(frozen=True)
class Fit:
    """The result of a fit."""

    unknowns: tuple[Unknown, ...]
    values: Array
    """(n,)"""
    covariance: Array
    """Of the values' errors (n, n)."""
    residuals: Array
    """(m,), in standard deviations."""
    jacobian: Array
    """Derivatives of the residuals (m, n)."""
    held: NDArray[np.bool_] | None = None
    """Which unknowns kept their start (n,), as the data do not determine them; None: none did."""
    considers: bool = False
    """Whether the last unknowns were never fitted, see `hold_unidentifiable`."""

    @property
    def free(self) -> NDArray[np.bool_]:
        """Which unknowns were fitted (n,)."""
        return np.ones(len(self.unknowns), np.bool_) if self.held is None else ~self.held

    @property
    def deviation(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """Correlation of the values' errors (n, n), from -1 to 1."""
        scale = np.maximum(self.deviation, 1e-300)
        return self.covariance / np.outer(scale, scale)

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """Which unknowns the data determine (n,): those whose deviation is clearly less than before."""
        return self.deviation < MAX_DEVIATION_RATIO * self.prior_deviation

    @property
    def prior_deviation(self) -> Array:
        """Standard deviations before the fit (n,)."""
        return np.array([unknown.prior_deviation for unknown in self.unknowns])

    def strongest_correlations(self, count: int = 5) -> list[tuple[str, str, float]]:
        """Return pairs of unknowns that are hardly distinguishable, strongest first."""
        c = self.correlation
        pairs = [(abs(c[i, j]), i, j) for i in range(len(c)) for j in range(i) if abs(c[i, j]) >= MIN_CORRELATION]
        return [
            (self.unknowns[j].label, self.unknowns[i].label, float(c[i, j])) for _, i, j in sorted(pairs)[::-1][:count]
        ]


def forward_jacobian(model: ReplayModel, values: Array, residuals: Array) -> Array:
    """Return derivatives (m, n) by forward differences, with one candidate for all unknowns of a colour."""
    unknowns = model.unknowns
    colours: dict[int, list[int]] = {}
    for i, unknown in enumerate(unknowns):
        colours.setdefault(-1 - i if unknown.colour is None else unknown.colour, []).append(i)
    groups = list(colours.values())
    candidates = np.tile(values, (len(groups), 1))
    change = np.array([u.step if v + u.step <= u.high else -u.step for u, v in zip(unknowns, values, strict=True)])
    for row, group in enumerate(groups):
        candidates[row, group] += change[group]
    differences = model.residuals(candidates) - residuals
    jacobian = np.empty((len(residuals), len(unknowns)))
    for difference, group in zip(differences, groups, strict=True):
        for i in group:
            affected = model.affected(i) if len(group) > 1 else None
            jacobian[:, i] = (difference if affected is None else np.where(affected, difference, 0.0)) / change[i]
    return jacobian


def fit_least_squares(
    model: ReplayModel, start: Array | None = None, report: Callable[[int, float], None] | None = None
) -> Fit:
    """Minimize the sum of squared residuals of a model within bounds, priors counted as residuals.

    Args:
        model: what to fit.
        start: values (n,) to begin with; those of the unknowns, if not given.
        report: callback with each iteration's number and mean square.

    Raises:
        SurefootError: residuals that are not finite where the fit begins.
    """
    unknowns = tuple(model.unknowns)
    scale, low, high, starts = (
        np.array([getattr(u, name) for u in unknowns]) for name in ("step", "low", "high", "start")
    )
    with_prior = np.array([i for i, u in enumerate(unknowns) if u.prior is not None], np.int64)
    middle, spread = starts[with_prior], np.array([unknowns[i].prior for i in with_prior], float)
    first = np.clip(starts if start is None else start, low, high)

    def values_of(x: Array) -> Array:
        # The solver's bounds hold to rounding: without this a friction of -1e-19 is possible.
        values: Array = np.clip(np.asarray(x).T * scale, low, high)
        return values

    def residual(x: Array) -> Array:
        values = values_of(x)
        r = np.concatenate([model.residuals(values), (values[:, with_prior] - middle) / spread], axis=1).T.copy()
        if here:
            check_convergence(x, r)
        return r

    def check_convergence(x: Array, r: Array) -> None:
        """End a fit whose next step promises next to nothing; the solver would try ever smaller ones."""
        x_before, r_before, slopes = here[0]
        change = slopes @ (x - x_before)
        before = float(np.sum(r_before**2))
        if -float(np.sum((2 * r_before + change) * change)) < MIN_COST_DECREASE * before:
            converged[:] = [x if np.sum(r**2) < before else x_before]
            raise _ConvergedError

    def jacobian(x: Array, r: Array) -> Array:
        values, count = values_of(x)[0], len(r) - len(with_prior)
        whole = np.zeros((len(r), len(scale)))
        whole[:count] = forward_jacobian(model, values, r[:count, 0])
        whole[count + np.arange(len(with_prior)), with_prior] = 1 / spread
        here[:] = [(x, r, whole * scale)]
        return here[0][2]

    here: list[tuple[Array, Array, Array]] = []
    converged: list[Array] = []
    begin = residual((first / scale)[:, None])
    if not np.isfinite(begin).all():
        raise SurefootError("the model breaks down where the fit begins; check robot and recording")

    def report_iteration(log: list[minimize.IterLog]) -> None:
        if report is not None:
            report(len(log), 2 * float(log[-1].objective) / len(begin))

    try:
        x, _ = minimize.least_squares(
            first / scale,
            residual,
            [low / scale, high / scale],
            jacobian,
            max_iter=MAX_ITERATIONS,
            verbose=minimize.Verbosity.SILENT,
            iter_callback=report_iteration,
            x_scale="jac",
        )
    except _ConvergedError:
        x = converged[0]
    here.clear()
    values = values_of(np.asarray(x).ravel())
    final = residual((values / scale)[:, None])[:, 0]
    count = len(final) - len(with_prior)
    own = forward_jacobian(model, values, final[:count])
    prior = np.diag((high - low) ** -2.0)
    prior[with_prior, with_prior] += spread**-2.0
    covariance = _covariance(own, final[:count], model.blocks, prior, high - low)
    return Fit(unknowns, values, covariance, final[:count], own)


def hold_unidentifiable(
    model: ReplayModel,
    fit: Fit,
    considered: Sequence[Unknown] = (),
    report: Callable[[int, float], None] | None = None,
) -> Fit:
    """Return a fit in which all that the data neither determine nor move keeps its start, the rest being fitted again.

    With the derivatives J_h of held unknowns, J' J + prior = H of the others, and the second moment P of what the held
    ones are off, the errors of the others have the covariance C + S P S' with S = -H^-1 J' J_h (Schmidt 1966). P is the
    prior covariance, or less where residuals would show more.

    Args:
        model: with the unknowns of the fit, then the considered ones.
        fit: of the former, with the latter held.
        considered: unknowns that are not fitted, but known with the deviation of their prior only.
        report: callback as of `fit_least_squares`.
    """
    unknowns = (*fit.unknowns, *considered)
    start = np.array([unknown.start for unknown in fit.unknowns])
    # Values that contradict the prior belong to the fit, even if they are not known better than before.
    known = fit.identifiable | (np.abs(fit.values - start) > fit.deviation)
    free = np.concatenate([known, np.zeros(len(considered), np.bool_)])
    if free.all():
        return fit
    values = np.array([unknown.start for unknown in unknowns])
    values[: len(fit.values)] = np.where(known, fit.values, start)
    deviation = np.array([unknown.prior_deviation for unknown in unknowns])
    residuals = model.residuals(values[None])[0]
    jacobian = np.empty((len(residuals), len(unknowns)))
    if not free.any():
        jacobian = forward_jacobian(model, values, residuals)
        return Fit(unknowns, values, np.diag(deviation**2.0), residuals, jacobian, ~free, bool(considered))
    again = fit_least_squares(model.holding(free, values), fit.values[known], report)
    values[free], residuals = again.values, again.residuals
    jacobian[:, free] = again.jacobian
    jacobian[:, ~free] = held = forward_jacobian(model.holding(~free, values), values[~free], residuals)
    # In units of the prior deviations: numbers differ by ten orders of magnitude.
    inside, out = deviation[free], deviation[~free]
    own, theirs = again.jacobian * inside, held * out
    prior = np.array([float(u.prior is not None) for u in again.unknowns])
    shift = -np.linalg.lstsq(own.T @ own + np.diag(prior), own.T @ theirs, rcond=None)[0]
    start = np.array([unknown.start for unknown in again.unknowns])
    pull = own.T @ residuals + prior * (again.values - start) / inside
    moment = _held_error_moment(theirs, own, shift, residuals, pull)
    shift, moment = inside[:, None] * shift / out, out[:, None] * moment * out
    covariance = np.empty((len(unknowns), len(unknowns)))
    covariance[np.ix_(free, free)] = again.covariance + shift @ moment @ shift.T
    covariance[np.ix_(free, ~free)] = shift @ moment
    covariance[np.ix_(~free, free)] = moment @ shift.T
    covariance[np.ix_(~free, ~free)] = moment
    return Fit(unknowns, values, covariance, residuals, jacobian, ~free, bool(considered))


def _held_error_moment(held: Array, jacobian: Array, shift: Array, residuals: Array, pull: Array) -> Array:
    """Return the second moment (h, h) of what held unknowns are off: their posterior covariance and mean.

    All are in units of the unknowns' prior deviations.

    Args:
        held: derivatives of the residuals (m, h) by them.
        jacobian: by the free unknowns (m, n).
        shift: change of the free unknowns (n, h) by the held ones.
        residuals: where the fit ended (m,).
        pull: gradient that is left there by the free unknowns (n,), not 0 at bounds.
    """
    precision = held.T @ (held + jacobian @ shift)
    covariance = np.linalg.inv((precision + precision.T) / 2 + np.eye(held.shape[1]))
    mean = np.clip(-covariance @ (held.T @ residuals + shift.T @ pull), -MAX_HELD_SHIFT, MAX_HELD_SHIFT)
    return np.asarray(covariance + np.outer(mean, mean), np.float64)


def _covariance(jacobian: Array, residuals: Array, blocks: NDArray[np.int64], prior: Array, width: Array) -> Array:
    """Return H^-1 (sum over blocks of g g' + prior) H^-1, with a block's gradient g = J' r and H = J' J + prior.

    White, Econometrica 48 (1980), by blocks of time as in Newey and West (1987): valid also where residuals of
    neighbouring times correlate, as those of a model that is a little wrong do. It is at least H^-1 itself, which
    independent residuals of unit size give. The prior includes the bounds' width (n,): unknowns that do not affect the
    residuals vary within it, and take nothing from the accuracy of the others.
    """
    hessian = jacobian.T @ jacobian + prior
    weighted = jacobian * residuals[:, None]
    order = np.argsort(blocks, kind="stable")
    edges = np.flatnonzero(np.diff(blocks[order], prepend=-1))
    gradients = np.add.reduceat(weighted[order], edges, axis=0)
    count = len(edges)
    middle = gradients.T @ gradients * (count / max(count - 1, 1)) + prior
    inverse = np.linalg.inv(hessian * np.outer(width, width)) * np.outer(width, width)
    sandwich = inverse @ middle @ inverse
    larger = np.maximum(np.diag(sandwich), np.diag(inverse))
    inflation = np.sqrt(larger / np.maximum(np.diag(sandwich), 1e-300))
    return sandwich * np.outer(inflation, inflation)
