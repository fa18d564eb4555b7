"""The open loop part of a gait: a periodic reference for the pose of every leg in leg space.

L legs have C coordinates each, in the robot's order: (abduction,) swing, extension.

Tan et al. 2018, eq. 3: a(t, o) = reference(t) + feedback(o).
"""

from __future__ import annotations

import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices, quoted
from surefoot.files import check_readable
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task import foot
from surefoot.task.commands import CommandState
from surefoot.task.following import FollowingReference
from surefoot.task.foot import FootReference

_QUANTITIES = ("amplitude", "frequency", "phase", "offset")
FOLLOWING_GAINS = ("stride_gain", "frequency_rise", "turn_gain")
"""Numbers that a reference of kind follow has besides those of its feet."""
# What NumPy raises for files that are empty, cut off or of another kind.
_UNREADABLE = (
    *(OSError, ValueError, KeyError, EOFError, IndexError, TypeError, AttributeError),
    *(zipfile.BadZipFile, zlib.error),
)


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
class SineReference:
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

    def extent(self) -> tuple[tuple[float, float], ...]:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return tuple(wave.extent for wave in self.waves.values())

    def to_dict(self) -> dict[str, Any]:
        """Return everything that `make_reference` needs to make it again, as JSON values."""
        return {"kind": "sine", **{part: wave.to_dict(self.legs) for part, wave in self.waves.items()}}


@dataclass(frozen=True)
class TableReference:
    """A table of leg poses over one period, with straight lines between its rows.

    Row k stands for the time k period / rows; after the last row comes the first.
    """

    legs: tuple[str, ...]
    period: float
    """Time [s] after which the reference repeats."""
    coordinates: tuple[str, ...]
    rows: Array
    """Poses (rows, C, L)."""

    def pose(self, time: ArrayLike, state: CommandState | None = None) -> Array:
        """Return the poses (N, C, L) at times (N,) [s] since the episode's start, whatever the commands."""
        rows = len(self.rows)
        place = np.asarray(time, float) / self.period % 1.0 * rows
        first = np.floor(place).astype(int) % rows
        share = (place - np.floor(place))[..., None, None]
        pose: Array = self.rows[first] + share * (self.rows[(first + 1) % rows] - self.rows[first])
        return pose

    def extent(self) -> tuple[tuple[float, float], ...]:
        """Return the lowest and highest value of each coordinate over all legs and times."""
        return tuple((float(part.min()), float(part.max())) for part in np.moveaxis(self.rows, 1, 0))

    def to_dict(self) -> dict[str, Any]:
        """Return what `make_reference` needs to make it again, as JSON values: rows in place of the file."""
        rows = {
            part: dict(zip(self.legs, self.rows[:, k].T.tolist(), strict=True))
            for k, part in enumerate(self.coordinates)
        }
        return {"kind": "table", "period": self.period, **rows}


Reference = SineReference | TableReference | FootReference | FollowingReference


def make_reference(
    data: Mapping[str, Any] | None, robot: RobotDescription, commands: CommandLimits | None = None
) -> Reference:
    """Make a reference for a robot's legs from configuration.

    Five forms: nothing (zero at all times); `kind: sine` with a table for each coordinate of leg space, each with
    `amplitude`, `frequency`, `phase` and `offset`, each a number or a mapping from leg to number; `kind:
    table` with `period` and either `file` (CSV or NPZ) or the rows themselves under each coordinate; `kind:
    foot` with `foot`: `frequency`, and the quantities of a `FootReference`, each a number or a mapping from leg to
    number; with `relative`, lengths count lengths of the straight leg l, the frequency natural frequencies
    sqrt(g / l) / 2 pi, and `velocity_feedforward` the actuators' k_d / k_p; `kind: follow` with `foot` as before, whose
    stroke is the longest stride, `stride_gain`, `frequency_rise` and, if it is not 1, `turn_gain`, for a robot with
    commands.

    Raises:
        SurefootError: an unknown key or leg, a value that is not a number, a table that does not fit, or a foot out
            of reach.
    """
    legs = robot.leg_names
    data = {"kind": "sine"} if data is None else data
    kind = data.get("kind")
    if kind == "sine":
        _only(data, "reference", ("kind", *robot.coordinates))
        waves = {part: _wave(data.get(part) or {}, f"reference.{part}", legs) for part in robot.coordinates}
        return SineReference(legs, waves)
    if kind == "table":
        return _table(data, legs, robot.coordinates)
    if kind == "foot":
        return _foot(data, robot)
    if kind == "follow":
        if commands is None:
            raise SurefootError("reference.kind is follow; it needs commands with a range, and the task has none")
        named = {"turn_gain": 1.0, **data}
        gains = {name: _number(named.get(name), f"reference.{name}") for name in FOLLOWING_GAINS}
        feet = _foot({key: value for key, value in data.items() if key not in gains}, robot)
        return FollowingReference(robot, feet, commands, **gains)
    raise SurefootError(f"reference.kind is {kind!r}; choices: sine, table, foot, follow")


def _only(data: Mapping[str, Any], where: str, keys: tuple[str, ...]) -> None:
    if not isinstance(data, Mapping):
        raise SurefootError(f"{where} is {quoted(data)}; it must be a table with keys out of: {choices(keys)}")
    for key in data:
        if key not in keys:
            raise SurefootError(f"{where}.{key} is not a key; choices: {choices(keys)}")


