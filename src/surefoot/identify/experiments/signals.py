"""Signals that experiments are made of. All take the time since a phase's start [s] and give one value a motor."""

from __future__ import annotations

import math

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import between
from surefoot.identify.plan import Signal

FADE = 0.2
"""Time [s] within which sines grow to their amplitude, and fade at the end."""


def go_to(target: Array, duration: float) -> Signal:
    """Smoothly from wherever the motors were sent to `target` (M,) [rad]."""
    return lambda t, start: between(start, target, t / duration)


def hold(target: Array) -> Signal:
    """Stay at `target`."""
    return lambda t, start: target


def chirps(middle: Array, amplitude: Array, first: float, last: float, duration: float, phase: Array) -> Signal:
    """Sines whose frequency grows exponentially, and that fade in and out.

    Args:
        middle: (M,) [rad].
        amplitude: (M,) [rad].
        first: frequency at the start [Hz].
        last: frequency at the end [Hz].
        duration: [s].
        phase: of each motor's sine (M,) [rad].
    """

    def signal(t: float, start: Array) -> Array:
        turned, faded = sweep(t, first, last, duration)
        value: Array = middle + faded * amplitude * np.sin(turned + phase)
        return value

    return signal


def sweep(t: float, first: float, last: float, duration: float) -> tuple[float, float]:
    """Angle [rad] that a sine of exponentially growing frequency has turned, and its fading in and out from 0 to 1."""
    rate = math.log(last / first) / duration
    turned = 2 * math.pi * first * (math.expm1(rate * t) / rate if rate else t)
    return turned, min(1.0, t / FADE, max(duration - t, 0.0) / FADE)


def steps(values: Array, each: float) -> Signal:
    """One row of `values` (K, M) after the other, for a time [s] each."""
    return lambda t, start: values[min(int(t / each + 1e-9), len(values) - 1)]
