"""Gait analysis of foot contacts: strides, duty factors, phases, and the name of the gait.

Terms and definitions follow the study of animal gaits:

* Stance and swing, duty factor (fraction of the stride in which a foot is on the ground), relative phase (fraction
  of the stride between the touchdowns of the reference foot and another foot): Alexander 1984, "The gaits of bipedal
  and quadrupedal animals", Int. J. Robotics Research 3(2).
* Symmetrical gaits, in which the two feet of a pair are half a stride apart. They are named by diagonality, the
  fraction of the stride by which a fore footfall follows the hind footfall on its side: 0 pace, 1/4 lateral sequence,
  1/2 trot, 3/4 diagonal sequence; walking if the duty factor is above 1/2: Hildebrand 1965, "Symmetrical gaits of
  horses", Science 150.
* Asymmetrical gaits: bound (both fore feet together, both hind feet together), half-bound (hind feet together, fore
  feet apart), gallop (both pairs slightly apart; transverse if fore and hind feet lead with the same side, otherwise
  rotary), pronk (all four together): Hildebrand 1977, "Analysis of asymmetrical gaits", J. Mammalogy 58(2).

Animal gaits are classified with tolerances of about 1/16 stride. Learned gaits scatter more, so the tolerance here is
1/8 stride around each of the four diagonalities, which leaves no gap between them.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.errors import choices
from surefoot.task.trace import EpisodeTrace

FEET = ("front_left", "back_left", "front_right", "back_right")

PHASE_TOLERANCE = 1 / 8  # maximum distance from a gait's ideal phase [strides]
MAX_TOGETHER_LAG = 1 / 16  # maximum lag [strides] between two feet of a pair that touch down together
MAX_GALLOP_DUTY = 0.6  # a gallop has duty factors below about a half; the margin is for compliant feet
MIN_CONCENTRATION = 0.75  # corresponds to a circular standard deviation of about 0.12 strides
MIN_STRIDES = 3
TRANSIENT = 1.0  # time [s] left out at the start, at most a third of the episode
DEBOUNCE = 0.015  # s
MIN_STRIDE_PERIOD = 0.08  # s
STANDING_REASON = "no foot leaves the ground"
"""Reason for the gait "other" of a robot that only stands."""

Intervals = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Footfalls:
    """Strides and gait of an episode. Dictionaries are by leg name; NaN for a foot that makes no steps.

    Attributes:
        gait: trot, pace, bound, gallop, walk, pronk or other.
        pattern: more specific name, such as "rotary gallop" or "walking trot".
        reason: why the gait is "other"; otherwise empty.
        stride_period: stride period [s].
        duty_factor: fraction of the stride in stance, 0 to 1.
        phase: circular mean of touchdown phases relative to front_left's touchdown, in strides, [0, 1).
        concentration: mean resultant length of these phases: 1 for constant phases, 0 for uniformly scattered ones.
        stance: mean duration of a stance [s].
        intervals: (start, end) of each stance [s], including the transient.
        window: (start, end) of the analyzed time [s].
    """

    gait: str
    pattern: str
    reason: str
    stride_period: float
    duty_factor: dict[str, float]
    phase: dict[str, float]
    concentration: dict[str, float]
    stance: dict[str, float]
    intervals: dict[str, Intervals]
    window: tuple[float, float]


def analyze_footfalls(trace: EpisodeTrace) -> Footfalls:
    """Measure strides and name the gait; names need the legs of `FEET`, in any order.

    Contact chatter is removed in this order: single readings that differ from their neighbours, losses of contact
    shorter than `DEBOUNCE`, contacts shorter than `DEBOUNCE`; then losses and contacts shorter than a tenth of the
    stride period.
    """
    touch, clock, names = trace.foot_contact, trace.elapsed, trace.leg_names
    start = min(TRANSIENT, clock[-1] / 3.0)
    window = (float(start), float(clock[-1]))
    if np.isnan(touch).any():
        nan = dict.fromkeys(names, math.nan)
        reason = "foot contacts were not measured"
        return Footfalls("other", "other", reason, math.nan, nan, nan, nan, nan, dict.fromkeys(names, ()), window)

    step = float(np.median(np.diff(clock))) if len(clock) > 1 else float(clock[0])
    # A running median removes single false readings and preserves edges.
    half = round(0.5 * DEBOUNCE / step)
    padded = np.pad(touch, ((half, half), (0, 0)), mode="edge")
    touch = np.median(np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1, axis=0), axis=-1)
    middle, square = clock - 0.5 * np.diff(clock, prepend=0.0), np.zeros_like(touch)
    for foot, column in enumerate(touch.T):
        for begin, end in stance_intervals(column, clock, DEBOUNCE):
            square[(middle > begin) & (middle < end), foot] = 1.0
    period = stride_period(square[clock > start], step)
    debounce = max(DEBOUNCE, 0.1 * period) if math.isfinite(period) else DEBOUNCE
    stances = [stance_intervals(c, clock, debounce) for c in touch.T]
    intervals = dict(zip(names, stances, strict=True))
    # A stance that the window's start or the episode's end cuts off has no known touchdown or duration.
    touchdowns = {n: np.array([a for a, _ in s if a > start]) for n, s in intervals.items()}
    complete = {n: [b - a for a, b in s if a > start and b < clock[-1]] for n, s in intervals.items()}

    reference = touchdowns.get("front_left", np.empty(0))
    scores = {n: _phase(touchdowns[n], reference, period) for n in names}
    phase, concentration = ({n: score[i] for n, score in scores.items()} for i in (0, 1))
    duty = {n: _duty(intervals[n], touchdowns[n], window) for n in names}
    gait, pattern, reason = "other", "other", _irregularity(names, touchdowns, intervals, period, window, concentration)
    if not reason:
        gait, pattern, reason = classify(phase, float(np.mean(list(duty.values()))))
    return Footfalls(
        gait=gait,
        pattern=pattern,
        reason=reason,
        stride_period=period,
        duty_factor=duty,
        phase=phase,
        concentration=concentration,
        stance={n: float(np.mean(lengths)) if lengths else math.nan for n, lengths in complete.items()},
        intervals=intervals,
        window=window,
    )


def classify(phase: dict[str, float], duty: float) -> tuple[str, str, str]:
    """Return gait, pattern and, if the gait is "other", the reason, from each foot's phase and the mean duty factor."""
    lag_fore = _lag(phase["front_right"], phase["front_left"])
    lag_hind = _lag(phase["back_right"], phase["back_left"])
    if max(abs(_lag(phase[a], phase[b])) for a in FEET for b in FEET) <= PHASE_TOLERANCE:
        return "pronk", "pronk", ""
    paired = [abs(lag) >= 0.5 - PHASE_TOLERANCE for lag in (lag_fore, lag_hind)]
    if all(paired):
        sides = [phase["front_left"] - phase["back_left"], phase["front_right"] - phase["back_right"]]
        return _symmetrical(_circular_mean(sides)[0], duty)
    if any(paired):
        alternate, others = ("fore", "hind") if paired[0] else ("hind", "fore")
        return "other", "other", f"the {alternate} feet alternate and the {others} feet do not"

    fore = _circular_mean([phase["front_left"], phase["front_right"]])[0]
    hind = _circular_mean([phase["back_left"], phase["back_right"]])[0]
    if abs(_lag(hind, fore)) <= PHASE_TOLERANCE:
        return "other", "other", "fore and hind feet strike together, left and right feet do not"
    fore_as_one, hind_as_one = abs(lag_fore) <= MAX_TOGETHER_LAG, abs(lag_hind) <= MAX_TOGETHER_LAG
    if fore_as_one and hind_as_one:
        return "bound", "bound", ""
    if duty > MAX_GALLOP_DUTY:
        return "other", "other", f"asymmetrical, but duty factor {duty:.2f} is too long for a gallop"
    if hind_as_one:
        return "gallop", "half-bound", ""
    if fore_as_one:
        return "gallop", "half-bound, fore feet together", ""
    return "gallop", "transverse gallop" if lag_fore * lag_hind > 0 else "rotary gallop", ""


