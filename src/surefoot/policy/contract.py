"""The contract of a policy file: robot, observation, action, reference, rates and delays of the policy."""

from __future__ import annotations

import hashlib
import json
import math
import typing
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

import numpy as np

from surefoot.configuration import Within, check_bounds, from_mapping, to_mapping
from surefoot.errors import SurefootError
from surefoot.robot.commands import CommandLimits

KIND = "surefoot-policy"
SCHEMA = 2
METADATA_KEY = "surefoot"
"""Property of the ONNX file that holds the contract."""
ASSUMED_PARAMS = ("control_step", "servo_latency", "control_latency", "servo_kp", "servo_kd", "voltage")
"""Physical parameters that the contract states."""
MEMORY = "memory"
"""Prefix of the names of numbers that a policy keeps from one control step to the next."""
MAX_MEMORY = 4096
MEMORY_RANGE = 1e6
"""Greatest number that a policy keeps."""


@dataclass(frozen=True)
class ContractField:
    """Mark of a task's field that is the policy's interface: the contract states it itself, or some keys of it."""

    keys: tuple[str, ...] = ()
    """Keys of the table that are stated; none: the whole field is."""


def contract_fields(kind: type) -> set[str]:
    """Return the dotted names of a dataclass's fields, and of keys in them, that are marked as `ContractField`."""
    hints = typing.get_type_hints(kind, include_extras=True)
    marks = [(name, mark) for name, hint in hints.items() for mark in getattr(hint, "__metadata__", ())]
    stated = [(name, mark.keys) for name, mark in marks if isinstance(mark, ContractField)]
    return {part for name, keys in stated for part in ([f"{name}.{key}" for key in keys] or [name])}


_TURN = Within(-2 * math.pi, 2 * math.pi)
Angle = Annotated[float, _TURN]
Latency = Annotated[float, Within(0, 1)]
Gain = Annotated[float | tuple[float, ...], Within(0, 1e4)]


@dataclass(frozen=True)
class ObservationPart:
    """One named part of the observation."""

    name: str
    unit: str
    frame: str


GridCoordinate = Annotated[float, Within(-10, 10)]


@dataclass(frozen=True)
class HeightMap:
    """The grid of the map of heights, in the heading frame at the base's origin: x forward, y left, z up."""

    ahead: tuple[GridCoordinate, ...]
    """Places of its points ahead [m], rising."""
    left: tuple[GridCoordinate, ...]
    """Places of its points to the left [m], rising. Heights have an order: by `ahead`, then by `left`."""
    age: Latency
    """Nominal age of the heights in training [s]."""


@dataclass(frozen=True)
class PluginRecord:
    """A plug-in whose terms a policy uses."""

    name: str
    """Name of its file, or of its entry point."""
    sha256: str
    """Digest of its source."""
    rewards: tuple[str, ...]
    """Reward terms of the policy's task that are its."""
    observations: tuple[str, ...]
    """Observations of the policy that are its."""


