"""Task configuration (robot, observations, gait, reward, disturbances), and loading of task files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from surefoot.configuration import NoOption, Within, check_bounds, from_mapping, keys_of_kind, read_yaml
from surefoot.errors import SurefootError, check_name, prefix_errors, quote, suggest
from surefoot.policy.contract import ASSUMED_PARAMS, MAX_MEMORY, ContractField
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.commands import COMMANDS
from surefoot.robot.params_file import ParamValue
from surefoot.robot.randomization import Ranges, check_ranges, resolve_table
from surefoot.task.commands import CommandConfig
from surefoot.task.gait import ActionKind, HybridGait, narrow_bounds
from surefoot.task.observation import BASE_VELOCITY, IMU_AND_MOTORS_12D, OVER_HOLES
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import REFERENCES, NoReferenceConfig, ReferenceField
from surefoot.task.reward import PAPER_REWARD, check_reward, energy_weight
from surefoot.task.terrain import TerrainConfig
from surefoot.world.interface import MAX_PHYSICS_STEP

_PRESETS = Path(__file__).parent / "presets"

_LIMIT_FIELDS = (*COMMANDS, "relative", "acceleration", "heading_gain")
"""Fields of `CommandConfig` that limit the commands of a policy."""
MAX_STEPS = 1_000_000
"""Maximum control steps of an episode: hours."""


@dataclass(frozen=True)
class FeedbackConfig:
    """Bounds of the feedback, which the policy adds to the reference. Equal bounds fix a coordinate."""

    swing: tuple[float, float] = (-0.5, 0.5)
    """Minimum and maximum feedback on each leg's swing [rad]."""
    extension: tuple[float, float] = (-0.5, 0.5)
    """Minimum and maximum feedback on each leg's extension: rad for a five-bar leg, lengths of the straight leg for a
    serial leg."""
    abduction: tuple[float, float] = (-0.2, 0.2)
    """Minimum and maximum feedback on each leg's abduction [rad], for robots with abduction."""
    joint: tuple[float, float] = (-0.5, 0.5)
    """Minimum and maximum feedback on each motor's angle [rad], for `action` joint."""

    def __post_init__(self) -> None:
        """Reject reversed bounds, and bounds that are not finite."""
        check_bounds(self, "feedback")
        for name, (low, high) in vars(self).items():
            if not low <= high:
                raise SurefootError(f"feedback.{name} is [{low:g}, {high:g}]; the lower bound must come first")

    def bounds(self, names: Sequence[str]) -> list[tuple[float, float]]:
        """Return the bounds of the named coordinates."""
        return [getattr(self, name) for name in names]


