"""Physical parameters that are drawn uniformly from ranges: an episode's, and a robot's that differs from its sheet.

The rows are those of Tan et al. 2018, table I, and a few further uncertain parameters. A range is the least
and the greatest value; a row without a range keeps its nominal value.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import SurefootError, choices, located
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params
from surefoot.seeding import generator, generators

Range = tuple[float, float] | None

_RANGES = Path(__file__).parent / "ranges"
RELATIVE_RANGE = 0.1
"""How far hidden torque constant and resistance may be from the sheet's, of their value."""
SERVO_LATENCY = (0.001, 0.005)
"""Hidden age of what the servo sees [s], least and greatest."""


@dataclass(frozen=True)
class Row:
    """The parameters that one row of a table of ranges sets."""

    params: tuple[str, ...]
    """Physical parameters; each draws a number of its own from the row's range."""
    each: bool = False
    """Whether each motor, or each axis of the IMU, draws a number of its own too."""
    apart: bool = False
    """Whether it draws from a separate part of the stream, so that the draws of other rows do not depend on it."""
    how: Literal["set", "times", "plus"] = "set"
    """Whether a number that is drawn is the parameter, or a factor of its nominal value, or is added to that."""

    def applied(self, nominal: Array, drawn: Array, allowed: tuple[float, float]) -> Array:
        """Return parameters for their nominal values and the numbers that were drawn.

        What is drawn around nominal values is cut to what the robot allows.
        """
        if self.how == "set":
            return drawn
        return np.clip(nominal * drawn if self.how == "times" else nominal + drawn, *allowed)

    def taken_back(self, nominal: Array, values: Array) -> Array:
        """Return the numbers that were drawn for parameters; 1 for factors of nothing."""
        if self.how == "times":
            return np.divide(values, nominal, out=np.ones_like(values), where=nominal != 0)
        return values - nominal if self.how == "plus" else values


def _row(*params: str, each: bool = False, apart: bool = False, how: Literal["set", "times", "plus"] = "set") -> Any:
    """Declare a row without a range."""
    return field(default=None, metadata={"row": Row(params, each, apart, how)})


def _around(param: str, each: bool = False, how: Literal["times", "plus"] = "times") -> Any:
    """Declare a row around the nominal values, without a range."""
    return _row(param, each=each, apart=True, how=how)


