"""Functions that the readers of other frameworks share: unread keys, unmeasured observations, and joint names."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from surefoot.adopt.specification import BASE_SPEED
from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError, choices, nearest, quote

T = TypeVar("T")

_UNMEASURED_PATTERNS = {
    r"contact|feet_force|foot_force|grf|touch": "is the contact of the feet, which policy contracts do not support",
    r"height_scan|height_map|scan|depth|camera|image|terrain|lidar|elevation|(^|_)rays?(_|$|\d)|heights": "is the "
    "height of the ground, which the robot does not measure",
    r"height|base_z": "is the height of the base, which no sensor of a robot measures",
    r"(base|root|body|robot)_?(pos|xy|position)": "is the position of the base, which no sensor of a robot measures",
}
"""Reasons why robots can't provide an observation, by a pattern of its name."""
_SPEED_PATTERN = r"vel|speed|twist"
_MEASURED_SPEED_PATTERN = r"ang|gyro|joint|dof|motor|wheel|command|cmd|rate"
_MAX_LISTED_KEYS = 12
"""Maximum number of keys that a note names."""


def unmeasured_reason(name: object) -> str | None:
    """Return the reason why no robot provides an observation, judging by its name, or None."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", str(name)[:200]).lower().replace(" ", "_").replace("-", "_")
    for pattern, reason in _UNMEASURED_PATTERNS.items():
        if re.search(pattern, text):
            return reason
    return BASE_SPEED if re.search(_SPEED_PATTERN, text) and not re.search(_MEASURED_SPEED_PATTERN, text) else None


def unmeasured_remedy(reason: str) -> str:
    """Return what a user can do about an observation that no robot provides, given the reason."""
    if reason == BASE_SPEED:
        return "as the term base_velocity of --from manual, --base-velocity estimate replaces it by an estimate"
    return "such a policy can't be adopted"


def unknown_term(name: object, known: Iterable[str]) -> SurefootError:
    """Return the error for an unsupported observation.

    Args:
        name: name of the observation.
        known: names of supported observations.
    """
    if reason := unmeasured_reason(name):
        return SurefootError(f"observation {quote(name)} {reason}; {unmeasured_remedy(reason)}")
    return SurefootError(f"observation {quote(name)} is unknown; known are {choices(known)}")


def from_table(kind: type[T], data: Mapping[str, Any]) -> T:
    """Make a dataclass from a table, ignoring keys that it does not have; `unread_keys` lists them.

    Raises:
        SurefootError: a key is missing, or a value has the wrong type.
    """
    names = field_names(kind)
    return from_mapping(kind, {key: value for key, value in data.items() if key in names and value is not None})


def field_names(kind: type) -> list[str]:
    """Return the names of a dataclass's fields."""
    return [item.name for item in dataclasses.fields(kind)]


def unread_keys(
    data: Mapping[str, Any], read: Iterable[str], harmless: Iterable[str] = (), where: str = ""
) -> list[str]:
    """Return keys with values that the reader ignores although they may affect observations or actions, as text.

    Args:
        data: the table.
        read: keys that the reader uses.
        harmless: keys that affect neither observations nor actions.
        where: dotted name of the table, ending in a dot.
    """
    read, harmless = list(read), {*harmless}
    named = []
    for key, value in data.items():
        if key in read or key in harmless or value in (None, "", [], {}, False):
            continue
        near = nearest(str(key), [one for one in read if one not in data])
        named.append(f"{where}{str(key)[:60]} = {quote(value)[:60]}{f' (did you mean {near}?)' if near else ''}")
    return named


def unread_note(named: list[str]) -> dict[str, str]:
    """Return a note about keys that are not read, or no note."""
    if not named:
        return {}
    more = f" and {len(named) - _MAX_LISTED_KEYS} more" if len(named) > _MAX_LISTED_KEYS else ""
    listed = ", ".join(named[:_MAX_LISTED_KEYS])
    return {"unread": f"not read: {listed}{more}; if the training used it, the policy acts differently"}


def first_names(terms: Mapping[str, str]) -> dict[str, str]:
    """Return the first name of each term in a format's table, which maps names to terms."""
    return {term: name for name, term in reversed([*terms.items()])}


def plain_joint_name(name: str) -> str:
    """Normalize a joint name: remove case, separators and the words joint and controller."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"joint|controller", "", name.lower()))


def match_joints(joints: Iterable[str], motors: Iterable[str]) -> tuple[str, ...] | None:
    """Return the robot's motor for each joint of a policy, if their normalized names agree; else None."""
    plain: dict[str, list[str]] = {}
    for motor in motors:
        plain.setdefault(plain_joint_name(motor), []).append(motor)
    matches = [plain.get(plain_joint_name(joint), []) for joint in joints]
    return tuple(match[0] for match in matches) if all(len(match) == 1 for match in matches) else None
