"""References read from mappings, as from a task's file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from surefoot.configuration import from_mapping
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.task.reference import Reference
from surefoot.task.reference_config import ReferenceConfig, make_reference


def read_reference(
    data: Mapping[str, Any], robot: RobotDescription, commands: CommandLimits | None = None
) -> Reference:
    """Return the reference that a task's `reference` describes."""
    return make_reference(from_mapping(ReferenceConfig, data, "reference"), robot, commands)
