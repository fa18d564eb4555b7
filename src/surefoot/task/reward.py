"""Reward terms: each a function of one control step's motion, with its unit and source.

A task's `reward` gives weights by name, and its `reward_limits` the greatest values that count. A term is a sum over
the control step or a rate; the reward is the weighted sum of both, rates times the step's duration. Rates are
dimensionless by the robot's own scales, so that the same weights serve every robot: lengths by the straight leg l,
times by sqrt(l / g), torques by m g l.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, suggest
from surefoot.robot import GRAVITY, RobotDescription
from surefoot.rotations import in_heading_frame
from surefoot.task.gait import HybridGait
from surefoot.task.trace import ENERGY_WEIGHT
from surefoot.world.ground import Ground
from surefoot.world.interface import Truth

PAPER_REWARD = {"progress": 1.0, "energy": -ENERGY_WEIGHT}
"""Tan et al. 2018, eq. 2: (p_n - p_{n-1}) . d - w dt |tau . qdot|, d the world's x axis."""


@dataclass(frozen=True)
class Scales:
    """Units of a robot's motion."""

    length: float
    """Straight leg l [m]."""
    speed: float
    """sqrt(g l) [m/s]."""
    rate: float
    """sqrt(g / l) [1/s]."""
    weight: float
    """m g [N]."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> Scales:
        """Return a robot's scales."""
        length = robot.leg_geometry.length
        return cls(length, float(np.sqrt(GRAVITY * length)), float(np.sqrt(GRAVITY / length)), robot.weight)


def base_height(position: Array, ground: Ground) -> Array:
    """Return heights (N,) [m] of points (N, 3) in the world over the level of the ground."""
    return np.asarray(position[:, 2] - ground.level(position[:, :2]))


def base_tilt(truth: Truth, ground: Ground) -> Array:
    """Return roll and pitch (N, 2) [rad] of the base less those of one that lies along the course of the ground."""
    angles = truth.roll_pitch_yaw
    if not ground.course.size:
        return angles[:, :2]
    tilt: Array = angles[:, :2] - ground.tilt(truth.base_position_world[:, :2], angles[:, 2])
    return tilt


def base_rates(before: Truth, after: Truth, duration: Array | float) -> tuple[Array, Array]:
    """Return mean rates of the base over a control step, for N robots.

    Args:
        before: truth at the beginning.
        after: truth at the end.
        duration: of the step [s], a number or (N, 1).

    Returns:
        Velocity in the heading frame of the beginning [m/s] and rates of roll, pitch and yaw [rad/s], (N, 3) each.
    """
    velocity = (after.base_position_world - before.base_position_world) / duration
    turned = (after.roll_pitch_yaw - before.roll_pitch_yaw + np.pi) % (2 * np.pi) - np.pi
    return in_heading_frame(velocity, before.roll_pitch_yaw[:, 2]), turned / duration


