"""Shared by benchmarks: layers that are timed in turn, and ratios between neighbouring turns."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

import numpy as np

Layer = Callable[[], tuple[int, float]]
"""Runs one turn and returns its number of steps and its duration [s]."""


def measure(layers: Mapping[str, Layer], rounds: int) -> dict[str, list[float]]:
    """Return the steps/s of every layer in each round; layers take turns, so that load changes affect all equally.

    Shorter turns reduce changes of the machine's load between two layers. Each round begins with a different layer, so
    that none always follows the same one.
    """
    rates: dict[str, list[float]] = {name: [] for name in layers}
    names = list(layers)
    for turn in range(rounds):
        first = turn % len(names)
        for name in names[first:] + names[:first]:
            steps, seconds = layers[name]()
            rates[name].append(steps / seconds)
    return rates


def median_ratio(rates: Mapping[str, Sequence[float]], name: str, base: str) -> float:
    """Return the median over rounds of the ratio of one layer's rate to another's."""
    return statistics.median(one / other for one, other in zip(rates[name], rates[base], strict=True))


def ratio_quartiles(rates: Mapping[str, Sequence[float]], name: str, base: str) -> tuple[float, float, float]:
    """Return lower quartile, median and upper quartile over rounds of the ratio of one layer's rate to another's."""
    low, middle, high = np.quantile(np.divide(rates[name], rates[base]), [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)
