"""Domain randomization: physical parameters are drawn uniformly from ranges, by the parameter's name.

A range is `[LOW, HIGH]` in the parameter's unit, a list of such pairs with one for each motor or axis, or
`{scale: [LOW, HIGH]}` or `{add: [LOW, HIGH]}` around the nominal value. Parameters without a range stay nominal.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_yaml, to_mapping
from surefoot.errors import SurefootError, choices, located
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS, check_parameter
from surefoot.robot.params_file import read_params
from surefoot.seeding import generator, generators

Interval = tuple[float, float]
"""Least and greatest value."""
Intervals = Interval | tuple[Interval, ...]
"""One interval, or one for each motor or axis."""


@dataclass(frozen=True)
class RelativeRange:
    """A range around the nominal value; it has either `scale` or `add`. Draws are cut to what the robot allows."""

    scale: Intervals | None = None
    """Factors of the nominal value."""
    add: Intervals | None = None
    """What is added to the nominal value, in its unit."""
    independent: bool | None = None
    """Whether each motor or axis draws a number of its own; as the parameter declares, if not given."""


ParamRange = Interval | tuple[Interval, ...] | RelativeRange
Ranges = dict[str, ParamRange]
"""Ranges by the names of parameters."""

_RANGES = Path(__file__).parent / "ranges"
_HIDDEN: Ranges = {
    "torque_constant": RelativeRange(scale=(0.9, 1.1)),
    "resistance": RelativeRange(scale=(0.9, 1.1)),
    "servo_latency": (0.001, 0.005),
}
"""Ranges of hidden parameters beside those of a table."""
_FORMER_NAMES = {
    "mass": "base_mass_ratio and leg_mass_ratio",
    "inertia": "base_inertia_ratio and leg_inertia_ratio",
    "latency": "control_latency",
    "spinning_friction": "contact_spinning_friction",
    "friction": "motor_friction: {scale: [LOW, HIGH], independent: true}",
    "viscous_friction": "motor_viscous_friction: {scale: [LOW, HIGH]}",
    "scaled": "NAME: {scale: [LOW, HIGH]}",
}
"""Keys of earlier versions, and what to write in their place."""
_FIRST_STREAM_ENDS = "servo_latency"
"""The last parameter that draws from a robot's stream itself; later ones draw from parts far ahead in it."""


def interval_of(given: ParamRange, nominal: Array) -> tuple[Array, Array]:
    """Return the least and the greatest value of a range, each in the shape of the nominal value, (N,) or (N, k)."""
    low, high = np.transpose(_intervals(given))
    if isinstance(given, RelativeRange):
        return (nominal + low, nominal + high) if given.scale is None else (nominal * low, nominal * high)
    return np.broadcast_to(low, nominal.shape), np.broadcast_to(high, nominal.shape)


def mean_interval(given: ParamRange, nominal: Array) -> Interval:
    """Return the least and the greatest value of a range, each the mean over motors or axes that differ."""
    low, high = (float(end.flat[0] if np.ptp(end) == 0 else end.mean()) for end in interval_of(given, nominal))
    return low, high


def is_independent(name: str, given: ParamRange) -> bool:
    """Return whether each motor or axis draws a number of its own."""
    if isinstance(given, RelativeRange) and given.independent is not None:
        return given.independent
    return PARAMETERS[name].independent or np.ndim(_intervals(given)) == 2


def _intervals(given: ParamRange) -> Intervals:
    if isinstance(given, RelativeRange):
        return given.scale or given.add or ()
    return given


def check_ranges(ranges: Mapping[str, ParamRange], robot: RobotDescription | None = None) -> None:
    """Refuse ranges that no robot can have, or that a robot's description does not allow."""
    for name, given in ranges.items():
        where = f"randomize.{name}"
        if name in _FORMER_NAMES:
            raise SurefootError(f"{where} is not a physical parameter; write {_FORMER_NAMES[name]}")
        with located("randomize"):
            check_parameter(name, robot)
        if isinstance(given, RelativeRange):
            if (given.scale is None) == (given.add is None):
                raise SurefootError(f"{where} must have one of scale and add")
            where += ".add" if given.scale is None else ".scale"
            if given.scale is not None and not PARAMETERS[name].scalable:
                raise SurefootError(f"{where} is given; write add, as {name} is 0 for most robots")
        pairs = np.reshape(_intervals(given), (-1, 2))
        for low, high in pairs:
            shown = f"{where} is [{low:g}, {high:g}]"
            if not (math.isfinite(low) and math.isfinite(high)):
                raise SurefootError(f"{shown}; both bounds must be finite numbers")
            if low > high:
                raise SurefootError(f"{shown}; the lower bound must come first")
            if isinstance(given, RelativeRange):
                if given.scale is not None and low < 0:
                    raise SurefootError(f"{shown}; factors are 0 or more")
            elif robot is not None:
                least, greatest = robot.allowed[name]
                if not (least <= low and high <= greatest):
                    raise SurefootError(
                        f"{shown}; {robot.name} allows {name} from {least:g} to {greatest:g} "
                        f"(unit: {PARAMETERS[name].unit})"
                    )
        parts = () if robot is None else PARAMETERS[name].parts(robot.motor_names)
        if robot is not None and np.ndim(_intervals(given)) == 2 and len(pairs) != len(parts):
            rule = f"one, or one for each of {', '.join(parts)}" if parts else "one"
            raise SurefootError(f"{where} has {len(pairs)} intervals; it must have {rule}")


