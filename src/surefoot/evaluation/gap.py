"""Reality gap: loss of a policy's return in another world than the one in which it was trained.

Koos et al. (2010, "Crossing the reality gap in evolutionary robotics by promoting transferable controllers") define
it as the difference between the expected return in simulation and on the robot. Tan et al. 2018, section VI-B,
measure it with a few runs of a few policies. Here a run is a trace of a simulation or of a robot.

The paper runs the three best policies of a group three times each on the robot, and gives the mean of the nine runs
with one standard error. Runs of one policy, and runs on one robot, are not independent. The tables therefore also give
intervals over policies and robots: in the target world, run k of every policy is on robot k.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from surefoot.arrays import Array
from surefoot.evaluation.runs import MEANS, summarize_runs
from surefoot.evaluation.statistics import MeanEstimate
from surefoot.tables import with_unit


@dataclass(frozen=True)
class PolicyGap:
    """Runs of one policy, or of several pooled, in the training world ("home") and in target worlds ("away")."""

    name: str
    runs: pd.DataFrame
    """One row per run: the policy, then the columns of `measure_runs`; runs in the training world come first."""

    @classmethod
    def from_runs(cls, name: str, worlds: Sequence[pd.DataFrame]) -> PolicyGap:
        """Return the gap of one policy from its runs in each world, the training world first."""
        runs = pd.concat(worlds, ignore_index=True)
        runs.insert(0, "policy", name)
        return cls(name, runs)

    @classmethod
    def pooled(cls, name: str, policies: Sequence[PolicyGap]) -> PolicyGap:
        """Pool policies that ran in the same worlds; the paper averages nine runs of three policies."""
        return cls(name, pd.concat([policy.runs for policy in policies], ignore_index=True))

    @property
    def worlds(self) -> tuple[str, ...]:
        """Names of the worlds, the training world first."""
        return tuple(self.runs.world.unique())

    @property
    def home(self) -> pd.DataFrame:
        """Runs in the training world."""
        return self.in_world(self.worlds[0])

    def in_world(self, world: str) -> pd.DataFrame:
        """Return the runs in a world."""
        return self.runs[self.runs.world == world]

    def split(self) -> list[PolicyGap]:
        """Return the pooled policies one by one."""
        return [PolicyGap(str(name), runs) for name, runs in self.runs.groupby("policy", sort=False)]

    def gap(self, world: str) -> MeanEstimate:
        """Return the reality gap [m]: return in the training world minus return in `world`.

        For several policies it is the mean of their gaps with the standard error over policies. A standard error over
        all runs would include the differences between the policies in the training world, such as gallop and trot.
        """
        policies = self.split()
        if len(policies) == 1:
            return self.gap_over_runs(world)
        return MeanEstimate.from_values([policy.gap_over_runs(world).mean for policy in policies])

    def gap_over_runs(self, world: str) -> MeanEstimate:
        """Return the gap to another world [m] with the standard error over all runs."""
        home, away = (MeanEstimate.from_values(runs["return"]) for runs in (self.home, self.in_world(world)))
        return home - away

    def table(self, world: str, column: str) -> Array:
        """Return a column of the runs in a world as an array (policies, runs)."""
        return np.array([one.in_world(world)[column] for one in self.split()], np.float64)

    def gaps(self, world: str) -> Array:
        """Return each policy's mean return in the training world minus its return in each run in `world` [m].

        The shape is (policies, runs).
        """
        home = self.table(self.worlds[0], "return").mean(axis=1, keepdims=True)
        return home - self.table(world, "return")

    def level(self, world: str, column: str) -> MeanEstimate:
        """Return the mean of a column in a world, over runs, or over the means of several policies; see `gap`."""
        runs = self.in_world(world)
        means = runs.groupby("policy", sort=False)[column].mean()
        return MeanEstimate.from_values(runs[column] if len(means) == 1 else means)

    def rows(self) -> list[dict[str, Any]]:
        """Return one row per world, the training world first: means with standard errors, see `level`, and the gap."""
        rows = []
        for number, world in enumerate(self.worlds):
            gap, side = (self.gap(world), "away") if number else (MeanEstimate(), "home")
            summary = summarize_runs(self.in_world(world))
            for column in MEANS:
                level = self.level(world, column)
                summary |= {f"{column}_mean": level.mean, f"{column}_error": level.error}
            rows.append({"policy": self.name, "side": side, **summary, "gap": gap.mean, "gap_error": gap.error})
        return rows


def gap_cells(row: Mapping[str, Any], is_home: bool, sign: bool = False, unit: str = "m") -> dict[str, str]:
    """Return a row as text, each mean with one standard error; `unit` is the unit of returns.

    The row has the columns of `summarize_runs`, and gap and gap_error.
    """

    def mean(name: str, digits: int = 2) -> str:
        return MeanEstimate(row[f"{name}_mean"], row[f"{name}_error"]).text(digits)

    return {
        "world": row["world"],
        with_unit("return", unit): mean("return"),
        with_unit("gap", unit): "" if is_home else MeanEstimate(row["gap"], row["gap_error"]).text(sign=sign),
        "speed (m/s)": mean("speed"),
        "power (W)": mean("power", 1),
        "falls": f"{row['falls']} of {row['runs']}",
        "success": f"{100 * row['success_rate']:.0f} %",
    }
