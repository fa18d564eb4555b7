"""The record of an episode, the same from a simulation, the robot emulator and the robot.

Speed, power, return, footfalls and the reality gap are all computed from this record by the same functions,
so all worlds are measured alike. numpy only: the robot's computer writes it too.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.columns import column, columns_of
from surefoot.configuration import Within, to_mapping, typed_entries
from surefoot.errors import SurefootError, choices, prefix_errors
from surefoot.npz import pack_bytes, pop_bytes, pop_meta, read_npz, write_npz
from surefoot.policy.contract import MEMORY
from surefoot.robot import ROBOT, RobotDescription, carried_robot

ENERGY_WEIGHT = 0.008  # w of the paper's reward, the same in all its experiments
LOG = "log"
"""World of a trace that was imported from somebody's log, whose rows are as the log has them: commands are sent at the
time of their row, readings are taken right after, times may repeat, and everything but time may be NaN. Its `params`
are the gains that came with the commands, and with `read_at_row` readings were taken exactly at the times of rows."""


@dataclass(frozen=True)
class TraceMeta:
    """Entries of every trace's meta."""

    robot: str
    """Name of the robot."""
    world: str
    """Name of the world: an engine, robot, or log."""
    control_step: Annotated[float, Within(0, 3600, above=True)]
    """Time between two rows [s]."""
    leg_names: tuple[str, ...]
    """Names of the L legs, in the order of their columns."""
    motor_names: tuple[str, ...]
    """Names of the M motors, in the order of their columns."""
    observation_names: tuple[str, ...]
    """Names of the O observations."""
    ended: Literal["time", "fall", "fault", "stopped"]
    """How the episode ended."""
    schema: Literal[1] = 1
    """Version of the format."""
    policy: str = ""
    """Name of the policy."""
    seed: int | None = None
    """The seed of the simulation; none for robots."""
    params: dict[str, Any] = field(default_factory=dict)
    """Physical parameters: each a number, or a list where motors or axes have their own."""
    energy_weight: Annotated[float, Within(0, 1e6)] | None = ENERGY_WEIGHT
    """Weight w of energy [m/J] of a task of the paper's reward, progress less w times energy; none: another reward."""
    progress_limit: Annotated[float, Within(-1e6, 1e6)] | None = None
    """Speed up to which progress counts [m/s]; none: any."""
    max_steps: Annotated[int, Within(1, 1e9)] = 1000
    """Control steps of a whole episode."""
    gait_period: Annotated[float, Within(1e-3, 1e3)] | None = None
    """Period of the reference gait [s]; none: it has none."""
    terrain: str = "flat"
    """What the robot stood on: flat or KIND:SIZE, such as stairs:0.10, made with `seed`; or a name of what a trace does
    not hold."""

    def __post_init__(self) -> None:
        """Refuse names that repeat."""
        for name in ("leg_names", "motor_names", "observation_names"):
            if len(set(getattr(self, name))) != len(getattr(self, name)):
                raise SurefootError(f"meta.{name} are {choices(getattr(self, name))}; names must not repeat")


@dataclass(frozen=True)
class FurtherMeta:
    """Entries of the meta of some traces; others that JSON can hold are kept as they are."""

    actuator: str = ""
    """Of a simulation: what drives the motors."""
    params_source: dict[str, str] = field(default_factory=dict)
    """Of a simulation: where parameters come from that are not nominal."""
    episode: int = 0
    """Number of the episode among those that ran together, or after one another."""
    lead: float | None = None
    """Of a robot: time by which states are requested before they are needed [s]."""
    firmware: str = ""
    """Of a robot: what runs on it."""
    config_hash: str = ""
    """Of a robot: digest of the policy's contract."""
    dry_run: bool = False
    """Of a robot: whether motors were off."""
    robot_time_start: float | None = None
    """Of a robot: its time at the start of the episode [s]; none: unknown."""
    reason: str = ""
    """Of a robot: why the run ended, in a word."""
    what: str = ""
    """Of a robot: why the run ended, in a sentence."""
    estimated: tuple[str, ...] = ()
    """Of a robot: columns that were not measured, but estimated from the others."""
    missed_steps: tuple[int, ...] = ()
    """Of a robot: rows of control steps that were missed, from 0; they repeat the step before."""
    timing: dict[str, Any] = field(default_factory=dict)
    """Of a robot: lateness and times of inference."""
    frames_missing: int = 0
    """Of a robot: frames that were lost on the link."""
    height_map: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Of a robot whose policy sees the ground: places of the map `ahead` and `left` of the base's origin [m]; heights
    have an order: by `ahead`, then by `left`."""
    source: str = ""
    """Of an imported log: name of its file."""
    read_at_row: bool = False
    """Of an imported log: whether readings were taken at the times of their rows."""
    notes: tuple[str, ...] = ()
    """Of an imported log: what was left out."""


def robot_meta(robot: RobotDescription) -> dict[str, Any]:
    """Return the entries of a trace's meta that name the robot and its parts."""
    return {"robot": robot.name, "leg_names": list(robot.leg_names), "motor_names": list(robot.motor_names)}