@dataclass(frozen=True)
class StepMotion:
    """The true motion of N robots over a control step. The heading frame is upright and has the base's yaw."""

    scales: Scales
    duration: Array
    """Of the control step (N,) [s]."""
    before: Truth
    """Truth at the beginning."""
    after: Truth
    """Truth at the end."""
    start_position: Array
    """Where the base settled (N, 3) [m]."""
    ground: Ground
    gait: HybridGait
    feedback: Array
    """Feedback of the step (N, A), see `HybridGait`."""
    last_feedback: Array
    """Feedback of the step before (N, A)."""
    command: Array
    """Speeds forward and to the left and yaw rate that are followed, without the correction of the heading (N, 3)."""
    heading_error: Array
    """Heading that is held less the robot's (N,) [rad]."""
    last_stride_error: Array
    """`stride_error` at the end of the step before (N, 3)."""
    stride: Array | float
    """Duration of a stride [s], a number or (N,)."""
    foothold_error: Array
    """What feet count that have landed beside their footholds (N,), see `Landings`."""

    @cached_property
    def _rates(self) -> tuple[Array, Array]:
        return base_rates(self.before, self.after, self.duration[:, None])

    @property
    def height(self) -> Array:
        """Height of the base above where it settled (N,) [m]."""
        return base_height(self.after.base_position_world, self.ground) - base_height(self.start_position, self.ground)

    @property
    def velocity(self) -> Array:
        """Mean velocity of the base in the heading frame (N, 3) [sqrt(g l)]: forward, left, up."""
        return self._rates[0] / self.scales.speed

    @property
    def turn(self) -> Array:
        """Mean rates of roll, pitch and yaw (N, 3) [sqrt(g / l)]."""
        return self._rates[1] / self.scales.rate

    @cached_property
    def command_error(self) -> Array:
        """Mean speeds forward and to the left and yaw rate less the command (N, 3) [m/s, m/s, rad/s]."""
        velocity, turn = self._rates
        return np.column_stack([velocity[:, :2], turn[:, 2]]) - self.command

    @cached_property
    def stride_error(self) -> Array:
        """Command error, averaged exponentially over a stride (N, 3) [m/s, m/s, rad/s]."""
        share = np.minimum(self.duration / self.stride, 1.0)[:, None]
        return np.asarray(self.last_stride_error + share * (self.command_error - self.last_stride_error))

    @property
    def velocity_error(self) -> Array:
        """Mean velocity less the command (N, 2) [sqrt(g l)]."""
        return (self._rates[0][:, :2] - self.command[:, :2]) / self.scales.speed

    @property
    def yaw_rate_error(self) -> Array:
        """Mean yaw rate less the command (N,) [sqrt(g / l)]."""
        return (self._rates[1][:, 2] - self.command[:, 2]) / self.scales.rate

    @cached_property
    def action(self) -> Array:
        """Normalized feedback (N, A), -1 to 1 between its bounds."""
        return self.gait.action(self.feedback)


@dataclass(frozen=True)
class Term:
    """A reward term."""

    unit: str
    """What its weight multiplies."""
    value: Callable[[StepMotion], Array]
    """Gives its values (N,)."""
    source: str
    """Where it comes from."""
    is_sum: bool = False
    """Whether it is a sum over the control step; else a rate."""


_TAN = "Tan et al. 2018, eq. 2"
_RUDIN = "Rudin et al. 2022, Learning to Walk in Minutes, table of rewards"

