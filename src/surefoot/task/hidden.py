"""Hidden physical parameters: a robot that differs from its data sheet, as every real one does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.seeding import generator
from surefoot.task.randomize import ROWS

RELATIVE_RANGE = 0.1
"""How far torque constant and resistance may be from the sheet's, of their value."""
SERVO_LATENCY = (0.001, 0.005)
"""Age of what the servo sees [s], least and greatest."""


def draw_hidden(robot: RobotDescription, ranges: Mapping[str, tuple[float, float]], seed: int) -> PhysicalParams:
    """Draw the parameters of one robot, uniformly; motors have their own strengths, axes of the IMU their own biases.

    Args:
        robot: whose sheet they are drawn around.
        ranges: least and greatest value by row of `ROWS`, as of Tan et al. 2018, table I. K_t and R are drawn within
            `RELATIVE_RANGE`, the servo's latency from `SERVO_LATENCY`, unless they have ranges; others stay nominal.
        seed: decides everything.

    Raises:
        SurefootError: a range beyond what the robot allows.
    """
    nominal = PhysicalParams.nominal(robot)
    around = {
        name: (value * (1 - RELATIVE_RANGE), value * (1 + RELATIVE_RANGE))
        for name, value in (
            ("torque_constant", robot.actuator.torque_constant),
            ("resistance", robot.actuator.resistance),
        )
    }
    known = {**around, "servo_latency": SERVO_LATENCY, **ranges}
    known.pop("control_step", None)  # the time between commands is the host's
    drawn = {}
    for row, (low, high) in known.items():
        for name in ROWS[row].params:
            # A stream for each name: what one row draws does not change with the others.
            size = np.shape(getattr(nominal, name)) if ROWS[row].each else 1
            drawn[name] = low + (high - low) * generator(seed, f"hidden {name}").uniform(size=size)
    return nominal.with_values(robot, **drawn)
