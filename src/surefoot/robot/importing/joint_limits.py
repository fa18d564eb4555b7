"""Units of joint limits: a URDF has radians, rad/s and N m, and some files have degrees or revolutions per minute."""

from __future__ import annotations

import math

import numpy as np

from surefoot.arrays import Array

PLACEHOLDER_SPEED = 100.0
"""A speed limit [rad/s] from which on it is a placeholder."""
_USUAL_SPEEDS = (3.0, 80.0)
"""Speed limits [rad/s] that drives of legs have."""
_UNITS = {"rpm": math.tau / 60, "degrees per second": math.pi / 180}
"""Units that speed limits are mistaken for, in rad/s."""
_ROUND = (100.0, 200.0, 500.0, 1000.0, 10000.0, 100000.0)
"""Speeds that are written where nobody knew one."""


def explain_speeds(speeds: Array) -> str:
    """Return what speed limits (n,) [rad/s] of a file are that no joint has."""
    stated = speeds[np.isfinite(speeds) & (speeds > 0)]
    if not stated.size:
        return "the file has no real limit"
    low, high = float(stated.min()), float(stated.max())
    text = f"the file has {_span(low, high)} rad/s, which no joint reaches"
    units = [
        f"if these are {unit}, it is {_span(low * size, high * size)} rad/s"
        for unit, size in _UNITS.items()
        if _USUAL_SPEEDS[0] <= low * size and high * size <= _USUAL_SPEEDS[1] and low not in _ROUND
    ]
    return "; ".join([text, *units])


def _span(low: float, high: float) -> str:
    return f"{low:.3g}" if math.isclose(low, high, rel_tol=5e-3) else f"{low:.3g} to {high:.3g}"
