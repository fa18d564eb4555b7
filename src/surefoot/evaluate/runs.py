"""Runs of a policy as a table, a row an episode, and what they come to: means, and the summary of an evaluation.

Evaluation, reality gap, sensitivity and studies all report by these columns, whether runs come from a simulation or
from recorded traces.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices
from surefoot.evaluate.footfalls import Footfalls, analyze_footfalls, circular_phase
from surefoot.evaluate.statistics import decimal
from surefoot.evaluate.tracking import STRIDE, Tracking
from surefoot.robot import GRAVITY
from surefoot.tables import plain_value
from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class Estimate:
    """A mean and its standard error."""

    mean: float
    """Mean over runs; NaN where no run tells."""
    error: float
    """Standard error of the mean; NaN where fewer than two runs tell."""

    @classmethod
    def of(cls, values: ArrayLike) -> Estimate:
        """Return mean and standard error of numbers (N,), those left out that are not known (NaN)."""
        array = np.asarray(values, np.float64)
        known = array[np.isfinite(array)]
        if not known.size:
            return cls(math.nan, math.nan)
        error = float(known.std(ddof=1)) / math.sqrt(known.size) if known.size > 1 else math.nan
        return cls(float(known.mean()), error)

    def __sub__(self, other: Estimate) -> Estimate:
        return Estimate(self.mean - other.mean, math.hypot(self.error, other.error))

    def text(self, digits: int = 2, sign: bool = False) -> str:
        """Return text such as `1.20 ± 0.05`; `-` if the mean is not known, no error if that is not."""
        if not math.isfinite(self.mean):
            return "-"
        mean = decimal(self.mean, digits, sign)
        return f"{mean} ± {decimal(self.error, digits)}" if math.isfinite(self.error) else mean


@dataclass(frozen=True)
class Runs:
    """Runs in one world, a row an episode; arrays (N,), NaN where a run does not tell."""

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
        return len(self.returns)

    @classmethod
    def of_traces(cls, traces: Iterable[EpisodeTrace], world: str | None = None) -> Runs:
        """Measure runs in one world, which is called `world`, or as its traces say.

        Raises:
            SurefootError: no traces, or of several worlds.
        """
        runs = list(traces)
        if not runs:
            raise SurefootError("no runs; a gap is measured from 1 run or more in each world")
        name = common(runs, "world") if world is None else world
        returns, distance, speed, power, steps = np.array([_measured(trace) for trace in runs]).T.copy()
        fell = np.array([trace.fell for trace in runs])
        balanced = np.array([trace.meta["ended"] == "time" for trace in runs])
        return cls(name, returns, distance, speed, power, steps, fell, balanced)

    @classmethod
    def pooled(cls, parts: Sequence[Runs]) -> Runs:
        """Return all runs of several policies in the same world."""
        columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in COLUMNS}
        return cls(parts[0].world, **columns)

    def estimate(self, name: str) -> Estimate:
        """Return mean and standard error of a column."""
        return Estimate.of(getattr(self, name))

    @property
    def success_rate(self) -> float:
        """Share of the runs in which the robot kept its balance to the end."""
        return float(self.balanced.mean())

    def rows(self) -> list[dict[str, Any]]:
        """Return a row for each run, for tables."""
        names = {"returns": "return"}
        columns = {names.get(name, name): getattr(self, name).tolist() for name in COLUMNS}
        return [
            {"run": number, **dict(zip(columns, values, strict=True))}
            for number, values in enumerate(zip(*columns.values(), strict=True))
        ]

    def summary(self) -> dict[str, Any]:
        """Return the row of these runs in a table of worlds: means and standard errors, falls and successes."""
        row: dict[str, Any] = {"world": self.world, "runs": len(self)}
        for name in ("return", "distance", "speed", "power", "steps"):
            found = self.estimate("returns" if name == "return" else name)
            row |= {f"{name}_mean": found.mean, f"{name}_error": found.error}
        return row | {"falls": int(self.fell.sum()), "success_rate": self.success_rate}

    def to_mapping(self) -> dict[str, Any]:
        """Return the columns as JSON holds them; what is not known is None."""
        columns = {name: [plain_value(value) for value in getattr(self, name).tolist()] for name in COLUMNS}
        return {"world": self.world, **columns}

    @classmethod
    def from_mapping(cls, data: dict[str, Any]) -> Runs:
        """Return runs from `to_mapping`."""
        kinds = {name: np.bool_ if name in ("fell", "balanced") else np.float64 for name in COLUMNS}
        return cls(data["world"], **{name: np.array(data[name], kind) for name, kind in kinds.items()})


def _measured(trace: EpisodeTrace) -> tuple[float, ...]:
    """Return return [m], distance [m], speed [m/s], power [W] and control steps of a run.

    The paper's reward r = (p_n - p_{n-1}) . d - w dt |tau . qdot| with d = world x sums to distance less w times the
    energy.
    """
    distance = float(trace.base_position_world[-1, 0] - trace.base_position_world[0, 0])
    energy, duration = float(trace.energy.sum()), trace.duration
    gained = distance - float(trace.meta["energy_weight"]) * energy
    return gained, distance, distance / duration, energy / duration, trace.num_steps


def common(traces: Sequence[EpisodeTrace], name: str) -> str:
    """Return the `world` or `policy` that all traces name; refuse several, whose runs must not be averaged."""
    said = sorted({str(trace.meta[name]) for trace in traces})
    if len(said) > 1:
        raise SurefootError(f"the traces come from more than one {name}: {choices(said)}; measure one at a time")
    return said[0]


COLUMNS = tuple(item.name for item in fields(Runs) if item.name != "world")
"""Columns of a table of runs."""


def summarize(traces: Iterable[EpisodeTrace], total_mass: float) -> dict[str, Any]:
    """Sum up the episodes of one policy in one world, by a robot of `total_mass` [kg].

    Means run over the episodes that know the number; standard deviations are of the population (zero for one
    episode). The gait is the commonest one, and phases, duty factors and stances come from its episodes.

    Returns:
        a dict that JSON can hold (None where nothing is known): episodes, falls, steps_mean, distance_mean
        (m), speed_mean and speed_std (m/s), power_mean (W), return_mean, return_std, drift_mean (m to either side),
        cost_of_transport_mean (of episodes that went forward), with commands rmse and rmse_stride by command, gait,
        and by leg name duty_factor, phases (strides after front_left) and stance (s), world, policy.

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
        **_tracking(episodes),
    }


def _tracking(traces: Sequence[EpisodeTrace]) -> dict[str, Any]:
    """Return how well commands were followed, of runs that had any."""
    told = [trace for trace in traces if np.isfinite(trace.command).any()]
    if not told:
        return {}
    return Tracking.of_traces(told, float(told[0].meta["gait_period"] or STRIDE)).to_mapping()


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
