"""Which parameters break a gait first, read from its sensitivity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.evaluate.sensitivity import Sensitivity


@dataclass(frozen=True)
class Break:
    """Where a gait stops to hold, going from a row's nominal value to one end of its range.

    A gait breaks in a world in which it falls in half of the episodes or more, or in which its mean return is below
    half of the nominal one (if that is over 0).
    """

    row: str
    """Row of the table."""
    value: float
    """Value nearest to the nominal one in whose world the gait breaks."""
    above: bool
    """Whether the value is over the nominal one."""
    fraction: float
    """How far from the nominal value, over 0, to the end of the range on this side, 1."""
    falls: int
    """Episodes in which the robot falls there."""
    mean_return: float
    """Mean return there [m]."""
    beyond: int
    """Values that were tried beyond."""
    broken_beyond: int
    """At how many of these the gait breaks too."""


def find_breaks(sensitivity: Sensitivity) -> list[Break]:
    """Where the gait breaks, up to two a row (below and above its nominal value), the nearest to nominal first."""
    means, nominal = sensitivity.mean_return, sensitivity.nominal.mean_return
    broken = sensitivity.fell.mean(axis=1) >= 0.5
    if nominal > 0:
        broken |= means < 0.5 * nominal
    found = []
    for row in sensitivity.rows:
        rows = sensitivity.of_row(row)
        values = np.array([sensitivity.worlds[i].value for i in rows])
        centre = sensitivity.nominal.values.get(row, float(values.mean()))
        for above in (True, False):
            distance = values - centre if above else centre - values
            # A value that is the nominal one but for rounding belongs to neither side.
            side = np.flatnonzero(distance > 1e-9 * max(np.ptp(values), abs(centre)))
            side = side[np.argsort(distance[side])]
            bad = broken[rows[side]]
            if not bad.any():
                continue
            first = int(np.argmax(bad))
            world = rows[side[first]]
            found.append(
                Break(
                    row=row,
                    value=float(values[side[first]]),
                    above=above,
                    fraction=float(distance[side[first]] / distance[side[-1]]),
                    falls=int(sensitivity.fell[world].sum()),
                    mean_return=float(means[world]),
                    beyond=len(side) - first - 1,
                    broken_beyond=int(bad[first + 1 :].sum()),
                )
            )
    # Equal fractions differ in their last digits; rounded, they keep the order of the table.
    return sorted(found, key=lambda item: round(item.fraction, 9))
