"""The reality gaps of groups of policies: their runs pooled as Tan et al. 2018 pool them, and their policies as units.

The paper takes the three best of a group to the robot, runs each three times, and gives the mean of the nine runs with
one standard error. Three runs of one policy are no independent ones, though: what a policy does badly, it does badly
three times. So the policies' own gaps, one number each, stand beside it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.evaluate.comparison import Comparison, GroupResult
from surefoot.evaluate.gap import Estimate, PolicyGap, Runs, known
from surefoot.evaluate.kinds import gap_of
from surefoot.evaluate.statistics import Interval, t_interval, welch_interval

Array = NDArray[np.float64]
FAR = 3.0
"""A run goes far over this [m]; the paper tells so of nine runs on the robot."""
MEASURES = {"returns": "m", "speed": "m/s", "distance": "m", "power": "W", "steps": ""}
"""What is averaged over runs, with its unit."""


@dataclass(frozen=True)
class ShortRun:
    """A run away that did not keep its balance for the whole episode, or did not go far."""

    seed: int
    """Seed of the policy's training."""
    run: int
    """Number of the run, from 0."""
    steps: int
    """Control steps until its end."""
    distance: float
    """How far it went [m]."""
    balanced: bool
    """Whether it kept its balance for the whole episode."""


@dataclass(frozen=True)
class GroupGap:
    """Runs of a group's policies at home and in another world."""

    name: str
    """Name of the group."""
    label: str
    """What figures and tables call it."""
    seeds: tuple[int, ...]
    """Seeds of the policies' trainings."""
    policies: tuple[PolicyGap, ...]
    """Runs of each policy, in the order of the seeds."""

    @property
    def home(self) -> Runs:
        """All runs at home."""
        return Runs.pooled([policy.home for policy in self.policies])

    @property
    def away(self) -> Runs:
        """All runs away."""
        return Runs.pooled([policy.away[0] for policy in self.policies])

    @property
    def described(self) -> Runs:
        """All runs in the engine of home, with the motors and delays of the robot's data sheet."""
        return Runs.pooled([policy.away[1] for policy in self.policies])

    @property
    def gap(self) -> Estimate:
        """Return at home less return away [m], with the standard error over all runs."""
        return self.home.estimate("returns") - self.away.estimate("returns")

    @property
    def policy_gaps(self) -> Array:
        """Each policy's own mean return at home less that away [m], (P,)."""
        return np.array([policy.gap(policy.away[0].world).mean for policy in self.policies])

    @property
    def interval(self) -> Interval:
        """The mean of the policies' gaps [m], with Student's interval over policies."""
        return t_interval(self.policy_gaps)

    @property
    def far(self) -> int:
        """How many runs away went far."""
        return int((self.away.distance > FAR).sum())

    @property
    def short_runs(self) -> list[ShortRun]:
        """Runs away that ended early or did not go far."""
        return [
            ShortRun(seed, run, int(runs.steps[run]), float(runs.distance[run]), bool(runs.balanced[run]))
            for seed, runs in ((seed, policy.away[0]) for seed, policy in zip(self.seeds, self.policies, strict=True))
            for run in range(len(runs))
            if not (runs.balanced[run] and runs.distance[run] > FAR)
        ]


def gap_groups(comparison: Comparison, count: int | None = None) -> dict[str, GroupGap]:
    """The groups' runs at home and away, by name.

    Args:
        comparison: the groups, evaluated with the kind "gap".
        count: how many policies of each, those with the highest return in their own simulator, best first; all of
            them, by seed, if not given.
    """
    return {group.name: _of_group(group, count) for group in comparison.groups}


def _of_group(group: GroupResult, count: int | None) -> GroupGap:
    seeds = list(group.seeds)
    if count is not None:
        # By episodes of their own: those that tell the gap were not chosen for being good.
        seeds = sorted(seeds, key=lambda seed: seed.figures["nominal_return"], reverse=True)[:count]
    policies = tuple(gap_of(seed.results["gap"], f"{group.label}, seed {seed.seed}") for seed in seeds)
    return GroupGap(group.name, group.label, tuple(seed.seed for seed in seeds), policies)


@dataclass(frozen=True)
class GapDifference:
    """How much wider one group's gap is than another's."""

    runs: Estimate
    """Difference of the gaps [m], with the standard error over runs."""
    policies: Interval
    """Difference of the policies' mean gaps [m], with Welch's interval over policies."""


def gap_difference(base: GroupGap, other: GroupGap) -> GapDifference:
    """The gap of `other` less that of `base`."""
    return GapDifference(other.gap - base.gap, welch_interval(other.policy_gaps, base.policy_gaps))


def gap_mapping(group: GroupGap) -> dict[str, Any]:
    """What a group's runs came to, as JSON holds it; what is not known is None."""
    home, away = group.home, group.away
    return {
        "seeds": list(group.seeds),
        "runs": len(away),
        "home": {name: estimate_mapping(home.estimate(name)) for name in MEASURES},
        "away": {name: estimate_mapping(away.estimate(name)) for name in MEASURES},
        "described": {name: estimate_mapping(group.described.estimate(name)) for name in MEASURES},
        "gap": estimate_mapping(group.gap),
        "gap_over_policies": interval_mapping(group.interval),
        "balanced_home": int(home.balanced.sum()),
        "balanced_away": int(away.balanced.sum()),
        "far_away": group.far,
        "least_distance_away": float(away.distance.min()),
    }


def estimate_mapping(estimate: Estimate) -> dict[str, float | None]:
    """Mean and standard error, as JSON holds them."""
    return {"mean": known(estimate.mean), "standard_error": known(estimate.error)}


def interval_mapping(interval: Interval) -> dict[str, float | None]:
    """Mean and interval, as JSON holds them."""
    return {"mean": known(interval.mean), "low": known(interval.low), "high": known(interval.high)}