def _symmetrical(diagonality: float, duty: float) -> tuple[str, str, str]:
    """Name a symmetrical gait by its diagonality in strides (Hildebrand 1965); return as `classify`."""
    walking = duty > 0.5
    for name, centre in (("trot", 0.5), ("pace", 0.0)):
        if abs(_lag(diagonality, centre)) <= PHASE_TOLERANCE:
            return name, f"{'walking' if walking else 'running'} {name}", ""
    pattern = f"{'lateral' if diagonality < 0.5 else 'diagonal'}-sequence {'walk' if walking else 'run'}"
    if pattern == "lateral-sequence walk":
        return "walk", pattern, ""
    return "other", pattern, f"a {pattern} with duty factor {duty:.2f} has none of the names"


def stance_intervals(contact: ArrayLike, time: ArrayLike, debounce: float = 0.0) -> Intervals:
    """Return (start, end) of each stance of one foot [s].

    Args:
        contact: fraction of each control step in contact (T,); the foot is in stance from 0.5 on.
        time: time at the END of each control step (T,) [s].
        debounce: gaps shorter than this [s] are closed, then stances shorter than this are dropped.
    """
    touch, clock = np.asarray(contact, dtype=np.float64), np.asarray(time, dtype=np.float64)
    step = np.diff(clock, prepend=2 * clock[0] - clock[1] if len(clock) > 1 else 0.0)
    edges = np.flatnonzero(np.diff(touch >= 0.5, prepend=False, append=False))
    spans: list[tuple[float, float]] = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        # The contact fractions of the steps at both edges give touchdown and lift-off within these steps.
        lead = touch[a - 1] * step[a - 1] if a > 0 else 0.0
        trail = touch[b] * step[b] if b < len(clock) else 0.0
        begin = clock[a] - touch[a] * step[a] - lead
        end = clock[b - 1] - (1.0 - touch[b - 1]) * step[b - 1] * (b - 1 > a) + trail
        if spans and begin - spans[-1][1] < debounce:
            spans[-1] = (spans[-1][0], float(end))
        else:
            spans.append((float(begin), float(end)))
    first, last = clock[0] - step[0], clock[-1]
    return tuple(s for s in spans if s[1] - s[0] >= debounce or s[0] <= first or s[1] >= last)


