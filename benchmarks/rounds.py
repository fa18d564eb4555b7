"""What the benchmarks share: layers timed in turn, and ratios of what neighbouring turns gave."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

import numpy as np

Layer = Callable[[], tuple[int, float]]
"""Does one turn and returns how many steps it took, and how long [s]."""


def measure(layers: Mapping[str, Layer], rounds: int) -> dict[str, list[float]]:
    """Steps/s of every layer in each round; layers take turns, so that a slow moment is slow for all.

    The shorter a turn, the less the machine changes between two layers. Each round begins with another layer, so that
    none always follows the same one.
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
    """The median over rounds of one layer's rate to another's."""
    return statistics.median(one / other for one, other in zip(rates[name], rates[base], strict=True))


def ratio_quartiles(rates: Mapping[str, Sequence[float]], name: str, base: str) -> tuple[float, float, float]:
    """Lower quartile, median and upper quartile over rounds of one layer's rate to another's."""
    low, middle, high = np.quantile(np.divide(rates[name], rates[base]), [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)
