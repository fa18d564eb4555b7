"""Terminations: conditions that end an episode, with their units and sources.

The task configuration has a field with the limit of each condition under its name; 0 disables it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from surefoot.task.config import TaskConfig
from surefoot.task.state import EnvState, base_height, base_tilt

Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class Termination:
    """A condition that ends an episode."""

    unit: str
    """Unit of its limit."""
    ends: Callable[[EnvState, float], Flags]
    """Function of state and limit that returns whether each robot's episode ends (N,)."""
    source: str
    """Origin of the condition, such as a paper."""
    is_timeout: bool = False
    """Whether the condition truncates the episode instead of terminating it."""


def is_tilted(state: EnvState, angle: float) -> Flags:
    """Return whether roll or pitch relative to the slope of the ground exceeds an angle [rad] (N,)."""
    return np.asarray(np.any(np.abs(base_tilt(state.truth, state.ground)) > angle, axis=1))


def is_low(state: EnvState, height: float) -> Flags:
    """Return whether the base's origin is lower than a height [m] above the smoothed ground (N,)."""
    return np.asarray(base_height(state.truth.base_position_world, state.ground) < height)


TERMINATIONS: dict[str, Termination] = {
    "fall_angle": Termination(
        "rad", is_tilted, "Tan et al. 2018, section IV-C: a base that tilts by more than 0.5 rad; no axis is named"
    ),
    "fall_height": Termination("m", is_low, "keeps gaits from crawling on the belly"),
    "max_steps": Termination("control steps", lambda state, limit: state.steps >= limit, "length of an episode", True),
}
"""Conditions that end an episode, by name, in addition to a diverged simulation."""


def end_episodes(state: EnvState, task: TaskConfig) -> None:
    """Set `terminated` and `truncated` of the state."""
    ended = {False: state.truth.diverged, True: np.zeros(len(state.over), np.bool_)}
    for name, termination in TERMINATIONS.items():
        if limit := getattr(task, name):
            ended[termination.is_timeout] = ended[termination.is_timeout] | termination.ends(state, limit)
    state.terminated = ended[False] & ~state.over
    state.truncated = ended[True] & ~state.over & ~state.terminated
