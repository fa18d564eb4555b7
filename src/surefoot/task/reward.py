"""Reward terms: functions of the state at the end of a control step, with their units and sources.

A task's `reward` contains weights by name, and its `reward_limits` upper clipping limits. A term is either a sum over
the control step or a rate, which is multiplied by the step's duration. The reward is the weighted sum of all terms.
Rates are made dimensionless by the robot's scales, so that the same weights suit every robot: lengths by the straight
leg l, times by sqrt(l / g), torques by m g l.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, suggest
from surefoot.task.state import EnvState, base_tilt
from surefoot.task.trace import ENERGY_WEIGHT

PAPER_REWARD = {"progress": 1.0, "energy": -ENERGY_WEIGHT}
"""Reward of Tan et al. 2018, eq. 2: (p_n - p_{n-1}) . d - w dt |tau . qdot|, where d is the world's x axis."""

ON_REQUEST = ("stride_error", "foothold_error")
"""Fields of `EnvState` that are zero unless a reward term of the task needs them. The tracking error over a stride is
also computed for tasks with commands."""


@dataclass(frozen=True)
class RewardTerm:
    """A reward term."""

    unit: str
    """Quantity and unit that the weight multiplies."""
    value: Callable[[EnvState], Array]
    """Function that returns its values (N,)."""
    source: str
    """Origin of the term, such as a paper."""
    is_sum: bool = False
    """Whether values are sums over the control step; otherwise rates."""
    needs: str = ""
    """Field of the state that is computed only for tasks with such a term, from `ON_REQUEST`."""


_TAN = "Tan et al. 2018, eq. 2"
_RUDIN = "Rudin et al. 2022, Learning to Walk in Minutes, table of rewards"

TERMS: dict[str, RewardTerm] = {
    "progress": RewardTerm(
        "displacement along the world's x axis, m",
        lambda m: m.truth.base_position_world[:, 0] - m.before.base_position_world[:, 0],
        _TAN,
        is_sum=True,
    ),
    "energy": RewardTerm("|tau . qdot| dt, J", lambda m: m.truth.energy, _TAN, is_sum=True),
    "transport_cost": RewardTerm("energy over m g, m", lambda m: m.truth.energy / m.scales.weight, _TAN, is_sum=True),
    "forward_speed": RewardTerm("speed, sqrt(g l)", lambda m: m.velocity[:, 0], _TAN),
    "power": RewardTerm(
        "power, m g sqrt(g l)", lambda m: m.truth.energy / m.duration / (m.scales.weight * m.scales.speed), _TAN
    ),
    "track_velocity": RewardTerm(
        "1", lambda m: np.exp(-(m.velocity_error**2).sum(axis=1) / 0.12**2), f"{_RUDIN}; narrower"
    ),
    "track_yaw_rate": RewardTerm("1", lambda m: np.exp(-(m.yaw_rate_error**2) / 0.08**2), f"{_RUDIN}; narrower"),
    "velocity_error": RewardTerm("|e|, sqrt(g l)", lambda m: np.hypot(*m.velocity_error.T), "as the measure"),
    "yaw_rate_error": RewardTerm("|e|, sqrt(g / l)", lambda m: np.abs(m.yaw_rate_error), "as above"),
    "stride_velocity_error": RewardTerm(
        "|e| of the average over a stride, sqrt(g l)",
        lambda m: np.hypot(*m.stride_error[:, :2].T) / m.scales.speed,
        "as the measure over strides: a speed that goes up and down in a stride hides a mean that is off",
        needs="stride_error",
    ),
    "stride_yaw_rate_error": RewardTerm(
        "|e| of the average over a stride, sqrt(g / l)",
        lambda m: np.abs(m.stride_error[:, 2]) / m.scales.rate,
        "as above",
        needs="stride_error",
    ),
    "heading_error": RewardTerm("|e|, rad", lambda m: np.abs(m.heading_error), "heading that is held"),
    "vertical_speed": RewardTerm("v_z^2, g l", lambda m: m.velocity[:, 2] ** 2, _RUDIN),
    "roll_pitch_rate": RewardTerm("w^2, g / l", lambda m: (m.attitude_rates[:, :2] ** 2).sum(axis=1), _RUDIN),
    "tilt": RewardTerm("angle^2, rad^2", lambda m: (base_tilt(m.truth, m.ground) ** 2).sum(axis=1), _RUDIN),
    "height": RewardTerm("height^2, l^2", lambda m: (m.height / m.scales.length) ** 2, _RUDIN),
    "torque": RewardTerm(
        "tau^2, (m g l)^2",
        lambda m: ((m.truth.motor_torque / (m.scales.weight * m.scales.length)) ** 2).sum(axis=1),
        _RUDIN,
    ),
    "heat": RewardTerm(
        "M times the root mean square over motors of their heat, m g sqrt(g l)",
        lambda m: (
            np.sqrt(m.truth.heat.shape[1] * (m.truth.heat**2).sum(axis=1))
            / (m.duration * m.scales.weight * m.scales.speed)
        ),
        "R I^2 at servo rate; squares, since the hottest motor ends a run",
    ),
    "foothold_error": RewardTerm(
        "square of the distance of each landing from its foothold, (l / 12)^2, at most 4",
        lambda m: m.foothold_error,
        "as in Jenelten et al. 2024, DTC: Deep Tracking Control",
        is_sum=True,
        needs="foothold_error",
    ),
    "feedback": RewardTerm("mean of squares", lambda m: (m.action**2).mean(axis=1), "keeps the network's part small"),
    "feedback_change": RewardTerm(
        "mean of squares", lambda m: ((m.action - m.gait.action(m.last_feedback)) ** 2).mean(axis=1), _RUDIN
    ),
}
"""Available reward terms by name. Costs have negative weights."""


