"""Hybrid gait: motor angles from a reference and bounded feedback, a(t, o) = reference(t) + feedback(o)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import SurefootError
from surefoot.policy.contract import MEMORY, MEMORY_RANGE
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.reference import Reference

Range = tuple[float, float]
ActionKind = Literal["leg", "joint", "angle"]


def action_names(robot: RobotDescription, kind: ActionKind, memory: int = 0) -> list[str]:
    """Return the names of the feedback's columns.

    They are COORDINATE.LEG, coordinate by coordinate for all legs, or KIND.MOTOR for all motors, followed by the
    columns of the policy's memory.
    """
    names = [f"{part}.{leg}" for part in robot.coordinates for leg in robot.leg_names]
    if kind != "leg":
        names = [f"{kind}.{motor}" for motor in robot.motor_names]
    return [*names, *(f"{MEMORY}.{k}" for k in range(memory))]


def narrow_bounds(bounds: Sequence[Range], reference: Reference, robot: RobotDescription) -> list[Range]:
    """Return the bounds of feedback in leg space, narrowed so that reference plus feedback is within the legs' range.

    With most references, the feedback must fit in every phase of the gait. References with feedforward of motion are
    clipped to the legs' range anyway, so their bounds include all feedback that is useful in any phase.
    """
    extent = reference.extent()
    if reference.is_clipped:
        extent = tuple((highest, lowest) for lowest, highest in extent)
    spans = zip(bounds, extent, robot.leg_space.values(), strict=True)
    return [
        (max(low, min(allowed_low - lowest, 0.0)), min(high, max(allowed_high - highest, 0.0)))
        for (low, high), (lowest, highest), (allowed_low, allowed_high) in spans
    ]


class HybridGait:
    """Reference plus bounded feedback (Tan et al. 2018, eq. 3).

    With a velocity feedforward time T, commands lead the reference by T dq/dt. An actuator with T = k_d / k_p then
    damps the velocity relative to the reference instead of the absolute velocity. Commands with feedforward are clipped
    to the legs' range.

    Feedback has A columns. With `action` leg they are C coordinates in leg space for each of L legs, with `action`
    joint an angle added to each of M motors, and with `action` angle the motor angles themselves, within the joints'
    limits and without a reference. `memory` more columns do not move the robot; the next observation contains them.

    Args:
        robot: robot, with the order and range of its legs.
        reference: open-loop part of the command, in leg space.
        bounds: bounds of the feedback: for each coordinate in the robot's order with `action` leg; one range [rad] for
            all motors with `action` joint; none with `action` angle.
        action: what the feedback is added to: leg poses, motor angles, or nothing.
        memory: number of columns that the policy keeps from one control step to the next.

    Raises:
        SurefootError: commands that are not clipped could exceed the legs' range.
    """

    def __init__(
        self,
        robot: RobotDescription,
        reference: Reference,
        *bounds: Range,
        action: ActionKind = "leg",
        memory: int = 0,
    ) -> None:
        self.robot, self.reference, self.action_kind, self.memory = robot, reference, action, memory
        if reference.feedforward.weight:
            self._allowed = robot.angle_extent(*robot.leg_space.values())
        legs, coordinates = len(robot.legs), robot.coordinates
        self._shape = (len(coordinates), legs)
        self._space = np.array(list(robot.leg_space.values())).T[..., None]
        self._ranges: list[Range] = []
        if action == "angle":
            if np.any(reference.extent()):
                raise SurefootError("action is angle: feedback is the motors' angles; the reference must be none")
            self.low, self.high = robot.motor_limits
        else:
            count = robot.num_motors if action == "joint" else legs
            self.low, self.high = np.repeat(np.array(bounds, float).T, count, axis=1)
            self._add_ranges(bounds)
        self.low = np.append(self.low, np.full(memory, -MEMORY_RANGE))
        self.high = np.append(self.high, np.full(memory, MEMORY_RANGE))

    def _add_ranges(self, bounds: Sequence[Range]) -> None:
        """Set the range of commands for each coordinate of leg space, and check it against the robot's range."""
        robot, reference, action, coordinates = self.robot, self.reference, self.action_kind, self.robot.coordinates
        feedback = bounds if action == "leg" else [(0.0, 0.0)] * len(coordinates)
        spans = zip(robot.leg_space.items(), robot.leg_geometry.units, reference.extent(), feedback, strict=True)
        for (name, (allowed_low, allowed_high)), unit, (lowest, highest), (low, high) in spans:
            if reference.is_clipped:
                self._ranges.append((max(lowest + low, allowed_low), min(highest + high, allowed_high)))
                continue
            self._ranges.append((lowest + low, highest + high))
            if lowest + low < allowed_low - 1e-9 or highest + high > allowed_high + 1e-9:
                unit = "" if unit == "1" else f" {unit}"
                raise SurefootError(
                    f"{name} can be {lowest + low:.3f} to {highest + high:.3f}{unit} "
                    f"(reference {lowest:.3f} to {highest:.3f}, feedback {low:g} to {high:g}); "
                    f"a leg of {robot.name} allows {allowed_low:g} to {allowed_high:g}"
                )

    @property
    def action_names(self) -> list[str]:
        """Names of the feedback's columns, see the function `action_names`."""
        return action_names(self.robot, self.action_kind, self.memory)

    @property
    def rest(self) -> tuple[float, ...]:
        """Resting pose in leg space: the middle of the range of commands, or the robot's own with `action` angle."""
        if self.action_kind == "angle":
            return self.robot.rest
        return tuple(float(low + high) / 2 for low, high in self._ranges)

    def angle_extent(self) -> tuple[Array, Array]:
        """Return the minimum and maximum motor angles (M,) [rad] of commands."""
        motors = self.robot.num_motors
        if self.action_kind == "angle":
            return self.low[:motors], self.high[:motors]
        feedforward = self.reference.feedforward
        is_clipped = feedforward.moves_poses or feedforward.weight
        ranges = list(self.robot.leg_space.values()) if is_clipped else self._ranges
        lowest, highest = self.robot.angle_extent(*ranges)
        return (
            (lowest + self.low[:motors], highest + self.high[:motors])
            if self.action_kind == "joint"
            else (lowest, highest)
        )

    def feedback(self, action: ArrayLike) -> Array:
        """Scale actions (N, A) from [-1, 1] to the bounds of the feedback, with clipping."""
        unit = np.clip(np.asarray(action, float), -1.0, 1.0)
        return self.low + (unit + 1.0) / 2 * (self.high - self.low)

    def action(self, feedback: ArrayLike) -> Array:
        """Scale feedback (N, A) to actions in [-1, 1]; 0 where bounds are equal."""
        width = self.high - self.low
        free = width > 0
        unit = 2 * (np.asarray(feedback, float) - self.low) / np.where(free, width, 1.0) - 1.0
        return np.where(free, np.clip(unit, -1.0, 1.0), 0.0)

    def motor_targets(self, time: ArrayLike, feedback: Array, state: CommandState | None = None) -> Array:
        """Return the commanded motor angles (N, M) [rad].

        Args:
            time: time since the episode's start (N,) [s].
            feedback: feedback (N, A).
            state: state of a gait that follows commands.
        """
        feedback = feedback[:, : len(self.low) - self.memory]
        if self.action_kind == "angle":
            return feedback
        reference, feedforward = self.reference, self.reference.feedforward
        lead = None
        if feedforward.moves_poses:
            pose, rate = reference.pose_and_rate(time, state)
            lead = feedforward.velocity * rate
            if feedforward.acceleration:
                lead += feedforward.acceleration * reference.pose_acceleration(time, state)
        else:
            pose = reference.pose(time, state)
        joint = self.action_kind == "joint"
        if not joint:
            pose = pose + feedback.reshape(len(feedback), *self._shape)
        if lead is not None:
            pose = np.clip(pose + lead, *self._space)
        motors = self.robot.to_motors(pose)
        if feedforward.weight:
            motors = np.clip(motors + self._weight_lead(motors, state), *self._allowed)
        return motors + feedback if joint else motors

    def _weight_lead(self, motors: Array, state: CommandState | None) -> Array:
        """Return the deflection of the actuators under the robot's weight, J^T F / k_p, as angles (N, M) [rad]."""
        index, reference = self.robot.leg_motor_index, self.reference
        rise = self.robot.leg_geometry.foot_kinematics(motors[:, index]).jacobian[..., 2, :]
        lead = np.empty_like(motors)
        lead[:, index] = -reference.feedforward.weight * reference.load(state)[..., None] * rise
        return lead
