"""The episodes of one policy in one world, summed up: speed, power, return, drift and gait."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import Footfalls, analyze_footfalls, circular_phase
from surefoot.evaluate.runs import Runs, common
from surefoot.robot import GRAVITY
from surefoot.task.trace import EpisodeTrace


def summarize(traces: Iterable[EpisodeTrace], total_mass: float) -> dict[str, Any]:
    """Sum up the episodes of one policy in one world.

    Means run over the episodes that know the number; standard deviations are of the population (zero for one
    episode). The gait is the commonest one, and phases, duty factors and stances come from its episodes.

    Args:
        traces: one episode or more.
        total_mass: kg.

    Returns:
        a dict that JSON can hold (None where nothing is known): episodes, falls, steps_mean, distance_mean
        (m), speed_mean and speed_std (m/s), power_mean (W), return_mean, return_std, drift_mean (m to either side),
        cost_of_transport_mean (of episodes that went forward), gait, and by leg name duty_factor, phases (strides
        after front_left) and stance (s), world, policy.

    Raises:
        SurefootError: no episodes, episodes of several worlds or policies, or no mass.
    """
    episodes = list(traces)
    if not episodes:
        raise SurefootError("summary: needs at least one episode trace")
    if not total_mass > 0:
        raise SurefootError(f"summary: total mass {total_mass} kg must be above 0")
    runs, policy = Runs.of_traces(episodes), common(episodes, "policy")
    feet = [analyze_footfalls(trace) for trace in episodes]
    gait = Counter(f.gait for f in feet).most_common(1)[0][0]
    chosen = [f for f in feet if f.gait == gait]
    weight = total_mass * GRAVITY
    return {
        "episodes": len(episodes),
        "falls": int(runs.fell.sum()),
        "steps_mean": _known(runs.steps),
        "distance_mean": _known(runs.distance),
        "speed_mean": _known(runs.speed),
        "speed_std": _known(runs.speed, np.std),
        "power_mean": _known(runs.power),
        "return_mean": _known(runs.returns),
        "return_std": _known(runs.returns, np.std),
        "drift_mean": _known([abs(t.base_position_world[-1, 1] - t.base_position_world[0, 1]) for t in episodes]),
        "cost_of_transport_mean": _known(runs.power / (weight * np.where(runs.speed > 0, runs.speed, np.nan))),
        "gait": gait,
        "duty_factor": _by_leg(chosen, "duty_factor"),
        "phases": _phases(chosen),
        "stance": _by_leg(chosen, "stance"),
        "world": runs.world,
        "policy": policy,
    }


def _known(values: ArrayLike, measure: Any = np.mean) -> float | None:
    """Return the mean, or another measure, of the values that are known; None where none is."""
    array = np.asarray(values, np.float64)
    known = array[np.isfinite(array)]
    return float(measure(known)) if known.size else None


def _by_leg(feet: Sequence[Footfalls], name: str) -> dict[str, float | None]:
    """Return the mean over episodes of a number that each leg has."""
    return {leg: _known([getattr(f, name)[leg] for f in feet]) for leg in getattr(feet[0], name)}


def _phases(feet: Sequence[Footfalls]) -> dict[str, float | None]:
    """Return each leg's circular mean phase over episodes, each weighted by its concentration."""
    phases: dict[str, float | None] = {}
    for leg in feet[0].phase:
        vectors = np.array([f.concentration[leg] * np.exp(2j * np.pi * f.phase[leg]) for f in feet])
        known = vectors[np.isfinite(vectors)]
        phases[leg] = circular_phase(known.sum()) if known.size else None
    return phases
