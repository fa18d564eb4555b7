"""What has to be known about a policy that others trained; every format is read into this.

As YAML it is the format `manual`. Numbers are in SI units and angles are joint angles as the robot's URDF has them, in
the order of `joints`, unless stated otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

from surefoot.configuration import Within, check_bounds
from surefoot.errors import SurefootError, check_name, choices
from surefoot.robot.commands import COMMANDS

TermName = Literal[
    "command",
    "gravity",
    "angular_velocity",
    "roll_pitch",
    "joint_positions",
    "joint_speeds",
    "last_action",
    "clock",
    "constant",
]
MAX_HISTORY = 100
PerJoint = float | tuple[float, ...]
"""One number, or one for each joint in the network's order."""
Range = tuple[float, float]


@dataclass(frozen=True)
class ObservationTerm:
    """A part of the network's observation: its numbers are clipped, scaled and clipped, for each of its ages."""

    term: TermName
    """command: speeds forward and to the left [m/s] and yaw rate [rad/s]; gravity: its direction in the base frame,
    (0, 0, -1) of a level base; angular_velocity: of the base, in the base frame [rad/s]; roll_pitch [rad];
    joint_positions: less the default pose [rad]; joint_speeds [rad/s]; last_action: as the network gave it, clipped by
    `action_clip`, 0 at first; clock: sine and cosine of a phase; constant: `values`."""
    scale: Annotated[PerJoint, Within(-1e4, 1e4)] = 1.0
    """Factor, one for all numbers of the term or one for each."""
    clip: Annotated[Range | None, Within(-1e6, 1e6)] = None
    """Least and greatest number before the scale; None: they are not clipped."""
    clip_after: Annotated[Range | None, Within(-1e6, 1e6)] = None
    """Least and greatest number after the scale; None: they are not clipped."""
    steps: Annotated[tuple[int, ...], Within(0, MAX_HISTORY - 1)] = (0,)
    """Ages of its numbers in control steps, in the network's order: 0 is the newest. (4, 3, 2, 1, 0) is a history of 5,
    the oldest first."""
    columns: Annotated[tuple[int, ...] | None, Within(0, 4095)] = None
    """Which of its numbers the network takes, in order; None: all."""
    relative: bool = True
    """Whether joint positions are less the default pose."""
    period: Annotated[float, Within(1e-3, 3600)] = 1.0
    """Period of a clock [s]."""
    start: Annotated[float, Within(-1e3, 1e3)] = 0.0
    """Phase of a clock in the first control step [cycles]."""
    phases: Annotated[tuple[float, ...], Within(-1e3, 1e3)] = (0.0,)
    """What is added to a clock's phase [cycles]: sine and cosine for each of them."""
    values: Annotated[tuple[float, ...], Within(-1e6, 1e6)] = ()
    """The numbers of a constant."""

    def __post_init__(self) -> None:
        """Refuse numbers out of bounds."""
        check_bounds(self, "observations")
        if not self.steps:
            raise SurefootError(f"observation {self.term}: steps is empty; it must have an age, such as 0")
        for name in ("clip", "clip_after"):
            low, high = getattr(self, name) or (0.0, 0.0)
            if low > high:
                raise SurefootError(
                    f"observation {self.term}: {name} is [{low:g}, {high:g}]; the lower bound must come first"
                )


