"""Episode traces: recorded episodes with the same format from simulations, the robot emulator and robots.

Speed, power, return, footfalls and the reality gap are computed from traces by the same functions for all worlds. This
module needs only numpy, because a robot's computer also writes traces.
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
from surefoot.robot import ROBOT_ARRAY, RobotDescription, load_embedded_robot

ENERGY_WEIGHT = 0.008
"""Weight w of energy in the paper's reward [m/J], the same in all its experiments."""
IMPORTED_LOG = "log"
"""`world` of a trace imported from a third-party log. Its rows are unchanged: commands are sent at the time of their
row, readings are taken right after it (exactly then with `read_at_row`), times may repeat, and all columns except time
may be NaN. Its `params` are the gains that were sent with the commands."""


@dataclass(frozen=True)
class TraceMeta:
    """Entries that the meta of every trace has."""

    robot: str
    """Name of the robot."""
    world: str
    """Name of the world: a simulated world, robot, or log."""
    control_step: Annotated[float, Within(0, 3600, exclusive=True)]
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
    """Seed of the simulation; none for robots."""
    params: dict[str, Any] = field(default_factory=dict)
    """Physical parameters: each one value, or a list with one value per motor or axis."""
    energy_weight: Annotated[float, Within(0, 1e6)] | None = ENERGY_WEIGHT
    """Weight w of energy [m/J] in the paper's reward (progress minus w times energy); none: the task has another
    reward."""
    progress_limit: Annotated[float, Within(-1e6, 1e6)] | None = None
    """Maximum speed for which progress is rewarded [m/s]; none: no limit."""
    max_steps: Annotated[int, Within(1, 1e9)] = 1000
    """Control steps of a complete episode."""
    gait_period: Annotated[float, Within(1e-3, 1e3)] | None = None
    """Period of the reference gait [s]; none: not periodic."""
    terrain: str = "flat"
    """Terrain: flat or KIND:SIZE, such as stairs:0.10, generated with `seed`; or the name of a terrain that is not in
    the trace."""

    def __post_init__(self) -> None:
        """Reject names that repeat."""
        for name in ("leg_names", "motor_names", "observation_names"):
            if len(set(getattr(self, name))) != len(getattr(self, name)):
                raise SurefootError(f"meta.{name} are {choices(getattr(self, name))}; names must not repeat")


@dataclass(frozen=True)
class FurtherMeta:
    """Entries that the meta of some traces has. Other entries with JSON values are kept unchanged."""

    actuator: str = ""
    """Simulation: model of the motors."""
    params_source: dict[str, str] = field(default_factory=dict)
    """Simulation: source of parameters that are not nominal."""
    episode: int = 0
    """Number of the episode among the episodes of one command."""
    lead: float | None = None
    """Robot: time by which states are requested before they are needed [s]."""
    firmware: str = ""
    """Robot: its firmware."""
    config_hash: str = ""
    """Robot: digest of the policy's contract."""
    dry_run: bool = False
    """Robot: whether motors were off."""
    robot_time_start: float | None = None
    """Robot: time on its clock at the start of the episode [s]; none: unknown."""
    reason: str = ""
    """Robot: reason for the end of the run, in a word."""
    what: str = ""
    """Robot: reason for the end of the run, in a sentence."""
    estimated: tuple[str, ...] = ()
    """Robot: columns that were not measured, but estimated from the others."""
    distance_error: float | None = None
    """Robot: standard deviation of the distance along x [m], if it was estimated."""
    missed_steps: tuple[int, ...] = ()
    """Robot: rows of missed control steps, from 0, which repeat the previous step."""
    timing: dict[str, Any] = field(default_factory=dict)
    """Robot: lateness of control steps and inference times."""
    frames_missing: int = 0
    """Robot: number of frames lost on the link."""
    height_map: dict[str, tuple[float, ...]] = field(default_factory=dict)
    """Robot with a height map: coordinates of its points `ahead` and `left` of the base's origin [m]. Heights are
    ordered by `ahead`, then by `left`."""
    source: str = ""
    """Imported log: name of the file."""
    read_at_row: bool = False
    """Imported log: whether readings were taken at the times of their rows."""
    notes: tuple[str, ...] = ()
    """Imported log: data that was left out."""


def robot_meta(robot: RobotDescription) -> dict[str, Any]:
    """Return the entries of a trace's meta with the names of the robot, its legs and its motors."""
    return {"robot": robot.name, "leg_names": list(robot.leg_names), "motor_names": list(robot.motor_names)}


