"""Components with privileged observations for the critic: the true state of robots in simulation."""

from __future__ import annotations

from surefoot.robot import RobotDescription
from surefoot.rotations import in_heading_frame
from surefoot.task.component import Component, Privileged
from surefoot.task.height_scan import CRITIC_GRID, scan_heights
from surefoot.task.observation import gait_phase
from surefoot.task.state import EnvState, base_height


class TrueState(Component):
    """True height, velocity and orientation of the base, motor angles and motor speeds.

    Args:
        robot: the robot.
        in_heading_frame: whether the velocity is in the heading frame; otherwise in the world frame.
    """

    def __init__(self, robot: RobotDescription, in_heading_frame: bool) -> None:
        self._motors, self._in_heading_frame = robot.motor_names, in_heading_frame

    def privileged(self, state: EnvState) -> Privileged:
        """Return height [m], velocity [m/s], roll, pitch and yaw [rad], motor angles [rad] and speeds [rad/s]."""
        truth, velocity = state.truth, state.truth.base_velocity_world
        if self._in_heading_frame:
            velocity = in_heading_frame(velocity, truth.roll_pitch_yaw[:, 2])
        return [
            (["height"], base_height(truth.base_position_world, state.ground)[:, None]),
            (["velocity_x", "velocity_y", "velocity_z"], velocity),
            (["roll", "pitch", "yaw"], truth.roll_pitch_yaw),
            ([f"angle.{motor}" for motor in self._motors], truth.motor_angle),
            ([f"speed.{motor}" for motor in self._motors], truth.motor_velocity),
        ]


class TrueHeights(Component):
    """True terrain heights around robots.

    Args:
        robot: the robot.
    """

    def __init__(self, robot: RobotDescription) -> None:
        self._points = CRITIC_GRID.points(robot)

    def privileged(self, state: EnvState) -> Privileged:
        """Return the terrain heights relative to the base's origin [m]."""
        truth = state.truth
        heights = scan_heights(state.ground, self._points, truth.base_position_world, truth.roll_pitch_yaw[:, 2])
        return [(CRITIC_GRID.columns(), heights)]


class ReferencePhase(Component):
    """Phase of a periodic reference gait."""

    def privileged(self, state: EnvState) -> Privileged:
        """Return sine and cosine of the phase."""
        return [(["phase_sin", "phase_cos"], gait_phase(state))]