def range_names() -> list[str]:
    """Return the names of the tables of ranges that ship with surefoot, each for every robot."""
    return sorted(path.stem for path in _RANGES.glob("*.yaml"))


def load_ranges(name: str, folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> Ranges:
    """Read a table of ranges, and check it against a robot; it is in the order of `PARAMETERS`.

    Args:
        name: of a table that ships, the robot's own if it has one; of an identification that ships with the robot,
            whose intervals are the ranges; or the path of a YAML file.
        folder: what the path is relative to.
        robot: name or folder of the robot.
    """
    description = RobotDescription.load(robot)
    own, identification = description.folder / "ranges" / f"{name}.yaml", description.folder / f"{name}.toml"
    if name in range_names():
        path = own if own.is_file() else _RANGES / f"{name}.yaml"
    elif name != "robot" and identification.is_file():
        path = identification
    else:
        path = folder / name
    if not path.is_file():
        raise SurefootError(
            f"randomize '{name}' does not exist; choices: {choices(range_names())}, or the path of a YAML file"
        )
    if path == identification:
        ranges = _ranges_from_intervals(path, description)
    else:
        data = read_yaml(path)
        with located(path):
            ranges = ranges_from_mapping(data)
    with located(path):
        check_ranges(ranges, description)
    return {name: ranges[name] for name in PARAMETERS if name in ranges}


@dataclass(frozen=True)
class _Table:
    randomize: Ranges


def ranges_from_mapping(data: Mapping[str, Any]) -> Ranges:
    """Return ranges from plain lists and tables; entries that are None are left out."""
    if former := [name for name in data if name in _FORMER_NAMES]:
        check_ranges({name: (0.0, 0.0) for name in former})
    return from_mapping(_Table, {"randomize": _without_none(data)}).randomize


def _without_none(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if value is not None}


def resolve_ranges(data: dict[str, Any], folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> dict[str, Any]:
    """Return a task's table in which `randomize` holds ranges in place of the name or the path of a table.

    It names a table either alone, or under `table` beside ranges that differ from it; None drops a range.

    Raises:
        SurefootError: no such table, or a file that does not fit.
    """
    given = data.get("randomize")
    ranges = {"table": given} if isinstance(given, str) else given
    if not isinstance(ranges, Mapping):
        return data
    ranges = dict(ranges)
    name = ranges.pop("table", None)
    table = {} if name is None else to_mapping(load_ranges(str(name), folder, robot))
    return {**data, "randomize": _without_none({**table, **ranges})}


def _ranges_from_intervals(path: Path, robot: RobotDescription) -> Ranges:
    """Return the 95 % intervals in the file of an identified robot as ranges.

    A motor or axis without an interval keeps its identified value, where others have one.
    """
    file, ranges = read_params(path, robot), Ranges()
    for name, given in file.tables.get("intervals", {}).items():
        if name not in PARAMETERS:
            continue
        with located(f"{path}: intervals.{name}"):
            pairs = _read_pairs(given)
        bounded = np.isfinite(pairs).all(axis=-1, keepdims=True)
        values = getattr(file.params, name)[0]
        if bounded.any():
            if pairs.ndim == 2 and len(pairs) == values.size:
                pairs = np.where(bounded, pairs, values.reshape(-1, 1))
            pairs = np.clip(pairs, *robot.allowed[name])
            ranges[name] = tuple(map(tuple, pairs.tolist())) if pairs.ndim == 2 else tuple(pairs.tolist())
    if not ranges:
        raise SurefootError(f"{path}: has no intervals to draw from")
    return ranges


def _read_pairs(given: Any) -> Array:
    try:
        pairs = np.asarray(given, float)
    except (TypeError, ValueError):
        pairs = np.zeros(0)
    if pairs.shape[-1:] != (2,) or pairs.ndim > 2:
        raise SurefootError("must be a pair of numbers, or a list of such pairs")
    return pairs


class Randomizer:
    """Draws physical parameters for robots whose episodes start.

    Each robot has a stream of random numbers of its own. An episode takes the same count of numbers in [0, 1) from it
    for any ranges, so a robot draws the same in any batch, and a parameter's draws do not change when another range is
    dropped. Parameters that were added later take theirs from far ahead in the same stream.

    Args:
        ranges: by parameter.
        robot: its bounds hold.
        nominal: values of parameters that are not drawn, one row per robot.
        seed: seed of the streams.
    """

    def __init__(self, ranges: Mapping[str, ParamRange], robot: RobotDescription, nominal: PhysicalParams, seed: int):
        check_ranges(ranges, robot)
        self.ranges = {name: ranges[name] for name in PARAMETERS if name in ranges}
        self.nominal, self._robot = nominal, robot
        self.streams = generators(seed, "randomize", nominal.num_envs)
        self._counts = [0, 0, 0]
        self._slots: dict[str, tuple[int, slice]] = {}
        part = 0
        for name, declared in PARAMETERS.items():
            size, given = getattr(nominal, name)[0].size, self.ranges.get(name)
            slot = self._next_slot(part, size if declared.independent else 1)
            own = self._next_slot(2, 0 if declared.independent else size)
            if given is not None and is_independent(name, given):
                self._slots[name] = slot if declared.independent else own
            elif given is not None:
                self._slots[name] = part, slice(slot[1].start, slot[1].start + 1)
            part = 1 if name == _FIRST_STREAM_ENDS else part

    def _next_slot(self, part: int, count: int) -> tuple[int, slice]:
        start = self._counts[part]
        self._counts[part] += count
        return part, slice(start, start + count)

    @property
    def enabled(self) -> bool:
        """Whether anything is drawn at all."""
        return bool(self.ranges)

    def draw(self, index: NDArray[np.int64]) -> PhysicalParams:
        """Return the parameters of new episodes of the robots at `index`, one row each."""
        units = {
            part: np.array([_ahead(self.streams[i], part).uniform(size=self._counts[part]) for i in index])
            # The stream itself comes last: the other parts are counted from where it stands.
            for part in sorted({0, *(part for part, _ in self._slots.values())}, reverse=True)
        }
        params = self.nominal.rows(index)
        for name, (part, slot) in self._slots.items():
            values, unit = getattr(params, name), units[part][:, slot]
            low, high = interval_of(self.ranges[name], values)
            drawn = low + (high - low) * (unit if values.ndim == 2 else unit[:, 0])
            values[...] = np.clip(drawn, *self._robot.allowed[name])
        return params

    @property
    def _varied(self) -> list[str]:
        """Names of the parameters whose ranges have a width."""
        return [name for name, given in self.ranges.items() if np.ptp(_intervals(given), axis=-1).any()]

    @property
    def columns(self) -> list[str]:
        """Names of the numbers of `scaled`, in order."""
        names = []
        for name in self._varied:
            parts = PARAMETERS[name].parts(self._robot.motor_names)
            names += [f"{name}.{part}" for part in parts] if self._is_vector(name) else [name]
        return names

    def _is_vector(self, name: str) -> bool:
        """Return whether a parameter's draw has a number for each motor or axis."""
        return bool(PARAMETERS[name].per) and is_independent(name, self.ranges[name])

    def scaled(self, params: PhysicalParams) -> Array:
        """Return drawn parameters scaled to -1 to 1 (N, P), for a privileged critic."""
        columns = [np.zeros((params.num_envs, 0))]
        for name in self._varied:
            nominal = getattr(self.nominal, name)[: params.num_envs]
            kept = slice(None) if self._is_vector(name) else slice(1)
            values, low, high = (
                array.reshape(params.num_envs, -1)[:, kept]
                for array in (getattr(params, name), *interval_of(self.ranges[name], nominal))
            )
            width = high - low
            columns.append(np.divide(2 * values - low - high, width, out=np.zeros(width.shape), where=width != 0))
        return np.concatenate(columns, axis=1)


def _ahead(stream: np.random.Generator, jumps: int) -> np.random.Generator:
    """Return a stream of random numbers, advanced by `jumps` times 2^127 numbers or more; the stream itself for 0."""
    bits = stream.bit_generator
    assert isinstance(bits, np.random.PCG64)
    return np.random.Generator(bits.jumped(jumps)) if jumps else stream


def draw_hidden(robot: RobotDescription, ranges: Mapping[str, ParamRange], seed: int) -> PhysicalParams:
    """Draw one robot's hidden parameters; those without a range stay nominal.

    Torque constant and resistance are within 10 % of the sheet's, the servo's latency is 1 to 5 ms, unless they have
    ranges. The control step stays, as it belongs to the control computer.
    """
    nominal = PhysicalParams.nominal(robot)
    ranges = {name: given for name, given in _HIDDEN.items() if PARAMETERS[name].belongs_to(robot)} | dict(ranges)
    ranges.pop("control_step", None)
    check_ranges(ranges, robot)
    drawn = {}
    for name, given in ranges.items():
        # A stream for each name: draws of a parameter do not change with the others.
        values = getattr(nominal, name)
        unit = generator(seed, f"hidden {name}").uniform(size=values.shape if is_independent(name, given) else 1)
        low, high = interval_of(given, values)
        drawn[name] = np.clip(low + (high - low) * unit, *robot.allowed[name])
    return nominal.with_values(robot, **drawn)
