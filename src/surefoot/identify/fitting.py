"""The one adapter between surefoot's models and the libraries that fit them.

Models go to MuJoCo's least squares (`mujoco.minimize`, the solver of `mujoco.sysid`), which takes residuals of many
candidates at once. What comes back has intervals that count how residuals hang together in time, correlations, and what
the data do not tell.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from mujoco import minimize
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.identify.result import indexed_name
from surefoot.robot import PhysicalParams

SMALL = 1e-5
"""Relative gain that a step must promise, or the fit has settled."""
UNTOLD = 0.7
"""Share of a parameter's prior spread, or of a quarter of its bounds, beyond which the data are said not to tell it."""
ALIKE = 0.8
"""Correlation from which on two numbers can hardly be told apart."""
MAX_STEPS = 25
"""Iterations of a fit, at most."""
BLOCK = 0.25
"""Length [s] of the blocks of time within which residuals may hang together."""
TORQUE_GAIN = "torque_gain"
"""Unknown relative error of a motor's torque report; nothing that a simulation needs."""
GAIN = 0.01
"""Standard deviation of a motor's torque report's relative error: a current sense resistor of 1 %. It is what carries
the scale of all forces: motion alone can't tell a strong motor on heavy legs from a weak one on light ones."""


@dataclass(frozen=True)
class Unknown:
    """A number that is to be found."""

    name: str
    """Physical parameter, or another number that the model needs."""
    start: float
    """Where to begin."""
    low: float
    high: float
    step: float
    """For finite differences: small beside what matters, large beside rounding."""
    index: int | None = None
    """Which motor, or which axis, if it is not one for all."""
    prior: float | None = None
    """Standard deviation around `start` that is known beforehand; None: nothing is."""
    colour: int | None = None
    """Unknowns of one colour touch different residuals, so that all of them are tried at once."""

    @property
    def label(self) -> str:
        """Name with index."""
        return indexed_name(self.name, self.index)