@dataclass(frozen=True)
class TaskConfig:
    """Configuration of a task. Fields marked `ContractField` are the policy's interface, and part of its contract."""

    name: str = "gait"
    """Name of the task, used in the names of run folders."""
    robot: Annotated[NoOption[str], ContractField()] = DEFAULT_ROBOT
    """Name of a robot that ships with surefoot, or the path of a robot's folder, in a file relative to that file."""
    observations: Annotated[tuple[str, ...], ContractField()] = IMU_AND_MOTORS_12D
    """Parts of the observation, in order."""
    history: Annotated[int, Within(1, 100), ContractField()] = 1
    """Number of past observations in the policy's input, including the current one, newest first."""
    reference: Annotated[ReferenceField, ContractField()] = field(default_factory=NoReferenceConfig)
    """Reference gait: the open-loop part of the command."""
    feedback: Annotated[FeedbackConfig, ContractField()] = field(default_factory=FeedbackConfig)
    """Bounds of the policy's feedback."""
    action: Annotated[ActionKind, ContractField()] = "leg"
    """What the policy outputs. leg: feedback on the legs' poses in leg space; joint: feedback on the motor angles;
    angle: the motor angles themselves, without a reference."""
    memory: Annotated[int, Within(0, MAX_MEMORY), ContractField()] = 0
    """Number of additional outputs that the policy receives in the next control step as the observation `memory`."""
    rest: Annotated[tuple[float | tuple[float, ...], ...] | None, ContractField()] = None
    """Pose of the legs in leg space in which the robot settles before an episode: for each coordinate one value, or one
    per leg. Defaults to the middle of the range of commands."""
    fall_angle: Annotated[float, Within(1e-3, math.pi)] = 0.5
    """Roll or pitch [rad], relative to the slope of the ground, beyond which an episode ends."""
    fall_height: Annotated[float, Within(0, 10)] = 0.0
    """Height of the base's origin above the smoothed ground [m] below which an episode ends; 0: no limit. It keeps
    gaits from crawling on the belly."""
    max_steps: Annotated[int, Within(1, MAX_STEPS)] = 1000
    """Control steps of an episode."""
    commands: Annotated[CommandConfig, ContractField(_LIMIT_FIELDS)] = field(default_factory=CommandConfig)
    """Velocity commands that the robot follows. By default there are none, and the robot goes straight ahead."""
    reward: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=PAPER_REWARD.copy)
    """Weights of reward terms by name (`task.reward.TERMS`); costs have negative weights."""
    reward_limits: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=dict)
    """Upper clipping limits of reward terms, by name; for progress, energy and transport_cost per second."""
    pushes: PushConfig = field(default_factory=PushConfig)
    """Random pushes on the base."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """Terrain, terrain curriculum, and the map of terrain heights that a policy receives."""
    randomize: NoOption[Ranges] = field(default_factory=dict)
    """Domain randomization: range of each physical parameter, by name, sampled in every episode; in a file also the
    name of a table of ranges."""
    randomize_ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: in a robot's first `randomize_ramp` episodes, ranges widen from the nominal value; 0: no
    curriculum."""
    params: Annotated[NoOption[dict[str, ParamValue]], ContractField(ASSUMED_PARAMS)] = field(default_factory=dict)
    """Physical parameters that differ from the robot's description, by name: one value, or one per motor."""
    params_source: NoOption[dict[str, str]] = field(default_factory=dict)
    """File from which `params` were read, if any: its name `file` and its `sha256`. It is not read again."""
    actuator: NoOption[Literal["dc", "constraint"]] = "dc"
    """dc: the robot's servo and motor model; constraint: the position motor of physics engines, the paper's
    baseline."""
    physics_step: Annotated[float, Within(0, MAX_PHYSICS_STEP)] = 0.0
    """Maximum step of servos and physics in training [s]: robots use the longest stable step up to it, if it is longer
    than their data sheet's. 0: the data sheet's, with which policies are evaluated."""
    thermal_protection: bool = False
    """Switch off motors that overheat."""
    start_linear_speed: Annotated[float, Within(0, 100)] = 0.05
    """Maximum of each component of the base's random initial velocity [m/s]."""
    start_angular_speed: Annotated[float, Within(0, 100)] = 0.1
    """Maximum of each component of the base's random initial angular velocity [rad/s]."""

    def __post_init__(self) -> None:
        """Reject an invalid name, values out of bounds, and unknown reward terms."""
        check_name("name", self.name)
        check_bounds(self)
        check_reward(self.reward, self.reward_limits)
        check_ranges(self.randomize)
        if self.reference.over_holes is not None and OVER_HOLES not in self.observations:
            raise SurefootError(
                f"reference.over_holes is given, but observations lack {OVER_HOLES}; the policy needs it to blend the "
                "networks of the two gaits"
            )

    @property
    def needs_height_map(self) -> bool:
        """Whether the task needs a map of terrain heights, as an observation or to choose footholds."""
        return "height_scan" in self.observations or bool(self.reference.foothold_radius)

    @property
    def needs_base_velocity(self) -> bool:
        """Whether the policy observes an estimate of the base's velocity."""
        return BASE_VELOCITY in self.observations

    def gait(self, robot: RobotDescription) -> HybridGait:
        """Return the gait of a robot: its reference and the bounds of the feedback.

        With a `relative` reference, which serves any robot, bounds are narrowed to the robot's range; see
        `narrow_bounds`.

        Raises:
            SurefootError: a gait that exceeds the robot's range.
        """
        reference = self.reference.make(robot, self.commands.limits(robot), self.nominal(robot))
        names = {"leg": robot.coordinates, "joint": ("joint",), "angle": ()}[self.action]
        bounds = self.feedback.bounds(names)
        if self.reference.relative and self.action == "leg":
            bounds = narrow_bounds(bounds, reference, robot)
        return HybridGait(robot, reference, *bounds, action=self.action, memory=self.memory)

    def return_meta(self, robot: RobotDescription) -> dict[str, float | None]:
        """Return the entries of `TraceMeta` from which the return of a trace is computed."""
        weight = energy_weight(self.reward, self.reward_limits, robot.weight)
        return {"energy_weight": weight, "progress_limit": self.reward_limits.get("progress")}

    def return_unit(self, robot: RobotDescription) -> str:
        """Return the unit of the return: m for the paper's reward, otherwise empty, as terms have different units."""
        return "" if self.return_meta(robot)["energy_weight"] is None else "m"

    def nominal(self, robot: RobotDescription) -> PhysicalParams:
        """Return the physical parameters without randomization, as one row."""
        return PhysicalParams.nominal(robot).with_values(robot, **self.params)