def run_meta(
    robot: RobotDescription, observation_names: Sequence[str], gait_period: float | None, **entries: Any
) -> dict[str, Any]:
    """Return the meta of a run on a simulated or real robot: the common entries, and `entries`."""
    return {
        **robot_meta(robot),
        "observation_names": list(observation_names),
        "gait_period": gait_period,
        **entries,
    }


_optional_column = functools.partial(column, required=False, always_in_file=False)


@dataclass(frozen=True, eq=False, kw_only=True)
class EpisodeTrace:
    """Trace of an episode of T control steps: M motors, L legs, O observations, A feedback columns, K map points.

    Arrays are float64 and read-only. World and base frames: x forward, y left, z up. In columns with T+1 rows, row 0 is
    the start and row k is after control step k.
    """

    time: Array = column("T", "s", "time since the start at which the step's readings were taken: at its end")
    base_position_world: Array = column("T+1, 3", "m", "position of the base", "world", required=False)
    base_quat_world: Array = column("T+1, 4", "1", "orientation, unit quaternion w, x, y, z", "world", required=False)
    roll_pitch_yaw: Array = column("T, 3", "rad", "orientation that the IMU measured, delayed and noisy", "world")
    angular_velocity_base: Array = column("T, 3", "rad/s", "angular velocity that the IMU measured", "base")
    motor_angle: Array = column("T, M", "rad", "angle that the encoder measured, delayed")
    motor_velocity: Array = column("T, M", "rad/s", "velocity that the encoder measured, delayed")
    motor_torque: Array = column("T, M", "N m", "torque at the end of the control step")
    observation: Array = column("T, O", "", "inputs of the policy, in the units of its contract")
    feedback: Array = column(
        "T, A",
        "",
        "feedback of the policy: coordinates of leg space, coordinate by coordinate for all legs (A = 2L or 3L; rad, "
        "extension of serial legs in lengths of the straight leg), or one angle per motor (rad); then the policy's "
        "memory, one column for each column of the observation `memory`",
    )
    target: Array = column("T, M", "rad", "motor angle sent to the servo")
    energy: Array = column("T", "J", "integral over the control step of |torque . velocity|, at servo rate")
    foot_contact: Array = column(
        "T, L", "1", "fraction of the control step in which the foot was in contact", required=False, is_fraction=True
    )
    foot_position_world: Array = column("T, L, 3", "m", "position of the foot", "world", required=False)
    true_motor_angle: Array = column("T, M", "rad", "angle at the end of the control step, not delayed", required=False)
    command: Array = _optional_column(
        "T, 3", "m/s, m/s, rad/s", "commanded speeds forward and to the left, and commanded yaw rate", "heading"
    )
    push_force_world: Array = _optional_column("T, 3", "N", "push force on the base", "world")
    reward: Array = _optional_column("T", "", "reward of the control step by the task's reward terms")
    motor_saturation: Array = _optional_column(
        "T, M",
        "1",
        "fraction of the control step in which the motor was at its limit: DC motors at full duty, joint actuators at "
        "the maximum torque at their speed",
        is_fraction=True,
    )
    motor_heat: Array = _optional_column("T, M", "J", "energy that the motor's windings turned into heat")
    accelerometer: Array = _optional_column("T, 3", "m/s^2", "specific force that the IMU measured, delayed", "base")
    height_map: Array = _optional_column(
        "T, K", "m", "terrain heights relative to the base's origin, at the points of meta's height_map", "heading"
    )
    meta: dict[str, Any] = field(default_factory=dict)
    """Entries of `TraceMeta`, entries of `FurtherMeta` that apply, and other JSON values."""
    robot_archive: bytes = b""
    """Archive of the robot's folder, see `RobotDescription.archive`; empty for a robot that ships with surefoot."""

    def __post_init__(self) -> None:
        with prefix_errors("trace"):
            object.__setattr__(self, "meta", _check_meta(self.meta))
            sizes = trace_sizes(np.size(self.time), np.shape(self.feedback), self.meta)
            if not sizes["T"]:
                raise SurefootError("an episode needs at least one control step")
            for name, declared in columns_of(EpisodeTrace).items():
                may_be_nan = not declared.required or (self.is_imported and name != "time")
                array = declared.validate(name, getattr(self, name), sizes, may_be_nan)
                invalid = np.isinf(array) if may_be_nan else ~np.isfinite(array)
                if np.any(invalid):
                    rule = "finite or NaN" if may_be_nan else "finite"
                    raise SurefootError(
                        f"{name} row {np.argwhere(invalid)[0][0]} is {array[invalid][0]}, but must be {rule}"
                    )
                if declared.is_fraction and np.any((array < 0.0) | (array > 1.0)):
                    raise SurefootError(f"{name} is a fraction of the control step; it must be 0 to 1")
                object.__setattr__(self, name, array)
            self._check_rules()

    def _check_rules(self) -> None:
        if self.is_imported:
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
    def is_imported(self) -> bool:
        """Whether the trace was imported from a third-party log; see `IMPORTED_LOG`."""
        return bool(self.meta["world"] == IMPORTED_LOG)

    @property
    def num_steps(self) -> int:
        """Number of control steps T."""
        return len(self.time)

    @property
    def elapsed(self) -> Array:
        """Time since the start of the episode (T,) [s]; `time` of an imported log may begin anywhere."""
        start = self.time[0] - self.meta["control_step"] if self.is_imported else 0.0
        return np.asarray(self.time - start)

    @property
    def duration(self) -> float:
        """Duration of the episode [s]."""
        return float(self.elapsed[-1])

    @property
    def fell(self) -> bool:
        """Whether the episode ended because the robot fell."""
        return bool(self.meta["ended"] == "fall")

    @property
    def leg_names(self) -> tuple[str, ...]:
        """Names of the legs, in the order of the columns."""
        return tuple(self.meta["leg_names"])

    def save(self, path: str | Path) -> Path:
        """Write the trace to an .npz file (atomic)."""
        path = Path(path)
        if path.suffix != ".npz":
            raise SurefootError(f"trace file {path}: the name must end in .npz")
        arrays = {
            name: getattr(self, name)
            for name, declared in columns_of(EpisodeTrace).items()
            if declared.always_in_file or not np.isnan(getattr(self, name)).all()
        }
        write_npz(path, arrays | pack_bytes(ROBOT_ARRAY, self.robot_archive), self.meta)
        return path

    @classmethod
    def load(cls, path: str | Path) -> EpisodeTrace:
        """Read a trace.

        Raises:
            SurefootError: a file that is missing, cut off, damaged, not a trace, or of another schema.
        """
        path = Path(path)
        with prefix_errors(f"trace file {path}"):
            arrays = read_npz(path)
            if (meta := pop_meta(arrays)) is None:
                raise SurefootError("not an episode trace: it has no meta")
            meta = _check_meta(meta)  # first, because another schema may have other arrays
            archive = pop_bytes(arrays, ROBOT_ARRAY)
            columns = columns_of(EpisodeTrace)
            optional = {name for name, declared in columns.items() if not declared.always_in_file}
            if different := set(columns) ^ {*arrays, *optional}:
                raise SurefootError(f"not an episode trace: missing or unknown {choices(sorted(different))}")
            return cls(meta=meta, robot_archive=archive, **arrays)

    def load_robot(self) -> RobotDescription:
        """Return the robot in the trace, or the robot of its name that ships with surefoot.

        Raises:
            SurefootError: neither exists, or the robot is invalid.
        """
        return load_embedded_robot(self.robot_archive, self.meta["robot"])


