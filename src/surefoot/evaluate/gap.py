"""The reality gap as a number: what a policy's return loses in another world than the one that it was trained in.

Koos et al. (2010, "Crossing the reality gap in evolutionary robotics by promoting transferable controllers") measure
it by the difference between the expected return in simulation and on the robot, and Tan et al. 2018, section VI-B, do
so with a few runs of a few policies. Here a run is a trace, wherever it comes from: of a simulation or of a robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.errors import SurefootError, choices
from surefoot.evaluate.metrics import episode_metrics
from surefoot.evaluate.statistics import decimal
from surefoot.task.config import TaskConfig
from surefoot.task.randomize import RandomizeConfig
from surefoot.task.trace import EpisodeTrace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Estimate:
    """A mean and its standard error."""

    mean: float
    """Mean over runs; NaN where no run tells."""
    error: float
    """Standard error of the mean; NaN where fewer than two runs tell."""

    @classmethod
    def of(cls, values: ArrayLike) -> Estimate:
        """Of numbers (N,) that vary by chance; those that are not known (NaN) are left out."""
        array = np.asarray(values, np.float64)
        known = array[np.isfinite(array)]
        if not known.size:
            return cls(math.nan, math.nan)
        error = float(known.std(ddof=1)) / math.sqrt(known.size) if known.size > 1 else math.nan
        return cls(float(known.mean()), error)

    def __sub__(self, other: Estimate) -> Estimate:
        """The difference of two estimates from different runs."""
        return Estimate(self.mean - other.mean, math.hypot(self.error, other.error))


def plus_minus(estimate: Estimate, digits: int = 2, sign: bool = False) -> str:
    """An estimate as text, such as `1.20 ± 0.05`; `-` where it is not known, no error where that is not.

    Args:
        estimate: what is told.
        digits: behind the point.
        sign: write + before what is above zero.
    """
    if not math.isfinite(estimate.mean):
        return "-"
    mean = decimal(estimate.mean, digits, sign)
    return f"{mean} ± {decimal(estimate.error, digits)}" if math.isfinite(estimate.error) else mean


def known(value: float) -> float | None:
    """A number as JSON holds it: None where it is none."""
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Runs:
    """What some runs in one world came to; arrays (N,), NaN where a run does not tell."""

    world: str
    """Name of the world, such as mujoco, bullet, or that of a robot."""
    returns: Array
    """The paper's return [m]."""
    distance: Array
    """Distance forward [m]."""
    speed: Array
    """Distance over time [m/s]."""
    power: Array
    """Mean mechanical power [W]."""
    steps: Array
    """Control steps."""
    fell: NDArray[np.bool_]
    """Whether the run ended in a fall."""
    balanced: NDArray[np.bool_]
    """Whether the robot kept its balance for the whole episode: what the paper counts as a success."""

    def __len__(self) -> int:
        """How many runs."""
        return len(self.returns)

    @classmethod
    def of_traces(cls, traces: Iterable[EpisodeTrace], world: str | None = None) -> Runs:
        """Measure runs.

        Args:
            traces: one or more, of the same world.
            world: its name; the traces' own if not given.

        Raises:
            SurefootError: no traces, or of several worlds.
        """
        runs = list(traces)
        if not runs:
            raise SurefootError("no runs; a gap is measured from 1 run or more in each world")
        names = sorted({str(trace.meta["world"]) for trace in runs})
        if world is None and len(names) > 1:
            raise SurefootError(f"traces come from several worlds: {choices(names)}; measure one at a time")
        metrics = [episode_metrics(trace) for trace in runs]
        return cls(
            world or names[0],
            np.array([one.return_ for one in metrics]),
            np.array([one.distance for one in metrics]),
            np.array([one.speed for one in metrics]),
            np.array([one.power for one in metrics]),
            np.array([one.steps for one in metrics], np.float64),
            np.array([one.fell for one in metrics]),
            np.array([trace.meta["ended"] == "time" for trace in runs]),
        )

    @classmethod
    def pooled(cls, parts: Sequence[Runs]) -> Runs:
        """All runs of several policies in the same world."""
        names = [item.name for item in fields(cls) if item.name != "world"]
        return cls(parts[0].world, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})

    def estimate(self, name: str) -> Estimate:
        """Mean and standard error of one of the arrays."""
        return Estimate.of(getattr(self, name))

    @property
    def success_rate(self) -> float:
        """Share of the runs in which the robot kept its balance to the end."""
        return float(self.balanced.mean())

    def to_mapping(self) -> dict[str, Any]:
        """As JSON holds it; what is not known is None."""
        known = {
            item.name: [None if isinstance(value, float) and math.isnan(value) else value for value in column.tolist()]
            for item in fields(self)
            if item.name != "world"
            for column in [getattr(self, item.name)]
        }
        return {"world": self.world, **known}

    @classmethod
    def from_mapping(cls, data: dict[str, Any]) -> Runs:
        """Back from `to_mapping`."""
        flags = ("fell", "balanced")
        columns: dict[str, Any] = {
            item.name: np.array(data[item.name], np.bool_ if item.name in flags else np.float64)
            for item in fields(cls)
            if item.name != "world"
        }
        return cls(data["world"], **columns)


