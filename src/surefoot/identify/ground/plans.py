"""Plans of the mass and contact experiments: the robot stands up, drops, squats, nods and drags its feet."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import minimum_jerk, sitting_pose
from surefoot.identify.plan import ExperimentLimits, Phase, Plan, Signal, Use, hold, sweep, transition
from surefoot.robot import RobotDescription

DROP_TIME = 1.4
"""Duration of a drop [s]."""
DRAG, STROKE, DRAG_TIME = 0.3, 0.7, 4.0
"""Swing amplitude of dragged legs [rad], period of the motion, and duration of a drag phase [s]."""


def fore_aft_signs(robot: RobotDescription) -> Array:
    """Return +1 for front legs and -1 for back legs (L,)."""
    return np.where(robot.leg_mounts[:, 0] > 0, 1.0, -1.0)


def lateral_signs(robot: RobotDescription) -> Array:
    """Return +1 for left legs and -1 for right legs (L,)."""
    return np.where(robot.leg_mounts[:, 1] > 0, 1.0, -1.0)


def stand_up_phases(robot: RobotDescription) -> list[Phase]:
    """Return the phases that move a damped robot from any pose to standing.

    Folded legs first swing out to the side of the body, unfold there, and are then pulled in, because legs that unfold
    under the body on a rough floor tip it over.
    """

    def swing_out(t: float, start: Array) -> Array:
        swing, extension = robot.to_pose(start)
        # Legs that slid out stay on their side of the body; legs under the body stay under it.
        aside = np.where(np.abs(swing) > 0.3, (robot.poses.spread or 0.0) * np.sign(swing), swing)
        return minimum_jerk(start, robot.pose_angles(aside, extension), t / 1.0)

    def unfold(t: float, start: Array) -> Array:
        swing, _ = robot.to_pose(start)
        return minimum_jerk(start, robot.pose_angles(swing, robot.poses.sit[-1]), t / 1.0)

    sit, stand = sitting_pose(robot), robot.pose_angles(0.0, robot.experiments.stance)
    return [
        Phase("swing legs out", "legs swing out next to the body, still folded", 1.0, swing_out, use="transition"),
        Phase("unfold", "legs unfold next to the body", 1.0, unfold, use="transition"),
        transition("draw in", "legs move under the body", 1.0, sit),
        Phase("sit", "the robot sits", 0.3, hold(sit), use="transition"),
        transition("stand up", "the robot stands up", 1.5, stand),
        Phase("stand", "the robot stands still", 0.5, hold(stand), use="transition"),
    ]


def ground_plan(robot: RobotDescription, name: str, *phases: Phase) -> Plan:
    """Return the plan of an experiment on the ground: stand up, run the phases, sit down."""
    sit = transition("sit down", "the robot sits down", 1.5, sitting_pose(robot))
    low, high = robot.pose_angles(0.0, 0.0), robot.pose_angles(0.0, 1.2 * robot.experiments.high)
    reach = 1.5  # the legs of a lying robot are far out to the side
    limits = ExperimentLimits(robot.experiments.torque)
    return Plan(name, False, (*stand_up_phases(robot), *phases, sit), low - reach, high + reach, 0.0, limits)


def drop(robot: RobotDescription, use: Use = "fit") -> Phase:
    """Return a phase in which the robot rises, then shortens its legs in one step, drops, and lands on its feet."""
    heights = robot.experiments
    stand, high, low = (robot.pose_angles(0.0, extension) for extension in (heights.stance, heights.high, heights.low))

    def signal(t: float, start: Array) -> Array:
        if t < 0.5:
            return minimum_jerk(start, high, t / 0.4)
        return low if t < 1.0 else minimum_jerk(low, stand, (t - 1.0) / 0.3)

    return Phase("drop", "the robot rises and drops by some centimetres", DROP_TIME, signal, use=use)


def extension_chirp(
    robot: RobotDescription, factor: Array, amplitude: float, first: float, last: float, duration: float
) -> Signal:
    """Return a chirp of leg extension [rad] around standing, like `chirps`; `factor` (L,) scales each leg's motion."""

    def signal(t: float, start: Array) -> Array:
        angle, fade = sweep(t, first, last, duration)
        return robot.pose_angles(0.0, robot.experiments.stance + fade * amplitude * factor * np.sin(angle))

    return signal