def trace_sizes(steps: int, feedback: tuple[int, ...], meta: Mapping[str, Any]) -> dict[str, int]:
    """Return the sizes of a trace's columns by letter.

    Args:
        steps: number of control steps T.
        feedback: shape of the feedback.
        meta: meta of the trace.
    """
    legs, motors = len(meta["leg_names"]), len(meta["motor_names"])
    memory = sum(str(name).startswith(f"{MEMORY}.") for name in meta["observation_names"])
    actions = feedback[-1] if feedback and feedback[-1] - memory in (3 * legs, motors) else 2 * legs + memory
    observations = len(meta["observation_names"])
    grid = meta.get("height_map") or {"ahead": (), "left": ()}
    points = len(grid.get("ahead", ())) * len(grid.get("left", ()))
    return {"T": steps, "T+1": steps + 1, "M": motors, "L": legs, "O": observations, "A": actions, "K": points}


def _check_meta(meta: dict[str, Any]) -> dict[str, Any]:
    """Check meta, and return it as plain JSON types with the defaults of `TraceMeta` filled in."""
    try:
        plain: dict[str, Any] = json.loads(json.dumps(meta, default=_plain))
        typed_entries(FurtherMeta, plain, "meta")
        return {**to_mapping(typed_entries(TraceMeta, plain, "meta")), **plain}
    except TypeError as error:
        raise SurefootError(f"meta must consist of JSON values: {error}") from error
    except RecursionError:
        raise SurefootError("meta is nested too deeply") from None


def _plain(value: object) -> object:
    """Convert numpy numbers and arrays to JSON values."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"{type(value).__name__} {value!r}")
