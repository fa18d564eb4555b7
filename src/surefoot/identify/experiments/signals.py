"""Signals that experiments are made of. All take the time since a phase's start [s] and give one value a motor."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.poses import between
from surefoot.identify.plan import Signal

Array = NDArray[np.float64]


def go_to(target: Array, duration: float) -> Signal:
    """Smoothly from wherever the motors were sent to `target` (M,) [rad]."""
    return lambda t, start: between(start, target, t / duration)


def hold(target: Array) -> Signal:
    """Stay at `target`."""
    return lambda t, start: target


def chirps(middle: Array, amplitude: Array, first: float, last: float, duration: float, phase: Array) -> Signal:
    """Sines whose frequency grows exponentially, and that fade in and out within .2 s.

    Args:
        middle: (M,) [rad].
        amplitude: (M,) [rad].
        first: frequency at the start [Hz].
        last: frequency at the end [Hz].
        duration: [s].
        phase: of each motor's sine (M,) [rad].
    """
    rate = np.log(last / first) / duration

    def signal(t: float, start: Array) -> Array:
        turned = 2 * np.pi * first * (np.exp(rate * t) - 1) / rate
        fade = min(1.0, t / 0.2, max(duration - t, 0.0) / 0.2)
        value: Array = middle + fade * amplitude * (np.sin(turned + phase))
        return value

    return signal


def steps(values: Array, each: float) -> Signal:
    """One row of `values` (K, M) after the other, for a time [s] each."""
    return lambda t, start: values[min(int(t / each + 1e-9), len(values) - 1)]
