"""The configuration of a task: robot, observation, feedback, reward."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from surefoot.configuration import Within, check_bounds, from_mapping, is_number, read_yaml
from surefoot.errors import SurefootError, check_name, choices, located, quoted
from surefoot.robot import DEFAULT_ROBOT, PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamValue
from surefoot.robot.randomization import Ranges, check_ranges, resolve_ranges
from surefoot.task.commands import CommandConfig
from surefoot.task.gait import ActionKind, HybridGait, narrowed_bounds
from surefoot.task.observation import IMU_AND_MOTORS_12D
from surefoot.task.pushes import PushConfig
from surefoot.task.reference import make_reference
from surefoot.task.reward import check_terms
from surefoot.task.trace import ENERGY_WEIGHT

_PRESETS = Path(__file__).parent / "presets"

MOST_STEPS = 1_000_000
"""Control steps of the longest episode: hours."""

PerLeg = float | dict[str, float]


@dataclass(frozen=True)
class WaveConfig:
    """A sinusoid for each leg; each quantity is one number, or one for each leg by name."""

    amplitude: PerLeg = 0.0
    """rad"""
    frequency: PerLeg = 0.0
    """Hz"""
    phase: PerLeg = 0.0
    """rad"""
    offset: PerLeg = 0.0
    """rad"""


@dataclass(frozen=True)
class FootConfig:
    """Paths of the feet in their legs' planes; each quantity but the frequency is one number, or one for each leg."""

    frequency: float = 2.0
    """Cycles a second [Hz]."""
    stroke: PerLeg = 0.1
    """How far a foot goes backward in stance, relative to the base [m]."""
    clearance: PerLeg = 0.03
    """How far a foot is lifted in the middle of its swing [m]."""
    duty_factor: PerLeg = 0.5
    """Part of the cycle that a foot is on the ground."""
    phase: PerLeg = 0.0
    """When a foot's cycle begins, with its touchdown [cycles]."""
    height: PerLeg = 0.22
    """Of the motor axis over the foot's end at touchdown and lift-off [m]."""
    offset: PerLeg = 0.0
    """Of the middle of the stroke, forward from the motor axis [m]."""
    depth: PerLeg = 0.0
    """How far a foot is pressed below that height in the middle of its stance [m]."""


@dataclass(frozen=True)
class ReferenceConfig:
    """The open loop part of the gait."""

    kind: Literal["none", "sine", "table", "foot", "follow"] = "none"
    """none: zero at all times; sine: `swing` and `extension`; table: poses out of `file`, every `period`;
    foot: paths of the feet, `foot`; follow: the same with strides that follow the task's commands."""
    abduction: WaveConfig = field(default_factory=WaveConfig)
    """Abduction of the legs, for kind sine; of robots that have it."""
    swing: WaveConfig = field(default_factory=WaveConfig)
    """Swing of the legs, for kind sine."""
    extension: WaveConfig = field(default_factory=WaveConfig)
    """Extension of the legs, for kind sine."""
    file: str | None = None
    """CSV or NPZ file with columns swing_LEG and extension_LEG, for kind table."""
    period: Annotated[float, Within(0, 3600, above=True)] | None = None
    """Time [s] in which the table is gone through once."""
    foot: FootConfig = field(default_factory=FootConfig)
    """Paths of the feet, for kind foot."""
    stride_gain: float = 1.15
    """Stride over that of a foot that does not slip, for kind follow; `foot.stroke` is the longest."""
    frequency_rise: float = 0.0
    """Frequency gained at the longest stride, over the frequency on the spot, for kind follow."""
    turn_gain: float = 1.0
    """What a stride has for turning, over that of a foot that does not slip, for kind follow."""
    velocity_feedforward: float = 0.0
    """Time [s] by which commands lead along the velocity of the reference, for kinds foot and follow."""
    relative: bool = False
    """Lengths of `foot` count lengths l of the straight leg, its frequency natural frequencies sqrt(g / l) / 2 pi, and
    `velocity_feedforward` the actuators' k_d / k_p."""
    rows: dict[str, dict[str, tuple[float, ...]]] | None = None
    """The table itself, in place of `file`: under each coordinate of leg space, each leg's poses."""

    def to_mapping(self) -> dict[str, Any] | None:
        """Return the mapping that `make_reference` takes."""
        if self.kind == "none":
            return None
        if self.kind == "sine":
            aside = {} if self.abduction == WaveConfig() else {"abduction": vars(self.abduction)}
            return {"kind": "sine", **aside, "swing": vars(self.swing), "extension": vars(self.extension)}
        if self.kind in ("foot", "follow"):
            own = {"stride_gain": self.stride_gain, "frequency_rise": self.frequency_rise}
            own |= {"turn_gain": self.turn_gain} if self.turn_gain != 1.0 else {}
            own = own if self.kind == "follow" else {}
            own |= {"velocity_feedforward": self.velocity_feedforward} if self.velocity_feedforward else {}
            return {"kind": self.kind, "foot": vars(self.foot), **({"relative": True} if self.relative else {}), **own}
        if self.rows is None and self.file is None:
            raise SurefootError("reference.file is missing; a reference of kind table needs a CSV or NPZ file")
        return {"kind": "table", "period": self.period, **({"file": self.file} if self.rows is None else self.rows)}


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

    def of(self, names: Sequence[str]) -> list[tuple[float, float]]:
        """Return the bounds of coordinates by name."""
        return [getattr(self, name) for name in names]


