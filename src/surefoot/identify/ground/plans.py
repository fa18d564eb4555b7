"""The experiments on the ground, mass and contact: a robot that stands up, drops, squats, nods and drags its feet."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import minimum_jerk, sitting_pose
from surefoot.identify.plan import ExperimentLimits, Phase, Plan, Signal, Use, go_to, hold, sweep
from surefoot.robot import RobotDescription

DROP = 1.4
"""Length of a drop [s]."""
DRAG, STROKE, DRAGGING = 0.3, 0.7, 4.0
"""Swing [rad], time for there and back, and length of a phase [s]."""


def ends(robot: RobotDescription) -> Array:
    """+1 for front legs, -1 for back legs (L,)."""
    return np.where(robot.leg_mounts[:, 0] > 0, 1.0, -1.0)


def sides(robot: RobotDescription) -> Array:
    """+1 for left legs, -1 for right legs (L,)."""
    return np.where(robot.leg_mounts[:, 1] > 0, 1.0, -1.0)


def standing_up(robot: RobotDescription) -> list[Phase]:
    """From however a damped robot lies to standing.

    Folded legs are swung out beside the body first, then unfolded there, then drawn in: legs that unfold under the body
    on a floor that holds them tip it over.
    """

    def swing_out(t: float, start: Array) -> Array:
        swing, extension = robot.to_pose(start)
        # Legs that slid out stay on their side; legs under the body stay there.
        aside = np.where(np.abs(swing) > 0.3, (robot.poses.spread or 0.0) * np.sign(swing), swing)
        return minimum_jerk(start, robot.pose_angles(aside, extension), t / 1.0)

    def unfold(t: float, start: Array) -> Array:
        swing, _ = robot.to_pose(start)
        return minimum_jerk(start, robot.pose_angles(swing, robot.poses.sit[-1]), t / 1.0)

    sit, stand = sitting_pose(robot), robot.pose_angles(0.0, robot.experiments.stance)
    return [
        Phase("swing legs out", "legs beside the body, as folded as they are", 1.0, swing_out, use="transition"),
        Phase("unfold", "legs beside the body, unfolded", 1.0, unfold, use="transition"),
        Phase("draw in", "legs under the body", 1.0, go_to(sit, 1.0), use="transition"),
        Phase("sit", "the robot sits", 0.3, hold(sit), use="transition"),
        Phase("stand up", "the robot stands up", 1.5, go_to(stand, 1.5), use="transition"),
        Phase("stand", "the robot stands still", 0.5, hold(stand), use="transition"),
    ]


def ground_plan(robot: RobotDescription, name: str, *phases: Phase) -> Plan:
    """Return the plan of an experiment on the ground: stand up, go through the phases, sit down."""
    sit = Phase("sit down", "the robot sits down", 1.5, go_to(sitting_pose(robot), 1.5), use="transition")
    low, high = robot.pose_angles(0.0, 0.0), robot.pose_angles(0.0, 1.2 * robot.experiments.high)
    reach = 1.5  # a robot that lies has its legs far to a side
    return Plan(
        name,
        False,
        (*standing_up(robot), *phases, sit),
        low - reach,
        high + reach,
        0.0,
        ExperimentLimits(robot.experiments.torque),
    )


def drop(robot: RobotDescription, use: Use = "fit") -> Phase:
    """The robot rises and lets itself fall by drawing its legs in at once; motors and soft feet catch it."""
    asked = robot.experiments
    stand, high, low = (robot.pose_angles(0.0, extension) for extension in (asked.stance, asked.high, asked.low))

    def signal(t: float, start: Array) -> Array:
        if t < 0.5:
            return minimum_jerk(start, high, t / 0.4)
        return low if t < 1.0 else minimum_jerk(low, stand, (t - 1.0) / 0.3)

    return Phase("drop", "the robot rises, and drops by some centimetres", DROP, signal, use=use)


def rocking(
    robot: RobotDescription, share: Array, amplitude: float, first: float, last: float, duration: float
) -> Signal:
    """Legs longer and shorter around standing, as `chirps` of the extension [rad]; each leg by its `share` (L,)."""

    def signal(t: float, start: Array) -> Array:
        turned, faded = sweep(t, first, last, duration)
        return robot.pose_angles(0.0, robot.experiments.stance + faded * amplitude * share * np.sin(turned))

    return signal


def mass_plan(robot: RobotDescription) -> Plan:
    """Still and slowly for mass and centre of mass, fast for the base's inertia."""
    use = robot.experiments
    legs, stand = np.ones(len(robot.legs)), robot.pose_angles(0.0, use.stance)
    squat = rocking(robot, legs, use.squat, 0.5, 0.5, 4.0)
    least, back = use.part("squat", 2 / 3), use.part("nod", 5 / 6)
    fast = rocking(robot, legs, least, 1.0, 3.0, 3.0)
    nod = rocking(robot, ends(robot), use.nod, 1.0, 5.0, 5.0)
    other = rocking(robot, ends(robot), back, 4.0, 1.5, 3.0)
    return ground_plan(
        robot,
        "mass",
        drop(robot),
        Phase("stand still", "the robot stands still", 1.0, hold(stand)),
        Phase("squat slowly", f"every leg {use.squat:g} rad longer and shorter, twice", 4.0, squat),
        Phase("squat fast", f"every leg {least:g} rad longer and shorter, from 1 to 3 Hz", 3.0, fast),
        drop(robot),
        Phase("nod", f"front and back legs {use.nod:g} rad against each other, from 1 to 5 Hz", 5.0, nod),
        drop(robot),
        Phase("stand still", "the robot stands still", 1.0, hold(stand)),
        drop(robot, use="check"),
        Phase(
            "nod back",
            f"front and back legs {back:g} rad against each other, from 4 to 1.5 Hz",
            3.0,
            other,
            use="check",
        ),
    )


def contact_plan(robot: RobotDescription) -> Plan:
    """Drag one diagonal pair of feet, then the other; drop and nod."""
    use = robot.experiments
    small = use.part("nod", 2 / 3)
    nod = rocking(robot, ends(robot), use.nod, 1.0, 5.0, 4.0)
    roll = rocking(robot, sides(robot), small, 1.0, 4.0, 3.0)
    what = f"two feet, made light, are dragged {DRAG:g} rad to and fro"
    return ground_plan(
        robot,
        "contact",
        drop(robot),
        Phase("drag", what, DRAGGING, _dragging(robot, 1.0)),
        drop(robot),
        Phase("drag", what, DRAGGING, _dragging(robot, -1.0)),
        drop(robot),
        Phase("nod", f"front and back legs {use.nod:g} rad against each other, from 1 to 5 Hz", 4.0, nod),
        drop(robot),
        Phase("rock", f"left and right legs {small:g} rad against each other, from 1 to 4 Hz", 3.0, roll),
    )


def _dragging(robot: RobotDescription, diagonal: float) -> Signal:
    """The legs of one diagonal get shorter and swing, front against back; the others stand."""
    use = robot.experiments
    light = ends(robot) * sides(robot) == diagonal

    def signal(t: float, start: Array) -> Array:
        lifted = np.clip(min(t, DRAGGING - t) / 0.5, 0.0, 1.0)
        swings = np.clip(min(t - 0.5, DRAGGING - 0.5 - t) / 0.3, 0.0, 1.0)
        swing = np.where(light, ends(robot) * DRAG * swings * np.sin(2 * np.pi * (t - 0.5) / STROKE), 0.0)
        return robot.pose_angles(swing, use.stance - np.where(light, use.lift * lifted, 0.0))

    return signal
