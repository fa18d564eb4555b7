"""Messages from a browser tab to a page with a robot: one dataclass per page, parsed like a configuration.

A message is a JSON object. Its keys are fields of the page's dataclass; any key may be omitted.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from surefoot.configuration import Within, from_mapping
from surefoot.errors import SurefootError, choices, quote

Pressed = Literal[True]
"""Value that a button sends."""
T = TypeVar("T", bound="TabMessage")


@dataclass(frozen=True)
class TabMessage:
    """Keys accepted by every page."""

    command: tuple[float, float, float] | None = None
    """Velocity command: forward, sideways [m/s], yaw rate [rad/s]. It is clipped to the policy's limits."""
    moved: float | None = None
    """Time of the user's input that caused the command [ms since 1970]."""

    @property
    def is_from_anyone(self) -> bool:
        """Whether tabs that only watch may send the message."""
        return False


@dataclass(frozen=True)
class DriveMessage(TabMessage):
    """Message to the page of a simulated robot."""

    set: tuple[str, float] | None = None
    """Name and new value of a physical parameter."""
    push: Annotated[tuple[float, float, float], Within(-1e4, 1e4)] | None = None
    """Force [N], direction from the robot's heading, counter-clockwise [deg], and duration [s]."""
    pause: bool | None = None
    restart: Pressed | None = None
    speed: float | None = None
    """Simulation speed relative to real time."""
    record: bool | None = None
    """Start or stop a recording."""
    export: str | None = None
    """File type to which the last recording is exported."""
    policy: str | None = None
    world: str | None = None
    ghost: str | None = None
    """Policy of the second robot; empty to remove it."""
    terrain: tuple[str] | tuple[str, float] | None = None
    """Kind of terrain and its size, or a height map."""


@dataclass(frozen=True)
class DeployMessage(TabMessage):
    """Message to the page of a deployed robot."""

    stop: Pressed | None = None
    """Sit down and disarm."""
    damp: Pressed | None = None
    """Damp the motors immediately."""

    @property
    def is_from_anyone(self) -> bool:
        """Whether the message only stops the robot, which every tab may do, whichever tab is in control."""
        return self.command is None and self.moved is None


def read_message(kind: type[T], text: str | bytes) -> T:
    """Parse a message from a tab.

    Args:
        kind: dataclass of the page's messages.
        text: untrusted text from the tab.

    Raises:
        SurefootError: the text is not JSON, has no or unknown keys, or values of the wrong type, length or range.
    """
    try:
        data = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise SurefootError(f"message is not JSON: {error}") from None
    if not isinstance(data, dict) or not data or None in data.values():
        keys = choices(field.name for field in dataclasses.fields(kind))
        raise SurefootError(f"message is {quote(data)}; it must be an object with one or more of the keys {keys}")
    return from_mapping(kind, data)


def _reject_constant(word: str) -> Any:
    raise ValueError(f"{word} is not a number")