@dataclass(frozen=True)
class TaskConfig:
    """Configuration of a task."""

    name: str = "gait"
    """Name of the task; run folders carry it."""
    robot: str = DEFAULT_ROBOT
    """Name of a robot that ships with surefoot, or the path of a robot's folder."""
    observations: tuple[str, ...] = IMU_AND_MOTORS_12D
    """Parts of the observation, in order."""
    history: Annotated[int, Within(1, 100)] = 1
    """Number of last observations in the policy's input, the newest first."""
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)
    """The open loop part of the gait."""
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    """Bounds of the policy's part."""
    action: ActionKind = "leg"
    """What the policy's part is added to: the legs' poses in leg space, or the motors' angles."""
    rest: tuple[float, ...] | None = None
    """Pose of all legs in leg space in which the robot settles first; the middle of commands if not given."""
    energy_weight: Annotated[float, Within(0, 1e6)] = ENERGY_WEIGHT
    """w of the reward [m/J]."""
    target_speed: Annotated[float | None, Within(0, 100, above=True)] = None
    """Speed forward [m/s] up to which the reward counts progress; beyond it only energy counts. None: any speed."""
    fall_angle: Annotated[float, Within(0, math.pi)] = 0.5
    """Roll or pitch [rad] beyond which an episode ends."""
    fall_height: Annotated[float, Within(0, 10)] = 0.0
    """Height of the base's origin over the floor's mean [m] below which an episode ends; 0: none. It keeps gaits from
    crawling on the belly."""
    max_steps: Annotated[int, Within(1, MOST_STEPS)] = 1000
    """Control steps of an episode."""
    commands: CommandConfig = field(default_factory=CommandConfig)
    """Speeds and yaw rates that the robot is told to follow; none by default: straight on, as fast as it pays."""
    reward: dict[str, float] = field(default_factory=dict)
    """Weights of reward terms by name (`task.reward`), a second; without any the paper's reward."""
    pushes: PushConfig = field(default_factory=PushConfig)
    """Random pushes on the base."""
    randomize: Ranges = field(default_factory=dict)
    """Ranges from which every episode draws physical parameters, by name; in a file also the name of a table."""
    params: dict[str, ParamValue] = field(default_factory=dict)
    """Physical parameters that differ from the robot's description, by name: a number, or one for each motor."""
    params_source: dict[str, str] = field(default_factory=dict)
    """The file that they were read from, if any: its name as `file`, and `sha256`. It is not read again."""
    actuator: Literal["dc", "constraint"] = "dc"
    """dc: servo and DC motor; constraint: the position motor of physics engines, the paper's baseline."""
    thermal_protection: bool = False
    """Switch off motors that overheat."""
    start_linear_speed: Annotated[float, Within(0, 100)] = 0.05
    """An episode starts with a random base velocity, each component up to this [m/s]."""
    start_angular_speed: Annotated[float, Within(0, 100)] = 0.1
    """An episode starts with a random angular velocity, each component up to this [rad/s]."""

    def __post_init__(self) -> None:
        """Refuse an invalid name and values out of bounds."""
        check_name("name", self.name)
        check_bounds(self)
        check_terms(self.reward)
        check_ranges(self.randomize)

    def gait(self, robot: RobotDescription) -> HybridGait:
        """Return the gait: reference and bounds of the feedback, which the robot must allow.

        Beside a `relative` reference, which serves any robot, bounds are narrowed to what the legs allow.
        """
        reference = make_reference(self.reference.to_mapping(), robot, self.commands.limits(robot))
        names = ("joint",) if self.action == "joint" else robot.coordinates
        bounds = self.feedback.of(names)
        if self.reference.relative and self.action == "leg":
            bounds = narrowed_bounds(bounds, reference, robot)
        return HybridGait(robot, reference, *bounds, action=self.action)

    def nominal(self, robot: RobotDescription) -> PhysicalParams:
        """Return the physical parameters, which the robot must allow, without randomization, one row."""
        return PhysicalParams.nominal(robot).with_values(robot, **self.params)


