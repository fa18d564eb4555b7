"""The model of all fits: recorded readings beside those that candidates have in their place.

The folders rack, traces and logs supply `Observations`: functions that predict readings, by replay or by the
motors' law alone, and the noise of each reading.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.identify.result import indexed_name
from surefoot.robot import PhysicalParams

BLOCK = 0.25
"""Length [s] of the blocks of time within which residuals may correlate."""
TORQUE_GAIN = "torque_gain"
"""Unknown relative error of a motor's torque report; no parameter of a simulation."""
GAIN_DEVIATION = 0.01
"""Standard deviation of that error: a current sense resistor of 1 %. It gives the scale of all forces: motion alone
does not distinguish a strong motor on heavy legs from a weak one on light legs."""
_BLOCKS_PER_RECORDING = 1_000_000

Nuisance = Mapping[tuple[str, int | None], Array]
"""Values (K,) of unknowns that are no physical parameters, by name and index."""


@dataclass(frozen=True)
class Unknown:
    """A number to estimate."""

    name: str
    """Physical parameter, or another number that the model needs."""
    start: float
    low: float
    high: float
    step: float
    """Of finite differences: small beside what matters, large beside rounding."""
    index: int | None = None
    """Motor, axis or recording, if the number is not one for all."""
    prior: float | None = None
    """Standard deviation of the prior around `start`; None: there is no prior."""
    colour: int | None = None
    """Unknowns of one colour affect different residuals, so that one candidate has all their steps."""
    affects: tuple[str, int] | None = None
    """Label and value of the readings that it affects, see `Observations.labels`; None: all."""
    motors: tuple[int, ...] = ()
    """Motors that share the number; all of them, or the one of `index`, if left out."""
    whose: str = ""
    """The motors or axis for people, such as "hip joints"."""

    @property
    def label(self) -> str:
        """Name with the motors or axis, or the index."""
        return f"{self.name} of {self.whose}" if self.whose else indexed_name(self.name, self.index)

    @property
    def prior_deviation(self) -> float:
        """Standard deviation before a fit: that of the prior, or a quarter of the bounds."""
        return self.prior if self.prior is not None else (self.high - self.low) / 4


def candidate_params(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Return one row of `base` for each of K candidates (K, n), with their physical parameters."""
    params = base.rows(np.zeros(len(values), np.int64))
    for unknown, column in zip(unknowns, values.T, strict=True):
        if unknown.name in PhysicalParams.names():
            array = getattr(params, unknown.name)
            if unknown.index is None:
                array.T[...] = column
            else:
                array[:, unknown.index] = column
    return params


@dataclass(frozen=True, eq=False)
class Observations:
    """Readings of one recording, as arrays of a common shape S, or of shapes that broadcast to it."""

    errors: Callable[[PhysicalParams, Nuisance], Array]
    """Returns predicted less recorded readings (K, *S) of K candidates."""
    noise: Array
    """Standard deviations; infinite where readings are not compared."""
    time: Array
    """[s]"""
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """Numbers that say which unknowns affect a reading, such as its motor."""


def _identity(values: Array) -> Array:
    return values


class ReplayModel:
    """Residuals of candidates against observations: what `fitting.fit_least_squares` fits.

    Args:
        unknowns: what is to be estimated.
        prior: all other parameters, one row.
        observations: of one recording each; with all labels that unknowns name.
        batch: number of candidates that are predicted at once; all, if not given.
        limit: greatest residual; it stands for predictions that diverge, too.
        params_of: returns the parameters of candidates, as `candidate_params` does.
    """

    def __init__(
        self,
        unknowns: Sequence[Unknown],
        prior: PhysicalParams,
        observations: Sequence[Observations],
        batch: int | None = None,
        limit: float = np.inf,
        params_of: Callable[[PhysicalParams, Sequence[Unknown], Array], PhysicalParams] = candidate_params,
    ) -> None:
        self.unknowns: Sequence[Unknown] = tuple(unknowns)
        self._all = self.unknowns
        self._complete: Callable[[Array], Array] = _identity
        self.prior, self.observations = prior, observations
        self._batch, self._limit, self._params_of = batch, limit, params_of
        self._compared = [np.isfinite(one.noise) for one in observations]
        self.blocks: NDArray[np.int64] = np.concatenate(
            [
                self._select(k, (one.time / BLOCK).astype(np.int64) + k * _BLOCKS_PER_RECORDING)
                for k, one in enumerate(observations)
            ]
        )
        """Number of the block of time of each residual (m,): residuals of different blocks are independent."""

    def _select(self, number: int, values: NDArray[np.int64]) -> NDArray[np.int64]:
        compared = self._compared[number]
        return np.broadcast_to(values, compared.shape)[compared]

    def affected(self, unknown: int) -> NDArray[np.bool_] | None:
        """Return which residuals (m,) an unknown affects; None: all."""
        affects = self.unknowns[unknown].affects
        if affects is None:
            return None
        label, value = affects
        return np.concatenate([self._select(k, one.labels[label]) for k, one in enumerate(self.observations)]) == value

    def nuisance(self, values: Array) -> Nuisance:
        """Return the values of candidates (K, n), held ones included, that are no physical parameters."""
        names = PhysicalParams.names()
        return {(u.name, u.index): values[:, i] for i, u in enumerate(self._all) if u.name not in names}

    def holding(self, free: NDArray[np.bool_], values: Array) -> ReplayModel:
        """Return the model of some of the unknowns (n,); the others keep their values (n,)."""
        columns, before = np.flatnonzero(free).tolist(), self._complete

        def complete(some: Array) -> Array:
            whole = np.tile(values, (len(some), 1))
            whole[:, columns] = some
            return before(whole)

        held = copy(self)
        held.unknowns = [self.unknowns[i] for i in columns]
        held._complete = complete
        return held

    def residuals(self, values: Array) -> Array:
        """Return the residuals (K, m) of K candidates (K, n), in standard deviations."""
        batch = self._batch or len(values)
        residuals = np.concatenate([self._residuals(values[k : k + batch]) for k in range(0, len(values), batch)])
        if np.isfinite(self._limit):
            np.clip(np.nan_to_num(residuals, nan=self._limit), -self._limit, self._limit, out=residuals)
        return residuals

    def _residuals(self, values: Array) -> Array:
        values = self._complete(values)
        params, nuisance = self._params_of(self.prior, self._all, values), self.nuisance(values)
        return np.concatenate(
            [
                (one.errors(params, nuisance) / one.noise)[:, compared]
                for one, compared in zip(self.observations, self._compared, strict=True)
            ],
            axis=1,
        )
