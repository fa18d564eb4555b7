"""The contact experiment: feet that carry little are dragged, the robot drops and nods on its soft feet."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import pose
from surefoot.identify.experiments.ground import STANCE, drop, ends, ground_plan, rocking, sides
from surefoot.identify.plan import Phase, Plan, Signal
from surefoot.robot import RobotDescription

LIFT = 0.25
"""How much shorter [rad] the legs get whose feet are dragged: they then carry a third to two thirds of what they
did, and weak motors of a heavy robot still move them against friction of 1.25."""
DRAG, STROKE, DRAGGING = 0.3, 0.7, 4.0
"""Swing [rad], time for there and back, and length of a phase [s]."""


def contact_plan(robot: RobotDescription) -> Plan:
    """Drag one diagonal pair of feet, then the other; drop and nod."""
    nod = rocking(robot, ends(robot), 0.12, 1.0, 5.0, 4.0)
    roll = rocking(robot, sides(robot), 0.08, 1.0, 4.0, 3.0)
    what = f"two feet, made light, are dragged {DRAG:g} rad to and fro"
    return ground_plan(
        robot,
        "contact",
        drop(robot),
        Phase("drag", what, DRAGGING, _dragging(robot, 1.0)),
        drop(robot),
        Phase("drag", what, DRAGGING, _dragging(robot, -1.0)),
        drop(robot),
        Phase("nod", "front and back legs 0.12 rad against each other, from 1 to 5 Hz", 4.0, nod),
        drop(robot),
        Phase("rock", "left and right legs 0.08 rad against each other, from 1 to 4 Hz", 3.0, roll),
    )


def _dragging(robot: RobotDescription, diagonal: float) -> Signal:
    """The legs of one diagonal get shorter and swing, front against back; the others stand."""
    light = ends(robot) * sides(robot) == diagonal

    def signal(t: float, start: Array) -> Array:
        lifted = np.clip(min(t, DRAGGING - t) / 0.5, 0.0, 1.0)
        swings = np.clip(min(t - 0.5, DRAGGING - 0.5 - t) / 0.3, 0.0, 1.0)
        swing = np.where(light, ends(robot) * DRAG * swings * np.sin(2 * np.pi * (t - 0.5) / STROKE), 0.0)
        return pose(robot, swing, STANCE - np.where(light, LIFT * lifted, 0.0))

    return signal
