"""The configuration of a task: robot, observation, feedback, reward."""

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
from surefoot.task.observation import IMU_AND_MOTORS_12D, OVER_HOLES
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import REFERENCES, NoReferenceConfig, ReferenceField
from surefoot.task.reward import PAPER_REWARD, check_reward, energy_weight
from surefoot.task.terrain import TerrainConfig

_PRESETS = Path(__file__).parent / "presets"

_LIMITS = (*COMMANDS, "relative", "acceleration", "heading_gain")
"""Fields of the commands that are limits of what a policy follows."""
MAX_STEPS = 1_000_000
"""Control steps of the longest episode: hours."""


@dataclass(frozen=True)
class FeedbackConfig:
    """Bounds of what the policy adds to the reference; equal bounds leave no choice."""

    swing: tuple[float, float] = (-0.5, 0.5)
    """Least and greatest feedback on each leg's swing [rad]."""
    extension: tuple[float, float] = (-0.5, 0.5)
    """Least and greatest feedback on each leg's extension: rad for a five-bar leg, lengths of the straight leg for a
    serial one."""
    abduction: tuple[float, float] = (-0.2, 0.2)
    """Least and greatest feedback on each leg's abduction [rad], of robots that have it."""
    joint: tuple[float, float] = (-0.5, 0.5)
    """Least and greatest feedback on each motor's angle [rad], for `action` joint."""

    def __post_init__(self) -> None:
        """Refuse reversed bounds, and bounds that are not finite."""
        check_bounds(self, "feedback")
        for name, (low, high) in vars(self).items():
            if not low <= high:
                raise SurefootError(f"feedback.{name} is [{low:g}, {high:g}]; the lower bound must come first")

    def bounds(self, names: Sequence[str]) -> list[tuple[float, float]]:
        """Return the bounds of coordinates by name."""
        return [getattr(self, name) for name in names]


@dataclass(frozen=True)
class TaskConfig:
    """Configuration of a task. Fields marked as `ContractField` are the policy's interface, which its contract states."""

    name: str = "gait"
    """Name of the task; run folders carry it."""
    robot: Annotated[NoOption[str], ContractField()] = DEFAULT_ROBOT
    """Name of a robot that ships with surefoot, or the path of a robot's folder; in a file from the file's folder."""
    observations: Annotated[tuple[str, ...], ContractField()] = IMU_AND_MOTORS_12D
    """Parts of the observation, in order."""
    history: Annotated[int, Within(1, 100), ContractField()] = 1
    """Number of last observations in the policy's input, the newest first."""
    reference: Annotated[ReferenceField, ContractField()] = field(default_factory=NoReferenceConfig)
    """The open loop part of the gait."""
    feedback: Annotated[FeedbackConfig, ContractField()] = field(default_factory=FeedbackConfig)
    """Bounds of the policy's part."""
    action: Annotated[ActionKind, ContractField()] = "leg"
    """What the policy's part is added to: the legs' poses in leg space, or the motors' angles. angle: to nothing; it is
    the motors' angles themselves, without a reference."""
    memory: Annotated[int, Within(0, MAX_MEMORY), ContractField()] = 0
    """Numbers beside the motion that the policy keeps from one control step to the next, by observation `memory`."""
    rest: Annotated[tuple[float | tuple[float, ...], ...] | None, ContractField()] = None
    """Pose of the legs in leg space in which the robot settles first, each coordinate of all legs or of each; the
    middle of commands if not given."""
    fall_angle: Annotated[float, Within(1e-3, math.pi)] = 0.5
    """Roll or pitch [rad] beyond which an episode ends, from how a base lies along the ground's course."""
    fall_height: Annotated[float, Within(0, 10)] = 0.0
    """Height of the base's origin over the level of the ground [m] below which an episode ends; 0: none. It keeps gaits
    from crawling on the belly."""
    max_steps: Annotated[int, Within(1, MAX_STEPS)] = 1000
    """Control steps of an episode."""
    commands: Annotated[CommandConfig, ContractField(_LIMITS)] = field(default_factory=CommandConfig)
    """Speeds and yaw rates that the robot must follow; none by default: it goes straight on."""
    reward: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=PAPER_REWARD.copy)
    """Weights of reward terms by name (`task.reward.TERMS`); costs have negative weights."""
    reward_limits: Annotated[dict[str, float], Within(-1e6, 1e6)] = field(default_factory=dict)
    """Greatest values of reward terms that count, by name; per second of progress, energy and transport_cost."""
    pushes: PushConfig = field(default_factory=PushConfig)
    """Random pushes on the base."""
    terrain: TerrainConfig = field(default_factory=TerrainConfig)
    """What robots stand on."""
    randomize: NoOption[Ranges] = field(default_factory=dict)
    """Ranges from which every episode draws physical parameters, by name; in a file also the name of a table."""
    randomize_ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: a robot's first `randomize_ramp` episodes draw from ranges that widen from the nominal value; 0: none
    do."""
    params: Annotated[NoOption[dict[str, ParamValue]], ContractField(ASSUMED_PARAMS)] = field(default_factory=dict)
    """Physical parameters that differ from the robot's description, by name: a number, or one for each motor."""
    params_source: NoOption[dict[str, str]] = field(default_factory=dict)
    """The file that they were read from, if any: its name as `file`, and `sha256`. It is not read again."""
    actuator: NoOption[Literal["dc", "constraint"]] = "dc"
    """dc: servo and DC motor; constraint: the position motor of physics engines, the paper's baseline."""
    thermal_protection: bool = False
    """Switch off motors that overheat."""
    start_linear_speed: Annotated[float, Within(0, 100)] = 0.05
    """An episode starts with a random base velocity, each component up to this [m/s]."""
    start_angular_speed: Annotated[float, Within(0, 100)] = 0.1
    """An episode starts with a random angular velocity, each component up to this [rad/s]."""

    def __post_init__(self) -> None:
        """Refuse an invalid name, values out of bounds, and a reward of unknown terms."""
        check_name("name", self.name)
        check_bounds(self)
        check_reward(self.reward, self.reward_limits)
        check_ranges(self.randomize)
        if self.reference.over_holes is not None and OVER_HOLES not in self.observations:
            raise SurefootError(
                f"reference.over_holes is given and observations lack {OVER_HOLES}; the policy has a network for each "
                "gait"
            )

    @property
    def needs_height_map(self) -> bool:
        """Whether a map of the ground's heights is needed: the policy observes it, or footholds are chosen on it."""
        return "height_scan" in self.observations or bool(self.reference.foothold_radius)

    def gait(self, robot: RobotDescription) -> HybridGait:
        """Return the gait: reference and bounds of the feedback, which the robot must allow.

        Beside a `relative` reference, which serves any robot, bounds are narrowed: see `narrow_bounds`.
        """
        reference = self.reference.make(robot, self.commands.limits(robot), self.nominal(robot))
        names = {"leg": robot.coordinates, "joint": ("joint",), "angle": ()}[self.action]
        bounds = self.feedback.bounds(names)
        if self.reference.relative and self.action == "leg":
            bounds = narrow_bounds(bounds, reference, robot)
        return HybridGait(robot, reference, *bounds, action=self.action, memory=self.memory)

    def return_meta(self, robot: RobotDescription) -> dict[str, float | None]:
        """Return what a trace's meta has to compute the return: `energy_weight` and `progress_limit` of `TraceMeta`."""
        weight = energy_weight(self.reward, self.reward_limits, robot.weight)
        return {"energy_weight": weight, "progress_limit": self.reward_limits.get("progress")}

    def return_unit(self, robot: RobotDescription) -> str:
        """Return m for the paper's reward, which is a distance; empty for others, whose terms have different units."""
        return "" if self.return_meta(robot)["energy_weight"] is None else "m"

    def nominal(self, robot: RobotDescription) -> PhysicalParams:
        """Return the physical parameters, which the robot must allow, without randomization, one row."""
        return PhysicalParams.nominal(robot).with_values(robot, **self.params)


