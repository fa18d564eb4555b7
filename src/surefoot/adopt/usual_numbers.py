"""Unusual numbers in a specification, which no framework uses: hints at mistakes that simulation may not reveal."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.arrays import Array
from surefoot.robot import RobotDescription

_USUAL_COMMANDS = ((1.0, 1.0, 1.0), (2.0, 2.0, 0.25))
"""Scales of commands: Isaac Lab's and legged_gym's."""
_USUAL_RATES = ((0.25, 0.05), (0.2, 0.05), (1.0, 1.0))
"""Scales of angular velocity and joint speeds: legged_gym's, unitree_rl_lab's and mjlab's."""
_USUAL_VELOCITIES = (1.0, 2.0)
"""Scales of the base's velocity: Isaac Lab's and legged_gym's."""
_USUAL_ACTIONS = (0.1, 0.125, 0.2, 0.25, 0.3, 0.5)
_USUAL_GAINS = (0.2, 1.2)
"""Range of the proportional gain per radian, relative to the robot's weight times the length of its legs."""
_USUAL_DAMPING = (0.018, 0.07)
"""Range of the ratio of derivative to proportional gain [s]."""
_USUAL_STEP = 0.02
VECTORS = ("command", "gravity", "angular_velocity", "base_velocity")
"""Observation terms with three components."""


def unusual_numbers(spec: PolicySpecification, robot: RobotDescription) -> tuple[str, ...]:
    """Return the names of numbers in a specification that are unusual for a robot of this size."""
    sizes = {str(term.term): _sizes(term) for term in spec.observations}
    rates = [sizes.get(name, np.array([np.nan])) for name in ("angular_velocity", "joint_speeds")]
    kp, kd = np.asarray(spec.kp), np.asarray(spec.kd)
    ratio = kd / np.maximum(kp, 1e-6)
    usual = {
        "scale of command": "command" not in sizes
        or any(np.allclose(sizes["command"], one) for one in _USUAL_COMMANDS),
        "scales of angular velocity and joint speeds": any(
            all(np.isnan(size[0]) or np.allclose(size, number) for size, number in zip(rates, pair, strict=True))
            for pair in _USUAL_RATES
        ),
        "signs of scales": all(
            np.min(scale) >= 0.0 for scale in (*(term.scale for term in spec.observations), spec.action_scale)
        ),
        "order of axes": all(list(term.columns) == sorted(term.columns) for term in spec.observations if term.columns),
        "scale of gravity": np.allclose(sizes.get("gravity", 1.0), 1.0),
        "scale of base velocity": any(
            np.allclose(sizes.get("base_velocity", 1.0), usual) for usual in _USUAL_VELOCITIES
        ),
        "scale of joint positions": np.allclose(sizes.get("joint_positions", 1.0), 1.0),
        "scale of last action": np.allclose(sizes.get("last_action", 1.0), 1.0),
        "scale of actions": np.isclose(np.abs(_column(spec.action_scale)), _USUAL_ACTIONS).any(axis=1).all(),
        "gains": _is_within(kp / (robot.weight * robot.leg_geometry.length), _USUAL_GAINS)
        and _is_within(ratio, _USUAL_DAMPING),
        "control step": math.isclose(spec.control_step, _USUAL_STEP),
    }
    return tuple(name for name, fits in usual.items() if not fits)


def _is_within(values: Array, bounds: tuple[float, float]) -> bool:
    return bool(np.all((values >= bounds[0]) & (values <= bounds[1])))


def _column(value: float | Sequence[float]) -> Array:
    return np.atleast_1d(np.asarray(value, float))[:, None]


def _sizes(term: ObservationTerm) -> Array:
    """Return the absolute scales of a term; for a vector, in the order of its components."""
    scales = np.abs(np.atleast_1d(term.scale))
    if term.term not in VECTORS:
        return scales
    sizes, columns = np.full(3, np.nan), list(term.columns or range(3))
    sizes[columns] = scales
    return np.where(np.isnan(sizes), np.nanmax(sizes), sizes)
