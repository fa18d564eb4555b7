"""The contract of a policy file: everything needed to run it, and to refuse what does not match."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError, choices
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits

KIND = "surefoot-policy"
SCHEMA = 1
METADATA_KEY = "surefoot"
"""Property of the ONNX file that holds the contract."""
RANGES = {
    "control_step": (1e-4, 1.0, "s"),
    "servo_latency": (0.0, 1.0, "s"),
    "control_latency": (0.0, 1.0, "s"),
    "servo_kp": (0.0, 1e4, "1/rad or N m/rad"),
    "servo_kd": (0.0, 1e4, "s/rad or N m s/rad"),
    "voltage": (1.0, 1e3, "V"),
}
"""What is assumed of a robot: least value, greatest value and unit, whatever the robot. Data sheets allow less."""
TASK_RANGES = {
    "fall_angle": (1e-3, math.pi, "rad"),
    "max_steps": (1, 1_000_000, "control steps"),
    "energy_weight": (0.0, 1e6, "m/J"),
}
"""Numbers of the task that a deployment uses."""
_ANGLE = 2 * math.pi


@dataclass(frozen=True)
class ObservationPart:
    """One named part of the observation."""

    name: str
    unit: str
    frame: str


@dataclass(frozen=True)
class Contract:
    """What a policy was made for, its inputs and outputs. Written as JSON at full precision."""

    name: str
    """Name of the policy."""
    robot: str
    """Name of the robot."""
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
    history: int
    """Number of last observations in the policy's input, the newest first."""
    action_names: tuple[str, ...]
    """Names of the feedback's A numbers: COORDINATE.LEG for each coordinate of leg space in turn, or joint.MOTOR."""
    low: tuple[float, ...]
    """Least feedback, one an action: rad, extension of serial legs in lengths of the straight leg."""
    high: tuple[float, ...]
    """Greatest feedback, one an action."""
    reference: dict[str, Any] | None
    """The open loop part of the gait, as the task's reference writes itself; None: zero at all times."""
    rest: tuple[float, ...]
    """Pose of all legs in leg space in which an episode starts."""
    control_step: float
    """Time between two commands [s]."""
    servo_latency: float
    """Assumed age of what the servo sees [s]."""
    control_latency: float
    """Assumed age of what the policy sees [s]."""
    servo_kp: float | tuple[float, ...]
    """Assumed proportional gain, or one for each motor: duty/rad of DC motors, N m/rad of joint actuators."""
    servo_kd: float | tuple[float, ...]
    """Assumed derivative gain, or one for each motor, per speed."""
    voltage: float | None
    """Assumed battery voltage [V]; None for joint actuators."""
    task: dict[str, Any]
    """The task as configuration."""
    config_hash: str
    """SHA-256 of the whole configuration, as `config_hash` makes it."""
    figures: dict[str, Any] = field(default_factory=dict)
    """Figures of the run that made the policy."""
    commands: CommandLimits | None = None
    """Speeds and yaw rates that it can be told to follow, and what means stand; None: it is not steered."""
    version: str = ""
    """Version of surefoot that wrote it."""
    created: str = ""
    """When it was written, ISO 8601; may be empty."""

    def __post_init__(self) -> None:
        """Refuse contradictions, and keep only what JSON can hold."""
        for name in ("task", "figures", "reference"):
            object.__setattr__(self, name, plain(getattr(self, name)))
        motors, actions = len(self.motor_names), len(self.action_names)
        for name, length in (("motor_signs", motors), ("low", actions), ("high", actions)):
            if len(getattr(self, name)) != length:
                raise SurefootError(f"contract: {name} has {len(getattr(self, name))} numbers; it must have {length}")
        legs = len(self.leg_names)
        if not actions or actions not in (2 * legs, 3 * legs, motors):
            raise SurefootError(f"contract: {actions} actions for {legs} legs; a leg has two or three")
        if not self.columns or self.history < 1:
            raise SurefootError("contract: the policy observes nothing; columns and history must be 1 or more")
        if any(abs(sign) != 1 for sign in self.motor_signs):
            raise SurefootError(f"contract: motor_signs is {list(self.motor_signs)}; each must be 1 or -1")
        bounds = zip(self.action_names, self.low, self.high, strict=True)
        for name, low, high in bounds:
            if not -_ANGLE <= low <= high <= _ANGLE:
                raise SurefootError(
                    f"contract: bounds of {name} are [{low:g}, {high:g}]; the lower one first, both within 2 pi rad"
                )
        self._check_ranges()

    def _check_ranges(self) -> None:
        params = self.task.get("params") or {}
        if not isinstance(params, dict):
            raise SurefootError(f"contract: task.params is {params!r:.40}; it must be a table")
        for value in self.rest:
            _check_range("rest", value, -_ANGLE, _ANGLE, "rad")
        for name, limits in RANGES.items():
            if name == "voltage" and self.voltage is None:
                continue
            given = {name: getattr(self, name)}
            if name in params:
                given[f"task.params.{name}"] = params[name]
            for place, values in given.items():
                each = isinstance(values, list | tuple) and name in ("servo_kp", "servo_kd")
                if each and len(values) != len(self.motor_names):
                    raise SurefootError(f"contract: {place} has {len(values)} numbers; a robot has one for each motor")
                for value in values if each else (values,):
                    _check_range(place, value, *limits)
        for name, limits in TASK_RANGES.items():
            if name in self.task:
                _check_range(f"task.{name}", self.task[name], *limits)

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
            SurefootError: no JSON, no contract, one of another schema, or one that does not fit.
        """
        try:
            data = json.loads(text, parse_constant=_finite, parse_float=_finite, parse_int=_whole)
        except ValueError as error:
            raise SurefootError(f"contract: is not JSON: {error}") from error
        if not isinstance(data, dict) or data.pop("kind", None) != KIND:
            raise SurefootError(f"contract: is not a policy's; its kind must be '{KIND}'")
        schema = data.pop("schema", None)
        if schema != SCHEMA:
            raise SurefootError(f"contract: has schema {schema!r}; this surefoot reads schema {SCHEMA}")
        return from_mapping(cls, data, "contract")


def _check_range(name: str, value: Any, low: float, high: float, unit: str) -> None:
    """Refuse what is not a number from `low` to `high`."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
        raise SurefootError(f"contract: {name} is {value!r:.40}; it must be a number from {low:g} to {high:g} {unit}")


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


