"""What the benchmarks share: layers timed in turn, round by round, and ratios of what one round gave."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Mapping, Sequence

Layer = Callable[[], tuple[int, float]]
"""Does something and returns how many steps it took, and how long [s]."""


def measure(layers: Mapping[str, Layer], rounds: int) -> dict[str, list[float]]:
    """Steps/s of every layer in each round; layers take turns, so that a slow minute is slow for all."""
    rates: dict[str, list[float]] = {name: [] for name in layers}
    for _ in range(rounds):
        for name, layer in layers.items():
            steps, seconds = layer()
            rates[name].append(steps / seconds)
    return rates


def median_ratio(rates: Mapping[str, Sequence[float]], name: str, base: str) -> float:
    """The median over rounds of one layer's rate to another's."""
    return statistics.median(one / other for one, other in zip(rates[name], rates[base], strict=True))
