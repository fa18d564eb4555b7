"""The trials of a search: their results, the gaits that emerged, and the selection bias of the best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pandas as pd

from surefoot.evaluate.statistics import Interval, t_interval
from surefoot.studies.evaluations import Result
from surefoot.tables import plain_value


@dataclass(frozen=True)
class TrialResult:
    """One trial."""

    number: int
    """Its number in the search."""
    state: str
    """complete, pruned, fail or running."""
    seed: int | None
    """Seed of its training; None if it has none."""
    value: float
    """Return of the policy at its end [m]; NaN if it was not evaluated."""
    steps: int
    """Control steps of its training."""
    seconds: float
    """How long its training took [s]."""
    curve: tuple[tuple[int, float], ...]
    """Control steps and return [m] of each evaluation."""
    params: dict[str, Any]
    """Proposed settings, by dotted name."""
    policy: Path | None
    """Its policy file; None if it has none."""
    gait: Result | None = None
    """Result of the evaluation `gait`; None if it has no policy."""
    why: str = ""
    """Why it failed."""

    @property
    def complete(self) -> bool:
        """Whether it was trained to the end."""
        return self.state == "complete"

    def row(self) -> dict[str, Any]:
        """Return its row of the table of trials."""
        gait = self.gait or {}
        return {
            "trial": self.number,
            "state": self.state,
            "return": plain_value(self.value),
            "steps": self.steps,
            "seconds": self.seconds,
            "gait": gait.get("gait"),
            "pattern": gait.get("pattern"),
            "seed": self.seed,
            **self.params,
            "why": self.why,
        }


@dataclass(frozen=True)
class Retest:
    """One of the best policies of a search, in episodes that the search has not seen."""

    trial: TrialResult
    """The trial."""
    runs: pd.DataFrame
    """Fresh episodes in the simulator of its training, and in Bullet if that is installed; as `measure_runs`."""

    def in_world(self, number: int) -> pd.DataFrame:
        """Return the runs at home, 0, or in Bullet, 1; empty without Bullet."""
        worlds = self.runs.world.unique()
        return self.runs[self.runs.world == worlds[number]] if number < len(worlds) else self.runs[:0]

    @property
    def fresh(self) -> Interval:
        """Mean return of fresh episodes at home [m]."""
        return t_interval(self.in_world(0)["return"])

    @property
    def selection_bias(self) -> Interval:
        """Return that the search saw, less the one in fresh episodes with its interval [m]."""
        fresh, claimed = self.fresh, self.trial.value
        return Interval(claimed - fresh.mean, claimed - fresh.high, claimed - fresh.low)


@dataclass(frozen=True)
class SearchResult:
    """A search, as its report shows it."""

    name: str
    """Name of the task."""
    seed: int
    """Seed of the search."""
    steps: int
    """Control steps of a trial that is not pruned."""
    episodes: int
    """Episodes of an evaluation of a trial."""
    trials: tuple[TrialResult, ...]
    """All trials, by number."""
    importance: dict[str, float] = field(default_factory=dict)
    """Importance of each field, all together 1; empty where too few trials are complete."""
    retests: tuple[Retest, ...] = ()
    """The best trials anew, best first."""

    @property
    def selection_bias(self) -> Interval:
        """Mean selection bias of the best trials [m], with its interval over policies."""
        return t_interval([retest.selection_bias.mean for retest in self.retests])

    def census(self) -> dict[str, list[TrialResult]]:
        """Return trials by the name of their gait, the most frequent first; within, those of the highest return first.

        Pruned trials count, with the gait of the policy that was pruned.
        """
        gaits: dict[str, list[TrialResult]] = {}
        for trial in best(self.trials):
            if trial.gait is not None:
                gaits.setdefault(trial.gait["gait"], []).append(trial)
        return dict(sorted(gaits.items(), key=lambda item: (-len(item[1]), item[0])))


def best(trials: Sequence[TrialResult]) -> list[TrialResult]:
    """Return trials by their return, the highest first; those without a return last."""
    return sorted(trials, key=lambda trial: -trial.value if math.isfinite(trial.value) else math.inf)