def _nod(robot: RobotDescription, name: str, amplitude: float, first: float, last: float, duration: float,
         use: Use = "fit") -> Phase:  # fmt: skip
    what = f"front and back legs move by {amplitude:g} rad in antiphase, from {first:g} to {last:g} Hz"
    return Phase(
        name, what, duration, extension_chirp(robot, fore_aft_signs(robot), amplitude, first, last, duration), use=use
    )


def mass_plan(robot: RobotDescription) -> Plan:
    """Return the plan of the mass experiment.

    Still and slow phases give mass and centre of mass, fast ones the inertia of the base.
    """
    use = robot.experiments
    legs = np.ones(len(robot.legs))
    still = Phase("stand still", "the robot stands still", 1.0, hold(robot.pose_angles(0.0, use.stance)))
    squat = extension_chirp(robot, legs, use.squat, 0.5, 0.5, 4.0)
    small = use.fraction("squat", 2 / 3)
    fast = extension_chirp(robot, legs, small, 1.0, 3.0, 3.0)
    return ground_plan(
        robot,
        "mass",
        drop(robot),
        still,
        Phase("squat slowly", f"every leg {use.squat:g} rad longer and shorter, twice", 4.0, squat),
        Phase("squat fast", f"every leg {small:g} rad longer and shorter, from 1 to 3 Hz", 3.0, fast),
        drop(robot),
        _nod(robot, "nod", use.nod, 1.0, 5.0, 5.0),
        drop(robot),
        still,
        drop(robot, use="check"),
        _nod(robot, "nod back", use.fraction("nod", 5 / 6), 4.0, 1.5, 3.0, use="check"),
    )


def contact_plan(robot: RobotDescription) -> Plan:
    """Return the plan of the contact experiment: drag one diagonal pair of feet, then the other; nod and rock."""
    use = robot.experiments
    small = use.fraction("nod", 2 / 3)
    roll = extension_chirp(robot, lateral_signs(robot), small, 1.0, 4.0, 3.0)
    what = f"two diagonal feet, with little load, are dragged {DRAG:g} rad back and forth"
    return ground_plan(
        robot,
        "contact",
        drop(robot),
        Phase("drag", what, DRAG_TIME, _dragging(robot, 1.0)),
        drop(robot),
        Phase("drag", what, DRAG_TIME, _dragging(robot, -1.0)),
        drop(robot),
        _nod(robot, "nod", use.nod, 1.0, 5.0, 4.0),
        drop(robot),
        Phase("rock", f"left and right legs move by {small:g} rad in antiphase, from 1 to 4 Hz", 3.0, roll),
    )


def _dragging(robot: RobotDescription, diagonal: float) -> Signal:
    """Return a motion in which the two legs of one diagonal shorten and swing in antiphase; the others stand."""
    use = robot.experiments
    light = fore_aft_signs(robot) * lateral_signs(robot) == diagonal

    def signal(t: float, start: Array) -> Array:
        lift = np.clip(min(t, DRAG_TIME - t) / 0.5, 0.0, 1.0)
        fade = np.clip(min(t - 0.5, DRAG_TIME - 0.5 - t) / 0.3, 0.0, 1.0)
        swing = np.where(light, fore_aft_signs(robot) * DRAG * fade * np.sin(2 * np.pi * (t - 0.5) / STROKE), 0.0)
        return robot.pose_angles(swing, use.stance - np.where(light, use.lift * lift, 0.0))

    return signal