def params_of(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Physical parameters, a row for each candidate (K, n), from one row of `base`."""
    params = base.rows(np.zeros(len(values), np.int64))
    for i, unknown in enumerate(unknowns):
        if unknown.name not in PhysicalParams.names():
            continue
        array = getattr(params, unknown.name)
        if unknown.index is None:
            array.T[...] = values[:, i]
        else:
            array[:, unknown.index] = values[:, i]
    return params


class _SettledError(Exception):
    """Raised from within the solver: its own tolerances are finer than finite differences of a simulation."""


class Model(Protocol):
    """What can be fitted."""

    unknowns: Sequence[Unknown]
    """n numbers to find."""
    blocks: NDArray[np.int64]
    """Number of the block of time of each residual (m,): residuals of different blocks are independent."""

    def residuals(self, values: Array) -> Array:
        """Residuals (K, m) of K candidates (K, n), each in standard deviations of its noise."""
        ...

    def touched(self, unknown: int) -> NDArray[np.bool_] | None:
        """Residuals (m,) that a coloured unknown touches."""
        ...


@dataclass(frozen=True)
class Fit:
    """What was found."""

    unknowns: tuple[Unknown, ...]
    values: Array
    """(n,)"""
    covariance: Array
    """(n, n), of what is not known about the values."""
    residuals: Array
    """(m,), in standard deviations."""

    @property
    def deviation(self) -> Array:
        """Standard deviations (n,)."""
        return np.sqrt(np.diag(self.covariance))

    @property
    def correlation(self) -> Array:
        """Of what is not known about two values (n, n), from -1 to 1."""
        scale = np.maximum(self.deviation, 1e-300)
        return self.covariance / np.outer(scale, scale)

    @property
    def identifiable(self) -> NDArray[np.bool_]:
        """Which unknowns the data tell: what is left open is clearly less than what was open before (n,)."""
        before = np.array([u.prior if u.prior is not None else (u.high - u.low) / 4 for u in self.unknowns])
        return self.deviation < UNTOLD * before

    def strongest_correlations(self, count: int = 5) -> list[tuple[str, str, float]]:
        """Pairs of unknowns that the data can hardly tell apart, strongest first."""
        c = self.correlation
        pairs = [(abs(c[i, j]), i, j) for i in range(len(c)) for j in range(i) if abs(c[i, j]) >= ALIKE]
        return [
            (self.unknowns[j].label, self.unknowns[i].label, float(c[i, j])) for _, i, j in sorted(pairs)[::-1][:count]
        ]


def forward_jacobian(model: Model, values: Array, residuals: Array) -> Array:
    """Derivatives (m, n) by forward differences; unknowns of one colour are tried together."""
    unknowns = model.unknowns
    together: dict[int, list[int]] = {}
    for i, unknown in enumerate(unknowns):
        together.setdefault(-1 - i if unknown.colour is None else unknown.colour, []).append(i)
    groups = list(together.values())
    tried = np.tile(values, (len(groups), 1))
    change = np.array([u.step if v + u.step <= u.high else -u.step for u, v in zip(unknowns, values, strict=True)])
    for row, group in enumerate(groups):
        tried[row, group] += change[group]
    moved = model.residuals(tried)
    jacobian = np.empty((len(residuals), len(unknowns)))
    for row, group in enumerate(groups):
        difference = moved[row] - residuals
        for i in group:
            touched = model.touched(i) if len(group) > 1 else None
            jacobian[:, i] = (difference if touched is None else np.where(touched, difference, 0.0)) / change[i]
    return jacobian


def fit_least_squares(
    model: Model, start: Array | None = None, report: Callable[[int, float], None] | None = None
) -> Fit:
    """Minimize the sum of squared residuals of a model within bounds, priors counted as residuals.

    Args:
        model: what to fit.
        start: values (n,) to begin with; those of the unknowns, if not given.
        tell: is told each iteration's number and mean square.

    Raises:
        SurefootError: residuals that are not finite where the fit begins.
    """
    unknowns = tuple(model.unknowns)
    scale, low, high, starts = (
        np.array([getattr(u, name) for u in unknowns]) for name in ("step", "low", "high", "start")
    )
    known = np.array([i for i, u in enumerate(unknowns) if u.prior is not None], np.int64)
    middle, spread = starts[known], np.array([unknowns[i].prior for i in known], float)
    first = np.clip(starts if start is None else start, low, high)

    def values_of(x: Array) -> Array:
        # The solver's bounds hold to rounding: a friction of -1e-19 is none.
        within: Array = np.clip(np.asarray(x).T * scale, low, high)
        return within

    def residual(x: Array) -> Array:
        values = values_of(x)
        r = np.concatenate([model.residuals(values), (values[:, known] - middle) / spread], axis=1).T.copy()
        if here:
            settle(x, r)
        return r

    def settle(x: Array, r: Array) -> None:
        """End a fit whose next step promises next to nothing; the solver would try ever smaller ones."""
        begun, then, slopes = here[0]
        change = slopes @ (x - begun)
        before = float(np.sum(then**2))
        if -float(np.sum((2 * then + change) * change)) < SMALL * before:
            settled[:] = [x if np.sum(r**2) < before else begun]
            raise _SettledError

    def jacobian(x: Array, r: Array) -> Array:
        values, count = values_of(x)[0], len(r) - len(known)
        whole = np.zeros((len(r), len(scale)))
        whole[:count] = forward_jacobian(model, values, r[:count, 0])
        whole[count + np.arange(len(known)), known] = 1 / spread
        here[:] = [(x, r, whole * scale)]
        return here[0][2]

    here: list[tuple[Array, Array, Array]] = []
    settled: list[Array] = []
    begin = residual((first / scale)[:, None])
    if not np.isfinite(begin).all():
        raise SurefootError("the model breaks down where the fit begins; check robot and recording")

    def each(log: list[minimize.IterLog]) -> None:
        if report is not None:
            report(len(log), 2 * float(log[-1].objective) / len(begin))

    try:
        x, _ = minimize.least_squares(
            first / scale,
            residual,
            [low / scale, high / scale],
            jacobian,
            max_iter=MAX_STEPS,
            verbose=minimize.Verbosity.SILENT,
            iter_callback=each,
            x_scale="jac",
        )
    except _SettledError:
        x = settled[0]
    here.clear()
    values = values_of(np.asarray(x).ravel())
    final = residual((values / scale)[:, None])[:, 0]
    count = len(final) - len(known)
    own = forward_jacobian(model, values, final[:count])
    covariance = _covariance(own, final[:count], model.blocks, known, spread, high - low)
    return Fit(unknowns, values, covariance, final[:count])


def _covariance(
    jacobian: Array, residuals: Array, blocks: NDArray[np.int64], known: NDArray[np.int64], spread: Array, width: Array
) -> Array:
    """H^-1 (sum over blocks of g g' + prior) H^-1, with a block's gradient g = J' r and H = J' J + prior.

    White, Econometrica 48 (1980), by blocks of time as in Newey and West (1987): right also where residuals of
    neighbouring times hang together, as those of a model that is a little wrong do. It is never taken to be less than
    H^-1 itself, which is what independent residuals of unit size give. What the data do not touch is open within the
    bounds' width: as a prior that takes nothing from what they do tell.
    """
    prior = np.diag(width**-2.0)
    prior[known, known] += spread**-2.0
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
