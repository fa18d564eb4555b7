"""Domain randomization: physical parameters are drawn uniformly from ranges.

A range is `[LOW, HIGH]` in the parameter's unit, a list of such pairs with one per motor or axis, or
`{scale: [LOW, HIGH]}` or `{add: [LOW, HIGH]}` relative to the nominal value. Parameters without a range stay nominal.
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
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors, quote, suggest
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS, check_parameter
from surefoot.robot.params_file import read_params
from surefoot.seeding import generator, generators

Interval = tuple[float, float]
"""Minimum and maximum."""
Intervals = Interval | tuple[Interval, ...]
"""One interval, or one per motor or axis."""


@dataclass(frozen=True)
class RelativeRange:
    """A range relative to the nominal value, with either `scale` or `add`. Samples are clipped to the allowed range."""

    scale: Intervals | None = None
    """Factors that multiply the nominal value."""
    add: Intervals | None = None
    """Offsets that are added to the nominal value, in its unit."""
    independent: bool | None = None
    """Whether each motor or axis draws an independent number; defaults to the parameter's declaration."""


ParamRange = Interval | tuple[Interval, ...] | RelativeRange
"""A range: absolute, in the parameter's unit, or relative."""
Ranges = dict[str, ParamRange]
"""Ranges by parameter name."""

_RANGES_FOLDER = Path(__file__).parent / "ranges"
_HIDDEN_RANGES: Ranges = {
    "torque_constant": RelativeRange(scale=(0.9, 1.1)),
    "resistance": RelativeRange(scale=(0.9, 1.1)),
    "servo_latency": (0.001, 0.005),
}
"""Default ranges of hidden parameters that a table of ranges does not name."""
_LAST_OF_MAIN_STREAM = "servo_latency"
"""Last parameter that draws from the start of a robot's random stream. Parameters that were added later draw from
segments far ahead in it, so that the earlier parameters' samples stay the same."""


def _intervals(param_range: ParamRange) -> Array:
    """Return the interval of a range (2,), or one per motor or axis (k, 2)."""
    if isinstance(param_range, RelativeRange):
        return np.array(param_range.add if param_range.scale is None else param_range.scale, float)
    return np.array(param_range, float)


def resolve_range(param_range: ParamRange, nominal: Array) -> tuple[Array, Array]:
    """Return the minimum and maximum of a range, each in the shape of the nominal values, (N,) or (N, k)."""
    low, high = _intervals(param_range).T
    if isinstance(param_range, RelativeRange):
        return (nominal + low, nominal + high) if param_range.scale is None else (nominal * low, nominal * high)
    return np.broadcast_to(low, nominal.shape), np.broadcast_to(high, nominal.shape)


def mean_interval(param_range: ParamRange, nominal: Array) -> Interval:
    """Return the minimum and maximum of a range, averaged over motors or axes if these differ."""
    low, high = (float(end.flat[0] if np.ptp(end) == 0 else end.mean()) for end in resolve_range(param_range, nominal))
    return low, high


def is_independent(name: str, param_range: ParamRange) -> bool:
    """Return whether each motor or axis draws an independent number."""
    if isinstance(param_range, RelativeRange) and param_range.independent is not None:
        return param_range.independent
    return PARAMETERS[name].independent or _intervals(param_range).ndim == 2


def check_ranges(ranges: Mapping[str, ParamRange], robot: RobotDescription | None = None) -> None:
    """Reject invalid ranges, and ranges that the robot does not allow."""
    for name, param_range in ranges.items():
        with prefix_errors("randomize"):
            check_parameter(name, robot)
        _check_range(name, param_range, robot)


