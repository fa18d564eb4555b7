"""Robot descriptions: URDF, data sheet, leg kinematics, and the physical parameters that randomization varies."""

from surefoot.robot.archive import ROBOT_ARRAY
from surefoot.robot.data_sheet import GRAVITY
from surefoot.robot.description import DEFAULT_ROBOT, RobotDescription, load_embedded_robot
from surefoot.robot.leg import FiveBar
from surefoot.robot.params import PhysicalParams, parse_settings
from surefoot.robot.serial_leg import SerialLegs

__all__ = [
    "DEFAULT_ROBOT",
    "GRAVITY",
    "ROBOT_ARRAY",
    "FiveBar",
    "PhysicalParams",
    "RobotDescription",
    "SerialLegs",
    "load_embedded_robot",
    "parse_settings",
]