def preset_names() -> list[str]:
    """Return the names of the tasks that ship with surefoot, for any robot or for the default robot."""
    return sorted(_shipped_tasks(DEFAULT_ROBOT))


def _shipped_tasks(robot: str) -> dict[str, Path]:
    """Return the task files that ship with surefoot, by name. A robot's own task replaces the general one."""
    folders = (_PRESETS, RobotDescription.find_folder(robot) / "tasks")
    return {path.stem: path for folder in folders for path in folder.glob("*.yaml")}


def load_task(task: str, robot: str | None = None) -> tuple[TaskConfig, dict[str, Any]]:
    """Load a task by name or path.

    Args:
        task: name of a task that ships with surefoot, also as ROBOT-NAME; or the path of a YAML file.
        robot: name of a robot that ships with surefoot, or the path of a robot's folder. Defaults to the file's robot.

    Returns:
        The task, and the file's `train` table, empty if it has none.

    Raises:
        SurefootError: no such task or robot, or a file that is not a valid task.
    """
    if robot is not None:
        RobotDescription.load(robot)  # raises an error if there is no such robot
    for name in RobotDescription.available():
        if robot is None and task.startswith(f"{name}-") and not task.endswith((".yaml", ".yml")):
            task, robot = task.removeprefix(f"{name}-"), name
    shipped = _shipped_tasks(robot or DEFAULT_ROBOT)
    if task not in shipped and not Path(task).is_file():
        raise SurefootError(
            f"task '{task}' does not exist; {suggest(task, sorted(shipped))}, or the path of a YAML file"
        )
    path = shipped.get(task, Path(task))
    data = _with_base(read_yaml(path), path)
    train = data.pop("train", None) or {}
    data.pop("handcrafted", None)  # belongs to `HandcraftedGait`
    if robot is not None or path.parent == _PRESETS:
        data["robot"] = robot or DEFAULT_ROBOT
    elif isinstance(data.get("robot"), str):
        data["robot"] = RobotDescription.resolve(data["robot"], path.parent)
    with prefix_errors(path):
        if not isinstance(data.get("robot", DEFAULT_ROBOT), str):
            raise SurefootError(f"robot is {quote(data['robot'])}; it must be the name or folder of a robot")
        config = from_mapping(
            TaskConfig, {"name": path.stem, **resolve_table(data, path.parent, data.get("robot", DEFAULT_ROBOT))}
        )
        if task in shipped and config.robot != DEFAULT_ROBOT:
            config = replace(config, name=f"{RobotDescription.load(config.robot).name}-{path.stem}")
    if config.reference.file is not None:
        # The path of a table is relative to the task file.
        absolute = str((path.parent / config.reference.file).resolve())
        config = from_mapping(TaskConfig, {"reference": {"file": absolute}}, base=config)
    heights = config.terrain.map_file
    if heights is not None and (own := path.parent / heights).is_file():  # as for a reference table
        config = replace(config, terrain=replace(config.terrain, ground=str(own.resolve())))
    return config, train


def _with_base(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a task file's table, merged into the table of the task that its key `base` names.

    If the file names a robot that ships with surefoot, this robot's own tasks take precedence.
    """
    base, robot = data.pop("base", None), data.get("robot")
    if base is None:
        return data
    own = [RobotDescription.find_folder(robot) / "tasks"] if robot in RobotDescription.available() else []
    files = {file.stem: file for folder in (_PRESETS, *own) for file in folder.glob("*.yaml") if file != path}
    if base not in list(files):  # it may be unhashable
        raise SurefootError(f"{path}: base is {quote(base)}; {suggest(base, sorted(files))}")
    base_data, reference = _with_base(read_yaml(files[base]), files[base]), data.get("reference")
    if isinstance(reference, dict) and "kind" in reference:
        base_data["reference"] = keys_of_kind(REFERENCES, base_data.get("reference", {}), reference["kind"])
    if isinstance(table := base_data.get("randomize"), str) and data.get("randomize"):
        base_data["randomize"] = {"table": table}  # so that own ranges are merged into it
    return _merge_tables(base_data, data)


def _merge_tables(base: dict[str, Any], override: dict[str, Any]) -> dict[str, Any]:
    """Return nested tables, merged recursively; entries of `override` take precedence."""
    both = {
        key: _merge_tables(base[key], value)
        for key, value in override.items()
        if isinstance(value, dict) and isinstance(base.get(key), dict)
    }
    return {**base, **override, **both}
