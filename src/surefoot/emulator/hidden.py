"""Physical parameters that nobody is told: a robot that differs from its data sheet, as every real one does."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.seeding import generator

SPREAD = 0.1
"""How far torque constant and resistance may be from the sheet's, of their value."""
SERVO_LATENCY = (0.001, 0.005)
"""Age of what the servo sees [s], least and greatest."""
PARAMS = {
    "mass": ("base_mass_ratio", "leg_mass_ratio"),
    "motor_friction": ("motor_friction",),
    "inertia": ("base_inertia_ratio", "leg_inertia_ratio"),
    "motor_strength": ("motor_strength",),
    "latency": ("control_latency",),
    "voltage": ("voltage",),
    "contact_friction": ("contact_friction",),
    "imu_bias": ("imu_bias",),
    "imu_noise": ("imu_noise",),
    "torque_constant": ("torque_constant",),
    "resistance": ("resistance",),
    "servo_latency": ("servo_latency",),
}
"""Parameters that a row of a table of ranges is for. The control step is the host's: it is not drawn."""
EACH = ("motor_strength", "imu_bias")
"""Parameters of which each motor, or each axis, draws its own."""


def draw_hidden(robot: RobotDescription, ranges: Mapping[str, tuple[float, float]], seed: int) -> PhysicalParams:
    """Draw the parameters of one robot, uniformly; motors have their own strengths, axes of the IMU their own biases.

    Args:
        robot: whose sheet they are drawn around.
        ranges: least and greatest value by row of `PARAMS`, as of Tan et al. 2018, table I. K_t and R are drawn within
            `SPREAD`, the servo's latency from `SERVO_LATENCY`, unless they have ranges; all others stay nominal.
        seed: decides everything.

    Raises:
        SurefootError: a range beyond what the robot allows.
    """
    nominal = PhysicalParams.nominal(robot)
    around = {
        name: (value * (1 - SPREAD), value * (1 + SPREAD))
        for name, value in (
            ("torque_constant", robot.actuator.torque_constant),
            ("resistance", robot.actuator.resistance),
        )
    }
    known = {**around, "servo_latency": SERVO_LATENCY, **ranges}
    drawn = {}
    for row, names in PARAMS.items():
        for name in names:
            # A stream for each name: what one row draws does not change with the others.
            size = np.shape(getattr(nominal, name)) if name in EACH else 1
            unit = generator(seed, f"hidden {name}").uniform(size=size)
            if row in known:
                low, high = known[row]
                drawn[name] = low + (high - low) * unit
    return nominal.with_values(robot, **drawn)
