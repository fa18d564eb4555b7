"""The reality gaps of groups of policies: their runs pooled as Tan et al. 2018 pool them, and their policies as units.

The paper takes the three best of a group to the robot, runs each three times, and gives the mean of the nine runs with
one standard error. Runs of one policy are no independent ones, though: what a policy does badly, it does badly in all
of them, and what is hard on one robot is hard for all policies. So intervals over policies and robots stand beside it:
run k of every policy away is on robot k.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.evaluate.comparison import Comparison, GroupResult
from surefoot.evaluate.gap import Estimate, PolicyGap, Runs, known
from surefoot.evaluate.kinds import gap_of
from surefoot.evaluate.statistics import Interval, crossed_interval

Array = NDArray[np.float64]
FAR = 3.0
"""A run goes far over this [m]; the paper tells so of nine runs on the robot."""
MEASURES = {"returns": "m", "speed": "m/s", "distance": "m", "power": "W", "steps": ""}
"""What is averaged over runs, with its unit."""


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
    def gaps(self) -> Array:
        """Each policy's mean return at home less its return in each run away [m], (P, R)."""
        return np.array([policy.home.estimate("returns").mean - policy.away[0].returns for policy in self.policies])

    @property
    def interval(self) -> Interval:
        """The mean gap [m], with its interval over policies and over robots (or starts) away."""
        return crossed_interval(self.gaps)

    @property
    def far(self) -> int:
        """How many runs away went far."""
        return int((self.away.distance > FAR).sum())


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
    crossed: Interval
    """The same [m], with its interval over policies and over robots (or starts) away."""
    away: Interval
    """Difference of the returns away [m], with the same interval."""


def gap_difference(base: GroupGap, other: GroupGap) -> GapDifference:
    """The gap of `other` less that of `base`."""
    away, base_away = (np.array([policy.away[0].returns for policy in group.policies]) for group in (other, base))
    crossed = crossed_interval(other.gaps, base.gaps)
    return GapDifference(other.gap - base.gap, crossed, crossed_interval(away, base_away))


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
        "gap_interval": interval_mapping(group.interval),
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
