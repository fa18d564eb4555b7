"""Terminations: conditions that end an episode, each with its unit and source.

The configuration of a task has the limit of each under its name; a limit of 0 means none.
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
    """Returns whether the episodes of robots end (N,), for a state and the limit."""
    source: str
    """Where it comes from."""
    is_timeout: bool = False
    """Whether the episode could have continued: a truncation."""


def is_tilted(state: EnvState, angle: float) -> Flags:
    """Return whether roll or pitch relative to the slope of the ground is beyond an angle [rad], (N,)."""
    return np.asarray(np.any(np.abs(base_tilt(state.truth, state.ground)) > angle, axis=1))


def is_low(state: EnvState, height: float) -> Flags:
    """Return whether the base's origin is below a height [m] above the level of the ground, (N,)."""
    return np.asarray(base_height(state.truth.base_position_world, state.ground) < height)


TERMINATIONS: dict[str, Termination] = {
    "fall_angle": Termination(
        "rad", is_tilted, "Tan et al. 2018, section IV-C: a base that tilts by more than 0.5 rad; no axis is named"
    ),
    "fall_height": Termination("m", is_low, "keeps gaits from crawling on the belly"),
    "max_steps": Termination("control steps", lambda state, limit: state.steps >= limit, "length of an episode", True),
}
"""Every condition that ends an episode, besides a simulation that diverges."""


def end_episodes(state: EnvState, task: TaskConfig) -> None:
    """Write to the state which episodes the control step has terminated and truncated."""
    ended = {False: state.truth.diverged, True: np.zeros(len(state.over), np.bool_)}
    for name, termination in TERMINATIONS.items():
        if limit := getattr(task, name):
            ended[termination.is_timeout] = ended[termination.is_timeout] | termination.ends(state, limit)
    state.terminated = ended[False] & ~state.over
    state.truncated = ended[True] & ~state.over & ~state.terminated
