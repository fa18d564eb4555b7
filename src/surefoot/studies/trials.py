"""The trials of a search: what each came to, which gaits emerged, and how much the best flatter themselves."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.evaluate.runs import Runs
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
    """What the search chose, by dotted name."""
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
    """A policy that a search found good, in episodes that the search has not seen."""

    trial: TrialResult
    """The trial."""
    home: Runs
    """Fresh episodes in the simulator that it was trained in."""
    away: Runs | None
    """Episodes in Bullet; None where Bullet is not installed."""

    @property
    def fresh(self) -> Interval:
        """Mean return of fresh episodes at home [m]."""
        return t_interval(self.home.returns)

    @property
    def flattery(self) -> Interval:
        """The return that the search gave less the one in fresh episodes [m]: selection bias.

        What the search gave is a number; the interval is that of the mean return of fresh episodes.
        """
        fresh, claimed = self.fresh, self.trial.value
        return Interval(claimed - fresh.mean, claimed - fresh.high, claimed - fresh.low)


@dataclass(frozen=True)
class SearchResult:
    """A search, as its report tells it."""

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
    def complete(self) -> list[TrialResult]:
        """Trials that were trained to the end."""
        return [trial for trial in self.trials if trial.complete]

    @property
    def flattery(self) -> Interval:
        """By how much the best trials flatter themselves [m]: mean over them, with its interval over policies."""
        return t_interval([retest.flattery.mean for retest in self.retests])

    def census(self) -> dict[str, list[TrialResult]]:
        """Return trials by the name of their gait, the most frequent first; within, those of the highest return first.

        Pruned trials count: their policies are those of the time when they were pruned.
        """
        found: dict[str, list[TrialResult]] = {}
        for trial in self.trials:
            if trial.gait is not None:
                found.setdefault(trial.gait["gait"], []).append(trial)
        ranked = {name: best(trials, len(trials)) for name, trials in found.items()}
        return dict(sorted(ranked.items(), key=lambda item: (-len(item[1]), item[0])))


def best(trials: Sequence[TrialResult], count: int) -> list[TrialResult]:
    """Return the trials of the highest return, best first; those without a return last."""
    known = [trial.value if math.isfinite(trial.value) else -math.inf for trial in trials]
    order = np.argsort(-np.array(known), kind="stable")[:count]
    return [trials[i] for i in order]
