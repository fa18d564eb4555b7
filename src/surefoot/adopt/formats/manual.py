"""Format `manual`: a YAML file with a complete `PolicySpecification`, for frameworks without a reader."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_args

import yaml

from surefoot.adopt.formats.common import unmeasured_reason, unmeasured_remedy
from surefoot.adopt.specification import PolicySpecification, TermName
from surefoot.configuration import from_mapping, read_yaml, to_mapping
from surefoot.errors import SurefootError, describe_os_errors, prefix_errors, quote
from surefoot.files import atomic_write
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS


def read(config: Path, robot: RobotDescription, overrides: Mapping[str, Any]) -> PolicySpecification:
    """Read the specification of a policy; `overrides` replace fields of the file, except stated ranges of commands.

    These say what the policy was trained for.

    Raises:
        SurefootError: the file lacks a field, or has a key that a specification does not have.
    """
    table = read_yaml(config)
    with prefix_errors(config):
        if "joints" not in table:
            table["joints"] = list(robot.motor_names)
        terms = table.get("observations")
        for place, term in enumerate(terms if isinstance(terms, list) else []):
            name = term.get("term") if isinstance(term, Mapping) else None
            if isinstance(name, str) and name not in get_args(TermName) and (reason := unmeasured_reason(name)):
                where = f"observations[{place}].term is {quote(name)}, which {reason}"
                raise SurefootError(f"{where}; {unmeasured_remedy(reason)}")
        stated = {name: table[name] for name in COMMANDS if name in table}
        return from_mapping(PolicySpecification, {**table, **overrides, **stated})


def write(path: Path, specification: PolicySpecification) -> None:
    """Write a specification to a file for `read`; fields with default values are omitted."""
    table = _without_defaults(specification)
    table["observations"] = [_without_defaults(term) for term in specification.observations]
    text = yaml.safe_dump(table, sort_keys=False, default_flow_style=None, width=110)
    with describe_os_errors(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
        atomic_write(path, f"# For surefoot adopt NETWORK --from manual --config {path.name}\n{text}")


def _without_defaults(config: Any) -> dict[str, Any]:
    """Return a dataclass as a table without fields that have default values."""
    made = to_mapping(config)
    defaults = {item.name: item.default for item in dataclasses.fields(config)}
    return {name: made[name] for name in made if getattr(config, name) not in (defaults[name], {})}