def check_robot(contract: Contract, robot: RobotDescription) -> None:
    """Refuse to run a policy on a robot that it was not made for.

    Raises:
        SurefootError: another robot, or other legs, motors, order or signs.
    """
    who = f"policy '{contract.name}'"
    if contract.robot != robot.name:
        raise SurefootError(f"{who} is for robot '{contract.robot}'; this robot is '{robot.name}'")
    if contract.leg_names != robot.leg_names:
        raise SurefootError(
            f"{who} has legs {choices(contract.leg_names)}; {robot.name} has {choices(robot.leg_names)}"
        )
    for index, (theirs, ours) in enumerate(zip(contract.motor_names, robot.motor_names, strict=False)):
        if theirs != ours:
            raise SurefootError(f"{who} has '{theirs}' as motor {index}; {robot.name} has '{ours}' there")
    if len(contract.motor_names) != robot.num_motors:
        raise SurefootError(f"{who} has {len(contract.motor_names)} motors; {robot.name} has {robot.num_motors}")
    for name, their_sign, our_sign in zip(robot.motor_names, contract.motor_signs, robot.motor_sign, strict=True):
        if their_sign != our_sign:
            raise SurefootError(f"{who} has sign {their_sign:+g} for {name}; {robot.name} has {our_sign:+g}")
