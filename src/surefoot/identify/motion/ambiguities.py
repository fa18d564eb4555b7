"""Sentences on what logs do not determine: parameters that can't be separated, or that keep their prior values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.identify.fitting import Fit
from surefoot.identify.motion.priors import CLOCK, COMMAND_SHIFT
from surefoot.identify.motion.robot_estimates import MODEL_ACCURACY, parameter_slopes
from surefoot.identify.result import NORMAL_95
from surefoot.robot import PhysicalParams

MIN_CORRELATION = 0.7
"""Correlation of the errors of two parameters above which they count as not separable."""
MIN_CORRELATION_WITH_HELD = 0.3
"""`MIN_CORRELATION` if one of the parameters is held at its prior value."""


@dataclass(frozen=True)
class _Ambiguity:
    """Pair of parameters of which logs determine only a combination."""

    names: tuple[str, str]
    powers: tuple[int, int] | None
    """Exponents of the product that is determined; None: the sum is determined."""
    combination: str
    """Name of the combination that is determined; empty if none is reported."""
    unit: str
    advice: str
    min_correlation: float = MIN_CORRELATION
    """Correlation above which they count as not separable."""


AMBIGUITIES = (
    _Ambiguity(
        ("servo_kd", "motor_viscous_friction"),
        None,
        "their sum",
        "N m s/rad",
        "a log with another kd separates them, or state the gain: --set servo_kd=VALUE",
        0.0,  # both brake in proportion to the speed, whatever the correlation
    ),
    _Ambiguity(
        ("servo_kp", "leg_mass_ratio"),
        (1, -1),
        "servo_kp for the leg mass of the data sheet",
        "N m/rad",
        "state the gain, --set servo_kp=VALUE, or weigh a leg",
    ),
    _Ambiguity(("servo_kd", "control_latency"), None, "", "", "a faster motion separates them"),
    _Ambiguity(("motor_viscous_friction", "control_latency"), None, "", "", "a faster motion separates them"),
    _Ambiguity(("rotor_inertia", "control_latency"), None, "", "", "a faster motion separates them"),
    _Ambiguity(("motor_friction", "motor_viscous_friction"), None, "", "", "motions of several speeds separate them"),
    _Ambiguity(("motor_friction", "load_friction"), None, "", "", "a log with a load separates them"),
)


def describe_ambiguities(fit: Fit, prior: PhysicalParams, params: PhysicalParams) -> tuple[str, ...]:
    """Return sentences on what the fitted logs do not determine.

    Args:
        fit: result of `fitting.hold_unidentifiable`.
        prior: parameters before the fit, one row.
        params: parameters after the fit, one row.
    """
    sentences = [text for pair in AMBIGUITIES if (text := _describe_ambiguity(pair, fit, prior, params))]
    if held := _held_labels(fit):
        sentences.append(f"these logs do not determine {', '.join(held)}: prior values are kept and not written")
    if any(unknown.name == CLOCK for unknown in fit.unknowns):
        sentences.append(
            "the times look computed, not measured: a clock error of 2 % changes kd, viscous friction and latency by "
            "2 %, and inertias by 4 %; the intervals include this"
        )
    if shifts := [unknown.prior for unknown in fit.unknowns if unknown.name == COMMAND_SHIFT]:
        sentences.append(
            f"commands repeat for some rows: the time of sending is known only to {1e3 * (shifts[0] or 0):.0f} ms, "
            "which can't be distinguished from control_latency; the intervals include this"
        )
    return tuple(sentences)


def _describe_ambiguity(pair: _Ambiguity, fit: Fit, prior: PhysicalParams, params: PhysicalParams) -> str:
    """Return a sentence on a pair of parameters that can't be separated; empty if it can be, or was not fitted."""
    free = [
        any(u.name == name and fitted for u, fitted in zip(fit.unknowns, fit.free, strict=True)) for name in pair.names
    ]
    if not any(free) or not set(pair.names) <= {unknown.name for unknown in fit.unknowns}:
        return ""
    slopes = [parameter_slopes(prior, fit, name).mean(axis=1) for name in pair.names]
    one, two = (float(np.mean(getattr(params, name)[0])) for name in pair.names)
    (a, shared), (_, b) = ([float(first @ fit.covariance @ second) for second in slopes] for first in slopes)
    correlation = shared / np.sqrt(max(a * b, 1e-300))
    min_correlation = pair.min_correlation if all(free) else min(pair.min_correlation, MIN_CORRELATION_WITH_HELD)
    if abs(correlation) < min_correlation:
        return ""
    subject = f"{pair.names[0]} and {pair.names[1]}"
    if not pair.combination:
        return f"{subject} are hardly distinguishable from these logs (correlation {correlation:+.2f}): {pair.advice}"
    if pair.powers is None:
        value, slope = one + two, slopes[0] + slopes[1]
    else:
        value = one ** pair.powers[0] * two ** pair.powers[1]
        slope = value * (pair.powers[0] * slopes[0] / one + pair.powers[1] * slopes[1] / two)
    floor = MODEL_ACCURACY[pair.names[0]] * value if fit.considered else 0.0
    half_width = NORMAL_95 * float(np.sqrt(slope @ fit.covariance @ slope + floor**2))
    return (
        f"these logs do not separate {subject}: {pair.combination} is {value:.3g} ({value - half_width:.3g} to "
        f"{value + half_width:.3g}) {pair.unit}; {pair.advice}"
    )


def _held_labels(fit: Fit) -> list[str]:
    """Return the labels of held unknowns; a name that is held for several motors appears once, with their number."""
    by_name: dict[str, list[str]] = {}
    for unknown, free in zip(fit.candidates, fit.free.tolist()[: len(fit.candidates)], strict=True):
        if not free:
            by_name.setdefault(unknown.name, []).append(unknown.label)
    return [labels[0] if len(labels) == 1 else f"{name} (of {len(labels)})" for name, labels in by_name.items()]
