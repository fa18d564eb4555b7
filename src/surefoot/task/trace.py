"""The record of an episode, the same from a simulation, the robot emulator and the robot.

Speed, power, return, footfalls and the reality gap are all computed from this record by the same functions,
so all worlds are measured alike. numpy only: the robot's computer writes it too.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import Within, from_mapping, to_mapping
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.npz import pack_bytes, pop_bytes, pop_meta, read_npz, write_npz
from surefoot.policy.contract import MEMORY
from surefoot.robot import ROBOT, RobotDescription, carried_robot

ENERGY_WEIGHT = 0.008  # w of the paper's reward, the same in all its experiments


@dataclass(frozen=True)
class TraceMeta:
    """Entries of every trace's meta."""

    robot: str
    world: str
    control_step: Annotated[float, Within(0, 3600, above=True)]
    """s"""
    leg_names: tuple[str, ...]
    motor_names: tuple[str, ...]
    observation_names: tuple[str, ...]
    ended: Literal["time", "fall", "fault", "stopped"]
    schema: Literal[1] = 1
    policy: str = ""
    seed: int | None = None
    params: dict[str, Any] = field(default_factory=dict)
    """Physical parameters: each a number, or a list where motors or axes have their own."""
    energy_weight: Annotated[float, Within(0, 1e6)] | None = ENERGY_WEIGHT
    """Weight w of energy [m/J] of a task of the paper's reward, progress less w times energy; None: another reward."""
    progress_limit: Annotated[float, Within(-1e6, 1e6)] | None = None
    """Speed up to which progress counts [m/s]; None: any."""
    max_steps: Annotated[int, Within(1, 1e9)] = 1000
    gait_period: Annotated[float, Within(1e-3, 1e3)] | None = None
    """Of the reference [s]; None: it has none."""
    terrain: str = "flat"
    """What the robot stood on: flat or KIND:SIZE, such as stairs:0.10, made with `seed`; or a name of what a trace does
    not hold."""

    def __post_init__(self) -> None:
        """Refuse names that repeat."""
        for name in ("leg_names", "motor_names", "observation_names"):
            if len(set(getattr(self, name))) != len(getattr(self, name)):
                raise SurefootError(f"meta.{name} are {choices(getattr(self, name))}; names must not repeat")


LOG = "log"
"""World of a trace that was imported from somebody's log, whose rows are as the log has them: commands are sent at the
time of their row, readings are taken right after, times may repeat, and everything but time may be NaN. Its `params`
are the gains that came with the commands, and with `read_at_row` readings were taken exactly at the times of rows."""
_OPTIONAL = ("command", "push_force_world", "reward", "motor_saturation", "motor_heat")
"""Arrays that are not in the file where all is NaN."""
_NO_ARRAYS = {"meta", "robot_archive"}
# Arrays that may be NaN: a robot without motion capture or foot switches does not measure them.
_MAY_BE_NAN = frozenset(
    {"base_position_world", "base_quat_world", "foot_contact", "foot_position_world", "true_motor_angle", *_OPTIONAL}
)


def _absent() -> Array:
    return np.empty(0)


