"""Random pushes on the base."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.configuration import NoOption, Within, check_bounds
from surefoot.errors import SurefootError
from surefoot.seeding import generators
from surefoot.task.component import Component, Privileged
from surefoot.task.state import EnvState


@dataclass(frozen=True)
class PushConfig:
    """Times and forces of pushes; defaults from Tan et al. 2018, section V-B."""

    enabled: NoOption[bool] = False
    """Whether robots are pushed at all."""
    period: Annotated[float, Within(0, 3600, exclusive=True)] = 1.2
    """Time from one push to the next [s]; the first comes after one period."""
    duration: float = 0.06
    """How long a push lasts [s]."""
    force: Annotated[tuple[float, float], Within(0, 1e6)] = (130.0, 220.0)
    """Least and greatest force [N]."""
    relative: bool = False
    """Whether forces count the robot's weight m g, else N."""
    direction: Literal["any", "horizontal"] = "any"
    """any: uniform over the sphere, as the paper; horizontal: uniform over the circle, the whole force sideways."""
    ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: a robot's first `ramp` pushes grow in force from nothing to what is drawn; 0: none do."""
    probability: Annotated[float, Within(0, 1)] = 1.0
    """Chance that a push that is due is given; the paper gives every one."""

    def __post_init__(self) -> None:
        """Refuse values out of bounds."""
        check_bounds(self, "pushes")
        if not 0 < self.duration < self.period:
            raise SurefootError(
                f"pushes.duration is {self.duration:g} s; it must be over 0 and below pushes.period {self.period:g} s"
            )
        if self.force[0] > self.force[1]:
            raise SurefootError(f"pushes.force is {list(self.force)}; the lower bound must come first")

    def for_evaluation(self, enabled: bool, force: tuple[float, float] | None = None) -> PushConfig:
        """Return what a policy is tested with: every push that is due, from the first in full force.

        With a `force` from least to greatest [N] directions are horizontal and robots are pushed in any case.
        """
        if force is not None:
            self = replace(self, force=force, relative=False, direction="horizontal")
        return replace(self, enabled=enabled or force is not None, probability=1.0, ramp=0)

    def force_range(self, weight: float) -> tuple[float, float]:
        """Return the least and greatest force [N] on a robot of a weight m g [N]."""
        unit = weight if self.relative else 1.0
        return self.force[0] * unit, self.force[1] * unit


class Pusher(Component):
    """Draws a force for each push of each robot, uniform in magnitude and in direction.

    Args:
        config: when and how hard robots are pushed.
        num_envs: robots.
        seed: seeds the streams.
        weight: the robot's m g [N].
    """

    prefix = "pushes"
    changing = ("force", "drawn", "before")

    def __init__(self, config: PushConfig, num_envs: int, seed: int, weight: float) -> None:
        self.config = config
        self._streams = generators(seed, "pushes", num_envs)
        self.range = np.tile(config.force_range(weight), (num_envs, 1))
        """Least and greatest force [N] of each robot's pushes, (N, 2)."""
        self.force = np.zeros((num_envs, 3))
        self.drawn = np.zeros(num_envs, np.int64)
        """Pushes that were due in this episode."""
        self.before = np.zeros(num_envs, np.int64)
        """Pushes that were due in earlier episodes."""

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Streams of random numbers, one per robot."""
        return {"push_streams": self._streams}

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """End the pushes of robots whose episodes start, and start their clocks."""
        self.restart(rows)
        self.publish(state)
        state.world.push(self.force)

    def before_step(self, state: EnvState) -> None:
        """Begin and end pushes that are due."""
        if self.update(state.readings.time):
            state.world.push(self.force)

    def privileged(self, state: EnvState) -> Privileged:
        """Return the horizontal force [100 N]."""
        return [(["push_x", "push_y"], self.force[:, :2] / 100.0)]

    def publish(self, state: EnvState) -> None:
        """Write the forces to the state."""
        state.push_force = self.force

    def restart(self, index: NDArray[np.int64]) -> None:
        """Start the clock of the robots at `index` anew."""
        self.before[index] += self.drawn[index]
        self.force[index] = self.drawn[index] = 0

    def update(self, time: Array) -> bool:
        """Set `force` for robots whose episodes are `time` (N,) [s] old; true if any force changed."""
        config = self.config
        # Half a microsecond forgives rounding where a period is a whole number of control steps.
        number = np.floor((time + 5e-7) / config.period).astype(np.int64)
        pushing = (number >= 1) & (time + 5e-7 - number * config.period < config.duration)
        start = pushing & (self.drawn < number)
        stop = ~pushing & self.force.any(axis=1)
        for i in np.flatnonzero(start):
            stream = self._streams[i]
            happens = stream.uniform() < config.probability
            direction = stream.standard_normal(3)
            if config.direction == "horizontal":
                direction[2] = 0.0
            size = stream.uniform(*self.range[i]) / np.linalg.norm(direction)
            share = min(1.0, (self.before[i] + number[i]) / config.ramp) if config.ramp else 1.0
            self.force[i] = share * size * direction if happens else 0.0
            self.drawn[i] = number[i]
        self.force[stop] = 0
        return bool(start.any() or stop.any())