def _check_range(name: str, param_range: ParamRange, robot: RobotDescription | None) -> None:
    where, minimum, allowed = f"randomize.{name}", -math.inf, (-math.inf, math.inf)
    if isinstance(param_range, RelativeRange):
        if (param_range.scale is None) == (param_range.add is None):
            raise SurefootError(f"{where} must have one of scale and add")
        where += ".add" if param_range.scale is None else ".scale"
        if param_range.scale is not None:
            minimum = 0.0
            if not PARAMETERS[name].scalable:
                raise SurefootError(f"{where} is given; write add, as {name} is 0 for most robots")
    elif robot is not None:
        allowed = robot.allowed[name]
    intervals = _intervals(param_range)
    pairs = intervals.reshape(-1, 2)
    low, high = pairs.T
    by, unit = ("", "") if robot is None else (robot.name, PARAMETERS[name].unit_for(robot))
    for bad, rule in (
        (~np.isfinite(pairs).all(axis=1), "both bounds must be finite numbers"),
        (low > high, "the lower bound must come first"),
        (low < minimum, "factors are 0 or more"),
        (
            (low < allowed[0]) | (high > allowed[1]),
            f"{by} allows {name} from {allowed[0]:g} to {allowed[1]:g} (unit: {unit})",
        ),
    ):
        if bad.any():
            raise SurefootError(f"{where} is [{low[bad][0]:g}, {high[bad][0]:g}]; {rule}")
    parts = PARAMETERS[name].element_names(robot.motor_names) if robot is not None else ()
    if not len(pairs) or (robot is not None and intervals.ndim == 2 and len(pairs) != len(parts)):
        rule = f"one, or one for each of {', '.join(parts)}" if parts else "one, written [LOW, HIGH]"
        raise SurefootError(f"{where} has {len(pairs)} intervals; it must have {rule}")


def range_names() -> list[str]:
    """Return the names of the built-in tables of ranges, which work for every robot."""
    return sorted(path.stem for path in _RANGES_FOLDER.glob("*.yaml"))


@dataclass(frozen=True)
class _Table:
    randomize: Ranges


