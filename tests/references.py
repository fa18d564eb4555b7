"""Reference gaits read from mappings, as in task files."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surefoot.configuration import from_tagged
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.reference import Reference
from surefoot.task.reference_config import REFERENCES


def read_reference(
    data: Mapping[str, Any], robot: RobotDescription, commands: CommandLimits | None = None
) -> Reference:
    """Return the reference gait for the table `reference` of a task."""
    return from_tagged(REFERENCES, data, "reference").make(robot, commands)
