"""From foot contacts to the name of the gait: strides, duty factors, phases.

Terms and definitions follow the study of animal gaits:

* Stance and swing, duty factor (the part of the stride a foot is on the ground), relative phase (the part of
  the stride after the reference foot's touchdown at which another foot touches down): Alexander 1984, "The
  gaits of bipedal and quadrupedal animals", Int. J. Robotics Research 3(2).
* Symmetrical gaits, the two feet of a pair half a stride apart, named by diagonality, the part of the stride
  by which a fore footfall follows the hind footfall of its side: 0 pace, 1/4 lateral sequence, 1/2 trot, 3/4
  diagonal sequence; walking when the duty factor is above 1/2: Hildebrand 1965, "Symmetrical gaits of
  horses", Science 150.
* Asymmetrical gaits: bound (both fore together, both hind together), half-bound (hind together, fore apart),
  gallop (both pairs a little apart; transverse when fore and hind lead with the same side, rotary when not),
  pronk (all four together): Hildebrand 1977, "Analysis of asymmetrical gaits", J. Mammalogy 58(2).

Animals are sorted with limits of about 1/16 stride around each name; learned gaits scatter more, so the bins
here are the four diagonalities with +-1/8 each, which leaves no gap between them.
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

PHASE_TOLERANCE = 1 / 8  # half the width of a bin of phase
MAX_TOGETHER_LAG = 1 / 16  # two feet of a pair closer than this strike as one
MAX_GALLOP_DUTY = 0.6  # a gallop has duty factors below about a half; some room for compliant feet
MIN_CONCENTRATION = 0.75  # circular scatter of about .12 stride
MIN_STRIDES = 3
TRANSIENT = 1.0  # s at the start that are left out, never more than a third of the episode
DEBOUNCE = 0.015  # s
MIN_STRIDE_PERIOD = 0.08  # s
STANDING_REASON = "no foot leaves the ground"
"""Reason of a gait that is none, since the robot stands."""

Intervals = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Footfalls:
    """Strides and gait of an episode; every dict is by leg name, NaN where a foot makes no steps.

    Attributes:
        gait: trot, pace, bound, gallop, walk, pronk or other.
        pattern: the gait in more words, such as "rotary gallop" or "walking trot".
        reason: why the gait is "other"; empty when it has a name.
        stride_period: s.
        duty_factor: part of the stride in stance, 0 to 1.
        phase: touchdown after front_left's, in strides, [0, 1): circular mean.
        concentration: resultant length of those phases: 1 always the same, 0 no order.
        stance: mean length of a stance, s.
        intervals: (start, end) of each stance, s, transient included.
        window: (start, end) s of what was analyzed.
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
    """Measure strides and name the gait, which needs legs with the names of `FEET`, in any order.

    Chatter is removed in this order: single readings unlike their neighbours, losses of contact shorter than
    `DEBOUNCE`, contacts shorter than that; then losses and contacts shorter than a tenth of the stride period.
    """
    touch, clock, names = trace.foot_contact, trace.time, trace.leg_names
    start = min(TRANSIENT, clock[-1] / 3.0)
    window = (float(start), float(clock[-1]))
    if np.isnan(touch).any():
        nan = dict.fromkeys(names, math.nan)
        reason = "foot contacts were not measured"
        return Footfalls("other", "other", reason, math.nan, nan, nan, nan, nan, dict.fromkeys(names, ()), window)

    step = float(np.median(np.diff(clock))) if len(clock) > 1 else float(clock[0])
    # A running median removes single false readings and keeps edges.
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
    # A stance cut by the window's start or by the episode's end has no known touchdown or length.
    touchdowns = {n: np.array([a for a, _ in s if a > start]) for n, s in intervals.items()}
    whole = {n: [b - a for a, b in s if a > start and b < clock[-1]] for n, s in intervals.items()}

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
        stance={n: float(np.mean(lengths)) if lengths else math.nan for n, lengths in whole.items()},
        intervals=intervals,
        window=window,
    )