def load_ranges(name: str, folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> Ranges:
    """Load a table of ranges for a robot, in the order of `PARAMETERS`.

    Args:
        name: name of a table in the folder `ranges` of the robot, which takes precedence, of a built-in table, or of a
            parameter file in the robot's folder; or the path of a table (.yaml), or of a parameter file (.toml) whose
            confidence intervals are the ranges.
        folder: folder to which the path is relative.
        robot: name or folder of the robot.

    Raises:
        SurefootError: there is no such table, or it has a range that the robot does not allow.
    """
    description = RobotDescription.load(robot)
    own = description.folder
    paths = [own / "ranges" / f"{name}.yaml"]
    if name in range_names():
        paths.append(_RANGES_FOLDER / f"{name}.yaml")
    elif name != "robot":  # whose file is the data sheet
        paths.append(own / f"{name}.toml")
    paths.append(folder / name)
    with describe_os_errors(f"randomize {quote(name)}"):
        path = next((path for path in paths if path.is_file()), None)
    if path is None:
        names = sorted({*range_names(), *(file.stem for file in (own / "ranges").glob("*.yaml"))})
        raise SurefootError(
            f"randomize {quote(name)} does not exist; {suggest(name, names)}, or the path of a YAML file"
        )
    data = _read_intervals(path, description) if path.suffix == ".toml" else read_yaml(path)
    with prefix_errors(path):
        ranges = from_mapping(_Table, {"randomize": _drop_none(data)}).randomize
        check_ranges(ranges, description)
    return {name: ranges[name] for name in PARAMETERS if name in ranges}


def _drop_none(data: Mapping[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in data.items() if value is not None}


def resolve_table(data: dict[str, Any], folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> dict[str, Any]:
    """Return a task's mapping with the table of ranges that `randomize` names replaced by its content.

    `randomize` is the name or path of a table, or a mapping that names it under `table` and has ranges that override
    it; None removes a range.

    Raises:
        SurefootError: there is no such table, or it is invalid.
    """
    ranges = data.get("randomize")
    if isinstance(ranges, str):
        ranges = {"table": ranges}
    if not isinstance(ranges, Mapping):
        return data
    name = ranges.get("table")
    table = {} if name is None else to_mapping(load_ranges(str(name), folder, robot))
    return {**data, "randomize": _drop_none({**table, **ranges, "table": None})}


def _read_intervals(path: Path, robot: RobotDescription) -> dict[str, Any]:
    """Return the 95 % confidence intervals of a parameter file, clipped to the ranges that the robot allows.

    If only some motors or axes have an interval, the others keep their values.
    """
    file, ranges = read_params(path, robot), {}
    intervals = file.tables.get("intervals", {})
    if not isinstance(intervals, Mapping):
        raise SurefootError(f"{path}: intervals is {quote(intervals)}; it must be a table, NAME = [LOW, HIGH]")
    for name, value in intervals.items():
        with prefix_errors(f"{path}: intervals.{name}"):
            try:
                pairs = np.array(value, float)
            except (TypeError, ValueError, OverflowError):
                pairs = np.zeros(0)
            if pairs.shape[-1:] != (2,) or pairs.ndim > 2:
                raise SurefootError("must be a pair of numbers, or a list of such pairs")
        bounded = np.isfinite(pairs).all(axis=-1)
        if name in PARAMETERS and bounded.any():
            values = np.atleast_1d(getattr(file.params, name)[0])
            if pairs.ndim == 2 and len(pairs) == values.size:
                pairs[~bounded] = values[~bounded, None]
            ranges[name] = np.clip(pairs, *robot.allowed[name]).tolist()
    if not ranges:
        raise SurefootError(f"{path}: has no intervals to draw from")
    return ranges


class Randomizer:
    """Sampler of physical parameters at the start of episodes.

    Each robot has its own random stream. Every episode takes the same number of uniform samples in [0, 1) from it,
    whatever the ranges are. Therefore a robot's samples do not depend on the batch, and a parameter's samples do not
    change when another range is removed. Parameters that were added later draw from far ahead in the same stream.

    Args:
        ranges: ranges by parameter name; the robot must allow them.
        robot: the robot's description.
        nominal: values of parameters without a range, one row per robot.
        seed: seed of the streams.
        ramp: number of first episodes of each robot over which the ranges widen from the nominal value; 0: full ranges
            from the start.
    """

    arrays = ("drawn",)
    """Names of the arrays that change over time, which checkpoints store."""

    def __init__(
        self,
        ranges: Mapping[str, ParamRange],
        robot: RobotDescription,
        nominal: PhysicalParams,
        seed: int,
        ramp: int = 0,
    ):
        check_ranges(ranges, robot)
        self.nominal, self._ramp = nominal, ramp
        self.drawn = np.zeros(nominal.num_envs, np.int64)
        """Number of episodes that were drawn for each robot."""
        self.ranges = {name: ranges[name] for name in PARAMETERS if name in ranges}
        self.streams = generators(seed, "randomize", nominal.num_envs)
        self.columns: list[str] = []
        """Names of the columns of `normalize`."""
        self._parts, numbers = _stream_layout(nominal)
        # The K sampled values are all motors and axes of every parameter with a range.
        self._columns: dict[str, slice] = {}
        sample_index, low, high = [np.zeros(0, np.int64)], list[Array](), list[Array]()
        allowed, varying = list[Interval](), list[int]()
        for name, param_range in self.ranges.items():
            ends = [end.reshape(nominal.num_envs, -1) for end in resolve_range(param_range, getattr(nominal, name))]
            independent, size, first = is_independent(name, param_range), ends[0].shape[1], len(allowed)
            index = numbers[name, independent and not PARAMETERS[name].independent]
            sample_index.append(np.broadcast_to(index if independent else index[:1], size))
            low.append(ends[0])
            high.append(ends[1])
            allowed += [robot.allowed[name]] * size
            self._columns[name] = slice(first, first + size)
            if np.ptp(_intervals(param_range), axis=-1).any():
                parts = PARAMETERS[name].element_names(robot.motor_names) if independent else ()
                self.columns += [f"{name}.{part}" for part in parts] or [name]
                varying += range(first, first + (len(parts) or 1))
        self._sample_index, self._varying = np.concatenate(sample_index), np.array(varying, np.int64)
        none = np.zeros((nominal.num_envs, 0))
        self._low, self._high = np.concatenate([none, *low], axis=1), np.concatenate([none, *high], axis=1)
        self._allowed = np.reshape(allowed, (-1, 2)).T

    @property
    def enabled(self) -> bool:
        """Whether any parameter is randomized."""
        return bool(self.ranges)

    def draw(self, index: NDArray[np.int64]) -> PhysicalParams:
        """Draw the parameters for new episodes of the robots at `index`, one row each."""
        unit = np.empty((len(index), self._parts[-1].stop))
        for jumps, part in reversed([*enumerate(self._parts)]):
            if jumps and not np.any((self._sample_index >= part.start) & (self._sample_index < part.stop)):
                continue
            # Segments ahead are relative to the stream's current state, so the stream itself is advanced last.
            size = part.stop - part.start
            unit[:, part] = [_jumped(self.streams[i], jumps).uniform(size=size) for i in index]
        low, high = self._low[index], self._high[index]
        drawn = np.clip(low + (high - low) * unit[:, self._sample_index], *self._allowed)
        params = self.nominal.rows(index)
        self.drawn[index] += 1
        for name, columns in self._columns.items():
            values = getattr(params, name)
            new = drawn[:, columns].reshape(values.shape)
            if self._ramp:
                progress = np.minimum(self.drawn[index] / self._ramp, 1.0).reshape(-1, *[1] * (values.ndim - 1))
                new = values + progress * (new - values)
            values[...] = new
        return params

    def normalize(self, params: PhysicalParams) -> Array:
        """Return the randomized parameters normalized to -1 to 1 (N, P), for a privileged critic."""
        num = params.num_envs
        values = np.concatenate(
            [np.zeros((num, 0)), *(getattr(params, name).reshape(num, -1) for name in self.ranges)], 1
        )
        low, high = self._low[:num, self._varying], self._high[:num, self._varying]
        width = high - low
        return np.divide(2 * values[:, self._varying] - low - high, width, out=np.zeros(width.shape), where=width != 0)


def _stream_layout(nominal: PhysicalParams) -> tuple[list[slice], dict[tuple[str, bool], NDArray[np.int64]]]:
    """Return the segments of an episode's uniform samples, and the indices of each parameter's samples.

    The first segment is the start of the stream. Two are far ahead in it: one for parameters that were added later,
    and one for parameters whose motors or axes share a sample by default, if a range makes them independent (True in
    the key).
    """
    sizes = {name: getattr(nominal, name)[0].size for name in PARAMETERS}
    own = {name: sizes[name] if declared.independent else 1 for name, declared in PARAMETERS.items()}
    names = list(PARAMETERS)
    later = names.index(_LAST_OF_MAIN_STREAM) + 1
    shared = [name for name in names if not PARAMETERS[name].independent]
    parts, sample_index, end = list[slice](), {}, 0
    for part, counts in ((names[:later], own), (names[later:], own), (shared, sizes)):
        start = end
        for name in part:
            sample_index[name, counts is sizes] = np.arange(end, end + counts[name])
            end += counts[name]
        parts.append(slice(start, end))
    return parts, sample_index


def _jumped(stream: np.random.Generator, jumps: int) -> np.random.Generator:
    """Return a copy of a random stream advanced by `jumps` times at least 2^127 numbers; the stream itself for 0."""
    bits = stream.bit_generator
    assert isinstance(bits, np.random.PCG64)
    return np.random.Generator(bits.jumped(jumps)) if jumps else stream


def draw_hidden(robot: RobotDescription, ranges: Mapping[str, ParamRange], seed: int) -> PhysicalParams:
    """Draw one robot's hidden parameters; parameters without a range stay nominal.

    By default the torque constant and resistance vary by 10 % and the servo latency is 1 to 5 ms. The control step is
    never drawn, because it belongs to the control computer.
    """
    nominal = PhysicalParams.nominal(robot)
    hidden = {name: param_range for name, param_range in _HIDDEN_RANGES.items() if PARAMETERS[name].belongs_to(robot)}
    drawn = {}
    for name, param_range in {**hidden, **ranges}.items():
        if name == "control_step":
            continue
        # One stream per name, so that a parameter's sample does not depend on the other ranges.
        values = getattr(nominal, name)
        size = values.shape if is_independent(name, param_range) else 1
        unit = generator(seed, f"hidden {name}").uniform(size=size)
        low, high = resolve_range(param_range, values)
        drawn[name] = np.clip(low + (high - low) * unit, *robot.allowed[name])
    return nominal.with_values(robot, **drawn)
