"""The configuration of a task: robot, observation, feedback, reward."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from surefoot.configuration import Within, check_bounds, from_mapping, read_yaml
from surefoot.errors import SurefootError, check_name, choices, located
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamValue
from surefoot.task.observation import IMU_AND_MOTORS_12D
from surefoot.task.pushes import PushConfig
from surefoot.task.randomize import RandomizeConfig, with_ranges
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

    kind: Literal["none", "sine", "table", "foot"] = "none"
    """none: zero at all times; sine: `swing` and `extension`; table: poses out of `file`, every `period`;
    foot: paths of the feet, `foot`."""
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
    rows: dict[str, dict[str, tuple[float, ...]]] | None = None
    """The table itself, in place of `file`: under swing and extension, each leg's poses [rad]."""

    def to_mapping(self) -> dict[str, Any] | None:
        """Return the mapping that `make_reference` takes."""
        if self.kind == "none":
            return None
        if self.kind == "sine":
            return {"kind": "sine", "swing": vars(self.swing), "extension": vars(self.extension)}
        if self.kind == "foot":
            return {"kind": "foot", "foot": vars(self.foot)}
        if self.rows is None and self.file is None:
            raise SurefootError("reference.file is missing; a reference of kind table needs a CSV or NPZ file")
        return {"kind": "table", "period": self.period, **({"file": self.file} if self.rows is None else self.rows)}


@dataclass(frozen=True)
class FeedbackConfig:
    """Bounds of what the policy adds to the reference, in leg space [rad]; equal bounds leave no choice."""

    swing: tuple[float, float] = (-0.5, 0.5)
    """Least and greatest feedback on each leg's swing."""
    extension: tuple[float, float] = (-0.5, 0.5)
    """Least and greatest feedback on each leg's extension."""

    def __post_init__(self) -> None:
        """Refuse reversed bounds, and bounds that are not finite."""
        check_bounds(self, "feedback")
        for name, (low, high) in (("swing", self.swing), ("extension", self.extension)):
            if not low <= high:
                raise SurefootError(f"feedback.{name} is [{low:g}, {high:g}]; the lower bound must come first")


@dataclass(frozen=True)
class TaskConfig:
    """Configuration of a task."""

    name: str = "gait"
    """Name of the task; run folders carry it."""
    robot: str = "minitaur"
    """Name of a robot that ships with surefoot, or the path of a robot's folder."""
    observations: tuple[str, ...] = IMU_AND_MOTORS_12D
    """Parts of the observation, in order."""
    history: Annotated[int, Within(1, 100)] = 1
    """Number of last observations in the policy's input, the newest first."""
    reference: ReferenceConfig = field(default_factory=ReferenceConfig)
    """The open loop part of the gait."""
    feedback: FeedbackConfig = field(default_factory=FeedbackConfig)
    """Bounds of the policy's part."""
    rest: tuple[float, float] | None = None
    """Swing and extension [rad] in which the robot settles first; the middle of commands if not given."""
    energy_weight: Annotated[float, Within(0, 1e6)] = ENERGY_WEIGHT
    """w of the reward [m/J]."""
    target_speed: Annotated[float | None, Within(0, 100, above=True)] = None
    """Speed forward [m/s] up to which the reward counts progress; beyond it only energy counts. None: any speed."""
    fall_angle: Annotated[float, Within(0, math.pi)] = 0.5
    """Roll or pitch [rad] beyond which an episode ends."""
    max_steps: Annotated[int, Within(1, MOST_STEPS)] = 1000
    """Control steps of an episode."""
    pushes: PushConfig = field(default_factory=PushConfig)
    """Random pushes on the base."""
    randomize: RandomizeConfig = field(default_factory=RandomizeConfig)
    """Ranges from which every episode draws its physical parameters; in a file also the name of a table of ranges."""
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

    def nominal(self, robot: RobotDescription) -> PhysicalParams:
        """Return the physical parameters, which the robot must allow, without randomization, one row."""
        return PhysicalParams.nominal(robot).with_values(robot, **self.params)


def preset_names() -> list[str]:
    """Return the names of the tasks that ship with surefoot."""
    return sorted(path.stem for path in _PRESETS.glob("*.yaml"))


def load_task(task: str) -> tuple[TaskConfig, dict[str, Any]]:
    """Read a task by preset name or path; returns it and the file's `train` table (empty, if there is none)."""
    path = _PRESETS / f"{task}.yaml" if task in preset_names() else Path(task)
    if not path.is_file():
        raise SurefootError(
            f"task '{task}' does not exist; choices: {choices(preset_names())}, or the path of a YAML file"
        )
    data = read_yaml(path)
    train = data.pop("train", None) or {}
    data.pop("handcrafted", None)  # Belongs to `HandcraftedGait`, whose task this is.
    with located(path):
        config = from_mapping(TaskConfig, {"name": path.stem, **with_ranges(data, path.parent)})
    if config.reference.file is not None:
        # A table's path counts from the task's file, wherever surefoot is run.
        absolute = str((path.parent / config.reference.file).resolve())
        config = from_mapping(TaskConfig, {"reference": {"file": absolute}}, base=config)
    return config, train