def check_reward(weights: Mapping[str, float], limits: Mapping[str, float], key: str = "reward") -> None:
    """Check weights and limits of a reward.

    Args:
        weights: weights of terms by name.
        limits: upper clipping limits by name.
        key: name of the weights in messages.

    Raises:
        SurefootError: no terms, terms that do not exist, or limits of terms that the reward does not have.
    """
    if not weights:
        raise SurefootError(f"{key} has no term; choices: {choices(TERMS)}")
    for name in weights:
        if name not in TERMS:
            raise SurefootError(f"{key}.{name} is not a term; {suggest(name, TERMS)}")
    for name in limits:
        if name not in weights:
            raise SurefootError(f"reward_limits.{name} is not a term of {key}; {suggest(name, weights)}")


def step_reward(
    weights: Mapping[str, float], limits: Mapping[str, float], state: EnvState
) -> tuple[Array, dict[str, Array]]:
    """Return the reward of a control step (N,), and the contribution of each term (N,) by name.

    Args:
        weights: weights of terms by name.
        limits: upper clipping limits by name; for sums per second.
        state: state at the end of the step.
    """
    totals = {True: np.zeros(len(state.duration)), False: np.zeros(len(state.duration))}
    parts = {}
    for name, weight in weights.items():
        term = TERMS[name]
        value = term.value(state)
        if name in limits:
            value = np.minimum(value, limits[name] * state.duration if term.is_sum else limits[name])
        part = weight * value
        totals[term.is_sum] += part
        parts[name] = part if term.is_sum else state.duration * part
    return totals[True] + state.duration * totals[False], parts


def energy_weight(weights: Mapping[str, float], limits: Mapping[str, float], weight: float) -> float | None:
    """Return w [m/J] if the reward is the paper's (progress minus w times energy), otherwise None.

    The return of such a reward can be computed from positions and energy, also in a trace of a real robot. Progress may
    have a limit.

    Args:
        weights: weights of terms by name.
        limits: upper clipping limits by name.
        weight: the robot's weight m g [N].
    """
    cost = -weights.get("energy", 0.0) - weights.get("transport_cost", 0.0) / weight
    is_paper = weights.get("progress") == 1.0 and weights.keys() <= {"progress", "energy", "transport_cost"}
    return cost if is_paper and cost >= 0 and limits.keys() <= {"progress"} else None