@dataclass(frozen=True)
class PolicyGap:
    """Runs of one policy, or of several as one, in the world that it comes from and in others."""

    name: str
    """Name of the policy, or of the group."""
    home: Runs
    """Runs in the world that it was trained in."""
    away: tuple[Runs, ...]
    """Runs in the other worlds, one entry each."""
    parts: tuple[PolicyGap, ...] = ()
    """The policies that these runs are of, if they are of several."""

    def gap(self, world: str) -> Estimate:
        """Return at home less return away [m]: above zero where the policy does worse than its simulation says.

        Of several policies it is the mean of their gaps, with its standard error over policies: how far policies
        differ from each other, gallops from trots, says nothing about how far any of them is from its simulation.

        Raises:
            SurefootError: no such world.
        """
        if self.parts:
            return Estimate.of([part.gap(world).mean for part in self.parts])
        return self.home.estimate("returns") - self.of(world).estimate("returns")

    def of(self, world: str) -> Runs:
        """Its runs in another world.

        Raises:
            SurefootError: no such world.
        """
        for runs in self.away:
            if runs.world == world:
                return runs
        raise SurefootError(f"no runs in '{world}'; worlds: {choices([runs.world for runs in self.away])}")

    @classmethod
    def pooled(cls, name: str, policies: Sequence[PolicyGap]) -> PolicyGap:
        """Several policies as one: all their runs together, as the paper averages nine runs of three policies.

        Raises:
            SurefootError: policies that were not run in the same worlds.
        """
        worlds = [tuple(runs.world for runs in policy.away) for policy in policies]
        if len(set(worlds)) != 1:
            raise SurefootError("policies were run in different worlds; a gap of several takes the same for all")
        away = tuple(Runs.pooled([policy.of(world) for policy in policies]) for world in worlds[0])
        return cls(name, Runs.pooled([policy.home for policy in policies]), away, tuple(policies))


def home_task(task: TaskConfig) -> TaskConfig:
    """The task as the policy's own simulator has it: its actuator and latencies; nothing drawn, nothing pushed."""
    return replace(task, randomize=RandomizeConfig(), pushes=replace(task.pushes, enabled=False))


def away_task(task: TaskConfig) -> TaskConfig:
    """The task on the robot as its data sheet describes it, whatever it was trained with: a stand-in for reality.

    The control step stays: it is the policy's, and a robot would keep it.
    """
    kept = {name: value for name, value in task.params.items() if name == "control_step"}
    return replace(home_task(task), actuator="dc", params=kept, params_source={})


def top(policies: Sequence[PolicyGap], count: int, by: Callable[[PolicyGap], float] | None = None) -> list[PolicyGap]:
    """The policies with the highest return at home, best first: those that one would take to a robot."""
    return sorted(policies, key=by or (lambda policy: policy.home.estimate("returns").mean), reverse=True)[:count]