def classify(phase: dict[str, float], duty: float) -> tuple[str, str, str]:
    """Return gait, pattern and, when it is "other", the reason, from each foot's phase and the mean duty factor."""
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
    """Name a symmetrical gait (Hildebrand 1965); diagonality in strides."""
    walking = duty > 0.5
    for name, centre in (("trot", 0.5), ("pace", 0.0)):
        if abs(_lag(diagonality, centre)) <= PHASE_TOLERANCE:
            return name, f"{'walking' if walking else 'running'} {name}", ""
    pattern = f"{'lateral' if diagonality < 0.5 else 'diagonal'}-sequence {'walk' if walking else 'run'}"
    if pattern == "lateral-sequence walk":
        return "walk", pattern, ""
    return "other", pattern, f"a {pattern} with duty factor {duty:.2f} has none of the names"


def stance_intervals(contact: ArrayLike, time: ArrayLike, debounce: float = 0.0) -> Intervals:
    """Return (start, end) in s of each stance of one foot.

    Args:
        contact: (T,) fraction of each control step in contact; the foot is in stance where it is at least .5.
        time: (T,) s at the END of each control step.
        debounce: s; gaps shorter than this are closed, then stances shorter than this dropped.
    """
    touch, clock = np.asarray(contact, dtype=np.float64), np.asarray(time, dtype=np.float64)
    step = np.diff(clock, prepend=2 * clock[0] - clock[1] if len(clock) > 1 else 0.0)
    edges = np.flatnonzero(np.diff(touch >= 0.5, prepend=False, append=False))
    spans: list[tuple[float, float]] = []
    for a, b in zip(edges[::2], edges[1::2], strict=True):
        # Fractions of contact at both edges place touchdown and lift-off within those steps.
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
    """Return the stride period in s, or NaN: the first high peak of the contacts' autocorrelation.

    Each foot is correlated with itself alone, so two feet half a stride apart do not halve the period.

    Args:
        contact: (T, L) contacts, 0 to 1.
        step: s between samples.
    """
    signal = contact - contact.mean(axis=0)
    count = len(signal)
    spectrum = np.fft.rfft(signal, n=2 * count, axis=0)
    raw = np.fft.irfft(np.abs(spectrum) ** 2, axis=0).sum(axis=1)[:count]
    longest = count // 2  # at least two strides must be seen
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
    """Return the circular mean of touchdown phases in [0, 1) and their resultant length."""
    phases = []
    for begin, end in itertools.pairwise(reference):
        if abs(end - begin - period) < 0.4 * period:  # else the reference foot missed or doubled a step
            inside = touchdowns[(touchdowns >= begin) & (touchdowns < end)]
            phases.extend((inside - begin) / (end - begin))
    if not phases:
        return math.nan, math.nan
    if touchdowns is reference:
        # Against itself a foot is always at 0: its regularity is that of its stride times.
        strides = np.diff(reference) / period
        return 0.0, _circular_mean(strides)[1]
    return _circular_mean(phases)


def _circular_mean(phases: ArrayLike) -> tuple[float, float]:
    """Return mean in [0, 1) and resultant length of phases given in strides."""
    vector = np.exp(2j * np.pi * np.asarray(phases, dtype=np.float64)).mean()
    return circular_phase(vector), float(np.abs(vector))


def circular_phase(vector: complex) -> float:
    """Return the direction of a vector in the complex plane as a phase in [0, 1); what rounds to 1 is 0."""
    phase = float(np.angle(vector) / (2 * np.pi)) % 1.0
    return 0.0 if phase > 1.0 - 1e-9 else phase


def _lag(phase: float, reference: float = 0.0) -> float:
    """Return the lag behind a reference in strides, wrapped to [-1/2, 1/2)."""
    return (phase - reference + 0.5) % 1.0 - 0.5


def _duty(intervals: Intervals, touchdowns: Array, window: tuple[float, float]) -> float:
    """Return the part of whole strides (touchdown to touchdown) in stance; of the window without strides."""
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
    """Return why these footfalls cannot be named, or an empty string."""
    if set(names) != set(FEET):
        return f"gaits are named for the feet {choices(FEET)}"
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
