"""The robot: URDF, data sheet, leg space and the physical parameters that may differ from the data sheet."""

from surefoot.robot.archive import ROBOT
from surefoot.robot.description import DEFAULT_ROBOT, RobotDescription, load_embedded_robot
from surefoot.robot.leg import FiveBar
from surefoot.robot.params import PhysicalParams, parse_settings
from surefoot.robot.serial_leg import SerialLegs
from surefoot.robot.sheet import GRAVITY

__all__ = [
    "DEFAULT_ROBOT",
    "GRAVITY",
    "ROBOT",
    "FiveBar",
    "PhysicalParams",
    "RobotDescription",
    "SerialLegs",
    "carried_robot",
    "parse_settings",
]
