"""Speed, power, return and drift of episodes, from their traces."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError, choices
from surefoot.evaluate.footfalls import Footfalls, analyze_footfalls
from surefoot.robot import GRAVITY
from surefoot.task.trace import EpisodeTrace


@dataclass(frozen=True)
class EpisodeMetrics:
    """What one episode came to. NaN where the trace does not tell (a robot without motion capture).

    Attributes:
        steps: control steps.
        duration: s.
        distance: m forward, along world x, from start to end.
        speed: m/s, distance over duration.
        power: W, mean mechanical power: the integral of |tau . qdot| over duration.
        return_: m, the paper's reward summed over the episode: r = (p_n - p_{n-1}) . d - w dt |tau . qdot|
            with d = world x; the first term sums to distance and the second to w times the energy.
        cost_of_transport: power / (m g speed), without unit; NaN when the robot did not go forward.
        fell: whether the episode ended in a fall.
        drift: m, how far to either side, |y|, the robot was at the end.
        heading_change: rad, turned left (+) or right (-) from start to end, full turns counted.
    """

    steps: int
    duration: float
    distance: float
    speed: float
    power: float
    return_: float
    cost_of_transport: float
    fell: bool
    drift: float
    heading_change: float


def episode_metrics(trace: EpisodeTrace, total_mass: float = math.nan) -> EpisodeMetrics:
    """Measure one episode.

    Args:
        trace: the episode.
        total_mass: kg; without it the cost of transport is NaN.
    """
    moved = trace.base_position_world[-1] - trace.base_position_world[0]
    distance, energy = float(moved[0]), float(trace.energy.sum())
    speed, power = distance / trace.duration, energy / trace.duration
    return EpisodeMetrics(
        steps=trace.num_steps,
        duration=trace.duration,
        distance=distance,
        speed=speed,
        power=power,
        return_=distance - float(trace.meta["energy_weight"]) * energy,
        cost_of_transport=power / (total_mass * GRAVITY * speed) if speed > 0 else math.nan,
        fell=trace.fell,
        drift=abs(float(moved[1])),
        heading_change=_heading_change(trace),
    )


def summarize(
    traces: Iterable[EpisodeTrace],
    total_mass: float,
    *,
    world: str | None = None,
    policy: str | None = None,
) -> dict[str, Any]:
    """Sum up the episodes of one policy in one world.

    Means run over the episodes that know the number; standard deviations are of the population (zero for one
    episode). The gait is the commonest one, and phases, duty factors and stances come from its episodes.

    Args:
        traces: one episode or more.
        total_mass: kg.
        world: name; the traces' own when left out.
        policy: name; the traces' own when left out.

    Returns:
        a dict that JSON can hold (None where nothing is known): episodes, falls, steps_mean, distance_mean
        (m), speed_mean and speed_std (m/s), power_mean (W), return_mean, return_std, drift_mean (m),
        cost_of_transport_mean, gait, and by leg name duty_factor, phases (strides after front_left) and
        stance (s), world, policy.
    """
    episodes = list(traces)
    if not episodes:
        raise SurefootError("summary: needs at least one episode trace")
    if not total_mass > 0:
        raise SurefootError(f"summary: total mass {total_mass} kg must be above 0")
    metrics = [episode_metrics(trace, total_mass) for trace in episodes]
    feet = [analyze_footfalls(t.foot_contact, t.time, t.leg_names) for t in episodes]
    gait = Counter(f.gait for f in feet).most_common(1)[0][0]
    chosen = [f for f in feet if f.gait == gait]
    speed, return_ = [m.speed for m in metrics], [m.return_ for m in metrics]
    return {
        "episodes": len(episodes),
        "falls": sum(m.fell for m in metrics),
        "steps_mean": _mean([m.steps for m in metrics]),
        "distance_mean": _mean([m.distance for m in metrics]),
        "speed_mean": _mean(speed),
        "speed_std": _std(speed),
        "power_mean": _mean([m.power for m in metrics]),
        "return_mean": _mean(return_),
        "return_std": _std(return_),
        "drift_mean": _mean([m.drift for m in metrics]),
        "cost_of_transport_mean": _mean([m.cost_of_transport for m in metrics]),
        "gait": gait,
        "duty_factor": _by_leg(chosen, "duty_factor"),
        "phases": _phases(chosen),
        "stance": _by_leg(chosen, "stance"),
        "world": _common(episodes, "world") if world is None else world,
        "policy": _common(episodes, "policy") if policy is None else policy,
    }


def _heading_change(trace: EpisodeTrace) -> float:
    """Return the change of yaw in rad; the IMU's where the true orientation is unknown."""
    w, x, y, z = trace.base_quat_world.T
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    if not np.all(np.isfinite(yaw)):
        yaw = trace.roll_pitch_yaw[:, 2]
    turned: NDArray[np.float64] = np.unwrap(yaw)
    return float(turned[-1] - turned[0])


def _known(values: Sequence[float]) -> NDArray[np.float64]:
    """Return the finite ones of values."""
    array = np.asarray(values, dtype=np.float64)
    return array[np.isfinite(array)]


def _mean(values: Sequence[float]) -> float | None:
    """Return the mean of what is known, or None."""
    known = _known(values)
    return float(known.mean()) if known.size else None


def _std(values: Sequence[float]) -> float | None:
    """Return the population standard deviation of what is known, or None."""
    known = _known(values)
    return float(known.std()) if known.size else None


def _by_leg(feet: Sequence[Footfalls], name: str) -> dict[str, float | None]:
    """Return the mean over episodes of a number that each leg has."""
    return {leg: _mean([getattr(f, name)[leg] for f in feet]) for leg in getattr(feet[0], name)}


def _phases(feet: Sequence[Footfalls]) -> dict[str, float | None]:
    """Return each leg's circular mean phase over episodes, each weighted by its concentration."""
    phases: dict[str, float | None] = {}
    for leg in feet[0].phase:
        vectors = [f.concentration[leg] * np.exp(2j * np.pi * f.phase[leg]) for f in feet]
        known = [v for v in vectors if np.isfinite(v)]
        mean = float(np.angle(np.sum(known)) / (2 * np.pi)) % 1.0
        phases[leg] = (0.0 if mean > 1.0 - 1e-9 else mean) if known else None
    return phases


def _common(traces: Sequence[EpisodeTrace], name: str) -> str:
    """Return what all traces say about themselves, so that two worlds are never averaged by accident."""
    said = sorted({str(trace.meta[name]) for trace in traces})
    if len(said) > 1:
        raise SurefootError(f"summary: the traces come from more than one {name}: {choices(said)}")
    return said[0]