@dataclass(frozen=True, eq=False)
class EpisodeTrace:
    """An episode of T control steps of a robot with M motors, L legs and O observations.

    Arrays are float64 and read-only. World and base frames: x forward, y left, z up.
    """

    time: Array
    """(T,) s since the episode's start at which the readings of each control step were taken: at its end."""
    base_position_world: Array
    """(T+1, 3) m. Row 0 is the start, row k is after control step k. NaN where unknown."""
    base_quat_world: Array
    """(T+1, 4) unit quaternion w, x, y, z, rows as above. NaN where unknown."""
    roll_pitch_yaw: Array
    """(T, 3) rad as the IMU measured it, with its delay and noise."""
    angular_velocity_base: Array
    """(T, 3) rad/s in the base frame, as the IMU measured it."""
    motor_angle: Array
    """(T, M) rad."""
    motor_velocity: Array
    """(T, M) rad/s."""
    motor_torque: Array
    """(T, M) N m at the end of the control step."""
    observation: Array
    """(T, O) inputs of the policy, in the units of its contract."""
    feedback: Array
    """(T, A), the policy's part of the action: each coordinate of leg space in turn, of every leg (A = 2L or 3L; rad,
    extension of serial legs in lengths of the straight leg), or an angle [rad] of every motor; then what the policy
    keeps, one number for each observation `memory`."""
    target: Array
    """(T, M) rad motor angles sent to the servos."""
    energy: Array
    """(T,) J, integral over the control step of |tau . qdot| at servo rate."""
    foot_contact: Array
    """(T, L) fraction of the control step's servo steps in which the foot touched, 0 to 1. NaN where unknown."""
    foot_position_world: Array = field(default_factory=_absent)
    """(T, L, 3) m; NaN where unknown, all NaN when left out."""
    true_motor_angle: Array = field(default_factory=_absent)
    """(T, M) rad at the end of the control step, without the readings' delay; NaN as above."""
    command: Array = field(default_factory=_absent)
    """(T, 3) speeds forward and to the left [m/s] and yaw rate [rad/s] that were commanded; all NaN without commands,
    and then not in the file."""
    push_force_world: Array = field(default_factory=_absent)
    """(T, 3) N that pushed the base during the control step; all NaN where pushes are unknown or there are none, and
    then not in the file."""
    reward: Array = field(default_factory=_absent)
    """(T,) reward of the control step by the task's own terms; all NaN where it is not known, as on a robot, and then
    not in the file."""
    motor_saturation: Array = field(default_factory=_absent)
    """(T, M) fraction of the control step's servo steps in which the motor was at its limit, 0 to 1: DC motors at full
    duty, joint actuators at the torque that there is at their speed. NaN as above."""
    motor_heat: Array = field(default_factory=_absent)
    """(T, M) J that each motor's windings turned into heat during the control step. NaN as above."""
    meta: dict[str, Any] = field(default_factory=dict)
    """The entries of `TraceMeta`, and others that JSON can hold."""
    robot_archive: bytes = b""
    """The robot's folder as `RobotDescription.archive` has it; empty for a robot that ships."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "meta", _checked_meta(self.meta))
        for name, shape in _shapes(np.size(self.time), np.shape(self.feedback), self.meta).items():
            value = getattr(self, name)
            if name in ("foot_position_world", "true_motor_angle", *_OPTIONAL) and np.size(value) == 0:
                value = np.full(shape, np.nan)
            may_be_nan = name in _MAY_BE_NAN or (self.imported and name != "time")
            object.__setattr__(self, name, _checked_array(name, value, shape, may_be_nan))
        if self.imported:
            if np.any(np.diff(self.time) < 0.0):
                raise SurefootError("trace: time must not go backwards")
        elif self.time[0] <= 0.0 or np.any(np.diff(self.time) <= 0.0):
            raise SurefootError("trace: time must be above 0 s at the first step and strictly increasing")
        if np.any(self.energy < 0.0):
            raise SurefootError(f"trace: energy {self.energy.min():.3g} J must be 0 or above: it sums |tau . qdot|")
        for name in ("foot_contact", "motor_saturation"):
            if np.any((getattr(self, name) < 0.0) | (getattr(self, name) > 1.0)):
                raise SurefootError(f"trace: {name} is a fraction of the control step: 0 to 1")
        norms = np.linalg.norm(self.base_quat_world, axis=1)
        if np.any(np.abs(norms - 1.0) > 1e-3):
            raise SurefootError("trace: base_quat_world must hold unit quaternions w, x, y, z (or NaN)")

    @property
    def imported(self) -> bool:
        """Whether it is a log that surefoot did not record; see `LOG`."""
        return bool(self.meta["world"] == LOG)

    @property
    def num_steps(self) -> int:
        """Number of control steps T."""
        return len(self.time)

    @property
    def duration(self) -> float:
        """Length of the episode in s."""
        return float(self.time[-1])

    @property
    def fell(self) -> bool:
        """Whether the episode ended because the robot fell."""
        return bool(self.meta["ended"] == "fall")

    @property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs in the order of `foot_contact` and `feedback`."""
        return tuple(self.meta["leg_names"])

    def save(self, path: str | Path) -> Path:
        """Write the trace to an .npz file; the file appears whole or not at all."""
        path = Path(path)
        if path.suffix != ".npz":
            raise SurefootError(f"trace file {path}: the name must end in .npz")
        arrays = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _NO_ARRAYS}
        for name in _OPTIONAL:
            if np.isnan(arrays[name]).all():
                del arrays[name]
        write_npz(path, arrays | pack_bytes(ROBOT, self.robot_archive), self.meta)
        return path

    @classmethod
    def load(cls, path: str | Path) -> EpisodeTrace:
        """Read a trace; refuse a file that is missing, cut off, damaged, not a trace, or of another schema."""
        path = Path(path)
        with prefix_errors(f"trace file {path}"):
            arrays = read_npz(path)
            if (meta := pop_meta(arrays)) is None:
                raise SurefootError("not an episode trace: it has no meta")
            try:
                meta = _checked_meta(meta)  # Another schema may have other arrays.
            except RecursionError:
                raise SurefootError("not an episode trace: its meta is nested too deep") from None
            archive = pop_bytes(arrays, ROBOT)
            if odd := {f.name for f in fields(cls)} - _NO_ARRAYS ^ {*arrays, *_OPTIONAL}:
                raise SurefootError(f"not an episode trace: missing or unknown {choices(sorted(odd))}")
            return cls(meta=meta, robot_archive=archive, **arrays)

    def load_robot(self) -> RobotDescription:
        """Return the robot that the trace carries, else the one of its name that ships.

        Raises:
            SurefootError: neither is there, or the robot is invalid.
        """
        return carried_robot(self.robot_archive, self.meta["robot"])


