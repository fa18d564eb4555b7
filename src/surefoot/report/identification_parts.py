"""How reports of an identification call and write its numbers."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from surefoot.identify.result import Estimate
from surefoot.robot import PhysicalParams, RobotDescription

_DIGITS = 6
"""Most digits behind the point; numbers that need more are written with powers of ten."""


def index_names(name: str, robot: RobotDescription) -> tuple[str, ...]:
    """What the indices of a number stand for: motors, or axes; empty where that is not known."""
    motors = tuple(motor.removesuffix("_motor") for motor in robot.motor_names)
    item: Any = PhysicalParams.__dataclass_fields__.get(name)
    if item is None:
        return motors if name.startswith(("motor", "torque")) else ("x", "y", "z")
    width = str(item.metadata["width"])
    return {"one": (), "motors": motors}.get(width, tuple(width.split(", ")))


def full_name(label: str, robot: RobotDescription) -> str:
    """A number's label with the motor's or axis' name in place of its index."""
    name, _, rest = label.partition("[")
    names = index_names(name, robot)
    index = int(rest.rstrip("]")) if rest.rstrip("]").isdigit() else -1
    return f"{name} {names[index]}" if 0 <= index < len(names) else label


def known_before(item: Estimate, known: PhysicalParams) -> float | None:
    """What a physical parameter was before; None for other numbers."""
    if item.name not in PhysicalParams.names():
        return None
    values = getattr(known, item.name)[0]
    return float(np.mean(values) if item.index is None else np.atleast_1d(values)[item.index])


def cells(item: Estimate, known: PhysicalParams) -> tuple[str, str, str]:
    """What was known of a number, what was found and its interval, as texts; empty where there is none."""
    before, (low, high) = known_before(item, known), item.interval
    width = high - low if item.told else math.nan
    was = "" if before is None else number(before, width)
    if not item.told:
        return was, "not told", ""
    return was, number(item.value, width), f"{number(low, width)} to {number(high, width)}"


def number(value: float, width: float) -> str:
    """A number with as many digits as its interval is worth: two of half the interval's width.

    Args:
        value: the number.
        width: of its interval; NaN, if there is none.
    """
    if not (math.isfinite(width) and width > 0 and math.isfinite(value)):
        return f"{value:.4g}"
    digits = 1 - math.floor(math.log10(width / 2))
    return f"{value:.{max(digits, 0)}f}" if digits <= _DIGITS else f"{value:.3g}"
