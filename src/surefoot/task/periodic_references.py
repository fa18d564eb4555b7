"""References of time alone: sinusoids, tables of poses, and foot trajectories in the legs' planes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

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
    """Sinusoids, one a leg: amplitude sin(2 pi frequency t + phase) + offset; arrays (L,), rad and Hz."""

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
        """Lowest and highest value over all legs."""
        size = np.abs(self.amplitude)
        return float(np.min(self.offset - size)), float(np.max(self.offset + size))

    def to_dict(self, legs: tuple[str, ...]) -> dict[str, dict[str, float]]:
        """Return each quantity as a mapping from leg to number."""
        return {name: dict(zip(legs, values.tolist(), strict=True)) for name, values in vars(self).items()}


@dataclass(frozen=True)
class SineReference(Reference):
    """One sinusoid for each coordinate of every leg."""

    legs: tuple[str, ...]
    waves: dict[str, Wave]
    """By coordinate, in order."""

    @property
    def period(self) -> float | None:
        """Time [s] after which the reference repeats; None if it does not move or has no common period."""
        moving = [wave.frequency[wave.amplitude != 0] for wave in self.waves.values()]
        frequencies = np.unique(np.abs(np.concatenate(moving)))
        frequencies = frequencies[frequencies > 0]
        if len(frequencies) == 0:
            return None
        ratios = frequencies / frequencies[0]
        return float(1 / frequencies[0]) if np.allclose(ratios, np.round(ratios)) else None

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start, whatever the commands."""
        return np.stack([wave.at(time) for wave in self.waves.values()], axis=-2)

    def extent(self) -> Extent:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return tuple(wave.extent for wave in self.waves.values())

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values."""
        return {"kind": "sine", **{part: wave.to_dict(self.legs) for part, wave in self.waves.items()}}


@dataclass(frozen=True)
class TableReference(Reference):
    """A table of leg poses over one period, with straight lines between its rows.

    Row k stands for the time k period / rows; after the last row comes the first.
    """

    legs: tuple[str, ...]
    duration: float
    """Time [s] in which the table is gone through once."""
    coordinates: tuple[str, ...]
    rows: Array
    """Poses (rows, C, L)."""

    @classmethod
    def from_columns(
        cls, robot: RobotDescription, duration: float, columns: Sequence[Array], where: str
    ) -> TableReference:
        """Return the table of columns of poses, of each coordinate for every leg in turn; `where` is its name."""
        lengths = sorted({len(column) for column in columns})
        if len(lengths) != 1:
            raise SurefootError(f"{where}: columns differ in length ({choices(map(str, lengths))}); make them equal")
        if lengths[0] < 2:
            raise SurefootError(f"{where}: the table has {lengths[0]} row(s); a periodic reference needs 2 or more")
        rows = np.stack(columns, axis=1)
        bad = ~np.isfinite(rows).all(axis=1)
        if bad.any():
            raise SurefootError(
                f"{where}: row {int(np.argmax(bad)) + 1} of the table is not finite; every pose must be a number"
            )
        legs, coordinates = robot.leg_names, robot.coordinates
        return cls(legs, duration, coordinates, rows.reshape(len(rows), len(coordinates), len(legs)))

    @property
    def period(self) -> float:
        """Time [s] after which the reference repeats."""
        return self.duration

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start, whatever the commands."""
        rows = len(self.rows)
        place = np.asarray(time, float) / self.period % 1.0 * rows
        first = np.floor(place).astype(int) % rows
        share = (place - np.floor(place))[..., None, None]
        return np.asarray(self.rows[first] + share * (self.rows[(first + 1) % rows] - self.rows[first]))

    def extent(self) -> Extent:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return tuple((float(part.min()), float(part.max())) for part in np.moveaxis(self.rows, 1, 0))

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values: rows instead of the file."""
        rows = {
            part: dict(zip(self.legs, self.rows[:, k].T.tolist(), strict=True))
            for k, part in enumerate(self.coordinates)
        }
        return {"kind": "table", "period": self.period, "rows": rows}


def read_columns(path: Path, names: list[str]) -> list[Array]:
    """Return the named columns of a CSV or NPZ file."""
    rule = f"a table has columns {choices(names)}"
    if path.suffix not in (".csv", ".npz"):
        raise SurefootError(f"{path}: is not a .csv or .npz file; {rule}")
    try:
        if path.suffix == ".npz":
            table = {name: np.atleast_1d(values).astype(float) for name, values in read_npz(path).items()}
        else:
            check_readable(path)
            read = np.genfromtxt(path, delimiter=",", names=True, dtype=float)
            table = {name: np.atleast_1d(read[name]) for name in read.dtype.names or ()}
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:  # Of empty and other files.
        raise SurefootError(f"{path}: can't be read as a table: {' '.join(str(error).split())}; {rule}") from error
    for name in names:
        if name not in table:
            raise SurefootError(f"{path}: has no column {name}; {rule}")
    return [table[name] for name in names]


@dataclass(frozen=True)
class FootReference(Reference):
    """Foot trajectories that repeat."""

    feet: FootPaths
    feedforward: Feedforward = Feedforward()

    @property
    def period(self) -> Any:
        """Time [s] after which the reference repeats, a number; (N,) where robots have paths of their own."""
        return self.feet.period

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start: no abduction, whatever the state."""
        return self.feet.pose(time)

    def extent(self) -> Extent:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return self.feet.extent

    def to_dict(self) -> dict[str, Any]:
        """Return the configuration that makes it again, as JSON values."""
        ahead = {"velocity_feedforward": self.feedforward.velocity} if self.feedforward.velocity else {}
        return {"kind": "foot", "foot": self.feet.to_dict(), **ahead}
