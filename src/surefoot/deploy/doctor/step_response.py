"""Step response of a motor with its servo: delay and rise time, from a fit of a second-order model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

WINDOW = 0.15
"""Time after a step whose readings are used [s]."""
_FITTED_FRACTION = 0.5
"""Fraction of the step up to which readings are fitted. Later, the leg's other motor yields, and the closed loop of the
leg distorts the response beyond a second-order model: fits of all readings had errors up to 6 ms, these 1 ms."""
_DELAYS = np.arange(0.0, 0.1, 0.001)
_FREQUENCIES = np.geomspace(15.0, 400.0, 28)
_DAMPINGS = np.array([0.3, 0.45, 0.6, 0.8, 1.05, 1.3, 1.8, 2.6, 4.0])


@dataclass(frozen=True)
class StepResponse:
    """Second-order step response with a delay."""

    delay: float
    """Time from the command's arrival at the robot to the first motion in the readings, at the time of sending [s]."""
    rise: float
    """Time from the first motion to 63 % of the step [s]."""
    error: float
    """Root mean square of the residuals, for a step of 1."""


def fit_response(age: Array, progress: Array) -> StepResponse:
    """Fit a second-order model to the readings of a motor after a step of its target.

        y(t) = gain (1 + (p2 exp(p1 t) - p1 exp(p2 t)) / (p1 - p2)),  t = max(age - delay, 0)

    with the poles p = w (-z +- sqrt(z^2 - 1)): a PD servo that drives the inertia of a leg.

    Args:
        age: time from the command's arrival to the sending of each reading, on the robot's clock (n,) [s].
        progress: fraction of the step that the motor had moved at each reading (n,).
    """
    order = np.argsort(age, kind="stable")
    age, progress = age[order], progress[order]
    early = np.flatnonzero(progress > _FITTED_FRACTION)
    fitted = age <= (age[early[0]] if len(early) else WINDOW)
    points = age[fitted], progress[fitted]
    best, frequency, damping = _search_grid(*points, _DELAYS, _FREQUENCIES, _DAMPINGS)
    for width, spread in ((2e-3, 1.3), (5e-4, 1.1)):
        delays = best.delay + np.linspace(-width, width, 21)
        factors = np.geomspace(1 / spread, spread, 9)
        best, frequency, damping = _search_grid(*points, delays[delays >= 0], frequency * factors, damping * factors)
    return replace(best, rise=_crossing_time(age, progress, 1 - np.exp(-1)) - best.delay)


def _search_grid(
    age: Array, progress: Array, delays: Array, frequencies: Array, dampings: Array
) -> tuple[StepResponse, float, float]:
    """Return the best response of a grid search, with its frequency [rad/s] and damping ratio."""
    damping, frequency = (axis.ravel() for axis in np.meshgrid(dampings, frequencies))
    # At a damping ratio of 1 both poles are equal, and the response would divide by zero.
    root = np.sqrt((damping + 1e-6 * (damping == 1)).astype(complex) ** 2 - 1)
    poles = frequency * (root - damping), frequency * (-root - damping)
    min_error, best, index = np.inf, StepResponse(0.0, WINDOW, np.inf), 0
    for delay in delays:
        unit = _unit_responses(*poles, np.maximum(age - delay, 0.0))
        gain = (unit @ progress) / np.maximum((unit * unit).sum(axis=1), 1e-12)
        error = ((gain[:, None] * unit - progress) ** 2).sum(axis=1)
        if error.min() < min_error:
            index, min_error = int(np.argmin(error)), float(error.min())
            best = StepResponse(float(delay), WINDOW, float(np.sqrt(min_error / max(len(age), 1))))
    return best, float(frequency[index]), float(damping[index])


def _unit_responses(first: NDArray[np.complex128], second: NDArray[np.complex128], time: Array) -> Array:
    """Return the unit step responses (K, n) of K pairs of poles at times (n,) [s]."""
    p, q = first[:, None], second[:, None]
    response: Array = np.real(1 + (q * np.exp(p * time) - p * np.exp(q * time)) / (p - q))
    return response


def _crossing_time(age: Array, progress: Array, level: float) -> float:
    """Return the time at which readings first reach a level [s], interpolated linearly; `WINDOW` if they never do."""
    above = np.flatnonzero(progress >= level)
    if not len(above) or above[0] == 0:
        return WINDOW
    after = int(above[0])
    fraction = (level - progress[after - 1]) / (progress[after] - progress[after - 1])
    return float(age[after - 1] + fraction * (age[after] - age[after - 1]))
