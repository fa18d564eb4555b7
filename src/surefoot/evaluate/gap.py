"""The reality gap as a number: what a policy's return loses in another world than the one that it was trained in.

Koos et al. (2010, "Crossing the reality gap in evolutionary robotics by promoting transferable controllers") measure
it by the difference between the expected return in simulation and on the robot, and Tan et al. 2018, section VI-B, do
so with a few runs of a few policies. Here a run is a trace, wherever it comes from: of a simulation or of a robot.

The paper takes the three best policies of a group to the robot, runs each three times, and gives the mean of the nine
runs with one standard error. Runs of one policy are not independent, though: what a policy does badly, it does badly
in all of them, and what is hard on one robot is hard for all policies. So intervals over policies and robots stand
beside it: run k of every policy away is on robot k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.evaluate.runs import Estimate, Runs
from surefoot.evaluate.statistics import Interval, crossed_interval
from surefoot.task.config import TaskConfig


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

    @property
    def runs(self) -> tuple[Runs, ...]:
        """Runs in each world, home first."""
        return self.home, *self.away

    def gap(self, world: str) -> Estimate:
        """Return at home less return away [m]: above zero where the policy does worse than its simulation says.

        Of several policies it is the mean of their gaps, with its standard error over policies: how far policies
        differ from each other, gallops from trots, says nothing about how far any of them is from its simulation.
        """
        if self.parts:
            return Estimate.of([part.gap(world).mean for part in self.parts])
        return self.gap_over_runs(world)

    def gap_over_runs(self, world: str) -> Estimate:
        """Return the gap to another world [m] with the standard error over all runs."""
        return self.home.estimate("returns") - self.of(world).estimate("returns")

    def gaps(self, world: str) -> Array:
        """Each policy's mean return at home less its return in each run away [m], (policies, runs)."""
        return np.array([part.home.estimate("returns").mean - part.of(world).returns for part in self.parts or (self,)])

    def interval(self, world: str) -> Interval:
        """Return the mean gap [m] with its interval over policies and over robots (or starts) away."""
        return crossed_interval(self.gaps(world))

    def of(self, world: str) -> Runs:
        """Its runs in another world, which must be one of those that it was run in."""
        for runs in self.away:
            if runs.world == world:
                return runs
        raise SurefootError(f"no runs in '{world}'; worlds: {choices([runs.world for runs in self.away])}")

    @classmethod
    def pooled(cls, name: str, policies: Sequence[PolicyGap]) -> PolicyGap:
        """Several policies, run in the same worlds, as one: the paper averages nine runs of three policies."""
        worlds = [tuple(runs.world for runs in policy.away) for policy in policies]
        if len(set(worlds)) != 1:
            raise SurefootError("policies were run in different worlds; a gap of several takes the same for all")
        away = tuple(Runs.pooled([policy.of(world) for policy in policies]) for world in worlds[0])
        return cls(name, Runs.pooled([policy.home for policy in policies]), away, tuple(policies))

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each world, home first, with its runs' means and errors and the gap; NaN: not known."""
        sides = [("home", Estimate.of([])), *(("away", self.gap(runs.world)) for runs in self.away)]
        return [
            {"policy": self.name, "side": side, **runs.summary(), "gap": gap.mean, "gap_error": gap.error}
            for (side, gap), runs in zip(sides, self.runs, strict=True)
        ]

    def text_rows(self) -> list[dict[str, str]]:
        """Return a row of text for each world, home first: means with one standard error."""
        return [
            {
                "policy": self.name,
                "world": runs.world,
                "return (m)": runs.estimate("returns").text(),
                "gap (m)": "" if runs is self.home else self.gap(runs.world).text(sign=True),
                "speed (m/s)": runs.estimate("speed").text(),
                "power (W)": runs.estimate("power").text(1),
                "falls": f"{runs.fell.sum()} of {len(runs)}",
                "success": f"{100 * runs.success_rate:.0f} %",
            }
            for runs in self.runs
        ]


def gap_difference(base: PolicyGap, other: PolicyGap) -> tuple[Estimate, Interval, Interval]:
    """Return how much wider the gap of one group of policies is than another's, each to its first world away.

    Returns:
        the gap of `other` less that of `base` [m] with its standard error over runs, the same with its interval over
        policies and robots (or starts), and the difference of their returns away [m] with that interval.
    """
    worlds = [group.away[0].world for group in (base, other)]
    gaps = [group.gaps(world) for group, world in zip((base, other), worlds, strict=True)]
    away = [np.array([part.away[0].returns for part in group.parts]) for group in (base, other)]
    over_runs = other.gap_over_runs(worlds[1]) - base.gap_over_runs(worlds[0])
    return over_runs, crossed_interval(gaps[1], gaps[0]), crossed_interval(away[1], away[0])


def home_task(task: TaskConfig) -> TaskConfig:
    """The task as the policy's own simulator has it: its actuator and latencies; nothing drawn, nothing pushed."""
    return replace(task, randomize={}, pushes=replace(task.pushes, enabled=False))


def away_task(task: TaskConfig) -> TaskConfig:
    """The task on the robot as its data sheet describes it, whatever it was trained with: a stand-in for reality.

    The control step stays: it is the policy's, and a robot would keep it.
    """
    kept = {name: value for name, value in task.params.items() if name == "control_step"}
    return replace(home_task(task), actuator="dc", params=kept, params_source={})
