"""Nonlinear least squares with MuJoCo's solver (`mujoco.minimize`, which `mujoco.sysid` also uses).

The solver evaluates many candidates in one batch. A fit states the covariance of its estimates, which allows for
residuals that are correlated in time, and which unknowns are identifiable.
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
"""Predicted relative decrease of the cost below which the fit ends."""
MAX_DEVIATION_RATIO = 0.7
"""Maximum standard deviation of an identifiable unknown, relative to its standard deviation before the fit."""
MIN_CORRELATION = 0.8
"""Correlation of errors from which two unknowns are hardly distinguishable."""
MAX_ITERATIONS = 25
MAX_HELD_SHIFT = 2.0
"""Maximum error of a held unknown that may be inferred from the residuals, in standard deviations of its prior."""


class _ConvergedError(Exception):
    """Raised in a callback to end the solver, whose tolerances are finer than finite differences of a simulation."""


@dataclass(frozen=True)
class Fit:
    """Result of a least-squares fit of n unknowns to m residuals."""

    unknowns: tuple[Unknown, ...]
    values: Array
    """Estimates (n,)."""
    covariance: Array
    """Covariance of the errors of the estimates (n, n)."""
    residuals: Array
    """Residuals at the estimates (m,), in standard deviations."""
    jacobian: Array
    """Derivatives of the residuals with respect to the unknowns (m, n)."""
    held: NDArray[np.bool_] | None = None
    """Mask (n,) of the unknowns held at their start values because the data do not determine them; None: none."""
    considered: int = 0
    """Number of the last unknowns that are considered parameters, which are never fitted; see `hold_unidentifiable`."""

    @property
    def candidates(self) -> tuple[Unknown, ...]:
        """Unknowns that were to be fitted: all but the considered ones, also those that are held."""
        return self.unknowns[: len(self.unknowns) - self.considered]

    @property
    def free(self) -> NDArray[np.bool_]:
        """Mask (n,) of the unknowns that were fitted."""
        return np.ones(len(self.unknowns), np.bool_) if self.held is None else ~self.held

    @property
    def deviation(self) -> Array:
        """Standard deviations of the estimates (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """Correlation matrix of the errors of the estimates (n, n)."""
        scale = np.maximum(self.deviation, 1e-300)
        return self.covariance / np.outer(scale, scale)

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """Mask (n,) of the unknowns that the data determine: the standard deviation is clearly below the prior one."""
        return self.deviation < MAX_DEVIATION_RATIO * self.prior_deviation

    @property
    def prior_deviation(self) -> Array:
        """Standard deviations before the fit (n,)."""
        return np.array([unknown.prior_deviation for unknown in self.unknowns])

    def strongest_correlations(self, count: int = 5) -> list[tuple[str, str, float]]:
        """Return the pairs of unknowns that are hardly distinguishable, the strongest correlation first."""
        c = self.correlation
        pairs = [(abs(c[i, j]), i, j) for i in range(len(c)) for j in range(i) if abs(c[i, j]) >= MIN_CORRELATION]
        return [
            (self.unknowns[j].label, self.unknowns[i].label, float(c[i, j])) for _, i, j in sorted(pairs)[::-1][:count]
        ]


def forward_jacobian(model: ReplayModel, values: Array, residuals: Array) -> Array:
    """Return the Jacobian (m, n) by forward differences; unknowns of one colour share a perturbed candidate."""
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
    """Minimize the sum of squared residuals of a model within bounds; deviations from priors count as residuals.

    Args:
        model: the residuals.
        start: initial values (n,). Defaults to the start values of the unknowns.
        report: callback with the number of each iteration and the mean squared residual.

    Raises:
        SurefootError: an unknown has equal bounds, or residuals are not finite at the initial values.
    """
    unknowns = tuple(model.unknowns)
    if pinned := next((u for u in unknowns if not u.low < u.high), None):
        raise SurefootError(
            f"{pinned.label} can't be fitted between {pinned.low:g} and {pinned.high:g}; widen [allowed] in robot.toml"
        )
    scale, low, high, starts = (
        np.array([getattr(u, name) for u in unknowns]) for name in ("step", "low", "high", "start")
    )
    with_prior = np.array([i for i, u in enumerate(unknowns) if u.prior is not None], np.int64)
    middle, spread = starts[with_prior], np.array([unknowns[i].prior for i in with_prior], float)
    first = np.clip(starts if start is None else start, low, high)

    def to_values(x: Array) -> Array:
        # The solver keeps bounds only up to rounding errors: without clipping, a friction of -1e-19 is possible.
        values: Array = np.clip(np.asarray(x).T * scale, low, high)
        return values

    def residual(x: Array) -> Array:
        values = to_values(x)
        r = np.concatenate([model.residuals(values), (values[:, with_prior] - middle) / spread], axis=1).T.copy()
        if last_point:
            check_convergence(x, r)
        return r

    def check_convergence(x: Array, r: Array) -> None:
        """End the fit if the next step would hardly reduce the cost; the solver would try ever smaller steps."""
        x_before, r_before, slopes = last_point[0]
        change = slopes @ (x - x_before)
        before = float(np.sum(r_before**2))
        if -float(np.sum((2 * r_before + change) * change)) < MIN_COST_DECREASE * before:
            converged[:] = [x if np.sum(r**2) < before else x_before]
            raise _ConvergedError

    def jacobian(x: Array, r: Array) -> Array:
        values, count = to_values(x)[0], len(r) - len(with_prior)
        full_jacobian = np.zeros((len(r), len(scale)))
        full_jacobian[:count] = forward_jacobian(model, values, r[:count, 0])
        full_jacobian[count + np.arange(len(with_prior)), with_prior] = 1 / spread
        last_point[:] = [(x, r, full_jacobian * scale)]
        return last_point[0][2]

    last_point: list[tuple[Array, Array, Array]] = []
    converged: list[Array] = []
    initial = residual((first / scale)[:, None])
    if not np.isfinite(initial).all():
        raise SurefootError("the simulation diverges with the initial parameters of the fit; check robot and recording")

    def report_iteration(log: list[minimize.IterLog]) -> None:
        if report is not None:
            report(len(log), 2 * float(log[-1].objective) / len(initial))

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
    last_point.clear()
    values = to_values(np.asarray(x).ravel())
    final = residual((values / scale)[:, None])[:, 0]
    count = len(final) - len(with_prior)
    final_jacobian = forward_jacobian(model, values, final[:count])
    prior = np.diag((high - low) ** -2.0)
    prior[with_prior, with_prior] += spread**-2.0
    covariance = _covariance(final_jacobian, final[:count], model.blocks, prior, high - low)
    return Fit(unknowns, values, covariance, final[:count], final_jacobian)


def hold_unidentifiable(
    model: ReplayModel,
    fit: Fit,
    considered: Sequence[Unknown] = (),
    report: Callable[[int, float], None] | None = None,
) -> Fit:
    """Hold the unknowns that the data neither determine nor move at their start values, and fit the others again.

    The errors of held unknowns add to the covariance of the others (consider parameters, Schmidt 1966). With the
    Jacobian J and H = J' J + prior of the free unknowns, the Jacobian J_h of the held ones, and the second moment P of
    the errors of the held ones, the errors of the free unknowns have the covariance C + S P S', S = -H^-1 J' J_h. P is
    the prior covariance, or less where larger errors would show in the residuals.

    Args:
        model: model with the unknowns of the fit, followed by the considered ones.
        fit: fit of the former, with the considered unknowns held.
        considered: unknowns that are never fitted and known only within their priors.
        report: callback as in `fit_least_squares`.
    """
    unknowns = (*fit.unknowns, *considered)
    start = np.array([unknown.start for unknown in fit.unknowns])
    # Unknowns that move away from the prior stay free, even if their uncertainty has not decreased.
    fitted = fit.identifiable | (np.abs(fit.values - start) > fit.deviation)
    free = np.concatenate([fitted, np.zeros(len(considered), np.bool_)])
    if free.all():
        return fit
    values = np.array([unknown.start for unknown in unknowns])
    values[: len(fit.values)] = np.where(fitted, fit.values, start)
    deviation = np.array([unknown.prior_deviation for unknown in unknowns])
    residuals = model.residuals(values[None])[0]
    jacobian = np.empty((len(residuals), len(unknowns)))
    if not free.any():
        jacobian = forward_jacobian(model, values, residuals)
        return Fit(unknowns, values, np.diag(deviation**2.0), residuals, jacobian, ~free, len(considered))
    refit = fit_least_squares(model.restrict(free, values), fit.values[fitted], report)
    values[free], residuals = refit.values, refit.residuals
    jacobian[:, free] = refit.jacobian
    jacobian[:, ~free] = held = forward_jacobian(model.restrict(~free, values), values[~free], residuals)
    # Scaled by the prior deviations, because the unknowns differ by ten orders of magnitude.
    free_scale, held_scale = deviation[free], deviation[~free]
    free_jacobian, held_jacobian = refit.jacobian * free_scale, held * held_scale
    prior = np.array([float(u.prior is not None) for u in refit.unknowns])
    hessian, cross = free_jacobian.T @ free_jacobian + np.diag(prior), free_jacobian.T @ held_jacobian
    sensitivity = -np.linalg.lstsq(hessian, cross, rcond=None)[0]
    start = np.array([unknown.start for unknown in refit.unknowns])
    gradient = free_jacobian.T @ residuals + prior * (refit.values - start) / free_scale
    moment = _held_error_moment(held_jacobian, free_jacobian, sensitivity, residuals, gradient)
    sensitivity = free_scale[:, None] * sensitivity / held_scale
    moment = held_scale[:, None] * moment * held_scale
    covariance = np.empty((len(unknowns), len(unknowns)))
    covariance[np.ix_(free, free)] = refit.covariance + sensitivity @ moment @ sensitivity.T
    covariance[np.ix_(free, ~free)] = sensitivity @ moment
    covariance[np.ix_(~free, free)] = moment @ sensitivity.T
    covariance[np.ix_(~free, ~free)] = moment
    return Fit(unknowns, values, covariance, residuals, jacobian, ~free, len(considered))


def _held_error_moment(
    held_jacobian: Array, free_jacobian: Array, sensitivity: Array, residuals: Array, gradient: Array
) -> Array:
    """Return the second moment (h, h) of the errors of h held unknowns, from their posterior covariance and mean.

    All quantities are scaled by the prior deviations of the unknowns.

    Args:
        held_jacobian: derivatives of the residuals with respect to the held unknowns (m, h).
        free_jacobian: derivatives with respect to the free unknowns (m, n).
        sensitivity: change of the free unknowns per change of the held ones (n, h).
        residuals: residuals at the end of the fit (m,).
        gradient: remaining gradient with respect to the free unknowns (n,), nonzero at bounds.
    """
    precision = held_jacobian.T @ (held_jacobian + free_jacobian @ sensitivity)
    covariance = np.linalg.inv((precision + precision.T) / 2 + np.eye(held_jacobian.shape[1]))
    pull = held_jacobian.T @ residuals + sensitivity.T @ gradient
    mean = np.clip(-covariance @ pull, -MAX_HELD_SHIFT, MAX_HELD_SHIFT)
    return np.asarray(covariance + np.outer(mean, mean), np.float64)


def _covariance(jacobian: Array, residuals: Array, blocks: NDArray[np.int64], prior: Array, width: Array) -> Array:
    """Return the sandwich covariance (n, n) of a fit, robust to residuals that are correlated within time blocks.

    H^-1 (sum over blocks of g g' + prior) H^-1, with a block's gradient g = J' r and H = J' J + prior: White,
    Econometrica 48 (1980), with time blocks as in Newey and West (1987). It stays valid if neighbouring residuals
    correlate, as they do with a slightly wrong model. Its diagonal is at least the diagonal of H^-1, the covariance
    for independent residuals of unit variance. The prior includes the width of the bounds (n,): unknowns that do not
    affect the residuals vary within it and do not reduce the accuracy of the others.
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
