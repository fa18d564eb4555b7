"""What experiments on the ground share: standing up, dropping, rocking, sitting down."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.poses import SIT_EXTENSION, SPREAD_SWING, between, pose, sitting
from surefoot.identify.experiments.signals import go_to, hold, sweep
from surefoot.identify.plan import Phase, Plan, Signal, Use
from surefoot.robot import RobotDescription

STANCE = 1.7
"""Extension [rad] in which the robot stands."""
HIGH, LOW = 2.0, 1.5
"""Extensions [rad] from which it drops, and to which it draws its legs in."""
DROP = 1.4
"""Length of a drop [s]."""


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
        swing, extension = robot.motor_to_leg_pose(start)
        # Legs that slid out stay on their side; legs under the body stay there.
        aside = np.where(np.abs(swing) > 0.3, SPREAD_SWING * np.sign(swing), swing)
        return between(start, pose(robot, aside, extension), t / 1.0)

    def unfold(t: float, start: Array) -> Array:
        swing, _ = robot.motor_to_leg_pose(start)
        return between(start, pose(robot, swing, SIT_EXTENSION), t / 1.0)

    sit, stand = sitting(robot), pose(robot, 0.0, STANCE)
    return [
        Phase("swing legs out", "legs beside the body, as folded as they are", 1.0, swing_out, use="way"),
        Phase("unfold", "legs beside the body, unfolded", 1.0, unfold, use="way"),
        Phase("draw in", "legs under the body", 1.0, go_to(sit, 1.0), use="way"),
        Phase("sit", "the robot sits", 0.3, hold(sit), use="way"),
        Phase("stand up", "the robot stands up", 1.5, go_to(stand, 1.5), use="way"),
        Phase("stand", "the robot stands still", 0.5, hold(stand), use="way"),
    ]


def ground_plan(robot: RobotDescription, name: str, *phases: Phase) -> Plan:
    """Return the plan of an experiment on the ground: stand up, go through the phases, sit down."""
    sit = Phase("sit down", "the robot sits down", 1.5, go_to(sitting(robot), 1.5), use="way")
    low, high = pose(robot, 0.0, 0.0), pose(robot, 0.0, 2.4)
    reach = 1.5  # a robot that lies has its legs far to a side
    return Plan(name, False, (*standing_up(robot), *phases, sit), low - reach, high + reach, 0.0)


def drop(robot: RobotDescription, use: Use = "fit") -> Phase:
    """The robot rises and lets itself fall by drawing its legs in at once; motors and soft feet catch it."""
    stand, high, low = (pose(robot, 0.0, extension) for extension in (STANCE, HIGH, LOW))

    def signal(t: float, start: Array) -> Array:
        if t < 0.5:
            return between(start, high, t / 0.4)
        return low if t < 1.0 else between(low, stand, (t - 1.0) / 0.3)

    return Phase("drop", "the robot rises, and drops by some centimetres", DROP, signal, use=use)


def rocking(
    robot: RobotDescription, share: Array, amplitude: float, first: float, last: float, duration: float
) -> Signal:
    """Legs longer and shorter around standing, with a frequency that grows exponentially, faded in and out.

    Args:
        robot: its legs.
        share: of the amplitude that each leg gets (L,).
        amplitude: of the extension [rad].
        first: frequency at the start [Hz].
        last: frequency at the end [Hz].
        duration: [s].
    """

    def signal(t: float, start: Array) -> Array:
        turned, faded = sweep(t, first, last, duration)
        return pose(robot, 0.0, STANCE + faded * amplitude * share * np.sin(turned))

    return signal
