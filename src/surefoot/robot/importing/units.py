"""Detection of wrong units in robot files: degrees, revolutions per minute, millimetres and grams."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree

import numpy as np

from surefoot.arrays import Array

MIN_PLACEHOLDER_SPEED = 100.0
"""Speed limit [rad/s] from which it counts as a placeholder."""
_REAL_SPEEDS = (3.0, 80.0)
"""Range of realistic speed limits of leg actuators [rad/s]."""
_SPEED_UNITS = {"rpm": math.tau / 60, "degrees per second": math.pi / 180}
"""Wrong units in which files state speed limits, in rad/s."""
_MAX_RADIANS = 4 * math.pi
"""Maximum angle limit that is interpreted as radians."""
_MAX_DEGREES = 360.0
"""Maximum angle limit that is interpreted as degrees; larger ones are placeholders."""
_DENSITIES = (10.0, 5000.0)
"""Plausible range of mass divided by the cube of the leg length [kg/m3]; 60 to 400 for known robots."""
_LENGTHS = {"mm": 1e-3}
_MASSES = {"g": 1e-3}
_MAX_SIZE_RATIO = 25.0
"""Maximum plausible size of shapes relative to the upper links' length."""
_MIN_RANGE = 0.15
"""Minimum range [rad] of the widest leg joint for a leg that can step."""
_PLACEHOLDER_SPEEDS = (100.0, 200.0, 500.0, 1000.0, 10000.0, 100000.0)
"""Typical placeholder speeds, which are in no unit."""


def explain_speeds(speeds: Array) -> str:
    """Return an explanation of a file's unrealistic speed limits (n,) [rad/s]."""
    stated = speeds[np.isfinite(speeds) & (speeds > 0)]
    if not stated.size:
        return "the file has no real limit"
    low, high = float(stated.min()), float(stated.max())
    text = f"the file has {_span(low, high)} rad/s, which no joint reaches"
    units = [
        f"if these are {unit}, it is {_span(low * size, high * size)} rad/s"
        for unit, size in _SPEED_UNITS.items()
        if _REAL_SPEEDS[0] <= low * size and high * size <= _REAL_SPEEDS[1] and low not in _PLACEHOLDER_SPEEDS
    ]
    return "; ".join([text, *units])


def _span(low: float, high: float) -> str:
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=5e-3) else f"{low:.3g} to {high:.3g}"


def convert_degrees(root: ElementTree.Element, notes: list[str]) -> None:
    """Convert a URDF's angle limits to radians in place, if they can only be degrees."""
    limits = []
    for joint in root.findall("joint"):
        limit = joint.find("limit")
        if joint.get("type") != "revolute" or limit is None:
            continue
        try:
            ends = float(limit.get("lower", "0")), float(limit.get("upper", "0"))
        except ValueError:
            continue
        limits.append((limit, ends))
    largest = [max(map(abs, ends)) for _, ends in limits]
    degrees = [_MAX_RADIANS < value <= _MAX_DEGREES for value in largest]
    if not limits or sum(degrees) * 2 < len(limits) or max(largest) > _MAX_DEGREES:
        return
    low, high = min(ends[0] for _, ends in limits), max(ends[1] for _, ends in limits)
    for limit, ends in limits:
        limit.attrib |= {key: repr(math.radians(end)) for key, end in zip(("lower", "upper"), ends, strict=True)}
    notes.append(f"angle limits, {low:g} to {high:g} in the file, are read as degrees, although a URDF has radians")


def explain_ranges(ranges: Array) -> str | None:
    """Return a message if the ranges (n, 2) [rad] of an MJCF's hinges are too narrow for legs, else None."""
    limited = ranges[np.isfinite(ranges).all(axis=-1)]
    if not len(limited) or (widest := float(np.ptp(limited, axis=-1).max())) > _MIN_RANGE:
        return None
    return (
        f"the hinges of its legs turn by {widest:.2g} rad or less; an MJCF has degrees unless its <compiler> has "
        'angle="radian": add that if its ranges are radians'
    )


def explain_size(mass: float, length: float) -> str | None:
    """Return a message with likely units if mass [kg] and leg length [m] are implausible for a robot, else None."""
    low, high = _DENSITIES
    density = mass / length**3
    if low <= density <= high:
        return None
    fits = [f"lengths are in {unit}" for unit, size in _LENGTHS.items() if low <= density / size**3 <= high]
    fits += [f"masses are in {unit}" for unit, size in _MASSES.items() if low <= density * size <= high]
    if not fits and low <= density * 1e6 <= high:
        fits = ["lengths are in mm and masses in g"]
    if not fits:
        return None
    return f"{mass:.4g} kg on legs of {length:.3g} m are implausible; it looks as if {' or '.join(fits)}: use m and kg"


def explain_meshes(upper: float, lower: float, box: float) -> str | None:
    """Return a message if shapes are much larger than the robot, else None.

    Args:
        upper: length of the upper links [m], measured between joints.
        lower: length of the lower links [m], measured to the end of their shapes.
        box: half the longest side of the bounding box of the base's shapes [m].
    """
    for part, size in (("the last links", lower), ("the base", box)):
        if size > _MAX_SIZE_RATIO * upper:
            return (
                f"the shapes of {part} are {size:.3g} m long, and its upper links {upper:.3g} m; meshes in mm need "
                'scale="0.001 0.001 0.001"'
            )
    return None
