"""What the readers of other frameworks' files share: tables that hold more than is needed, and names."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError, choices, nearest, quote

T = TypeVar("T")

_UNMEASURED = {
    r"contact|feet_force|foot_force|grf|touch": "is the contact of the feet, which contracts do not have",
    r"height_scan|height_map|scan|depth|camera|image|terrain|lidar|elevation|(^|_)rays?(_|$|\d)|heights": "is the "
    "height of the ground, which the robot does not see",
    r"height|base_z": "is the height of the base, which no sensor of a robot gives",
    r"(base|root|body|robot)_?(pos|xy|position)": "is the position of the base, which no sensor of a robot gives",
}
"""What robots do not measure, by a pattern of its name."""
_SPEED = r"vel|speed|twist"
_OTHER_SPEED = r"ang|gyro|joint|dof|motor|wheel|command|cmd|rate"
_BASE_SPEED = "is the speed of the base, which no sensor of a robot gives"
_UNREAD = 12
"""Keys that a note names at most."""


def unmeasured_reason(name: object) -> str | None:
    """Return why no robot gives an observation, by its name; None if its name does not say so."""
    text = re.sub(r"(?<=[a-z])(?=[A-Z])", "_", str(name)[:200]).lower().replace(" ", "_").replace("-", "_")
    for pattern, reason in _UNMEASURED.items():
        if re.search(pattern, text):
            return reason
    return _BASE_SPEED if re.search(_SPEED, text) and not re.search(_OTHER_SPEED, text) else None


def unknown_term(name: object, known: Iterable[str]) -> SurefootError:
    """Return the error of an observation that can't be adopted.

    Args:
        name: its name.
        known: names of observations that can be.
    """
    if reason := unmeasured_reason(name):
        return SurefootError(f"observation {quote(name)} {reason}; such a policy can't be adopted")
    return SurefootError(f"observation {quote(name)} is unknown; known are {choices(known)}")


def pick(kind: type[T], data: Mapping[str, Any]) -> T:
    """Make a dataclass from those keys of a table that it has; `unread` names the others.

    Raises:
        SurefootError: missing keys, or a value of another kind.
    """
    names = field_names(kind)
    return from_mapping(kind, {key: value for key, value in data.items() if key in names and value is not None})


def field_names(kind: type) -> list[str]:
    """Return the names of a dataclass's fields."""
    return [item.name for item in dataclasses.fields(kind)]


def unread(data: Mapping[str, Any], read: Iterable[str], harmless: Iterable[str] = (), where: str = "") -> list[str]:
    """Return the keys of a table that nothing reads and that may change observations or actions, with their values.

    Args:
        data: the table.
        read: keys that are read.
        harmless: keys that change neither observations nor actions.
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
    """Return the note that names keys that are not read, or none."""
    if not named:
        return {}
    more = f" and {len(named) - _UNREAD} more" if len(named) > _UNREAD else ""
    return {
        "unread": f"not read: {', '.join(named[:_UNREAD])}{more}; if the training used it, the policy acts otherwise"
    }


def first_names(terms: Mapping[str, str]) -> dict[str, str]:
    """Return the first name of each term in a format's table of terms by name."""
    return {term: name for name, term in reversed([*terms.items()])}


def plain_joint_name(name: str) -> str:
    """Return a joint's name without what frameworks add to it: case, separators and the word joint."""
    return re.sub(r"[^a-z0-9]", "", re.sub(r"joint|controller", "", name.lower()))


def match_joints(joints: Iterable[str], motors: Iterable[str]) -> tuple[str, ...] | None:
    """Return the robot's names of a policy's joints, if these differ only by what frameworks add; else None."""
    plain: dict[str, list[str]] = {}
    for motor in motors:
        plain.setdefault(plain_joint_name(motor), []).append(motor)
    found = [plain.get(plain_joint_name(joint), []) for joint in joints]
    return tuple(one[0] for one in found) if all(len(one) == 1 for one in found) else None