def run_meta(
    robot: RobotDescription, observation_names: Sequence[str], gait_period: float | None, **entries: Any
) -> dict[str, Any]:
    """Return the meta of a run of a task on a robot, simulated or real: what both have in common, and other entries."""
    return {
        **robot_meta(robot),
        "observation_names": list(observation_names),
        "gait_period": gait_period,
        **entries,
    }


_column_of_some = functools.partial(column, known=False, always_in_file=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeTrace:
    """An episode of T control steps: M motors, L legs, O observations, A numbers of feedback, K points of a map.

    Arrays are float64 and read-only. World and base frames: x forward, y left, z up. In columns with T+1 rows, row 0 is
    the start and row k is after control step k.
    """

    time: Array = column("T", "s", "time since the start at which the step's readings were taken: at its end")
    base_position_world: Array = column("T+1, 3", "m", "position of the base", "world", known=False)
    base_quat_world: Array = column("T+1, 4", "1", "orientation, unit quaternion w, x, y, z", "world", known=False)
    roll_pitch_yaw: Array = column("T, 3", "rad", "orientation that the IMU measured, delayed and noisy", "world")
    angular_velocity_base: Array = column("T, 3", "rad/s", "angular velocity that the IMU measured", "base")
    motor_angle: Array = column("T, M", "rad", "angle that the encoder measured, delayed")
    motor_velocity: Array = column("T, M", "rad/s", "velocity that the encoder measured, delayed")
    motor_torque: Array = column("T, M", "N m", "torque at the end of the control step")
    observation: Array = column("T, O", "", "inputs of the policy, in the units of its contract")
    feedback: Array = column(
        "T, A",
        "",
        "the policy's part of the action: each coordinate of leg space in turn, of every leg (A = 2L or 3L; rad, "
        "extension of serial legs in lengths of the straight leg), or an angle (rad) of every motor; then what the "
        "policy keeps, one number for each observation `memory`",
    )
    target: Array = column("T, M", "rad", "motor angle sent to the servo")
    energy: Array = column("T", "J", "integral over the control step of |torque . velocity|, at servo rate")
    foot_contact: Array = column(
        "T, L", "1", "fraction of the control step in which the foot touched", known=False, is_fraction=True
    )
    foot_position_world: Array = column("T, L, 3", "m", "position of the foot", "world", known=False)
    true_motor_angle: Array = column("T, M", "rad", "angle at the end of the control step, not delayed", known=False)
    command: Array = _column_of_some(
        "T, 3", "m/s, m/s, rad/s", "commanded speeds forward and to the left, and yaw rate", "heading"
    )
    push_force_world: Array = _column_of_some("T, 3", "N", "force that pushed the base", "world")
    reward: Array = _column_of_some("T", "", "reward of the control step by the task's own terms")
    motor_saturation: Array = _column_of_some(
        "T, M",
        "1",
        "fraction of the control step in which the motor was at its limit: DC motors at full duty, joint actuators at "
        "the torque that there is at their speed",
        is_fraction=True,
    )
    motor_heat: Array = _column_of_some("T, M", "J", "energy that the motor's windings turned into heat")
    height_map: Array = _column_of_some(
        "T, K", "m", "heights of the ground over the base's origin, at the points of meta's height_map", "heading"
    )
    meta: dict[str, Any] = field(default_factory=dict)
    """The entries of `TraceMeta`, those of `FurtherMeta` that apply, and others that JSON can hold."""
    robot_archive: bytes = b""
    """The robot's folder as `RobotDescription.archive` has it; empty for a robot that ships."""

    def __post_init__(self) -> None:
        with prefix_errors("trace"):
            object.__setattr__(self, "meta", _checked_meta(self.meta))
            sizes = trace_sizes(np.size(self.time), np.shape(self.feedback), self.meta)
            if not sizes["T"]:
                raise SurefootError("an episode needs at least one control step")
            for name, declared in columns_of(EpisodeTrace).items():
                may_be_nan = not declared.known or (self.imported and name != "time")
                array = declared.checked(name, getattr(self, name), sizes, may_be_nan)
                bad = np.isinf(array) if may_be_nan else ~np.isfinite(array)
                if np.any(bad):
                    rule = "finite or NaN" if may_be_nan else "finite"
                    raise SurefootError(
                        f"{name} row {np.argwhere(bad)[0][0]} holds {array[bad][0]}, but must be {rule}"
                    )
                if declared.is_fraction and np.any((array < 0.0) | (array > 1.0)):
                    raise SurefootError(f"{name} is a fraction of the control step: 0 to 1")
                object.__setattr__(self, name, array)
            self._check_rules()

    def _check_rules(self) -> None:
        if self.imported:
            if np.any(np.diff(self.time) < 0.0):
                raise SurefootError("time must not go backwards")
        elif self.time[0] <= 0.0 or np.any(np.diff(self.time) <= 0.0):
            raise SurefootError("time must be above 0 s at the first step and strictly increasing")
        if np.any(self.energy < 0.0):
            raise SurefootError(f"energy {self.energy.min():.3g} J must be 0 or above: it sums |tau . qdot|")
        norms = np.linalg.norm(self.base_quat_world, axis=1)
        if np.any(np.abs(norms - 1.0) > 1e-3):
            raise SurefootError("base_quat_world must hold unit quaternions w, x, y, z (or NaN)")

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
        arrays = {
            name: getattr(self, name)
            for name, declared in columns_of(EpisodeTrace).items()
            if declared.always_in_file or not np.isnan(getattr(self, name)).all()
        }
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
            meta = _checked_meta(meta)  # Another schema may have other arrays.
            archive = pop_bytes(arrays, ROBOT)
            columns = columns_of(EpisodeTrace)
            left_out = {name for name, declared in columns.items() if not declared.always_in_file}
            if odd := set(columns) ^ {*arrays, *left_out}:
                raise SurefootError(f"not an episode trace: missing or unknown {choices(sorted(odd))}")
            return cls(meta=meta, robot_archive=archive, **arrays)

    def load_robot(self) -> RobotDescription:
        """Return the robot that the trace carries, else the one of its name that ships.

        Raises:
            SurefootError: neither is there, or the robot is invalid.
        """
        return carried_robot(self.robot_archive, self.meta["robot"])


def trace_sizes(steps: int, feedback: tuple[int, ...], meta: Mapping[str, Any]) -> dict[str, int]:
    """Return the sizes of a trace's columns by letter, for T `steps` and a `feedback` of that shape."""
    legs, motors = len(meta["leg_names"]), len(meta["motor_names"])
    memory = sum(str(name).startswith(f"{MEMORY}.") for name in meta["observation_names"])
    actions = feedback[-1] if feedback and feedback[-1] - memory in (3 * legs, motors) else 2 * legs + memory
    observations = len(meta["observation_names"])
    grid = meta.get("height_map") or {"ahead": (), "left": ()}
    points = len(grid.get("ahead", ())) * len(grid.get("left", ()))
    return {"T": steps, "T+1": steps + 1, "M": motors, "L": legs, "O": observations, "A": actions, "K": points}


def _checked_meta(meta: dict[str, Any]) -> dict[str, Any]:
    """Return meta with the defaults of `TraceMeta` filled in, as plain JSON types."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(meta, default=_plain))
        typed_entries(FurtherMeta, plain, "meta")
        return {**to_mapping(typed_entries(TraceMeta, plain, "meta")), **plain}
    except TypeError as error:
        raise SurefootError(f"meta must be what JSON can hold: {error}") from error
    except RecursionError:
        raise SurefootError("meta is nested too deep") from None


def _plain(value: object) -> object:
    """Turn numpy numbers and arrays into what JSON can hold."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} {value!r}")