@dataclass(frozen=True)
class RandomizeConfig:
    """Ranges (least, greatest) from which every episode draws its physical parameters; None: nominal.

    New rows go to the end and draw apart, so that the others' draws stay what they were.
    """

    mass: Range = _row("base_mass_ratio", "leg_mass_ratio")
    """Mass to the description's; base and legs draw their own."""
    motor_friction: Range = _row("motor_friction")
    """Coulomb friction of the motors [N m]."""
    inertia: Range = _row("base_inertia_ratio", "leg_inertia_ratio")
    """Rotational inertia to the description's; base and legs draw their own."""
    motor_strength: Range = _row("motor_strength", each=True)
    """Motor torque to the model's; each motor draws its own."""
    control_step: Range = _row("control_step")
    """Time between two commands of the policy [s]."""
    latency: Range = _row("control_latency")
    """Age of the readings that the policy sees [s]."""
    voltage: Range = _row("voltage")
    """Battery voltage [V]."""
    contact_friction: Range = _row("contact_friction")
    """Lateral friction coefficient of the feet."""
    imu_bias: Range = _row("imu_bias", each=True)
    """Constant error of roll and of pitch, each its own [rad]."""
    imu_noise: Range = _row("imu_noise")
    """Standard deviation of the noise on roll and pitch [rad]."""
    torque_constant: Range = _row("torque_constant")
    """Torque constant K_t [N m/A]; not in the paper's table."""
    resistance: Range = _row("resistance")
    """Armature resistance R [Ohm]; not in the paper's table."""
    servo_latency: Range = _row("servo_latency")
    """Age of what the servo sees [s]; not in the paper's table."""
    contact_stiffness: Range = _row("contact_stiffness", apart=True)
    """Stiffness of the feet against the ground [N/m]; not in the paper's table."""
    spinning_friction: Range = _row("contact_spinning_friction", apart=True)
    """Spinning friction of the feet [m]; not in the paper's table."""
    knee_friction: Range = _row("knee_friction", apart=True)
    """Coulomb friction of the knees [N m]; Bullet only, not in the paper's table."""
    knee_play: Range = _row("knee_play", apart=True)
    """Radial clearance of the pins that close the loops [m]; Bullet only, not in the paper's table."""
    floor_unevenness: Range = _row("floor_unevenness", apart=True)
    """Standard deviation of the floor's height [m]; Bullet only, not in the paper's table."""
    imu_mount: Range = _row("imu_mount", each=True, apart=True)
    """Roll, pitch and yaw of the IMU against the base, each its own [rad]; not in the paper's table."""
    servo_kp: Range = _around("servo_kp")
    """Proportional gain, to the nominal one; this and all that follow are not in the paper's table."""
    servo_kd: Range = _around("servo_kd")
    """Derivative gain, to the nominal one."""
    friction: Range = _around("motor_friction", each=True)
    """Coulomb friction of the motors, to the nominal one; each motor draws its own."""
    viscous_friction: Range = _around("motor_viscous_friction")
    """Viscous friction of the motors, to the nominal one."""
    load_friction: Range = _around("load_friction")
    """Friction of joint actuators that grows with their torque, to the nominal one."""
    speed_filter: Range = _around("speed_filter")
    """Time constant of the joint actuators' filter on the speed, to the nominal one."""
    rotor_inertia: Range = _around("rotor_inertia")
    """Inertia of the joint actuators' rotors, to the nominal one."""
    torque_limit: Range = _around("torque_limit")
    """Greatest torque of joint actuators, to the nominal one."""
    motor_offset: Range = _around("motor_offset", each=True, how="plus")
    """Error of the encoders, less the nominal one [rad]; each motor draws its own."""
    base_offset: Range = _around("base_offset", each=True, how="plus")
    """Centre of mass of the base, less the nominal one [m]; each axis draws its own."""
    imu_yaw_drift: Range = _row("imu_yaw_drift", apart=True)
    """Bias of the gyro about z, with which the IMU's yaw drifts [rad/s]."""

    def __post_init__(self) -> None:
        """Refuse reversed ranges and bounds that are not finite."""
        for name, (low, high) in self.ranges.items():
            if not (math.isfinite(low) and math.isfinite(high)):
                raise SurefootError(f"randomize.{name} is [{low:g}, {high:g}]; both bounds must be finite numbers")
            if low > high:
                raise SurefootError(f"randomize.{name} is [{low:g}, {high:g}]; the lower bound must come first")

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Rows that have a range, and their ranges."""
        given = {item.name: getattr(self, item.name) for item in fields(self)}
        return {name: value for name, value in given.items() if value is not None}


ROWS: dict[str, Row] = {item.name: item.metadata["row"] for item in fields(RandomizeConfig)}
"""Every row that can be drawn, by name."""
_AROUND = [row for row in ROWS.values() if row.how != "set"]


def range_names() -> list[str]:
    """Return the names of the tables of ranges that ship with surefoot, each for every robot."""
    return sorted(path.stem for path in _RANGES.glob("*.yaml"))


def load_ranges(name: str, folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> RandomizeConfig:
    """Read a table of ranges.

    Rows under `scaled` are multiples of the robot's nominal values, of its motors' mean.

    Args:
        name: of a table that ships, the robot's own if it has one; or the path of a YAML file.
        folder: what the path is seen from.
        robot: name or folder of the robot.
    """
    own = RobotDescription.find_folder(robot) / "ranges" / f"{name}.yaml"
    path = own if name in range_names() and own.is_file() else _RANGES / f"{name}.yaml"
    identified = RobotDescription.find_folder(robot) / f"{name}.toml"
    if name not in range_names() and name != "robot" and identified.is_file():
        return _ranges_of_intervals(identified, RobotDescription.load(robot))
    if name not in range_names():
        path = folder / name
    if not path.is_file():
        raise SurefootError(
            f"randomize '{name}' does not exist; choices: {choices(range_names())}, or the path of a YAML file"
        )
    data = read_yaml(path)
    with located(path):
        scaled = data.pop("scaled", None) or {}
        config = from_mapping(RandomizeConfig, data, "randomize")
        if not scaled:
            return config
        factors, nominal = (
            from_mapping(RandomizeConfig, scaled, "scaled"),
            RobotDescription.load(robot).nominal_params(),
        )
        values = {row: float(np.mean(nominal[ROWS[row].params[0]])) for row in factors.ranges}
        return replace(
            config, **{row: (low * values[row], high * values[row]) for row, (low, high) in factors.ranges.items()}
        )


def _ranges_of_intervals(path: Path, robot: RobotDescription) -> RandomizeConfig:
    """Return the ranges of an identified robot: the 95 % intervals in the file of its parameters.

    A row that all motors or axes share has the widest of their intervals, around the value of each.
    """
    found = read_params(path, robot)
    intervals, ranges = found.tables.get("intervals", {}), dict[str, tuple[float, float]]()
    for row, what in ROWS.items():
        # What one row sets and another draws around is drawn around.
        names = [name for name in what.params if name in intervals]
        if not names or (what.how == "set" and any(names[0] in other.params for other in _AROUND)):
            continue
        with located(f"{path}: intervals.{names[0]}"):
            pairs = np.reshape(_pairs(intervals[names[0]]), (-1, 2))
        value = np.atleast_1d(getattr(found.params, names[0])[0])
        kept = np.isfinite(pairs).all(axis=1)
        if len(pairs) not in (1, len(value)) or not kept.any():
            continue
        drawn = np.array([what.taken_back(value, np.broadcast_to(end, value.shape)) for end in pairs.T])
        kept = np.broadcast_to(kept, value.shape)
        ranges[row] = (float(drawn[0][kept].min()), float(drawn[1][kept].max()))
    if not ranges:
        raise SurefootError(f"{path}: has no intervals to draw from")
    return RandomizeConfig(**ranges)


def _pairs(given: Any) -> Array:
    try:
        pairs = np.asarray(given, float)
    except (TypeError, ValueError):
        pairs = np.zeros(0)
    if pairs.shape[-1:] != (2,) or pairs.ndim > 2:
        raise SurefootError("must be a pair of numbers, or a list of such pairs")
    return pairs


def check_ranges(config: RandomizeConfig, robot: RobotDescription) -> None:
    """Refuse ranges outside what the robot's description allows."""
    for row, given in config.ranges.items():
        for name in ROWS[row].params:
            low, high = robot.allowed[name]
            if (kind := PhysicalParams.actuator_kind(name)) not in ("", robot.actuator.kind):
                rule = f"it belongs to motors of kind {kind}, those of {robot.name} are {robot.actuator.kind}"
                raise SurefootError(f"randomize.{row} is given; {rule}")
            if ROWS[row].how != "set":
                if ROWS[row].how == "times" and given[0] < 0:
                    raise SurefootError(f"randomize.{row} is [{given[0]:g}, {given[1]:g}]; factors are 0 or more")
                continue  # what is drawn is cut to what the robot allows
            if not (low <= given[0] and given[1] <= high):
                raise SurefootError(
                    f"randomize.{row} is [{given[0]:g}, {given[1]:g}]; "
                    f"{robot.name} allows {name} from {low:g} to {high:g} (unit: {PhysicalParams.unit(name)})"
                )


