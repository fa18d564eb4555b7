"""State of a batch of robots, the input of observations, reward terms, terminations and components.

A `RobotState` contains only quantities that a robot's control computer also has. An `EnvState` adds the true state of a
simulation. The heading frame is upright and has the yaw of the base.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import in_heading_frame
from surefoot.task.commands import CommandState
from surefoot.task.gait import HybridGait
from surefoot.world.ground import Ground
from surefoot.world.interface import SensorReadings, SimState, Simulation

_CACHED = ("_rates", "action")
"""Cached properties of `EnvState`, which are computed again after every control step."""


@dataclass(frozen=True)
class RobotScales:
    """Scales that make a robot's motion dimensionless."""

    length: float
    """Length l of the straight leg [m]."""
    speed: float
    """sqrt(g l) [m/s]."""
    rate: float
    """sqrt(g / l) [1/s]."""
    weight: float
    """m g [N]."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> RobotScales:
        """Return the scales of a robot."""
        length = robot.leg_geometry.length
        return cls(length, float(np.sqrt(GRAVITY * length)), float(np.sqrt(GRAVITY / length)), robot.weight)


def base_height(position: Array, ground: Ground) -> Array:
    """Return the heights (N,) [m] of points in the world (N, 3) above the smoothed ground."""
    return np.asarray(position[:, 2] - ground.smooth_height(position[:, :2]))


def base_tilt(truth: SimState, ground: Ground) -> Array:
    """Return roll and pitch of the base relative to the slope of the ground (N, 2) [rad]."""
    angles = truth.roll_pitch_yaw
    if not ground.smooth_heights.size:
        return angles[:, :2]
    tilt: Array = angles[:, :2] - ground.tilt(truth.base_position_world[:, :2], angles[:, 2])
    return tilt


def base_rates(before: SimState, after: SimState, duration: Array | float) -> tuple[Array, Array]:
    """Return the mean velocities of the base over a control step, for N robots.

    Args:
        before: true state at the start.
        after: true state at the end.
        duration: duration of the step [s], a number or (N, 1).

    Returns:
        Velocity in the heading frame at the start [m/s], and rates of roll, pitch and yaw [rad/s], (N, 3) each.
    """
    velocity = (after.base_position_world - before.base_position_world) / duration
    turned = (after.roll_pitch_yaw - before.roll_pitch_yaw + np.pi) % (2 * np.pi) - np.pi
    return in_heading_frame(velocity, before.roll_pitch_yaw[:, 2]), turned / duration


@dataclass
class RobotState:
    """State at the end of a control step as known to the control computer, for N robots with M motors."""

    gait: HybridGait
    readings: SensorReadings
    duration: Array
    """Nominal duration of the control step (N,) [s]; a step takes a whole number of servo steps, on average this."""
    feedback: Array
    """Feedback of the control step (N, A), see `HybridGait`; zero before the first step."""
    target: Array
    """Commanded motor angles (N, M) [rad]."""
    command: Array
    """Requested speeds forward and to the left [m/s] and yaw rate [rad/s] (N, 3); zero in a task without commands."""
    filtered_command: Array
    """Command after the rate limit, without the yaw rate of the heading control (N, 3) [m/s, m/s, rad/s]."""
    heading_error: Array
    """Desired minus measured heading (N,) [rad]."""
    gait_state: CommandState | None = None
    """Command, phase, footholds and lift of the gait; None in a task without commands."""
    heights: Array | None = None
    """Terrain heights around the robots (N, K) [m], see `height_scan`; None without a map."""
    base_velocity: Array | None = None
    """Estimated velocity of the base in its frame (N, 3) [m/s], see `base_velocity`; None unless it is observed."""

    @classmethod
    def initial(cls, gait: HybridGait, readings: SensorReadings, duration: Array, **more: Any) -> Any:
        """Return the state of robots before their first control step.

        Args:
            gait: the gait.
            readings: the first readings.
            duration: duration of the control step (N,) [s].
            more: additional fields of a subclass.
        """
        num_envs = len(duration)
        return cls(
            gait=gait,
            readings=readings,
            duration=duration,
            feedback=np.zeros((num_envs, len(gait.action_names))),
            target=np.zeros((num_envs, gait.robot.num_motors)),
            command=np.zeros((num_envs, 3)),
            filtered_command=np.zeros((num_envs, 3)),
            heading_error=np.zeros(num_envs),
            **more,
        )

    def without_truth(self) -> RobotState:
        """Return the state without the true state of the simulation."""
        return RobotState(**{field.name: getattr(self, field.name) for field in fields(RobotState)})


@dataclass(kw_only=True)
class EnvState(RobotState):
    """State of N simulated robots after a reset or a control step."""

    world: Simulation
    ground: Ground
    scales: RobotScales
    truth: SimState
    """True state at the end of the control step."""
    before: SimState
    """True state at the start of the control step."""
    last_feedback: Array
    """Feedback of the previous control step (N, A)."""
    start_place: Array
    """Position on the ground at which the next episode starts (N, 2) [m]."""
    start_position: Array
    """Position of the settled base at the episode's start (N, 3) [m]."""
    command_error: Array
    """Mean speeds forward and to the left and yaw rate minus the filtered command (N, 3) [m/s, m/s, rad/s]."""
    stride_error: Array
    """Command error, exponentially averaged over a stride (N, 3) [m/s, m/s, rad/s]."""
    foothold_error: Array
    """Foothold error of feet that touched down in this control step (N,), see `FootholdError`."""
    push_force: Array
    """Push force on the base in the world frame (N, 3) [N]."""
    reward: Array
    """Reward of the control step (N,)."""
    reward_terms: dict[str, Array]
    """Contribution of each reward term to the reward (N,), by name."""
    steps: NDArray[np.int64]
    """Control steps since the episode's start (N,)."""
    returns: Array
    """Return since the episode's start (N,)."""
    terminated: NDArray[np.bool_]
    """Whether the episode ended in this control step by a fall or divergence (N,)."""
    truncated: NDArray[np.bool_]
    """Whether the episode reached its maximum length in this control step (N,)."""
    over: NDArray[np.bool_]
    """Whether the robot waits for a reset (N,)."""

    @classmethod
    def of_world(cls, world: Simulation, gait: HybridGait, ground: Ground) -> EnvState:
        """Return the state of a world's robots before their first reset."""
        num_envs, truth = world.num_envs, world.truth()
        state: EnvState = cls.initial(
            gait,
            world.readings(),
            world.params.control_step,
            world=world,
            ground=ground,
            scales=RobotScales.from_robot(world.robot),
            truth=truth,
            before=truth,
            last_feedback=np.zeros((num_envs, len(gait.action_names))),
            start_place=np.zeros((num_envs, 2)),
            start_position=np.zeros((num_envs, 3)),
            command_error=np.zeros((num_envs, 3)),
            stride_error=np.zeros((num_envs, 3)),
            foothold_error=np.zeros(num_envs),
            push_force=np.zeros((num_envs, 3)),
            reward=np.zeros(num_envs),
            reward_terms={},
            steps=np.zeros(num_envs, np.int64),
            returns=np.zeros(num_envs),
            terminated=np.zeros(num_envs, np.bool_),
            truncated=np.zeros(num_envs, np.bool_),
            over=np.zeros(num_envs, np.bool_),
        )
        return state

    def arrays(self) -> dict[str, NDArray[Any]]:
        """Return the arrays that an exact resume needs, by name."""
        names = ("steps", "returns", "start_position", "feedback", "stride_error", "over")
        return {name: getattr(self, name) for name in names}

    def begin_episodes(self, rows: NDArray[np.int64], readings: SensorReadings) -> None:
        """Update the state after some robots were reset.

        Args:
            rows: indices of the robots that were reset.
            readings: readings of all robots.
        """
        self.observe_world(readings)
        self.over[rows], self.feedback[rows] = False, 0.0
        self.start_position[rows] = self.truth.base_position_world[rows]

    def finish_step(self, target: Array, feedback: Array, readings: SensorReadings) -> None:
        """Update the state at the end of a control step.

        Args:
            target: commanded motor angles (N, M) [rad].
            feedback: feedback in these commands (N, A).
            readings: readings at the end of the step.
        """
        before = self.truth
        self.target, self.last_feedback, self.feedback = target, self.feedback, feedback
        self.observe_world(readings)
        self.before = before

    def observe_world(self, readings: SensorReadings) -> None:
        """Update readings and true state from the world."""
        self.readings, self.truth, self.duration = readings, self.world.truth(), self.world.params.control_step
        for name in _CACHED:
            self.__dict__.pop(name, None)

    @property
    def idle(self) -> NDArray[np.bool_]:
        """Whether the robot diverged in this control step or waits for a reset, so that the step is ignored (N,)."""
        return self.truth.diverged | self.over

    @property
    def done(self) -> NDArray[np.bool_]:
        """Whether the episode ended in this control step (N,)."""
        return self.terminated | self.truncated

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        return base_rates(self.before, self.truth, self.duration[:, None])

    @property
    def planar_velocity(self) -> Array:
        """Mean speeds forward and to the left [m/s] and yaw rate [rad/s] of the base (N, 3)."""
        velocity, turn = self._rates
        return np.column_stack([velocity[:, :2], turn[:, 2]])

    @property
    def height(self) -> Array:
        """Height of the base relative to the settled height at the episode's start (N,) [m]."""
        return base_height(self.truth.base_position_world, self.ground) - base_height(self.start_position, self.ground)

    @property
    def velocity(self) -> Array:
        """Mean velocity of the base in the heading frame (N, 3) [sqrt(g l)]: forward, left, up."""
        return self._rates[0] / self.scales.speed

    @property
    def attitude_rates(self) -> Array:
        """Mean rates of roll, pitch and yaw (N, 3) [sqrt(g / l)]."""
        return self._rates[1] / self.scales.rate

    @property
    def velocity_error(self) -> Array:
        """Mean velocity minus the filtered command (N, 2) [sqrt(g l)]."""
        return (self._rates[0][:, :2] - self.filtered_command[:, :2]) / self.scales.speed

    @property
    def yaw_rate_error(self) -> Array:
        """Mean yaw rate minus the filtered command (N,) [sqrt(g / l)]."""
        return (self._rates[1][:, 2] - self.filtered_command[:, 2]) / self.scales.rate

    @cached_property
    def action(self) -> Array:
        """Feedback normalized to -1 to 1 between its bounds (N, A)."""
        return self.gait.action(self.feedback)
