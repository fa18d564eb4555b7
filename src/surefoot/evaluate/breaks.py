"""Which parameters break a gait first, read from its sensitivity and told in plain words."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.evaluate.sensitivity import Sensitivity, row_unit


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


def plain_words(sensitivity: Sensitivity) -> str:
    """One line on which parameters break the gait, the nearest to its nominal value first (see `Break`)."""
    name, nominal = sensitivity.policy or "policy", sensitivity.nominal
    if nominal.fell.size and nominal.fell.mean() >= 0.5:
        standing = int((sensitivity.fell.mean(axis=1) < 0.5).sum())
        return (
            f"{name}: falls in the nominal world already ({nominal.fell.sum()} of {nominal.fell.size} fall); "
            f"stays up in {standing} of {len(sensitivity.worlds)} test worlds"
        )
    parts = []
    if nominal.mean_return <= 0:
        parts.append(
            f"goes nowhere in the nominal world (return {nominal.mean_return:.2f} m), so that only falls count"
        )
    breaks = find_breaks(sensitivity)
    if breaks:
        told = list(dict.fromkeys(_break_words(item, breaks, sensitivity) for item in breaks))
        parts.append("breaks first at " + ", then ".join([told[0], ", ".join(told[1:])] if told[1:] else told))
    names = {item.row for item in breaks}
    holding = [row for row in sensitivity.rows if row not in names]
    if holding:
        whole = "" if breaks else "every row: "
        parts.append(f"holds over the whole range of {whole}{', '.join(holding)}")
    return f"{name}: {'; '.join(parts)}"


def _break_words(item: Break, breaks: Sequence[Break], sensitivity: Sensitivity) -> str:
    """Tell of a break, such as `latency 0.0356 s and above (5 of 8 fall)`; of both of a row that holds nowhere."""
    unit, episodes = row_unit(item.row), sensitivity.episodes
    nominal = sensitivity.nominal.values.get(item.row, math.nan)
    same = [other for other in breaks if other.row == item.row]
    others = [i for i in sensitivity.of_row(item.row) if not math.isclose(sensitivity.worlds[i].value, nominal)]
    if len(same) == 2 and sum(1 + other.broken_beyond for other in same) == len(others):
        falls = int(sensitivity.fell[others].sum())
        what = f"{item.row} other than {nominal:.3g} {unit}".rstrip()
        return f"{what} ({falls} of {len(others) * episodes} fall)"
    what = f"{item.row} {item.value:.3g} {unit}".rstrip()
    direction = "above" if item.above else "below"
    if item.beyond and item.broken_beyond == item.beyond:
        what += f" and {direction}"
    elif item.broken_beyond:
        what += f" and {item.broken_beyond} of {item.beyond} values {direction}"
    elif item.beyond:
        what += f" but not {direction}"
    why = [f"{item.falls} of {episodes} fall"] if item.falls else []
    if 2 * item.falls < episodes:
        why.append(f"return {item.mean_return:.2f} m instead of {sensitivity.nominal.mean_return:.2f} m")
    return f"{what} ({', '.join(why)})"
