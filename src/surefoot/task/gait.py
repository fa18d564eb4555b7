"""The hybrid policy's arithmetic: a(t, o) = reference(t) + feedback(o), bounded, as motor angles."""

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
    """Return the names of the feedback's numbers: of every leg for each coordinate in turn, or of every motor.

    Those of the policy's memory come last.
    """
    names = [f"{part}.{leg}" for part in robot.coordinates for leg in robot.leg_names]
    if kind != "leg":
        names = [f"{kind}.{motor}" for motor in robot.motor_names]
    return [*names, *(f"{MEMORY}.{k}" for k in range(memory))]


def narrow_bounds(bounds: Sequence[Range], reference: Reference, robot: RobotDescription) -> list[Range]:
    """Return bounds of the feedback in leg space, narrowed to what the robot's legs allow beside a reference.

    Beside a reference that follows commands with a lead, poses are clipped to the leg space: feedback may be all that
    is of use in some phase. Beside others it must fit in every phase.
    """
    extent = reference.extent()
    if reference.is_clipped:
        extent = tuple((highest, lowest) for lowest, highest in extent)
    spans = zip(bounds, extent, robot.leg_space.values(), strict=True)
    return [
        (max(low, min(least - down_from, 0.0)), min(high, max(most - up_from, 0.0)))
        for (low, high), (down_from, up_from), (least, most) in spans
    ]


class HybridGait:
    """Reference plus bounded feedback (Tan et al. 2018, eq. 3).

    With a velocity feed-forward T of the reference, commands are T dq/dt ahead of it: an actuator with T = k_d / k_p
    then damps the difference to the reference's velocity, not the velocity. Commands with a lead are clipped to what
    legs allow.

    Feedback is in leg space, C numbers a leg, or, with `action` joint, an angle for each of the M motors. With `action`
    angle there is no reference and no leg space: feedback is the motors' angles themselves, within the joints' limits.
    `memory` numbers more move nothing; the next observation has them. A = C L or M, and these.

    Args:
        robot: legs, their order and range.
        reference: the open loop part, in leg space.
        bounds: bounds of the feedback on each leg's coordinates, in the robot's order; one range [rad] for all motors
            with `action` joint; none with `action` angle.
        action: what feedback is added to: poses of legs, motor angles, or nothing.
        memory: numbers that a policy keeps from one control step to the next.

    Raises:
        SurefootError: a command that is not clipped could leave the leg's range.
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
        """Set the range of each coordinate of leg space that commands may have, which the robot must allow."""
        robot, reference, action, coordinates = self.robot, self.reference, self.action_kind, self.robot.coordinates
        feedback = bounds if action == "leg" else [(0.0, 0.0)] * len(coordinates)
        spans = zip(robot.leg_space.items(), robot.leg_geometry.units, reference.extent(), feedback, strict=True)
        for (name, (allowed_low, allowed_high)), unit, (least, most), (low, high) in spans:
            if reference.is_clipped:
                self._ranges.append((max(least + low, allowed_low), min(most + high, allowed_high)))
                continue
            self._ranges.append((least + low, most + high))
            if least + low < allowed_low - 1e-9 or most + high > allowed_high + 1e-9:
                unit = "" if unit == "1" else f" {unit}"
                raise SurefootError(
                    f"{name} can be {least + low:.3f} to {most + high:.3f}{unit} "
                    f"(reference {least:.3f} to {most:.3f}, feedback {low:g} to {high:g}); "
                    f"a leg of {robot.name} allows {allowed_low:g} to {allowed_high:g}"
                )

    @property
    def action_names(self) -> list[str]:
        """Names of the feedback's numbers: see `action_names`."""
        return action_names(self.robot, self.action_kind, self.memory)

    @property
    def rest(self) -> tuple[float, ...]:
        """Pose in leg space in the middle of the range of commands; the robot's own, where commands are angles."""
        if self.action_kind == "angle":
            return self.robot.rest
        return tuple(float(low + high) / 2 for low, high in self._ranges)

    def angle_extent(self) -> tuple[Array, Array]:
        """Return the least and greatest motor angles (M,) [rad] that a command may have."""
        motors = self.robot.num_motors
        if self.action_kind == "angle":
            return self.low[:motors], self.high[:motors]
        ahead = self.reference.feedforward
        ranges = list(self.robot.leg_space.values()) if ahead.moves_poses or ahead.weight else self._ranges
        least, greatest = self.robot.angle_extent(*ranges)
        return (
            (least + self.low[:motors], greatest + self.high[:motors])
            if self.action_kind == "joint"
            else (least, greatest)
        )

    def feedback(self, action: ArrayLike) -> Array:
        """Return feedback (N, A) for actions in [-1, 1], clipped: -1 is the lower bound, 1 the upper one."""
        unit = np.clip(np.asarray(action, float), -1.0, 1.0)
        return self.low + (unit + 1.0) / 2 * (self.high - self.low)

    def action(self, feedback: ArrayLike) -> Array:
        """Return the actions (N, A) in [-1, 1] that give this feedback (N, A); 0 where bounds are equal."""
        width = self.high - self.low
        free = width > 0
        unit = 2 * (np.asarray(feedback, float) - self.low) / np.where(free, width, 1.0) - 1.0
        return np.where(free, np.clip(unit, -1.0, 1.0), 0.0)

    def motor_targets(self, time: ArrayLike, feedback: Array, state: CommandState | None = None) -> Array:
        """Return the motor angles (N, M) [rad] for feedback (N, A) at times (N,) [s], with what is followed."""
        feedback = feedback[:, : len(self.low) - self.memory]
        if self.action_kind == "angle":
            return feedback
        reference, ahead = self.reference, self.reference.feedforward
        pose = reference.pose(time, state)
        joint = self.action_kind == "joint"
        if not joint:
            pose = pose + feedback.reshape(len(feedback), *self._shape)
        if ahead.moves_poses:
            lead = ahead.velocity * reference.pose_rate(time, state)
            if ahead.acceleration:
                lead += ahead.acceleration * reference.pose_acceleration(time, state)
            pose = np.clip(pose + lead, *self._space)
        motors = self.robot.to_motors(pose)
        if ahead.weight:
            motors = np.clip(motors + self._weight_lead(motors, state), *self._allowed)
        return motors + feedback if joint else motors

    def _weight_lead(self, motors: Array, state: CommandState | None) -> Array:
        """Return the angles (N, M) [rad] by which the weight would bend actuators: J^T F / k_p."""
        index, reference = self.robot.leg_motor_index, self.reference
        rise = self.robot.leg_geometry.jacobian(motors[:, index])[..., 2, :]
        lead = np.empty_like(motors)
        lead[:, index] = -reference.feedforward.weight * reference.load(state)[..., None] * rise
        return lead
