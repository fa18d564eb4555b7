"""When a motor began to move, and how fast it got there: a step response with a delay, fitted to readings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WINDOW = 0.15
"""Time after a step [s] whose readings are fitted."""
_DELAYS = np.arange(0.0, 0.1, 0.001)
_FREQUENCIES = np.geomspace(15.0, 400.0, 28)
_DAMPINGS = np.array([0.3, 0.45, 0.6, 0.8, 1.001, 1.3, 1.8, 2.6, 4.0])


@dataclass(frozen=True)
class Response:
    """A step response of second order with a delay."""

    delay: float
    """From the command's arrival at the robot to the first motion in the readings, at the time they are sent [s]."""
    rise: float
    """From the first motion to 63 % of the way [s]."""
    gain: float
    """How far it went for a step of 1."""
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
    kept = age <= WINDOW
    age, moved = age[kept], moved[kept]
    coarse = _search(age, moved, _DELAYS)
    fine = coarse.delay + np.arange(-1.5e-3, 1.6e-3, 1e-4)
    return _search(age, moved, fine[fine >= 0])


def _search(age: Array, moved: Array, delays: Array) -> Response:
    root = np.sqrt(_DAMPINGS.astype(complex) ** 2 - 1)
    poles = _FREQUENCIES[:, None, None] * np.array([root - _DAMPINGS, -root - _DAMPINGS]).transpose(1, 0)
    one, other = poles[..., 0].ravel(), poles[..., 1].ravel()
    best, found = np.inf, Response(0.0, 0.0, 0.0, np.inf)
    for delay in delays:
        unit = _step(one, other, np.maximum(age - delay, 0.0))
        power = (unit * unit).sum(axis=1)
        gain = (unit @ moved) / np.maximum(power, 1e-12)
        error = ((gain[:, None] * unit - moved) ** 2).sum(axis=1)
        index = int(np.argmin(error))
        if error[index] < best:
            best = float(error[index])
            rise = _rise(one[index], other[index])
            found = Response(float(delay), rise, float(gain[index]), float(np.sqrt(best / max(len(age), 1))))
    return found


def _step(one: NDArray[np.complex128], other: NDArray[np.complex128], time: Array) -> Array:
    """Unit step responses (K, n) of K pairs of poles."""
    p, q = one[:, None], other[:, None]
    response: Array = np.real(1 + (q * np.exp(p * time) - p * np.exp(q * time)) / (p - q))
    return response


def _rise(one: complex, other: complex) -> float:
    time = np.arange(0.0, 1.0, 1e-4)
    reached = _step(np.array([one]), np.array([other]), time)[0] >= 1 - np.exp(-1)
    return float(time[int(np.argmax(reached))]) if reached.any() else 1.0
