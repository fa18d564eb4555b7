"""The mass experiment: the robot stands, squats, drops and nods; the forces on its feet tell what it weighs."""

from __future__ import annotations

import numpy as np

from surefoot.deploy.poses import pose
from surefoot.identify.experiments.ground import STANCE, drop, ends, ground_plan, rocking
from surefoot.identify.experiments.signals import hold
from surefoot.identify.plan import Phase, Plan
from surefoot.robot import RobotDescription

SQUAT, NOD = 0.3, 0.12
"""Amplitudes of the extension [rad] when it squats, and when it nods."""


def mass_plan(robot: RobotDescription) -> Plan:
    """Still and slowly for mass and centre of mass, fast for the base's inertia."""
    legs, stand = np.ones(len(robot.legs)), pose(robot, 0.0, STANCE)
    squat = rocking(robot, legs, SQUAT, 0.5, 0.5, 4.0)
    fast = rocking(robot, legs, 0.2, 1.0, 3.0, 3.0)
    nod = rocking(robot, ends(robot), NOD, 1.0, 5.0, 5.0)
    other = rocking(robot, ends(robot), 0.1, 4.0, 1.5, 3.0)
    return ground_plan(
        robot,
        "mass",
        drop(robot),
        Phase("stand still", "the robot stands still", 1.0, hold(stand)),
        Phase("squat slowly", f"every leg {SQUAT:g} rad longer and shorter, twice", 4.0, squat),
        Phase("squat fast", "every leg 0.2 rad longer and shorter, from 1 to 3 Hz", 3.0, fast),
        drop(robot),
        Phase("nod", f"front and back legs {NOD:g} rad against each other, from 1 to 5 Hz", 5.0, nod),
        drop(robot),
        Phase("stand still", "the robot stands still", 1.0, hold(stand)),
        drop(robot, use="check"),
        Phase("nod back", "front and back legs 0.1 rad against each other, from 4 to 1.5 Hz", 3.0, other, use="check"),
    )
