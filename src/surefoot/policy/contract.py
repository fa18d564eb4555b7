"""Contract of a policy file: the robot, observation, action, reference, rates and delays that the policy assumes."""

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
"""Metadata key of the ONNX file under which the contract is stored."""
ASSUMED_PARAMS = ("control_step", "servo_latency", "control_latency", "servo_kp", "servo_kd", "voltage")
"""Physical parameters that the contract states."""
MEMORY = "memory"
"""Prefix of the action names that hold the memory of a policy, which it passes to its next control step."""
MAX_MEMORY = 4096
MEMORY_RANGE = 1e6
"""Maximum magnitude of a memory value."""


@dataclass(frozen=True)
class ContractField:
    """Annotation of a task field that belongs to the policy's interface, so that the contract states it."""

    keys: tuple[str, ...] = ()
    """Keys of the field that the contract states; empty: the whole field."""


def contract_fields(kind: type) -> set[str]:
    """Return the names of the fields of a dataclass that are annotated with `ContractField`, as NAME or NAME.KEY."""
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
    """Named part of an observation, with its unit and frame."""

    name: str
    unit: str
    frame: str


GridCoordinate = Annotated[float, Within(-10, 10)]


@dataclass(frozen=True)
class HeightMap:
    """Grid of the height map, in the heading frame at the origin of the base: x forward, y left, z up."""

    ahead: tuple[GridCoordinate, ...]
    """x coordinates of the grid points [m], rising."""
    left: tuple[GridCoordinate, ...]
    """y coordinates of the grid points [m], rising. Heights are ordered by `ahead`, then by `left`."""
    age: Latency
    """Nominal age of the heights in training [s]."""


@dataclass(frozen=True)
class PluginRecord:
    """Plug-in with reward terms or observations that a policy uses."""

    name: str
    """Name of the plug-in's file or entry point."""
    sha256: str
    """SHA-256 of its source."""
    rewards: tuple[str, ...]
    """Reward terms of the policy's task that the plug-in defines."""
    observations: tuple[str, ...]
    """Observations of the policy that the plug-in defines."""


@dataclass(frozen=True)
class Contract:
    """Everything that is needed to run a policy on a robot, stored as JSON at full precision without redundancy.

    The bounds declared here hold for every robot; `deploy.checks.check_policy` compares a contract with a data sheet.
    """

    name: str
    """Name of the policy."""
    robot: str
    """Name of the robot."""
    description: str
    """Name of the robot description if it is built in; empty if the policy file contains the description."""
    motor_names: tuple[str, ...]
    """Names of the motors, in the order of motor angles."""
    motor_signs: tuple[float, ...]
    """Sign of each motor, 1 or -1: joint angle = sign * motor angle."""
    leg_names: tuple[str, ...]
    """Names of the legs, in the order of the actions."""
    observation: tuple[ObservationPart, ...]
    """Parts of an observation, in order."""
    columns: tuple[str, ...]
    """Names of the O values of an observation, in order."""
    history: Annotated[int, Within(1, 100)]
    """Number of stacked observations in the policy's input: the current one and previous ones, newest first."""
    action_names: tuple[str, ...]
    """Names of the A values of the feedback: COORDINATE.LEG for each coordinate of leg space in turn, joint.MOTOR, or
    angle.MOTOR for motor angles. They are followed by memory.K: values that move nothing but are part of the next
    observation, such as the last action in the network's own units or a hidden state. Memory starts at 0."""
    low: Annotated[tuple[float, ...], Within(-MEMORY_RANGE, MEMORY_RANGE)]
    """Minimum feedback, one value per action [rad]; extension of serial legs relative to the straight leg's length."""
    high: Annotated[tuple[float, ...], Within(-MEMORY_RANGE, MEMORY_RANGE)]
    """Maximum feedback, one value per action."""
    reference: dict[str, Any] | None
    """Open-loop part of the gait, as a task's `reference`; None: always zero."""
    rest: tuple[Angle | tuple[Angle, ...], ...]
    """Leg pose in leg space at the start of an episode: one value per coordinate, or one per coordinate and leg."""
    control_step: Annotated[float, Within(1e-4, 1)]
    """Time between two commands [s]."""
    servo_latency: Latency
    """Nominal age of the readings that the servo uses, in training [s]."""
    control_latency: Latency
    """Nominal age of the readings that the policy observes, in training [s]."""
    servo_kp: Gain
    """Proportional gain in training, one value or one per motor: duty/rad (DC motors) or N m/rad (joint actuators)."""
    servo_kd: Gain
    """Derivative gain in training, one value or one per motor: duty s/rad or N m s/rad."""
    voltage: Annotated[float | None, Within(1, 1e3)]
    """Nominal battery voltage in training [V]; None for joint actuators."""
    task: dict[str, Any]
    """Remaining task configuration, for simulation: reward, randomization, terminations."""
    config_hash: str
    """SHA-256 of the whole configuration, see `config_hash`."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Metrics of the training run that produced the policy."""
    commands: CommandLimits | None = None
    """Limits of the commands that the policy follows; None if it takes no commands."""
    height_map: HeightMap | None = None
    """Height map that the policy observes or on which footholds are chosen; None if it needs none."""
    plugins: tuple[PluginRecord, ...] = ()
    """Plug-ins that the policy uses. To run it, their observations must be available, but not their reward terms."""
    version: str = ""
    """Version of surefoot that wrote the file."""
    created: str = ""
    """Date of creation, ISO 8601; may be empty."""

    def __post_init__(self) -> None:
        """Reject values out of bounds, and convert tables to JSON values."""
        for name in ("task", "figures", "reference"):
            object.__setattr__(self, name, to_json_value(getattr(self, name)))
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
                raise SurefootError(
                    f"contract.rest has {len(numbers)} numbers for a coordinate; it must have one, or one per leg"
                )
        if "file" in (self.reference or {}):
            raise SurefootError("contract.reference names a file; a policy must contain the rows of its table")

    @property
    def width(self) -> int:
        """Number of inputs of the policy: O * history."""
        return len(self.columns) * self.history

    def to_json(self) -> str:
        """Return the contract as JSON; `from_json` returns an equal contract."""
        data = {"kind": KIND, "schema": SCHEMA, **to_mapping(self)}
        return json.dumps(data, ensure_ascii=False, allow_nan=False)

    @classmethod
    def from_json(cls, text: str) -> Contract:
        """Read a contract.

        Raises:
            SurefootError: the text is not JSON, not a contract, of another schema, or has invalid keys or values.
        """
        try:
            data = json.loads(text, parse_constant=_parse_float, parse_float=_parse_float, parse_int=_parse_int)
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


def _parse_float(text: str) -> float:
    """Parse a JSON number; NaN and numbers that are too large are errors."""
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"it holds {text:.40}; numbers must be finite")
    return value


def _parse_int(text: str) -> int:
    """Parse a JSON integer that fits into 64 bits."""
    if abs(_parse_float(text)) >= 2.0**64:
        raise ValueError(f"it holds {text:.40}; whole numbers must be below 2^64")
    return int(text)


def to_json_value(value: Any) -> Any:
    """Convert mappings, sequences, arrays, strings and numbers to JSON values; non-finite numbers become None."""
    if isinstance(value, Mapping):
        return {str(key): to_json_value(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        return to_json_value(value.tolist())
    if isinstance(value, list | tuple):
        return [to_json_value(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def config_hash(config: Mapping[str, Any]) -> str:
    """Return the SHA-256 of a configuration in canonical JSON (sorted keys, no whitespace)."""
    text = json.dumps(to_json_value(config), sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()
