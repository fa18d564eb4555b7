"""When a motor began to move, and how fast it got there: a step response with a delay, fitted to readings."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

WINDOW = 0.15
"""Time after a step [s] whose readings are kept."""
EARLY = 0.5
"""Share of the step up to which readings are fitted: later on the leg's other motor gives way, and its loop bends the
response in a way that no two poles follow; fits of all readings were up to 6 ms off, these 1."""
_DELAYS = np.arange(0.0, 0.1, 0.001)
_FREQUENCIES = np.geomspace(15.0, 400.0, 28)
_DAMPINGS = np.array([0.3, 0.45, 0.6, 0.8, 1.05, 1.3, 1.8, 2.6, 4.0])


@dataclass(frozen=True)
class Response:
    """A step response of second order with a delay."""

    delay: float
    """From the command's arrival at the robot to the first motion in the readings, at the time they are sent [s]."""
    rise: float
    """From the first motion to 63 % of the way [s]."""
    error: float
    """Root mean square of what the fit leaves, for a step of 1."""


def fit_response(age: Array, moved: Array) -> Response:
    """Fit readings of a motor after a step of its target.

        y(t) = gain (1 + (p2 exp(p1 t) - p1 exp(p2 t)) / (p1 - p2)),  t = max(age - delay, 0)

    with the poles p = w (-z +- sqrt(z^2 - 1)): the servo's proportional and derivative gain on the inertia of a leg.

    Args:
        age: of each reading: time from the command's arrival until it was sent, on the robot's clock (n,) [s].
        moved: how far it had moved by then, in shares of the step (n,).
    """
    order = np.argsort(age, kind="stable")
    whole_age, whole_moved = age[order], moved[order]
    begun = np.flatnonzero(whole_moved > EARLY)
    kept = whole_age <= (whole_age[begun[0]] if len(begun) else WINDOW)
    age, moved = whole_age[kept], whole_moved[kept]
    found, frequency, damping = _search(age, moved, _DELAYS, _FREQUENCIES, _DAMPINGS)
    for delay, spread in ((2e-3, 1.3), (5e-4, 1.1)):
        delays = found.delay + np.linspace(-delay, delay, 21)
        around = np.geomspace(1 / spread, spread, 9)
        found, frequency, damping = _search(age, moved, delays[delays >= 0], frequency * around, damping * around)
    return replace(found, rise=_crossing(whole_age, whole_moved, 1 - np.exp(-1)) - found.delay)


def _search(
    age: Array, moved: Array, delays: Array, frequencies: Array, dampings: Array
) -> tuple[Response, float, float]:
    """The best of a grid, with its frequency [rad/s] and damping ratio."""
    damping, frequency = (axis.ravel() for axis in np.meshgrid(dampings, frequencies))
    # Both poles being one is no case of its own, but a division by 0.
    root = np.sqrt((damping + 1e-6 * (damping == 1)).astype(complex) ** 2 - 1)
    one, other = frequency * (root - damping), frequency * (-root - damping)
    best, found, at = np.inf, Response(0.0, WINDOW, np.inf), 0
    for delay in delays:
        unit = _step(one, other, np.maximum(age - delay, 0.0))
        gain = (unit @ moved) / np.maximum((unit * unit).sum(axis=1), 1e-12)
        error = ((gain[:, None] * unit - moved) ** 2).sum(axis=1)
        index = int(np.argmin(error))
        if error[index] < best:
            best, at = float(error[index]), index
            found = Response(float(delay), WINDOW, float(np.sqrt(best / max(len(age), 1))))
    return found, float(frequency[at]), float(damping[at])


def _step(one: NDArray[np.complex128], other: NDArray[np.complex128], time: Array) -> Array:
    """Unit step responses (K, n) of K pairs of poles."""
    p, q = one[:, None], other[:, None]
    response: Array = np.real(1 + (q * np.exp(p * time) - p * np.exp(q * time)) / (p - q))
    return response


def _crossing(age: Array, moved: Array, share: float) -> float:
    """When readings first pass a share of the step [s], on a straight line between two; `WINDOW`, if never."""
    above = np.flatnonzero(moved >= share)
    if not len(above) or above[0] == 0:
        return WINDOW
    after = int(above[0])
    part = (share - moved[after - 1]) / (moved[after] - moved[after - 1])
    return float(age[after - 1] + part * (age[after] - age[after - 1]))