class Randomizer:
    """Draws physical parameters for robots whose episodes start.

    Each robot has a stream of its own, and an episode takes as many numbers from it for any ranges: a robot
    draws the same in any batch, and a row's draws do not change when another row is dropped. Rows that draw apart take
    theirs from far ahead in the same stream: it need not be saved twice.

    Args:
        config: the ranges, within what the robot allows.
        robot: its bounds hold.
        nominal: values of parameters that are not drawn, one row per robot.
        seed: the one seed.
    """

    def __init__(self, config: RandomizeConfig, robot: RobotDescription, nominal: PhysicalParams, seed: int) -> None:
        check_ranges(config, robot)
        self.ranges, self.nominal, self._motor_names = config.ranges, nominal, robot.motor_names
        self._allowed = robot.allowed
        self.streams = generators(seed, "randomize", nominal.num_envs)
        self._places: list[tuple[str, str, slice]] = []
        self._numbers = {False: 0, True: 0}
        for row, what in ROWS.items():
            for name in what.params:
                start = self._numbers[what.apart]
                self._numbers[what.apart] += getattr(nominal, name)[0].size if what.each else 1
                self._places.append((name, row, slice(start, self._numbers[what.apart])))

    @property
    def enabled(self) -> bool:
        """Whether anything is drawn at all."""
        return bool(self.ranges)

    def draw(self, index: NDArray[np.int64]) -> PhysicalParams:
        """Return the parameters of new episodes of the robots at `index`, one row each."""
        apart = np.empty((len(index), self._numbers[True]))
        if any(ROWS[row].apart for row in self.ranges):
            apart[:] = [_far_ahead(self.streams[i]).uniform(size=self._numbers[True]) for i in index]
        together = np.array([self.streams[i].uniform(size=self._numbers[False]) for i in index])
        params = self.nominal.rows(index)
        for name, row, place in self._places:
            if row in self.ranges:
                low, high = self.ranges[row]
                values, unit = getattr(params, name), apart if ROWS[row].apart else together
                drawn = low + (high - low) * unit[:, place]
                numbers = drawn if values.ndim == 2 else drawn[:, 0]
                values[...] = ROWS[row].applied(values, numbers, self._allowed[name])
        return params

    @property
    def columns(self) -> list[str]:
        """Names of the numbers of `scaled`, in order."""
        angles = ("roll", "pitch", "yaw")
        parts = {"imu_bias": angles[:2], "imu_mount": angles, "base_offset": ("x", "y", "z")}
        names = []
        for name, row in self._varying():
            names += [f"{name}.{part}" for part in parts.get(name, self._motor_names)] if ROWS[row].each else [name]
        return names

    def _varying(self) -> Iterator[tuple[str, str]]:
        """Yield each drawn parameter, and its row, whose range has a width."""
        for name, row, _ in self._places:
            if row in self.ranges and self.ranges[row][1] > self.ranges[row][0]:
                yield name, row

    def scaled(self, params: PhysicalParams) -> Array:
        """Return drawn parameters scaled to -1 to 1 (N, P), for a privileged critic."""
        columns = []
        for name, row in self._varying():
            low, high = self.ranges[row]
            nominal = getattr(self.nominal, name)[: params.num_envs]
            values = ROWS[row].taken_back(nominal, getattr(params, name)).reshape(params.num_envs, -1)
            if not ROWS[row].each:
                values = values[:, :1]
            columns.append((2 * values - low - high) / (high - low))
        return np.concatenate(columns, axis=1) if columns else np.zeros((params.num_envs, 0))


