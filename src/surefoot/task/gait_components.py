"""Construction of the components of a gait that follows commands, the same in simulation and on the robot."""

from __future__ import annotations

from surefoot.robot.commands import CommandLimits
from surefoot.task.command_follower import CommandFilter, CommandFollower
from surefoot.task.commands import CommandGenerator
from surefoot.task.component import RobotComponent
from surefoot.task.contact_reflex import ContactReflex
from surefoot.task.footholds import Footholds
from surefoot.task.gait import HybridGait


def gait_components(
    gait: HybridGait, limits: CommandLimits, source: CommandGenerator, num_envs: int
) -> list[RobotComponent]:
    """Return the components of a gait: commands and, if its reference has them, contact reflex and footholds.

    Args:
        gait: the gait.
        limits: limits of the commands.
        source: command generator.
        num_envs: number of robots.
    """
    commands = CommandFilter(limits, gait.robot.natural_time, num_envs, gait.reference.frequency)
    components: list[RobotComponent] = [CommandFollower(source, commands)]
    if reference := gait.reference.following:
        if reference.touch_clearance:
            components.append(ContactReflex(reference, num_envs))
        if reference.foothold_radius:
            components.append(Footholds(reference, num_envs))
    return components