TERMS: dict[str, Term] = {
    "progress": Term(
        "displacement along the world's x axis, m",
        lambda m: m.after.base_position_world[:, 0] - m.before.base_position_world[:, 0],
        _TAN,
        is_sum=True,
    ),
    "energy": Term("|tau . qdot| dt, J", lambda m: m.after.energy, _TAN, is_sum=True),
    "transport_cost": Term("energy over m g, m", lambda m: m.after.energy / m.scales.weight, _TAN, is_sum=True),
    "forward_speed": Term("speed, sqrt(g l)", lambda m: m.velocity[:, 0], _TAN),
    "power": Term(
        "power, m g sqrt(g l)", lambda m: m.after.energy / m.duration / (m.scales.weight * m.scales.speed), _TAN
    ),
    "track_velocity": Term("1", lambda m: np.exp(-(m.velocity_error**2).sum(axis=1) / 0.12**2), f"{_RUDIN}; narrower"),
    "track_yaw_rate": Term("1", lambda m: np.exp(-(m.yaw_rate_error**2) / 0.08**2), f"{_RUDIN}; narrower"),
    "velocity_error": Term("|e|, sqrt(g l)", lambda m: np.hypot(*m.velocity_error.T), "as the measure"),
    "yaw_rate_error": Term("|e|, sqrt(g / l)", lambda m: np.abs(m.yaw_rate_error), "as above"),
    "stride_velocity_error": Term(
        "|e| of the average over a stride, sqrt(g l)",
        lambda m: np.hypot(*m.stride_error[:, :2].T) / m.scales.speed,
        "as the measure over strides: a speed that goes up and down in a stride hides a mean that is off",
    ),
    "stride_yaw_rate_error": Term(
        "|e| of the average over a stride, sqrt(g / l)",
        lambda m: np.abs(m.stride_error[:, 2]) / m.scales.rate,
        "as above",
    ),
    "heading_error": Term("|e|, rad", lambda m: np.abs(m.heading_error), "heading that is held"),
    "vertical_speed": Term("v_z^2, g l", lambda m: m.velocity[:, 2] ** 2, _RUDIN),
    "roll_pitch_rate": Term("w^2, g / l", lambda m: (m.turn[:, :2] ** 2).sum(axis=1), _RUDIN),
    "tilt": Term("angle^2, rad^2", lambda m: (base_tilt(m.after, m.ground) ** 2).sum(axis=1), _RUDIN),
    "height": Term("height^2, l^2", lambda m: (m.height / m.scales.length) ** 2, _RUDIN),
    "torque": Term(
        "tau^2, (m g l)^2",
        lambda m: ((m.after.motor_torque / (m.scales.weight * m.scales.length)) ** 2).sum(axis=1),
        _RUDIN,
    ),
    "heat": Term(
        "M times the root mean square over motors of their heat, m g sqrt(g l)",
        lambda m: (
            np.sqrt(m.after.heat.shape[1] * (m.after.heat**2).sum(axis=1))
            / (m.duration * m.scales.weight * m.scales.speed)
        ),
        "R I^2 at servo rate; squares, since the hottest motor ends a run",
    ),
    "foothold_error": Term(
        "square of the distance of each landing from its foothold, (l / 12)^2, at most 4",
        lambda m: m.foothold_error,
        "as in Jenelten et al. 2024, DTC: Deep Tracking Control",
        is_sum=True,
    ),
    "feedback": Term("mean of squares", lambda m: (m.action**2).mean(axis=1), "keeps the network's part small"),
    "feedback_change": Term(
        "mean of squares", lambda m: ((m.action - m.gait.action(m.last_feedback)) ** 2).mean(axis=1), _RUDIN
    ),
}
"""Every term that a task's reward can have. Costs have negative weights."""


def check_reward(weights: Mapping[str, float], limits: Mapping[str, float], key: str = "reward") -> None:
    """Refuse a reward without terms, terms that do not exist, and limits of terms that the reward does not have."""
    if not weights:
        raise SurefootError(f"{key} has no term; choices: {choices(TERMS)}")
    for name in weights:
        if name not in TERMS:
            raise SurefootError(f"{key}.{name} is not a term; {suggest(name, TERMS)}")
    for name in limits:
        if name not in weights:
            raise SurefootError(f"reward_limits.{name} is not a term of {key}; {suggest(name, weights)}")


def step_reward(
    weights: Mapping[str, float], limits: Mapping[str, float], motion: StepMotion
) -> tuple[Array, dict[str, Array]]:
    """Return the reward (N,) of a control step, and the part of each term in it (N,) by name.

    Args:
        weights: of terms by name.
        limits: greatest values that count, by term; of a sum per second.
        motion: of the step.
    """
    totals = {True: np.zeros(len(motion.duration)), False: np.zeros(len(motion.duration))}
    parts = {}
    for name, weight in weights.items():
        term = TERMS[name]
        value = term.value(motion)
        if name in limits:
            value = np.minimum(value, limits[name] * motion.duration if term.is_sum else limits[name])
        part = weight * value
        totals[term.is_sum] += part
        parts[name] = part if term.is_sum else motion.duration * part
    return totals[True] + motion.duration * totals[False], parts


def energy_weight(weights: Mapping[str, float], limits: Mapping[str, float], weight: float) -> float | None:
    """Return w [m/J] if the reward is the paper's, progress less w times energy; None for any other.

    Positions and energy give the return of such a reward, in a robot's trace too. Progress may have a limit.

    Args:
        weights: of terms by name.
        limits: greatest values that count, by term.
        weight: the robot's m g [N].
    """
    cost = -weights.get("energy", 0.0) - weights.get("transport_cost", 0.0) / weight
    own = weights.get("progress") == 1.0 and weights.keys() <= {"progress", "energy", "transport_cost"}
    return cost if own and cost >= 0 and limits.keys() <= {"progress"} else None
