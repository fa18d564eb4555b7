"""Runs of a policy as a table with one row per episode, and the summary of an evaluation.

Evaluation, reality gap, sensitivity and studies share these columns, for simulated and recorded runs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from surefoot.errors import SurefootError, choices
from surefoot.evaluation.footfalls import Footfalls, analyze_footfalls, circular_phase
from surefoot.evaluation.statistics import MeanEstimate
from surefoot.evaluation.tracking import Tracking, distance_along, is_successful
from surefoot.robot import GRAVITY
from surefoot.tables import plain_value
from surefoot.task.trace import EpisodeTrace

MEANS = ("return", "distance", "speed", "power", "steps")
"""Columns of runs whose means are summarized."""
MIN_LIMITING_SATURATION = 0.25
"""Fraction of time at its limit from which a motor counts as limiting a gait. A trotting leg is in stance for half of
the time, so this is half of every stance; trots with enough torque stay below 0.04."""


def episode_metrics(
    returns: ArrayLike, distance: ArrayLike, duration: ArrayLike, energy: ArrayLike, steps: ArrayLike, ended: ArrayLike
) -> pd.DataFrame:
    """Return the metrics of episodes, one row each, from their totals in SI units (N,).

    The return is the sum of the task's own reward, as in training. The paper's reward r = (p_n - p_{n-1}) . d -
    w dt |tau . qdot| with d = world x sums to the distance minus w times the energy, so that traces of a real robot
    also have a return.

    Returns:
        Columns return, distance forward [m], mean speed [m/s] and mechanical power [W], control steps, whether the
        robot fell, and whether it kept its balance to the end, which the paper counts as a success.
    """
    path, time, outcome = np.asarray(distance, np.float64), np.asarray(duration, np.float64), np.asarray(ended)
    rates = {"return": returns, "distance": path, "speed": path / time, "power": np.asarray(energy, np.float64) / time}
    return pd.DataFrame({**rates, "steps": steps, "fell": outcome == "fall", "balanced": outcome == "time"})


def measure_runs(traces: Iterable[EpisodeTrace], world: str | None = None) -> pd.DataFrame:
    """Return the metrics of one or more runs in one world.

    Args:
        traces: the runs.
        world: name of the world; defaults to the name in the traces.

    Returns:
        One row per run: world, run, the columns of `episode_metrics`, and saturation, the fraction of time for which
        the worst motor was at its limit. NaN for quantities that were not measured.

    Raises:
        SurefootError: the traces are from several worlds.
    """
    runs = list(traces)
    name = common_value(runs, "world") if world is None else world
    distance, energy = [_distance(trace) for trace in runs], [_energy(trace) for trace in runs]
    table = episode_metrics(
        list(map(_return, runs, distance, energy)),
        distance,
        [trace.duration for trace in runs],
        energy,
        [trace.num_steps for trace in runs],
        [trace.meta["ended"] for trace in runs],
    )
    table.insert(0, "world", name)
    table.insert(1, "run", range(len(runs)))
    return table.assign(saturation=[float(trace.motor_saturation.mean(axis=0).max()) for trace in runs])


def _distance(trace: EpisodeTrace) -> float:
    """Return the distance that a run covered along the world's x axis [m]."""
    return float(trace.base_position_world[-1, 0] - trace.base_position_world[0, 0])


def _energy(trace: EpisodeTrace) -> float:
    """Return the mechanical energy of a run [J]."""
    return float(trace.energy.sum())


def _return(trace: EpisodeTrace, distance: float, energy: float) -> float:
    """Return the sum of the task's reward over a run; NaN if it was neither recorded nor follows from the trace."""
    if (weight := trace.meta["energy_weight"]) is None:
        return float(trace.reward.sum())
    if (limit := trace.meta["progress_limit"]) is not None:
        steps = np.diff(trace.base_position_world[:, 0])
        distance = float(np.minimum(steps, limit * trace.meta["control_step"]).sum())
    return distance - float(weight) * energy


def common_value(traces: Sequence[EpisodeTrace], name: str) -> str:
    """Return the `world` or `policy` of all traces.

    Raises:
        SurefootError: the traces have different ones, and must not be averaged.
    """
    values = sorted({str(trace.meta[name]) for trace in traces})
    if len(values) > 1:
        raise SurefootError(f"the traces come from more than one {name}: {choices(values)}; measure one at a time")
    return values[0]


def summarize_runs(runs: pd.DataFrame) -> dict[str, Any]:
    """Return the summary of runs in one world: means with standard errors, falls and success rate."""
    row: dict[str, Any] = {"world": runs.world.iloc[0], "runs": len(runs)}
    for name in MEANS:
        estimate = MeanEstimate.from_values(runs[name])
        row |= {f"{name}_mean": estimate.mean, f"{name}_error": estimate.error}
    return row | {"falls": int(runs.fell.sum()), "success_rate": float(runs.balanced.mean())}


