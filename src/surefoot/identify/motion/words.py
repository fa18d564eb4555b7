"""What logs can't tell, in words: numbers that are exchanged for each other, and those that keep their values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.identify.fitting import Fit
from surefoot.identify.motion.priors import CLOCK, COMMAND_SHIFT
from surefoot.identify.motion.robot_estimates import MODEL_ACCURACY, parameter_slopes
from surefoot.identify.motion.robot_unknowns import CONSIDERED
from surefoot.identify.result import NORMAL_95
from surefoot.robot import PhysicalParams, RobotDescription

EXCHANGED = 0.7
"""Correlation of the errors of two numbers from which they are exchanged for each other."""
EXCHANGED_WITH_HELD = 0.3
"""The same where one of them keeps the value of before."""


@dataclass(frozen=True)
class _Exchange:
    """Two parameters of which logs show a combination."""

    names: tuple[str, str]
    powers: tuple[int, int] | None
    """Exponents of the product that is known; None: their sum is."""
    text: str
    """The combination, with its value and interval in braces."""
    unit: str
    advice: str
    least: float = EXCHANGED
    """Correlation from which they are exchanged."""


EXCHANGES = (
    _Exchange(
        ("servo_kd", "motor_viscous_friction"),
        None,
        "their sum",
        "N m s/rad",
        "a log with another kd separates them, or state the gain: --set servo_kd=VALUE",
        0.0,  # both brake in proportion to the speed, whatever the numbers say
    ),
    _Exchange(
        ("servo_kp", "leg_mass_ratio"),
        (1, -1),
        "servo_kp for legs as heavy as on the sheet",
        "N m/rad",
        "state the gain, --set servo_kp=VALUE, or weigh a leg",
    ),
    _Exchange(("servo_kd", "control_latency"), None, "", "", "a faster motion separates them"),
    _Exchange(("motor_viscous_friction", "control_latency"), None, "", "", "a faster motion separates them"),
    _Exchange(("rotor_inertia", "control_latency"), None, "", "", "a faster motion separates them"),
    _Exchange(("motor_friction", "motor_viscous_friction"), None, "", "", "motions of several speeds separate them"),
    _Exchange(("motor_friction", "load_friction"), None, "", "", "a log with a load separates them"),
)


def describe_ambiguities(robot: RobotDescription, fit: Fit, params: PhysicalParams) -> tuple[str, ...]:
    """Return sentences on what the fitted logs can't tell.

    Args:
        robot: its description.
        fit: result of `fitting.hold_unidentifiable`.
        params: parameters with the fit's values, one row.
    """
    sentences = [text for exchange in EXCHANGES if (text := _describe_exchange(exchange, fit, params))]
    if held := _held_labels(fit):
        sentences.append(f"these logs do not show {', '.join(held)}: the values before are kept and not written")
    if any(unknown.name == CLOCK for unknown in fit.unknowns):
        sentences.append(
            "the times look computed, not measured: with a clock that is 2 % off, kd, viscous friction and latency are "
            "2 % off and inertias 4 %; the intervals include it"
        )
    if shifts := [unknown.prior for unknown in fit.unknowns if unknown.name == COMMAND_SHIFT]:
        sentences.append(
            f"commands repeat for some rows: when they were sent is known to {1e3 * (shifts[0] or 0):.0f} ms, which "
            "control_latency can't be told from; the intervals include it"
        )
    return tuple(sentences)


def _describe_exchange(exchange: _Exchange, fit: Fit, params: PhysicalParams) -> str:
    """Return a sentence on two parameters whose errors are exchanged; nothing, if they are not, or were not fitted."""
    free = [
        any(u.name == name and fitted for u, fitted in zip(fit.unknowns, fit.free, strict=True))
        for name in exchange.names
    ]
    if not any(free) or not set(exchange.names) <= {unknown.name for unknown in fit.unknowns}:
        return ""
    slopes = [_mean_slope(params, fit, name) for name in exchange.names]
    one, two = (float(np.mean(getattr(params, name)[0])) for name in exchange.names)
    (a, shared), (_, b) = ([float(first @ fit.covariance @ second) for second in slopes] for first in slopes)
    correlation = shared / np.sqrt(max(a * b, 1e-300))
    if abs(correlation) < (exchange.least if all(free) else min(exchange.least, EXCHANGED_WITH_HELD)):
        return ""
    who = f"{exchange.names[0]} and {exchange.names[1]}"
    if not exchange.text:
        return f"{who} are hardly told apart by these logs (correlation {correlation:+.2f}): {exchange.advice}"
    if exchange.powers is None:
        value, slope = one + two, slopes[0] + slopes[1]
    else:
        value = one ** exchange.powers[0] * two ** exchange.powers[1]
        slope = value * (exchange.powers[0] * slopes[0] / one + exchange.powers[1] * slopes[1] / two)
    floor = MODEL_ACCURACY[exchange.names[0]] * value if fit.considers else 0.0
    reach = NORMAL_95 * float(np.sqrt(slope @ fit.covariance @ slope + floor**2))
    return (
        f"{who} are one number in these logs: {exchange.text} is {value:.3g} ({value - reach:.3g} to "
        f"{value + reach:.3g}) {exchange.unit}; {exchange.advice}"
    )


def _mean_slope(params: PhysicalParams, fit: Fit, name: str) -> Array:
    return np.asarray(parameter_slopes(params, fit, name).mean(axis=1))


def _held_labels(fit: Fit) -> list[str]:
    """Return the labels of held unknowns; a name with many of its motors once, with their number."""
    by_name: dict[str, list[str]] = {}
    for unknown, free in zip(fit.unknowns, fit.free.tolist(), strict=True):
        if not free and unknown.name not in (CLOCK, COMMAND_SHIFT, *(CONSIDERED if fit.considers else ())):
            by_name.setdefault(unknown.name, []).append(unknown.label)
    return [labels[0] if len(labels) == 1 else f"{name} (of {len(labels)})" for name, labels in by_name.items()]