@dataclass(frozen=True)
class Contract:
    """What a policy needs to run on a robot. Written as JSON at full precision. Each fact stands in one place.

    Bounds of the numbers here hold for every robot; `deploy.checks.check_policy` compares it with a data sheet.
    """

    name: str
    """Name of the policy."""
    robot: str
    """Name of the robot."""
    description: str
    """Name of the robot's description, if it ships; empty, if the policy file carries it."""
    motor_names: tuple[str, ...]
    """Motors, in the order of motor angles."""
    motor_signs: tuple[float, ...]
    """Joint angle = sign * motor angle; 1 or -1 for each motor."""
    leg_names: tuple[str, ...]
    """Legs, in the order of the actions."""
    observation: tuple[ObservationPart, ...]
    """Parts of an observation, in order."""
    columns: tuple[str, ...]
    """Names of an observation's O numbers, in order."""
    history: Annotated[int, Within(1, 100)]
    """Number of last observations in the policy's input, the newest first."""
    action_names: tuple[str, ...]
    """Names of the feedback's A numbers: COORDINATE.LEG for each coordinate of leg space in turn, joint.MOTOR, or
    angle.MOTOR for the motors' angles themselves. After them memory.K: numbers that move nothing, which the next
    observation has, such as the last action in the network's own units or a hidden state; 0 at first."""
    low: Annotated[tuple[float, ...], Within(-MEMORY_RANGE, MEMORY_RANGE)]
    """Least feedback, one an action: rad; extension of serial legs in lengths of the straight leg."""
    high: Annotated[tuple[float, ...], Within(-MEMORY_RANGE, MEMORY_RANGE)]
    """Greatest feedback, one an action."""
    reference: dict[str, Any] | None
    """The open loop part of the gait, as a task's `reference`; None: zero at all times."""
    rest: tuple[Angle | tuple[Angle, ...], ...]
    """Pose of the legs in leg space in which an episode starts: each coordinate of all legs or of each."""
    control_step: Annotated[float, Within(1e-4, 1)]
    """Time between two commands [s]."""
    servo_latency: Latency
    """Nominal age of the servo's readings in training [s]."""
    control_latency: Latency
    """Nominal age of the policy's readings in training [s]."""
    servo_kp: Gain
    """Proportional gain in training, of all motors or of each: duty/rad of DC motors, N m/rad of joint actuators."""
    servo_kd: Gain
    """Derivative gain in training, of all motors or of each: per speed in rad/s."""
    voltage: Annotated[float | None, Within(1, 1e3)]
    """Nominal battery voltage in training [V]; None for joint actuators."""
    task: dict[str, Any]
    """The rest of the task, for simulation: reward, randomization, ends of an episode."""
    config_hash: str
    """SHA-256 of the whole configuration, as `config_hash` makes it."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Figures of the run that made the policy."""
    commands: CommandLimits | None = None
    """Limits of the commands that the policy follows; None: it follows none."""
    height_map: HeightMap | None = None
    """The map of heights that the policy observes, or on which footholds are chosen; None: it needs none."""
    plugins: tuple[PluginRecord, ...] = ()
    """Plug-ins whose terms it uses. The observations must be there to run it, the reward terms need not."""
    version: str = ""
    """Version of surefoot that wrote it."""
    created: str = ""
    """When it was written, ISO 8601; may be empty."""

    def __post_init__(self) -> None:
        """Refuse numbers out of bounds; keep only what JSON can hold."""
        for name in ("task", "figures", "reference"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        for k, name in enumerate(self.action_names):
            if not name.startswith(f"{MEMORY}."):
                for end in ("low", "high"):
                    numbers = getattr(self, end)
                    if k < len(numbers):
                        _TURN.check(f"contract.{end}[{k}]", numbers[k])
        check_bounds(self, "contract")
        motors, actions = len(self.motor_names), len(self.action_names)
        lengths = {"motor_signs": motors, "low": actions, "high": actions, "servo_kp": motors, "servo_kd": motors}
        for name, length in lengths.items():
            numbers = getattr(self, name)
            if isinstance(numbers, tuple) and len(numbers) != length:
                raise SurefootError(f"contract.{name} has {len(numbers)} numbers; it must have {length}")
        for name, low, high in zip(self.action_names, self.low, self.high, strict=True):
            if low > high:
                raise SurefootError(
                    f"contract: bounds of {name} are [{low:g}, {high:g}]; the lower bound must come first"
                )
        for numbers in self.rest:
            if isinstance(numbers, tuple) and len(numbers) != len(self.leg_names):
                raise SurefootError(f"contract.rest has {len(numbers)} numbers in one; it must have one or one a leg")
        if "file" in (self.reference or {}):
            raise SurefootError("contract.reference names a file; a policy holds the rows of its table itself")

    @property
    def width(self) -> int:
        """Numbers that the policy takes: O for each observation of the history."""
        return len(self.columns) * self.history

    def to_json(self) -> str:
        """Return the contract as JSON; `from_json` returns an equal contract."""
        data = {"kind": KIND, "schema": SCHEMA, **to_mapping(self)}
        return json.dumps(data, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Contract:
        """Read a contract.

        Raises:
            SurefootError: no JSON, no contract, one of another schema, or other keys and values than a contract has.
        """
        try:
            data = json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_whole)
        except ValueError as error:
            raise SurefootError(f"contract: is not JSON: {error}") from error
        if not isinstance(data, dict) or data.pop("kind", None) != KIND:
            raise SurefootError(f"contract: its kind must be '{KIND}'")
        schema = data.pop("schema", None)
        if schema != SCHEMA:
            raise SurefootError(
                f"contract: has schema {schema!r:.40}; this surefoot reads schema {SCHEMA}: use the version that wrote "
                "it, or train the policy again"
            )
        return from_mapping(cls, data, "contract")


def _finite(text: str) -> float:
    """Return a number of JSON; NaN and numbers that are too large are errors."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"it holds {text:.40}; numbers must be finite")
    return value


def _whole(text: str) -> int:
    """Return an integer of JSON of at most 64 bits, as arrays hold."""
    if abs(_finite(text)) >= 2.0**64:
        raise ValueError(f"it holds {text:.40}; whole numbers must be below 2^64")
    return int(text)


def plain(value: Any) -> Any:
    """Return tables, lists, text and numbers as JSON values; a number that is not finite becomes None."""
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def config_hash(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a configuration as canonical JSON: keys sorted, no blanks."""
    text = json.dumps(plain(config), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
