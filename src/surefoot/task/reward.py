"""Reward terms: each a function of one control step's motion, of one line, with its unit and source.

A task's `reward` gives weights by name; the reward of a control step is its duration times the weighted sum. Terms are
made dimensionless with the robot's own scales, so that the same weights serve every robot: lengths by the straight leg
l, times by sqrt(l / g), torques by m g l. Without weights a task has the paper's reward, `task.env.locomotion_reward`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError, choices, quoted
from surefoot.robot import GRAVITY, RobotDescription


@dataclass(frozen=True)
class Scales:
    """What a robot's motion is measured by."""

    length: float
    """Straight leg l [m]."""
    speed: float
    """sqrt(g l) [m/s]."""
    rate: float
    """sqrt(g / l) [1/s]."""
    weight: float
    """m g [N]."""

    @classmethod
    def of(cls, robot: RobotDescription) -> Scales:
        """Return a robot's scales."""
        length = robot.leg_geometry.length
        return cls(length, float(np.sqrt(GRAVITY * length)), float(np.sqrt(GRAVITY / length)), robot.weight)


@dataclass(frozen=True)
class StepMotion:
    """The true motion of N robots over a control step, in the heading frame: upright, with the base's yaw."""

    scales: Scales
    velocity: Array
    """Mean velocity of the base over the step (N, 3) [m/s]: forward, left, up."""
    turn: Array
    """Mean rates of roll, pitch and yaw over the step (N, 3) [rad/s]."""
    tilt: Array
    """Roll and pitch (N, 2) [rad]."""
    height: Array
    """Height of the base above where it settled (N,) [m]."""
    power: Array
    """Mean of |tau . qdot| (N,) [W]."""
    torque: Array
    """Motor torques at the end of the step (N, M) [N m]."""
    heat: Array
    """Mean heat of the motors (N, M) [W]."""
    action: Array
    """Feedback in half widths of its bounds (N, A)."""
    last_action: Array
    """That of the step before (N, A)."""
    command: Array
    """Speeds forward and to the left and yaw rate that are followed, without the correction of the heading (N, 3)."""
    heading_error: Array
    """Heading that is held less the robot's (N,) [rad]."""


@dataclass(frozen=True)
class Term:
    """A reward term."""

    unit: str
    """What its weight multiplies."""
    value: Callable[[StepMotion], Array]
    """Gives its values (N,)."""
    source: str
    """Where it comes from."""


def _near(error: Array, scale: float, width: float) -> Array:
    """Return exp(-|e|^2 / width^2) of errors (N, ...) in units of a scale."""
    square = (error / scale) ** 2
    return np.asarray(np.exp(-(square.sum(axis=1) if square.ndim > 1 else square) / width**2))


_RUDIN = "Rudin et al. 2022, Learning to Walk in Minutes, table of rewards"

TERMS: dict[str, Term] = {
    "progress": Term("speed forward, sqrt(g l)", lambda m: m.velocity[:, 0] / m.scales.speed, "Tan et al. 2018, eq. 2"),
    "power": Term(
        "power, m g sqrt(g l)", lambda m: m.power / (m.scales.weight * m.scales.speed), "Tan et al. 2018, eq. 2"
    ),
    "track_velocity": Term(
        "1", lambda m: _near(m.velocity[:, :2] - m.command[:, :2], m.scales.speed, 0.12), f"{_RUDIN}; narrower"
    ),
    "track_yaw_rate": Term(
        "1", lambda m: _near(m.turn[:, 2] - m.command[:, 2], m.scales.rate, 0.08), f"{_RUDIN}; narrower"
    ),
    "velocity_error": Term(
        "|e|, sqrt(g l)",
        lambda m: np.hypot(*(m.velocity[:, :2] - m.command[:, :2]).T) / m.scales.speed,
        "as the measure",
    ),
    "yaw_rate_error": Term(
        "|e|, sqrt(g / l)", lambda m: np.abs(m.turn[:, 2] - m.command[:, 2]) / m.scales.rate, "as above"
    ),
    "heading_error": Term("|e|, rad", lambda m: np.abs(m.heading_error), "heading that is held"),
    "vertical_speed": Term("v_z^2, g l", lambda m: (m.velocity[:, 2] / m.scales.speed) ** 2, _RUDIN),
    "roll_pitch_rate": Term("w^2, g / l", lambda m: ((m.turn[:, :2] / m.scales.rate) ** 2).sum(axis=1), _RUDIN),
    "tilt": Term("angle^2, rad^2", lambda m: (m.tilt**2).sum(axis=1), _RUDIN),
    "height": Term("height^2, l^2", lambda m: (m.height / m.scales.length) ** 2, _RUDIN),
    "torque": Term(
        "tau^2, (m g l)^2", lambda m: ((m.torque / (m.scales.weight * m.scales.length)) ** 2).sum(axis=1), _RUDIN
    ),
    "heat": Term(
        "M times the root mean square over motors of their heat, m g sqrt(g l)",
        lambda m: np.sqrt(m.heat.shape[1] * np.square(m.heat).sum(axis=1)) / (m.scales.weight * m.scales.speed),
        "R I^2 at servo rate; squares, since the hottest motor ends a run",
    ),
    "feedback": Term("mean of squares", lambda m: (m.action**2).mean(axis=1), "keeps the network's part small"),
    "feedback_change": Term("mean of squares", lambda m: ((m.action - m.last_action) ** 2).mean(axis=1), _RUDIN),
}
"""Every term a task's reward can have. Costs have negative weights."""

_MOST = 1e6


def check_terms(weights: Mapping[str, float]) -> None:
    """Refuse weights of terms that do not exist, or that are no numbers."""
    for name, weight in weights.items():
        if name not in TERMS:
            raise SurefootError(f"reward.{name} is not a term; choices: {choices(TERMS)}")
        if not is_number(weight) or not abs(weight) <= _MOST:
            raise SurefootError(f"reward.{name} is {quoted(weight)}; a weight is a number within {_MOST:g}")


def reward_rate(weights: Mapping[str, float], motion: StepMotion) -> Array:
    """Return the weighted sum of terms (N,) [1/s]."""
    return np.asarray(sum(weight * TERMS[name].value(motion) for name, weight in weights.items()), float)
