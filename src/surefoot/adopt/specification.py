"""Specification of a third-party policy, the common representation of all formats.

As YAML it is the format `manual`. Numbers are in SI units. Angles are joint angles of the robot's URDF, in the order of
`joints`, unless stated otherwise.
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
    "base_velocity",
    "roll_pitch",
    "joint_positions",
    "joint_speeds",
    "last_action",
    "clock",
    "constant",
]
MAX_HISTORY = 100
BASE_SPEED = "is the speed of the base, which no sensor of a robot measures"
BASE_SPEED_REMEDY = "give --base-velocity estimate to adopt the policy with an estimate from the IMU and the legs"
PerJoint = float | tuple[float, ...]
"""One number, or one per joint in the network's order."""
Range = tuple[float, float]


@dataclass(frozen=True)
class ObservationTerm:
    """A term of the network's observation; its values are clipped, scaled and clipped again, for each time step."""

    term: TermName
    """command: forward and leftward velocity [m/s] and yaw rate [rad/s]; gravity: unit vector in the base frame,
    (0, 0, -1) for a level base; angular_velocity: of the base, in the base frame [rad/s]; base_velocity: estimated
    velocity of the base, in the base frame [m/s]; roll_pitch [rad];
    joint_positions: minus the default pose [rad]; joint_speeds [rad/s]; last_action: raw network output, clipped by
    `action_clip`, initially 0; clock: sine and cosine of a phase; constant: `values`."""
    scale: Annotated[PerJoint, Within(-1e4, 1e4)] = 1.0
    """Scale factor: one for the whole term, or one per element."""
    clip: Annotated[Range | None, Within(-1e6, 1e6)] = None
    """Minimum and maximum before scaling; None: not clipped."""
    clip_after: Annotated[Range | None, Within(-1e6, 1e6)] = None
    """Minimum and maximum after scaling; None: not clipped."""
    steps: Annotated[tuple[int, ...], Within(0, MAX_HISTORY - 1)] = (0,)
    """History: ages of the values in control steps, in the network's order; 0 is the newest. (4, 3, 2, 1, 0) is a
    history of length 5, oldest first."""
    columns: Annotated[tuple[int, ...] | None, Within(0, 4095)] = None
    """Indices of the term's elements that the network takes, in order; None: all."""
    relative: bool = True
    """Whether the default pose is subtracted from joint positions."""
    period: Annotated[float, Within(1e-3, 3600)] = 1.0
    """Period of a clock [s]."""
    start: Annotated[float, Within(-1e3, 1e3)] = 0.0
    """Phase of a clock in the first control step [cycles]."""
    phases: Annotated[tuple[float, ...], Within(-1e3, 1e3)] = (0.0,)
    """Phase offsets of a clock [cycles]; each gives a sine and a cosine."""
    values: Annotated[tuple[float, ...], Within(-1e6, 1e6)] = ()
    """Values of a constant term."""

    def __post_init__(self) -> None:
        """Reject numbers out of bounds."""
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
    """Specification of a third-party policy: everything except its network."""

    joints: tuple[str, ...]
    """Joint names of the robot's URDF, in the network's order."""
    default_pose: Annotated[tuple[float, ...], Within(-2 * math.pi, 2 * math.pi)]
    """Joint angles [rad] to which actions and joint positions are relative, and in which the robot initially stands."""
    kp: Annotated[PerJoint, Within(0, 1e4)]
    """Proportional gain [N m/rad], one for all joints or one per joint."""
    kd: Annotated[PerJoint, Within(0, 1e4)]
    """Derivative gain [N m s/rad], one for all joints or one per joint."""
    control_step: Annotated[float, Within(1e-4, 1)]
    """Time between two actions [s]: the simulation step times the decimation."""
    observations: tuple[ObservationTerm, ...]
    """Terms of the network's observation, in order."""
    action_scale: Annotated[PerJoint, Within(-100, 100)] = 1.0
    """Joint angle per unit of action [rad]."""
    action_offset: Annotated[tuple[float, ...] | None, Within(-2 * math.pi, 2 * math.pi)] = None
    """Joint angles at action 0 [rad]; defaults to the default pose."""
    action_clip: Annotated[tuple[PerJoint, PerJoint] | None, Within(-1e6, 1e6)] = None
    """Minimum and maximum action before scaling; None: not clipped."""
    target_clip: Annotated[tuple[PerJoint, PerJoint] | None, Within(-1e3, 1e3)] = None
    """Minimum and maximum target joint angle [rad]; None: only the joint limits, which always apply."""
    joint_signs: Annotated[tuple[float, ...] | None, Within(-1, 1)] = None
    """1 or -1 for each joint: its positive direction relative to the robot's URDF; defaults to 1."""
    observation_clip: Annotated[float | None, Within(0, 1e6, exclusive=True)] = None
    """Maximum absolute value of an observation after scaling; None: not clipped."""
    history_by: Literal["step", "term"] = "step"
    """Order of an observation with history. step: all terms of one time step, then all terms of the next; term: all
    time steps of one term, then all time steps of the next."""
    forward: Annotated[Range, Within(-100, 100)] = (-0.5, 1.0)
    """Range of forward velocity commands [m/s], as in training."""
    sideways: Annotated[Range, Within(-100, 100)] = (-0.4, 0.4)
    """Range of leftward velocity commands [m/s]."""
    yaw_rate: Annotated[Range, Within(-100, 100)] = (-0.8, 0.8)
    """Range of yaw rate commands [rad/s]."""
    latency: Annotated[float | None, Within(0, 1)] = None
    """Latency of the readings in training [s]; defaults to the robot's nominal value."""
    base_velocity: Literal["estimate"] | None = None
    """Source of the observation base_velocity, which no sensor of a robot measures. estimate: an estimate from the IMU
    and the legs; None: there is none, so that a policy that observes it can't be adopted."""
    fall_angle: Annotated[float, Within(1e-3, math.pi)] = 0.5
    """Roll or pitch [rad] beyond which an episode ends."""
    name: str = ""
    """Name of the policy; defaults to the name of the written file."""
    notes: dict[str, str] = field(default_factory=dict)
    """Notes for the user by field, such as assumptions."""

    def __post_init__(self) -> None:
        """Reject fields that contradict each other."""
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
            raise SurefootError("observations are empty; name at least one")
        if self.history_by == "step" and len({term.steps for term in self.observations}) > 1:
            raise SurefootError("history_by is step, so all observations must have the same steps")

    @property
    def observes_base_velocity(self) -> bool:
        """Whether the network observes the velocity of the base."""
        return any(term.term == "base_velocity" for term in self.observations)

    def check_base_velocity(self) -> None:
        """Reject an observed velocity of the base without a source, and a source that nothing observes."""
        if self.observes_base_velocity and self.base_velocity is None:
            raise SurefootError(f"observation base_velocity {BASE_SPEED}; {BASE_SPEED_REMEDY}")
        if self.base_velocity is not None and not self.observes_base_velocity:
            raise SurefootError(
                f"base_velocity is {self.base_velocity}; the network does not observe the speed of the base: leave "
                "--base-velocity out"
            )

    def check_commands(self) -> None:
        """Reject command ranges without 0, which is surefoot's command to stand."""
        for name, unit in COMMANDS.items():
            low, high = getattr(self, name)
            if low > high:
                raise SurefootError(f"{name} is [{low:g}, {high:g}]; the lower bound must come first")
            if not low <= 0.0 <= high:
                option = f"--{name.replace('_', '-')} {min(low, 0.0):g} {max(high, 0.0):g}"
                raise SurefootError(
                    f"{name} is [{low:g}, {high:g}] {unit}, without 0: standing was never trained. surefoot commands 0 "
                    f"to stand; give {option} if the policy can stand"
                )