def _number(value: Any, where: str) -> float:
    if not is_number(value):
        raise SurefootError(f"{where} is {quoted(value)}; it must be a finite number")
    return float(value)


def _per_leg(given: Any, where: str, legs: tuple[str, ...]) -> Array:
    """Return the numbers (L,) of all legs, given as one number or by leg."""
    if not isinstance(given, Mapping):
        return np.full(len(legs), _number(given, where))
    _only(given, where, legs)
    missing = [leg for leg in legs if leg not in given]
    if missing:
        raise SurefootError(f"{where} has no number for {choices(missing)}; every leg needs one")
    return np.array([_number(given[leg], f"{where}.{leg}") for leg in legs])


def _foot(data: Mapping[str, Any], robot: RobotDescription) -> FootReference:
    where, names = "reference.foot", ("frequency", *foot.QUANTITIES)
    _only(data, "reference", ("kind", "foot", "relative", "velocity_feedforward"))
    given: Any = data.get("foot") or {}
    _only(given, where, names)
    for name in names:
        if name not in given:
            raise SurefootError(f"{where}.{name} is missing; a reference of kind foot needs it")
    values = {name: _per_leg(given[name], f"{where}.{name}", robot.leg_names) for name in foot.QUANTITIES}
    frequency = np.array(_number(given["frequency"], f"{where}.frequency"))
    ahead = _number(data.get("velocity_feedforward", 0.0), "reference.velocity_feedforward")
    if data.get("relative"):
        length = robot.leg_geometry.length
        frequency = frequency * np.sqrt(GRAVITY / length) / (2 * np.pi)
        values |= {name: values[name] * length for name in foot.LENGTHS}
        nominal = robot.nominal_params()
        ahead *= float(np.mean(nominal["servo_kd"]) / np.mean(nominal["servo_kp"]))
    return FootReference(robot.leg_names, robot.leg_geometry, frequency, velocity_feedforward=ahead, **values)


def _wave(data: Mapping[str, Any], where: str, legs: tuple[str, ...]) -> Wave:
    _only(data, where, _QUANTITIES)
    values = {key: _per_leg(data.get(key, 0.0), f"{where}.{key}", legs) for key in _QUANTITIES}
    if np.any(values["frequency"] < 0):
        raise SurefootError(f"{where}.frequency is {values['frequency'].min():g}; it must not be below 0 Hz")
    return Wave(**values)


def _table(data: Mapping[str, Any], legs: tuple[str, ...], coordinates: tuple[str, ...]) -> TableReference:
    _only(data, "reference", ("kind", "period", "file", *coordinates))
    period = _number(data.get("period"), "reference.period")
    if not period > 0:
        raise SurefootError(f"reference.period is {period:g}; it must be over 0 s")
    where = "reference"
    parts: list[Array] = []
    if "file" in data:
        where = str(Path(str(data["file"])))
        parts = _read_table(Path(where), legs, coordinates)
    else:
        for part in coordinates:
            _only(data.get(part, {}), f"reference.{part}", legs)
            try:
                parts.append(np.array([data[part][leg] for leg in legs], dtype=np.float64).T)
            except (KeyError, ValueError, TypeError, OverflowError):
                raise SurefootError(
                    f"reference.{part} must give one list of numbers, equally long, for {choices(legs)}"
                ) from None
    if len({part.shape for part in parts}) != 1 or parts[0].ndim != 2 or len(parts[0]) < 2:
        raise SurefootError(f"{where}: the table has {len(parts[0])} row(s); a periodic reference needs 2 or more")
    bad = ~np.isfinite(np.concatenate(parts, axis=1)).all(axis=1)
    if bad.any():
        raise SurefootError(
            f"{where}: row {int(np.argmax(bad)) + 1} of the table is not finite; every pose must be a number"
        )
    return TableReference(legs, period, coordinates, np.stack(parts, axis=1))


def _read_table(path: Path, legs: tuple[str, ...], coordinates: tuple[str, ...]) -> list[Array]:
    columns = [f"{part}_{leg}" for part in coordinates for leg in legs]
    rule = f"a table has columns {choices(columns)}"
    try:
        check_readable(path)
        if path.suffix == ".npz":
            with np.load(path) as archive:
                table = {name: np.atleast_1d(archive[name]).astype(float) for name in archive.files}
        elif path.suffix == ".csv":
            read = np.genfromtxt(path, delimiter=",", names=True, dtype=float)
            table = {name: np.atleast_1d(read[name]) for name in read.dtype.names or ()}
        else:
            raise SurefootError(f"{path}: is not a .csv or .npz file; {rule}")
    except SurefootError:
        raise
    except _UNREADABLE as error:
        raise SurefootError(f"{path}: can't be read as a table: {' '.join(str(error).split())}; {rule}") from error
    missing = [name for name in columns if name not in table]
    if missing:
        raise SurefootError(f"{path}: has no column {missing[0]}; {rule}")
    lengths = {len(table[name]) for name in columns}
    if len(lengths) != 1:
        raise SurefootError(f"{path}: columns differ in length ({choices(map(str, sorted(lengths)))}); make them equal")
    return np.split(np.stack([table[name] for name in columns], axis=1), len(coordinates), axis=1)
