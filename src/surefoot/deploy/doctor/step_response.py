"""Step response of a motor behind its servo: delay, rise time, and how well two poles describe it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array

WINDOW = 0.15
"""Time after a step [s] whose readings are kept."""
_FITTED_FRACTION = 0.5
"""Share of the step up to which readings are fitted: later on the leg's other motor gives way, and its loop bends the
response in a way that no two poles follow; fits of all readings were up to 6 ms off, these 1."""
_DELAYS = np.arange(0.0, 0.1, 0.001)
_FREQUENCIES = np.geomspace(15.0, 400.0, 28)
_DAMPINGS = np.array([0.3, 0.45, 0.6, 0.8, 1.05, 1.3, 1.8, 2.6, 4.0])


@dataclass(frozen=True)
class StepResponse:
    """A step response of second order with a delay."""

    delay: float
    """From the command's arrival at the robot to the first motion in the readings, when they are sent [s]."""
    rise: float
    """From the first motion to 63 % of the step [s]."""
    error: float
    """Root mean square of the residuals, for a step of 1."""


def fit_response(age: Array, share: Array) -> StepResponse:
    """Fit readings of a motor after a step of its target.

        y(t) = gain (1 + (p2 exp(p1 t) - p1 exp(p2 t)) / (p1 - p2)),  t = max(age - delay, 0)

    with the poles p = w (-z +- sqrt(z^2 - 1)): the servo's proportional and derivative gain on the inertia of a leg.

    Args:
        age: of each reading: time from the command's arrival until it was sent, on the robot's clock (n,) [s].
        share: share of the step that the motor had moved by then (n,).
    """
    order = np.argsort(age, kind="stable")
    age, share = age[order], share[order]
    early = np.flatnonzero(share > _FITTED_FRACTION)
    fitted = age <= (age[early[0]] if len(early) else WINDOW)
    points = age[fitted], share[fitted]
    best, frequency, damping = _search_grid(*points, _DELAYS, _FREQUENCIES, _DAMPINGS)
    for width, spread in ((2e-3, 1.3), (5e-4, 1.1)):
        delays = best.delay + np.linspace(-width, width, 21)
        factors = np.geomspace(1 / spread, spread, 9)
        best, frequency, damping = _search_grid(*points, delays[delays >= 0], frequency * factors, damping * factors)
    return replace(best, rise=_crossing_time(age, share, 1 - np.exp(-1)) - best.delay)


def _search_grid(
    age: Array, share: Array, delays: Array, frequencies: Array, dampings: Array
) -> tuple[StepResponse, float, float]:
    """Return the best response of a grid, with its frequency [rad/s] and damping ratio."""
    damping, frequency = (axis.ravel() for axis in np.meshgrid(dampings, frequencies))
    # At a damping ratio of 1 both poles are the same, and the response would divide by 0.
    root = np.sqrt((damping + 1e-6 * (damping == 1)).astype(complex) ** 2 - 1)
    poles = frequency * (root - damping), frequency * (-root - damping)
    least, best, index = np.inf, StepResponse(0.0, WINDOW, np.inf), 0
    for delay in delays:
        unit = _unit_responses(*poles, np.maximum(age - delay, 0.0))
        gain = (unit @ share) / np.maximum((unit * unit).sum(axis=1), 1e-12)
        error = ((gain[:, None] * unit - share) ** 2).sum(axis=1)
        if error.min() < least:
            index, least = int(np.argmin(error)), float(error.min())
            best = StepResponse(float(delay), WINDOW, float(np.sqrt(least / max(len(age), 1))))
    return best, float(frequency[index]), float(damping[index])


def _unit_responses(one: NDArray[np.complex128], other: NDArray[np.complex128], time: Array) -> Array:
    """Return the unit step responses (K, n) of K pairs of poles."""
    p, q = one[:, None], other[:, None]
    response: Array = np.real(1 + (q * np.exp(p * time) - p * np.exp(q * time)) / (p - q))
    return response


def _crossing_time(age: Array, share: Array, level: float) -> float:
    """Return when readings first pass a level [s], interpolated linearly; `WINDOW`, if never."""
    above = np.flatnonzero(share >= level)
    if not len(above) or above[0] == 0:
        return WINDOW
    after = int(above[0])
    part = (level - share[after - 1]) / (share[after] - share[after - 1])
    return float(age[after - 1] + part * (age[after] - age[after - 1]))
