"""Periodic references that do not depend on commands: sinusoids, tables of poses, and foot trajectories."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.files import check_readable
from surefoot.npz import read_npz
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.foot_paths import FootPaths
from surefoot.task.reference import Extent, Feedforward, Reference


@dataclass(frozen=True)
class Wave:
    """One sinusoid per leg: amplitude sin(2 pi frequency t + phase) + offset; arrays (L,) in rad and Hz."""

    amplitude: Array
    frequency: Array
    phase: Array
    offset: Array

    def at(self, time: ArrayLike) -> Array:
        """Return the values (N, L) [rad] at times (N,) [s]."""
        if not self.amplitude.any():
            return np.broadcast_to(self.offset, (*np.shape(time), len(self.offset)))
        angle = 2 * np.pi * np.asarray(time, float)[..., None] * self.frequency + self.phase
        return self.amplitude * np.sin(angle) + self.offset

    @property
    def extent(self) -> tuple[float, float]:
        """Minimum and maximum over all legs."""
        size = np.abs(self.amplitude)
        return float(np.min(self.offset - size)), float(np.max(self.offset + size))

    def to_dict(self, legs: tuple[str, ...]) -> dict[str, dict[str, float]]:
        """Return each quantity as a mapping from leg to value."""
        return {name: dict(zip(legs, values.tolist(), strict=True)) for name, values in vars(self).items()}


_MAX_CYCLES = 12
"""Maximum number of cycles of the slowest sinusoid in a common period."""


@dataclass(frozen=True)
class SineReference(Reference):
    """Sinusoids in leg space, one per coordinate and leg."""

    legs: tuple[str, ...]
    waves: dict[str, Wave]
    """Sinusoids by coordinate, in the robot's order."""

    @property
    def period(self) -> float | None:
        """Period [s], or None if the reference does not move or has no common period of `_MAX_CYCLES` or fewer."""
        moving = [wave.frequency[wave.amplitude != 0] for wave in self.waves.values()]
        frequencies = np.unique(np.abs(np.concatenate(moving)))
        frequencies = frequencies[frequencies > 0]
        if len(frequencies) == 0:
            return None
        ratios = [Fraction(ratio).limit_denominator(_MAX_CYCLES) for ratio in (frequencies / frequencies[0]).tolist()]
        if not np.allclose(frequencies / frequencies[0], list(map(float, ratios))):
            return None
        return math.lcm(*(ratio.denominator for ratio in ratios)) / float(frequencies[0])

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (N, C, L) at times (N,) [s] since the episode's start; commands have no effect."""
        return np.stack([wave.at(time) for wave in self.waves.values()], axis=-2)

    def extent(self) -> Extent:
        """Return the minimum and maximum of each coordinate over all legs and times."""
        return tuple(wave.extent for wave in self.waves.values())

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values."""
        return {"kind": "sine", **{part: wave.to_dict(self.legs) for part, wave in self.waves.items()}}


@dataclass(frozen=True)
class TableReference(Reference):
    """A table of leg poses over one period, with linear interpolation.

    Row k is the pose at time k * period / rows. The first row follows the last.
    """

    legs: tuple[str, ...]
    duration: float
    """Period of the table [s]."""
    coordinates: tuple[str, ...]
    rows: Array
    """Poses (rows, C, L)."""

    @classmethod
    def from_columns(
        cls, robot: RobotDescription, duration: float, columns: Sequence[Array], where: str
    ) -> TableReference:
        """Return the table made of columns.

        Args:
            robot: the robot.
            duration: period of the table [s].
            columns: poses over time, coordinate by coordinate for all legs.
            where: name of the table for error messages.

        Raises:
            SurefootError: columns that differ in length, are too short, or are not finite.
        """
        lengths = sorted({len(column) for column in columns})
        if len(lengths) != 1:
            raise SurefootError(
                f"{where}: columns differ in length ({choices(map(str, lengths))}); they must have equal lengths"
            )
        if lengths[0] < 2:
            raise SurefootError(f"{where}: the table has {lengths[0]} row(s); a periodic reference needs 2 or more")
        rows = np.stack(columns, axis=1)
        invalid = ~np.isfinite(rows).all(axis=1)
        if invalid.any():
            raise SurefootError(
                f"{where}: row {int(np.argmax(invalid)) + 1} of the table is not finite; every pose must be a number"
            )
        legs, coordinates = robot.leg_names, robot.coordinates
        return cls(legs, duration, coordinates, rows.reshape(len(rows), len(coordinates), len(legs)))

    @property
    def period(self) -> float:
        """Period [s]."""
        return self.duration

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (N, C, L) at times (N,) [s] since the episode's start; commands have no effect."""
        rows = len(self.rows)
        position = np.asarray(time, float) / self.period % 1.0 * rows
        first = np.floor(position).astype(int) % rows
        fraction = (position - np.floor(position))[..., None, None]
        return np.asarray(self.rows[first] + fraction * (self.rows[(first + 1) % rows] - self.rows[first]))

    def extent(self) -> Extent:
        """Return the minimum and maximum of each coordinate over all legs and times."""
        return tuple((float(part.min()), float(part.max())) for part in np.moveaxis(self.rows, 1, 0))

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values, with `rows` instead of `file`."""
        rows = {
            part: dict(zip(self.legs, self.rows[:, k].T.tolist(), strict=True))
            for k, part in enumerate(self.coordinates)
        }
        return {"kind": "table", "period": self.period, "rows": rows}


def _column(name: str, values: NDArray[Any]) -> Array:
    if values.ndim > 1 or values.dtype.kind not in "biuf":
        raise ValueError(f"{name} has shape {values.shape} and type {values.dtype}; it must be a row of numbers")
    return np.atleast_1d(values).astype(float)


def read_columns(path: Path, names: list[str]) -> list[Array]:
    """Read the named columns of a CSV or NPZ file.

    Raises:
        SurefootError: a file of another kind, one that can't be read, or a missing column.
    """
    rule = f"a table has columns {choices(names)}"
    if path.suffix not in (".csv", ".npz"):
        raise SurefootError(f"{path}: is not a .csv or .npz file; {rule}")
    try:
        if path.suffix == ".npz":
            table = {name: _column(name, values) for name, values in read_npz(path).items() if name in names}
        else:
            check_readable(path)
            read = np.genfromtxt(path, delimiter=",", names=True, dtype=float)
            table = {name: np.atleast_1d(read[name]) for name in read.dtype.names or ()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:  # e.g. an empty file
        raise SurefootError(f"{path}: can't be read as a table: {' '.join(str(error).split())}; {rule}") from error
    for name in names:
        if name not in table:
            raise SurefootError(f"{path}: has no column {name}; {rule}")
    return [table[name] for name in names]


@dataclass(frozen=True)
class FootReference(Reference):
    """Periodic foot trajectories."""

    feet: FootPaths
    feedforward: Feedforward = Feedforward()

    @property
    def period(self) -> Any:
        """Period [s]: a number, or (N,) if robots have different trajectories."""
        return self.feet.period

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the leg poses (N, C, L) at times (N,) [s] since the episode's start, with zero abduction."""
        return self.feet.pose(time)

    def extent(self) -> Extent:
        """Return the minimum and maximum of each coordinate over all legs and times."""
        return self.feet.extent

    def to_dict(self) -> dict[str, Any]:
        """Return the equivalent configuration as JSON values."""
        feedforward = {"velocity_feedforward": self.feedforward.velocity} if self.feedforward.velocity else {}
        return {"kind": "foot", "foot": self.feet.to_dict(), **feedforward}