@dataclass(frozen=True)
class PolicySpecification:
    """A policy that others trained, without its network."""

    joints: tuple[str, ...]
    """Joints in the network's order, by their names in the robot's URDF."""
    default_pose: Annotated[tuple[float, ...], Within(-2 * math.pi, 2 * math.pi)]
    """Joint angles [rad] about which actions and joint positions count; the robot stands in them first."""
    kp: Annotated[PerJoint, Within(0, 1e4)]
    """Proportional gain [N m/rad] of all joints, or of each."""
    kd: Annotated[PerJoint, Within(0, 1e4)]
    """Derivative gain [N m s/rad] of all joints, or of each."""
    control_step: Annotated[float, Within(1e-4, 1)]
    """Time between two actions [s]: the simulation's step times its decimation."""
    observations: tuple[ObservationTerm, ...]
    """Parts of the network's observation, in order."""
    action_scale: Annotated[PerJoint, Within(-100, 100)] = 1.0
    """Joint angle [rad] for each unit of the action."""
    action_offset: Annotated[tuple[float, ...] | None, Within(-2 * math.pi, 2 * math.pi)] = None
    """Joint angles [rad] of action 0; the default pose, if not given."""
    action_clip: Annotated[tuple[PerJoint, PerJoint] | None, Within(-1e6, 1e6)] = None
    """Least and greatest action, before the scale; None: not clipped."""
    target_clip: Annotated[tuple[PerJoint, PerJoint] | None, Within(-1e3, 1e3)] = None
    """Least and greatest joint angle [rad]; None: the joints' own limits. These hold in any case."""
    joint_signs: Annotated[tuple[float, ...] | None, Within(-1, 1)] = None
    """1 or -1 for each joint: its sense over that of the robot's URDF; None: the same."""
    observation_clip: Annotated[float | None, Within(0, 1e6, exclusive=True)] = None
    """Greatest size of a number of the observation, after the scale; None: not clipped."""
    history_by: Literal["step", "term"] = "step"
    """Order of an observation with several ages. step: all terms of an age, then all terms of the next one; term: all
    ages of a term, then all ages of the next one."""
    forward: Annotated[Range, Within(-100, 100)] = (-0.5, 1.0)
    """Speeds forward [m/s] that may be commanded: those of training."""
    sideways: Annotated[Range, Within(-100, 100)] = (-0.4, 0.4)
    """Speeds to the left [m/s] that may be commanded."""
    yaw_rate: Annotated[Range, Within(-100, 100)] = (-0.8, 0.8)
    """Yaw rates [rad/s] that may be commanded."""
    latency: Annotated[float | None, Within(0, 1)] = None
    """Age of the readings in training [s]; the robot's nominal one, if not given."""
    fall_angle: Annotated[float, Within(1e-3, math.pi)] = 0.5
    """Roll or pitch [rad] beyond which an episode ends."""
    name: str = ""
    """Name of the policy; that of the file that is written, if empty."""
    notes: dict[str, str] = field(default_factory=dict)
    """What the user should know of fields, such as what was assumed."""

    def __post_init__(self) -> None:
        """Refuse numbers that do not fit each other."""
        check_bounds(self)
        if self.name:
            check_name("name", self.name)
        count = len(self.joints)
        if not count or len(set(self.joints)) != count:
            raise SurefootError(f"joints are {choices(self.joints) or 'none'}; there must be some, and none twice")
        lists = {name: getattr(self, name) for name in ("default_pose", "kp", "kd", "action_scale", "action_offset")}
        lists["joint_signs"] = self.joint_signs
        for clip in ("action_clip", "target_clip"):
            low, high = getattr(self, clip) or (None, None)
            lists |= {f"{clip}[0]": low, f"{clip}[1]": high}
        for name, numbers in lists.items():
            if isinstance(numbers, tuple) and len(numbers) != count:
                raise SurefootError(f"{name} has {len(numbers)} numbers; there are {count} joints")
        if self.joint_signs is not None and not {*self.joint_signs} <= {1.0, -1.0}:
            raise SurefootError(f"joint_signs are {list(self.joint_signs)}; each must be 1 or -1")
        if not self.observations:
            raise SurefootError("observations are empty; a policy observes something")
        if self.history_by == "step" and len({term.steps for term in self.observations}) > 1:
            raise SurefootError("history_by is step, so all observations must have the same steps")

    def check_commands(self) -> None:
        """Refuse ranges of commands without 0, at which surefoot lets robots stand."""
        for name, unit in COMMANDS.items():
            low, high = getattr(self, name)
            if low > high:
                raise SurefootError(f"{name} is [{low:g}, {high:g}]; the lower bound must come first")
            if not low <= 0.0 <= high:
                option = f"--{name.replace('_', '-')} {min(low, 0.0):g} {max(high, 0.0):g}"
                raise SurefootError(
                    f"{name} is [{low:g}, {high:g}] {unit}, without 0: standing was never trained. surefoot lets "
                    f"robots stand at command 0; give {option} if it stands"
                )