def _shapes(steps: int, feedback: tuple[int, ...], meta: dict[str, Any]) -> dict[str, tuple[int, ...]]:
    """Return the shape of each array of a trace of `steps` control steps, whose `feedback` has that shape."""
    legs, motors = len(meta["leg_names"]), len(meta["motor_names"])
    memory = sum(str(name).startswith(f"{MEMORY}.") for name in meta["observation_names"])
    actions = feedback[-1] if feedback and feedback[-1] - memory in (3 * legs, motors) else 2 * legs + memory
    return {
        "time": (steps,),
        "base_position_world": (steps + 1, 3),
        "base_quat_world": (steps + 1, 4),
        **dict.fromkeys(("roll_pitch_yaw", "angular_velocity_base"), (steps, 3)),
        **dict.fromkeys(("motor_angle", "motor_velocity", "motor_torque", "target"), (steps, motors)),
        "observation": (steps, len(meta["observation_names"])),
        "feedback": (steps, actions),
        "energy": (steps,),
        "foot_contact": (steps, legs),
        "foot_position_world": (steps, legs, 3),
        "true_motor_angle": (steps, motors),
        "command": (steps, 3),
        "push_force_world": (steps, 3),
        "reward": (steps,),
        **dict.fromkeys(("motor_saturation", "motor_heat"), (steps, motors)),
    }


def _checked_array(name: str, value: ArrayLike, shape: tuple[int, ...], may_be_nan: bool) -> Array:
    """Return a read-only float64 copy after checking shape and finiteness."""
    array = np.asarray(value)
    if array.dtype.kind not in "biuf":
        raise SurefootError(f"trace: {name} holds {array.dtype}, but must hold numbers")
    if array.shape != shape:
        raise SurefootError(f"trace: {name} has shape {array.shape}, but must have {shape}")
    if shape[0] == 0:
        raise SurefootError("trace: an episode needs at least one control step")
    array = array.astype(np.float64)
    bad = np.isinf(array) if may_be_nan else ~np.isfinite(array)
    if np.any(bad):
        rule = "finite or NaN" if may_be_nan else "finite"
        raise SurefootError(f"trace: {name} row {np.argwhere(bad)[0][0]} holds {array[bad][0]}, but must be {rule}")
    array.setflags(write=False)
    return array


def _checked_meta(meta: dict[str, Any]) -> dict[str, Any]:
    """Return meta with defaults filled in, as plain JSON types."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(meta, default=_plain))
    except TypeError as error:
        raise SurefootError(f"trace: meta must be what JSON can hold: {error}") from error
    names = {item.name for item in fields(TraceMeta)}
    with prefix_errors("trace"):
        typed = from_mapping(TraceMeta, {name: value for name, value in plain.items() if name in names}, "meta")
    return {**to_mapping(typed), **plain}


def _plain(value: object) -> object:
    """Turn numpy numbers and arrays into what JSON can hold."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} {value!r}")