def preset_names() -> list[str]:
    """Return the names of the tasks that ship with surefoot: those for any robot, and those of the default one."""
    return sorted(_shipped_tasks(DEFAULT_ROBOT))


def _shipped_tasks(robot: str) -> dict[str, Path]:
    """Return the files of tasks by name: those for any robot, and a robot's own in their place."""
    folders = (_PRESETS, RobotDescription.find_folder(robot) / "tasks")
    return {path.stem: path for folder in folders for path in folder.glob("*.yaml")}


def load_task(task: str, robot: str | None = None) -> tuple[TaskConfig, dict[str, Any]]:
    """Read a task by name or path.

    Args:
        task: name of a task that ships, of the robot or for any; also ROBOT-NAME; or the path of a YAML file.
        robot: name of a robot that ships, or the path of a robot's folder; the file's, if not given.

    Returns:
        the task, and the file's `train` table (empty, if there is none).
    """
    if robot is not None:
        RobotDescription.load(robot)  # refuses one that is not there
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
    data.pop("handcrafted", None)  # Belongs to `HandcraftedGait`, whose task this is.
    if robot is not None or path.parent == _PRESETS:
        data["robot"] = robot or DEFAULT_ROBOT
    elif isinstance(data.get("robot"), str):
        data["robot"] = RobotDescription.resolve(data["robot"], path.parent)
    with prefix_errors(path):
        config = from_mapping(
            TaskConfig, {"name": path.stem, **resolve_table(data, path.parent, data.get("robot", DEFAULT_ROBOT))}
        )
        if task in shipped and config.robot != DEFAULT_ROBOT:
            config = replace(config, name=f"{RobotDescription.load(config.robot).name}-{path.stem}")
    if config.reference.file is not None:
        # A table's path counts from the task's file, wherever surefoot is run.
        absolute = str((path.parent / config.reference.file).resolve())
        config = from_mapping(TaskConfig, {"reference": {"file": absolute}}, base=config)
    return config, train


def _with_base(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a task file's table merged over that of the task that its key `base` names, if it has one.

    In a file with the name of a robot that ships that is the robot's own task of that name before one for any robot.
    """
    base, robot = data.pop("base", None), data.get("robot")
    if base is None:
        return data
    own = [RobotDescription.find_folder(robot) / "tasks"] if robot in RobotDescription.available() else []
    files = {file.stem: file for folder in (_PRESETS, *own) for file in folder.glob("*.yaml") if file != path}
    if base not in list(files):  # it may be unhashable
        raise SurefootError(f"{path}: base is {quote(base)}; {suggest(base, sorted(files))}")
    below, reference = _with_base(read_yaml(files[base]), files[base]), data.get("reference")
    if isinstance(reference, dict) and "kind" in reference:
        below["reference"] = keys_of_kind(REFERENCES, below.get("reference", {}), reference["kind"])
    return _merge_tables(below, data)


def _merge_tables(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return a table with what another one changes or adds, at every depth."""
    both = {
        key: _merge_tables(below[key], value)
        for key, value in above.items()
        if isinstance(value, dict) and isinstance(below.get(key), dict)
    }
    return {**below, **above, **both}
