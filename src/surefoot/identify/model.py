"""The residual model of all fits: predicted minus recorded readings of candidate parameter sets.

The packages `rack` and `motion` supply `Observations`: functions that predict readings, either by replaying commands in
simulation or from the motor model without a simulation, and the noise of each reading.
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
"""Length [s] of the time blocks within which residuals may be correlated."""
TORQUE_GAIN = "torque_gain"
"""Unknown relative error of a motor's torque report; not a parameter of the simulation."""
GAIN_DEVIATION = 0.01
"""Standard deviation of the relative error of torque reports: a current sense resistor of 1 %. It sets the scale of all
forces, because motion does not distinguish a strong motor on heavy legs from a weak one on light legs."""
_BLOCKS_PER_RECORDING = 1_000_000

Nuisance = Mapping[tuple[str, int | None], Array]
"""Values (K,) of the unknowns that are not physical parameters, by name and index."""


@dataclass(frozen=True)
class Unknown:
    """An unknown of a fit, with its bounds and prior."""

    name: str
    """Name of a physical parameter, or of another number that the model needs."""
    start: float
    low: float
    high: float
    step: float
    """Step of finite differences: small compared with relevant changes, large compared with rounding errors."""
    index: int | None = None
    """Index of the motor, axis or recording that the unknown belongs to; None if it is shared by all."""
    prior: float | None = None
    """Standard deviation of the prior around `start`, or None without a prior."""
    colour: int | None = None
    """Group for the Jacobian: unknowns of one colour affect different residuals, so one candidate perturbs them all."""
    affects: tuple[str, int] | None = None
    """Label and value of the readings that the unknown affects, see `Observations.labels`; None: all readings."""
    motors: tuple[int, ...] = ()
    """Motors that share the value. Defaults to all motors, or to the motor `index`."""
    part_name: str = ""
    """Name of the motors or axis for messages, such as "hip joints"."""

    @property
    def label(self) -> str:
        """Name with the motors or axis, or with the index."""
        return f"{self.name} of {self.part_name}" if self.part_name else indexed_name(self.name, self.index)

    @property
    def prior_deviation(self) -> float:
        """Standard deviation before a fit: the prior's, or a quarter of the width of the bounds without a prior."""
        return self.prior if self.prior is not None else (self.high - self.low) / 4


def candidate_params(base: PhysicalParams, unknowns: Sequence[Unknown], values: Array) -> PhysicalParams:
    """Return the physical parameters of K candidates (K, n): the first row of `base`, with their values inserted."""
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
    """Readings of one recording that a fit compares, as arrays of shape S or of shapes that broadcast to it."""

    errors: Callable[[PhysicalParams, Nuisance], Array]
    """Function that returns predicted minus recorded readings (K, *S) of K candidates."""
    noise: Array
    """Standard deviations of the readings; infinite where readings are not compared."""
    time: Array
    """Time of the readings [s]."""
    labels: Mapping[str, NDArray[np.int64]] = field(default_factory=dict)
    """Integer labels of the readings, such as the motor, by which unknowns name the readings that they affect."""


def _identity(values: Array) -> Array:
    return values


class ReplayModel:
    """Residuals of candidate parameter sets, which `fitting.fit_least_squares` minimizes.

    Args:
        unknowns: parameters to estimate.
        prior: values of all other parameters, one row.
        observations: one entry per recording, with every label that the unknowns refer to.
        batch: number of candidates that are predicted at once. Defaults to all.
        limit: maximum absolute residual; predictions that diverge get this residual.
        make_params: function that returns the parameters of candidates. Defaults to `candidate_params`.
    """

    def __init__(
        self,
        unknowns: Sequence[Unknown],
        prior: PhysicalParams,
        observations: Sequence[Observations],
        batch: int | None = None,
        limit: float = np.inf,
        make_params: Callable[[PhysicalParams, Sequence[Unknown], Array], PhysicalParams] = candidate_params,
    ) -> None:
        self.unknowns: Sequence[Unknown] = tuple(unknowns)
        self._all = self.unknowns
        self._insert_held: Callable[[Array], Array] = _identity
        self.prior, self.observations = prior, observations
        self._batch, self._limit, self._make_params = batch, limit, make_params
        self._compared = [np.isfinite(one.noise) for one in observations]
        self.blocks: NDArray[np.int64] = np.concatenate(
            [
                self._select(k, (one.time / BLOCK).astype(np.int64) + k * _BLOCKS_PER_RECORDING)
                for k, one in enumerate(observations)
            ]
        )
        """Index of the time block of each residual (m,); residuals of different blocks are taken as independent."""

    def _select(self, number: int, values: NDArray[np.int64]) -> NDArray[np.int64]:
        compared = self._compared[number]
        return np.broadcast_to(values, compared.shape)[compared]

    def affected(self, unknown: int) -> NDArray[np.bool_] | None:
        """Return a mask (m,) of the residuals that an unknown affects, or None if it affects all."""
        affects = self.unknowns[unknown].affects
        if affects is None:
            return None
        label, value = affects
        return np.concatenate([self._select(k, one.labels[label]) for k, one in enumerate(self.observations)]) == value

    def nuisance(self, values: Array) -> Nuisance:
        """Return the values of candidates (K, n), including held ones, that are not physical parameters."""
        names = PhysicalParams.names()
        return {(u.name, u.index): values[:, i] for i, u in enumerate(self._all) if u.name not in names}

    def restrict(self, free: NDArray[np.bool_], values: Array) -> ReplayModel:
        """Return the model of the free unknowns only (mask (n,)); the others are held at `values` (n,)."""
        columns, insert_outer = np.flatnonzero(free).tolist(), self._insert_held

        def insert_held(free_values: Array) -> Array:
            all_values = np.tile(values, (len(free_values), 1))
            all_values[:, columns] = free_values
            return insert_outer(all_values)

        restricted = copy(self)
        restricted.unknowns = [self.unknowns[i] for i in columns]
        restricted._insert_held = insert_held
        return restricted

    def residuals(self, values: Array) -> Array:
        """Return the residuals (K, m) of K candidates (K, n), in standard deviations."""
        batch = self._batch or len(values)
        residuals = np.concatenate([self._residuals(values[k : k + batch]) for k in range(0, len(values), batch)])
        if np.isfinite(self._limit):
            np.clip(np.nan_to_num(residuals, nan=self._limit), -self._limit, self._limit, out=residuals)
        return residuals

    def _residuals(self, values: Array) -> Array:
        values = self._insert_held(values)
        params, nuisance = self._make_params(self.prior, self._all, values), self.nuisance(values)
        return np.concatenate(
            [
                (one.errors(params, nuisance) / one.noise)[:, compared]
                for one, compared in zip(self.observations, self._compared, strict=True)
            ],
            axis=1,
        )
