"""A YAML file that states all of a `PolicySpecification`, for whatever has no format of its own."""

from __future__ import annotations

from pathlib import Path

from surefoot.adopt.specification import PolicySpecification
from surefoot.configuration import from_mapping, read_yaml
from surefoot.errors import prefix_errors
from surefoot.robot import RobotDescription


def read(config: Path, robot: RobotDescription) -> PolicySpecification:
    """Read the specification of a policy.

    Raises:
        SurefootError: a file without what is needed, or with a key that a specification does not have.
    """
    table = read_yaml(config)
    with prefix_errors(config):
        return from_mapping(PolicySpecification, {"joints": list(robot.motor_names), **table})