def preset_names(robot: str = DEFAULT_ROBOT) -> list[str]:
    """Return the names of the tasks that ship with surefoot: those of a robot, and those for any."""
    return sorted({path.stem for folder in (_tasks_of(robot), _PRESETS) for path in folder.glob("*.yaml")})


def _tasks_of(robot: str) -> Path:
    """Return the folder with a robot's own tasks, which need not be there."""
    return RobotDescription.find_folder(robot) / "tasks"


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
        if robot is None and task.startswith(f"{name}-"):
            task, robot = task.removeprefix(f"{name}-"), name
    path, named = _task_file(task, robot or DEFAULT_ROBOT)
    data = _with_base(read_yaml(path), path)
    train = data.pop("train", None) or {}
    data.pop("handcrafted", None)  # Belongs to `HandcraftedGait`, whose task this is.
    cost_weight, push_weight = data.pop("cost_weight", None), data.pop("push_weight", None)
    if robot is not None or path.parent == _PRESETS:
        data["robot"] = robot or DEFAULT_ROBOT
    with located(path):
        config = from_mapping(
            TaskConfig, {"name": path.stem, **resolve_ranges(data, path.parent, data.get("robot", DEFAULT_ROBOT))}
        )
        if named and config.robot != DEFAULT_ROBOT:
            config = replace(config, name=f"{RobotDescription.load(config.robot).name}-{path.stem}")
        if cost_weight is not None:
            if not is_number(cost_weight) or not 0 <= cost_weight <= 1e6:
                raise SurefootError(f"cost_weight is {quoted(cost_weight)}; it must be a number from 0 to 1e6")
            config = replace(config, energy_weight=cost_weight / RobotDescription.load(config.robot).weight)
        if push_weight is not None:
            pair = isinstance(push_weight, list) and len(push_weight) == 2
            if not pair or not all(is_number(number) for number in push_weight):
                raise SurefootError(f"push_weight is {quoted(push_weight)}; it must be two numbers, least and greatest")
            force = [number * RobotDescription.load(config.robot).weight for number in push_weight]
            config = from_mapping(TaskConfig, {"pushes": {"force": force}}, base=config)
    if config.reference.file is not None:
        # A table's path counts from the task's file, wherever surefoot is run.
        absolute = str((path.parent / config.reference.file).resolve())
        config = from_mapping(TaskConfig, {"reference": {"file": absolute}}, base=config)
    return config, train


def _with_base(data: dict[str, Any], path: Path) -> dict[str, Any]:
    """Return a task file's table laid over that of its `base`, the name of a task for any robot, if it names one."""
    base = data.pop("base", None)
    if base is None:
        return data
    names = sorted(found.stem for found in _PRESETS.glob("*.yaml") if found != path)
    if base not in names:
        raise SurefootError(f"{path}: base is {quoted(base)}; choices: {choices(names)}")
    below = _PRESETS / f"{base}.yaml"
    return _laid_over(_with_base(read_yaml(below), below), data)


def _laid_over(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return a table with what another one changes or adds, at every depth."""
    both = {
        key: _laid_over(below[key], value)
        for key, value in above.items()
        if isinstance(value, dict) and isinstance(below.get(key), dict)
    }
    return {**below, **above, **both}


def _task_file(task: str, robot: str) -> tuple[Path, bool]:
    """Return the file of a task, and whether it is one that ships."""
    for folder in (_tasks_of(robot), _PRESETS):
        path = folder / f"{task}.yaml"
        if task in {found.stem for found in folder.glob("*.yaml")}:
            return path, True
    if not Path(task).is_file():
        raise SurefootError(
            f"task '{task}' does not exist; choices: {choices(preset_names(robot))}, or the path of a YAML file"
        )
    return Path(task), False