def summarize(traces: Sequence[EpisodeTrace], total_mass: float) -> dict[str, Any]:
    """Summarize one or more episodes of one policy in one world, on a robot of `total_mass` [kg].

    Means leave out episodes in which the value is NaN; standard deviations divide by n - 1. The gait is the most
    frequent one; phases, duty factors and stances are means over its episodes.

    Returns:
        A dictionary for JSON (None for NaN): episodes, falls, steps_mean, distance_mean (m), speed_mean and speed_std
        (m/s), power_mean (W), return_mean, return_std, drift_mean (m to either side), cost_of_transport_mean (energy
        divided by weight and distance, if the distance is positive; along the commands, if there are any), with
        commands the result of `command_metrics`, gait and why it is "other" (gait_reason), hottest_motor and its mean
        hottest_heat (W), by leg name duty_factor, phases (strides after front_left) and stance (s), by motor name
        saturation (fraction of time at the motor's limit), world, policy.

    Raises:
        SurefootError: the episodes are of several worlds or policies.
    """
    runs, policy = measure_runs(traces), common_value(traces, "policy")
    feet = [analyze_footfalls(trace) for trace in traces]
    saturation = np.concatenate([trace.motor_saturation for trace in traces]).mean(axis=0).tolist()
    gait = Counter(one.gait for one in feet).most_common(1)[0][0]
    feet = [one for one in feet if one.gait == gait]
    return {
        "episodes": len(runs),
        "falls": int(runs.fell.sum()),
        "steps_mean": _mean(runs.steps),
        "distance_mean": _mean(runs.distance),
        "speed_mean": _mean(runs.speed),
        "speed_std": plain_value(float(runs.speed.std())),
        "power_mean": _mean(runs.power),
        "return_mean": _mean(runs["return"]),
        "return_std": plain_value(float(runs["return"].std())),
        "drift_mean": _mean([abs(t.base_position_world[-1, 1] - t.base_position_world[0, 1]) for t in traces]),
        "cost_of_transport_mean": _mean([_cost_of_transport([trace], total_mass * GRAVITY) for trace in traces]),
        "gait": gait,
        "gait_reason": Counter(one.reason for one in feet).most_common(1)[0][0],
        "duty_factor": _by_leg(feet, "duty_factor"),
        "phases": _phases(feet),
        "stance": _by_leg(feet, "stance"),
        "saturation": dict(zip(traces[0].meta["motor_names"], map(plain_value, saturation), strict=True)),
        **_hottest(traces),
        "world": runs.world.iloc[0],
        "policy": policy,
        **command_metrics(traces),
    }


def command_metrics(traces: Sequence[EpisodeTrace]) -> dict[str, Any]:
    """Return how well episodes follow their commands: `rmse` and `rmse_stride` by command, see `Tracking`, and success.

    Success is the fraction of successful episodes, see `is_successful`, of those in which the motion was measured.
    Empty without commands.
    """
    commanded = [trace for trace in traces if is_commanded(trace)]
    if not commanded:
        return {}
    return {
        **Tracking.from_traces(commanded).to_mapping(),
        "success": _mean(list(map(is_successful, commanded))),
    }


def summarize_load(traces: Sequence[EpisodeTrace], weight: float) -> dict[str, Any]:
    """Return the motor load in episodes of a robot with a weight [N], averaged over their total time.

    Returns:
        Mechanical power [W]; cost_of_transport as in `summarize`, NaN unless the distance is positive; hottest_motor
        and its mean heating power hottest_heat [W].
    """
    time = sum(trace.duration for trace in traces)
    return {
        "power": sum(map(_energy, traces)) / time,
        "cost_of_transport": _cost_of_transport(traces, weight),
        **_hottest(traces),
    }


def _hottest(traces: Sequence[EpisodeTrace]) -> dict[str, Any]:
    """Return the motor with the highest mean heating power, and this power [W]; None if it was not measured."""
    time = sum(trace.duration for trace in traces)
    heat = np.sum([trace.motor_heat.sum(axis=0) for trace in traces], axis=0)
    if not np.isfinite(heat).all():
        return {"hottest_motor": None, "hottest_heat": None}
    hottest = int(heat.argmax())
    return {
        "hottest_motor": traces[0].meta["motor_names"][hottest],
        "hottest_heat": plain_value(float(heat[hottest] / time)),
    }


def is_commanded(trace: EpisodeTrace) -> bool:
    """Return whether the robot received commands."""
    return bool(np.isfinite(trace.command).any())


def _cost_of_transport(traces: Sequence[EpisodeTrace], weight: float) -> float:
    """Return the energy of runs divided by weight [N] and distance; NaN unless the distance is positive."""
    distance = sum(distance_along(trace) if is_commanded(trace) else _distance(trace) for trace in traces)
    return sum(map(_energy, traces)) / (weight * distance) if distance > 0 else np.nan


def _mean(values: ArrayLike | Sequence[bool | None]) -> object:
    """Return the mean of values without NaN and None; None if there are none."""
    return plain_value(float(pd.Series(values, dtype=np.float64).mean()))


def _by_leg(feet: Sequence[Footfalls], name: str) -> dict[str, object]:
    """Return the mean over episodes of a leg's quantity, by leg."""
    return {leg: _mean([getattr(one, name)[leg] for one in feet]) for leg in getattr(feet[0], name)}


def _phases(feet: Sequence[Footfalls]) -> dict[str, float | None]:
    """Return each leg's circular mean phase over episodes, weighted by concentration."""
    phases: dict[str, float | None] = {}
    for leg in feet[0].phase:
        vectors = np.array([one.concentration[leg] * np.exp(2j * np.pi * one.phase[leg]) for one in feet])
        vectors = vectors[np.isfinite(vectors)]
        phases[leg] = circular_phase(vectors.sum()) if vectors.size else None
    return phases
