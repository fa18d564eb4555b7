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
    """Timing, force and direction of random pushes; defaults from Tan et al. 2018, section V-B."""

    enabled: NoOption[bool] = False
    """Whether robots are pushed."""
    period: Annotated[float, Within(0, 3600, exclusive=True)] = 1.2
    """Time between the starts of two pushes [s]. The first push starts after one period."""
    duration: float = 0.06
    """Duration of a push [s]."""
    force: Annotated[tuple[float, float], Within(0, 1e6)] = (130.0, 220.0)
    """Minimum and maximum force [N]."""
    relative: bool = False
    """Forces are in units of the robot's weight m g instead of N."""
    direction: Literal["any", "horizontal"] = "any"
    """any: uniform over the sphere, as in the paper; horizontal: uniform over the horizontal circle."""
    ramp: Annotated[int, Within(0, 1_000_000)] = 0
    """Curriculum: the forces of a robot's first `ramp` pushes are scaled up linearly; 0: no curriculum."""
    probability: Annotated[float, Within(0, 1)] = 1.0
    """Probability that a push happens in each period; 1 in the paper."""

    def __post_init__(self) -> None:
        """Reject values out of bounds."""
        check_bounds(self, "pushes")
        if not 0 < self.duration < self.period:
            raise SurefootError(
                f"pushes.duration is {self.duration:g} s; it must be above 0 and below pushes.period {self.period:g} s"
            )
        if self.force[0] > self.force[1]:
            raise SurefootError(f"pushes.force is {list(self.force)}; the lower bound must come first")

    def for_evaluation(self, enabled: bool, force: tuple[float, float] | None = None) -> PushConfig:
        """Return the pushes of an evaluation: one in every period, and full force from the first.

        Args:
            enabled: whether robots are pushed.
            force: minimum and maximum force [N]. If given, robots are pushed horizontally, whatever `enabled` is.
        """
        if force is not None:
            self = replace(self, force=force, relative=False, direction="horizontal")
        return replace(self, enabled=enabled or force is not None, probability=1.0, ramp=0)

    def force_range(self, weight: float) -> tuple[float, float]:
        """Return the minimum and maximum force [N] for a robot with the weight m g [N]."""
        unit = weight if self.relative else 1.0
        return self.force[0] * unit, self.force[1] * unit


class Pusher(Component):
    """Component that pushes robots with random forces, uniform in magnitude and direction.

    Args:
        config: timing, force and direction of pushes.
        num_envs: number of robots.
        seed: seed of the random streams, one per robot.
        weight: the robot's weight m g [N].
    """

    prefix = "pushes"
    changing = ("force", "drawn", "before")

    def __init__(self, config: PushConfig, num_envs: int, seed: int, weight: float) -> None:
        self.config = config
        self._streams = generators(seed, "pushes", num_envs)
        self.range = np.tile(config.force_range(weight), (num_envs, 1))
        """Minimum and maximum force of each robot's pushes (N, 2) [N]."""
        self.force = np.zeros((num_envs, 3))
        """Current force on each robot's base in the world frame (N, 3) [N]."""
        self.drawn = np.zeros(num_envs, np.int64)
        """Number of push periods in this episode (N,)."""
        self.before = np.zeros(num_envs, np.int64)
        """Number of push periods in earlier episodes (N,)."""

    @property
    def streams(self) -> Mapping[str, list[np.random.Generator]]:
        """Random streams, one per robot."""
        return {"push_streams": self._streams}

    def reset(self, rows: NDArray[np.int64], state: EnvState) -> None:
        """Stop the pushes of robots whose episodes start, and restart their timing."""
        self.restart(rows)
        self.publish(state)
        state.world.push(self.force)

    def before_step(self, state: EnvState) -> None:
        """Start and stop pushes that are due."""
        if self.update(state.readings.time):
            state.world.push(self.force)

    def privileged(self, state: EnvState) -> Privileged:
        """Return the horizontal force components [100 N]."""
        return [(["push_x", "push_y"], self.force[:, :2] / 100.0)]

    def publish(self, state: EnvState) -> None:
        """Write the forces to the state."""
        state.push_force = self.force

    def restart(self, index: NDArray[np.int64]) -> None:
        """Restart the push timing of the robots at `index`."""
        self.before[index] += self.drawn[index]
        self.force[index] = self.drawn[index] = 0

    def update(self, time: Array) -> bool:
        """Update `force` for the times `time` (N,) [s] since the episodes' starts; return whether any force changed."""
        config = self.config
        # A tolerance of half a microsecond allows for rounding if a period is a whole number of control steps.
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
            scale = min(1.0, (self.before[i] + number[i]) / config.ramp) if config.ramp else 1.0
            self.force[i] = scale * size * direction if happens else 0.0
            self.drawn[i] = number[i]
        self.force[stop] = 0
        return bool(start.any() or stop.any())