def _far_ahead(stream: np.random.Generator) -> np.random.Generator:
    """Return the same stream of random numbers, advanced by 2^127 numbers or more, further than it is ever drawn."""
    bits = stream.bit_generator
    assert isinstance(bits, np.random.PCG64)
    return np.random.Generator(bits.jumped())


def with_ranges(data: dict[str, Any], folder: Path = Path(), robot: str | Path = DEFAULT_ROBOT) -> dict[str, Any]:
    """Return a task's table with `randomize` as a table where it names a table of ranges or a file in a folder.

    It names one either alone, or under `table` beside rows that differ from it.

    Raises:
        SurefootError: no such table, or a file that does not fit.
    """
    given = data.get("randomize")
    rows = dict(given) if isinstance(given, Mapping) else {"table": given}
    name = rows.pop("table", None)
    if not isinstance(name, str):
        return data
    return {**data, "randomize": {**vars(load_ranges(name, folder, robot)), **rows}}


def draw_hidden(robot: RobotDescription, ranges: Mapping[str, tuple[float, float]], seed: int) -> PhysicalParams:
    """Draw one robot's hidden parameters, uniformly; motors have their own strengths, axes of the IMU their own biases.

    Args:
        robot: whose sheet they are drawn around; it must allow the ranges.
        ranges: least and greatest value by row of `ROWS`, as of Tan et al. 2018, table I. K_t and R are drawn within
            `RELATIVE_RANGE`, the servo's latency from `SERVO_LATENCY`, unless they have ranges; others stay nominal.
        seed: decides everything.
    """
    nominal = PhysicalParams.nominal(robot)
    known: dict[str, tuple[float, float]] = {"servo_latency": SERVO_LATENCY}
    if robot.actuator.kind == "dc":
        for name in ("torque_constant", "resistance"):
            value = getattr(robot.dc_motor, name)
            known[name] = (value * (1 - RELATIVE_RANGE), value * (1 + RELATIVE_RANGE))
    known |= ranges
    known.pop("control_step", None)  # the time between commands is the host's
    drawn = {}
    for row, (low, high) in known.items():
        for name in ROWS[row].params:
            # A stream for each name: what one row draws does not change with the others.
            size = np.shape(getattr(nominal, name)) if ROWS[row].each else 1
            numbers = low + (high - low) * generator(seed, f"hidden {name}").uniform(size=size)
            drawn[name] = ROWS[row].applied(getattr(nominal, name), numbers, robot.allowed[name])
    return nominal.with_values(robot, **drawn)