def stride_period(contact: Array, step: float) -> float:
    """Return the stride period [s], the first high peak of the contacts' autocorrelation; NaN without a peak.

    Each foot is correlated only with itself, so two feet half a stride apart do not halve the period.

    Args:
        contact: contacts (T, L), 0 to 1.
        step: time between samples [s].
    """
    signal = contact - contact.mean(axis=0)
    count = len(signal)
    spectrum = np.fft.rfft(signal, n=2 * count, axis=0)
    raw = np.fft.irfft(np.abs(spectrum) ** 2, axis=0).sum(axis=1)[:count]
    longest = count // 2  # the signal must contain at least two strides
    if raw[0] < 1e-9 or longest < 4:
        return math.nan
    correlation = raw[:longest] / (count - np.arange(longest)) * (count / raw[0])
    inner = correlation[1:-1]
    peaks = np.flatnonzero((inner >= correlation[:-2]) & (inner > correlation[2:])) + 1
    peaks = peaks[(peaks * step >= MIN_STRIDE_PERIOD) & (correlation[peaks] > 0.2)]
    if not peaks.size:
        return math.nan
    best = peaks[correlation[peaks] >= 0.7 * correlation[peaks].max()][0]
    below, at, above = correlation[best - 1 : best + 2]
    return float((best + 0.5 * (below - above) / (below - 2 * at + above)) * step)


def _phase(touchdowns: Array, reference: Array, period: float) -> tuple[float, float]:
    """Return circular mean, in [0, 1), and mean resultant length of a foot's touchdown phases."""
    phases = []
    for begin, end in itertools.pairwise(reference):
        if abs(end - begin - period) < 0.4 * period:  # else the reference foot missed or doubled a step
            inside = touchdowns[(touchdowns >= begin) & (touchdowns < end)]
            phases.extend((inside - begin) / (end - begin))
    if not phases:
        return math.nan, math.nan
    if touchdowns is reference:
        # The reference foot's own phase is always 0: the regularity of its stride times counts instead.
        strides = np.diff(reference) / period
        return 0.0, _circular_mean(strides)[1]
    return _circular_mean(phases)


def _circular_mean(phases: ArrayLike) -> tuple[float, float]:
    """Return circular mean, in [0, 1), and mean resultant length of phases in strides."""
    vector = np.exp(2j * np.pi * np.asarray(phases, dtype=np.float64)).mean()
    return circular_phase(vector), float(np.abs(vector))


def circular_phase(vector: complex) -> float:
    """Return the argument of a complex number as a phase in [0, 1); phases that round to 1 become 0."""
    phase = float(np.angle(vector) / (2 * np.pi)) % 1.0
    return 0.0 if phase > 1.0 - 1e-9 else phase


def _lag(phase: float, reference: float = 0.0) -> float:
    """Return the lag behind a reference in strides, wrapped to [-1/2, 1/2)."""
    return (phase - reference + 0.5) % 1.0 - 0.5


def _duty(intervals: Intervals, touchdowns: Array, window: tuple[float, float]) -> float:
    """Return the fraction of complete strides (touchdown to touchdown) in stance; of the window without strides."""
    begin, end = (touchdowns[0], touchdowns[-1]) if len(touchdowns) > 1 else window
    stance = sum(max(0.0, min(b, end) - max(a, begin)) for a, b in intervals)
    return float(stance / (end - begin))


def _irregularity(
    names: tuple[str, ...],
    touchdowns: dict[str, Array],
    intervals: dict[str, Intervals],
    period: float,
    window: tuple[float, float],
    concentration: dict[str, float],
) -> str:
    """Return the reason that footfalls have no name, or an empty string."""
    if set(names) != set(FEET):
        return f"gaits have names only for robots with the feet {choices(FEET)}"
    idle = [name for name in names if not len(touchdowns[name])]
    down = [name for name in idle if any(a <= window[0] and b >= window[1] for a, b in intervals[name])]
    if len(down) == len(names):
        return STANDING_REASON
    parts = (
        f"{' and '.join(feet)} never {verb if len(feet) > 1 else one}"
        for feet, verb, one in (
            (down, "leave the ground", "leaves the ground"),
            ([name for name in idle if name not in down], "touch down", "touches down"),
        )
        if feet
    )
    if idle:
        return "; ".join(parts)
    if not math.isfinite(period):
        return "no stride repeats"
    strides = (window[1] - window[0]) / period
    if strides < MIN_STRIDES:
        return f"only {strides:.1f} strides after the transient"
    for name in names:
        if not 0.7 * strides - 1 <= len(touchdowns[name]) <= 1.3 * strides + 1:
            return f"{name} touches down {len(touchdowns[name]) / strides:.2g} times a stride"
        if not concentration[name] >= MIN_CONCENTRATION:
            return f"{name} has no steady phase (concentration {concentration[name]:.2f})"
    return ""
