"""Messages of a browser's tab to a page with a robot: one dataclass per page, read by the reader of configurations.

A message is a JSON object. Its keys are fields of the page's dataclass; any key may be left out.
"""

from __future__ import annotations

import dataclasses
import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, TypeVar

from surefoot.configuration import Within, from_mapping
from surefoot.errors import SurefootError, choices, quote

Pressed = Literal[True]
"""What a button sends."""
T = TypeVar("T", bound="TabMessage")


@dataclass(frozen=True)
class TabMessage:
    """Keys that every page takes."""

    command: tuple[float, float, float] | None = None
    """Command: forward, sideways [m/s], yaw rate [rad/s]. The robot clamps it to the policy's limits."""
    moved: float | None = None
    """When the hand moved that gave the command [ms since 1970]."""

    @property
    def is_from_anyone(self) -> bool:
        """Whether tabs that watch may send the message."""
        return False


@dataclass(frozen=True)
class DriveMessage(TabMessage):
    """A message to the page of a simulated robot."""

    set: tuple[str, float] | None = None
    """Name and new value of a physical parameter."""
    push: Annotated[tuple[float, float, float], Within(-1e4, 1e4)] | None = None
    """Force [N], direction from the robot's heading, counter-clockwise [deg], and duration [s]."""
    pause: bool | None = None
    restart: Pressed | None = None
    speed: float | None = None
    """Simulated over real time."""
    record: bool | None = None
    """Begin or end a recording."""
    export: str | None = None
    """Kind of file to make of the last recording."""
    policy: str | None = None
    world: str | None = None
    ghost: str | None = None
    """Policy of the second robot; empty for no second robot."""
    terrain: tuple[str] | tuple[str, float] | None = None
    """Kind of terrain and its size, or a map."""


@dataclass(frozen=True)
class DeployMessage(TabMessage):
    """A message to the page of a robot."""

    stop: Pressed | None = None
    """Sit down and disarm."""
    damp: Pressed | None = None
    """Damp the motors at once."""

    @property
    def is_from_anyone(self) -> bool:
        """Whether it stops the robot and does nothing else: a tab that drives must not take the buttons from others."""
        return self.command is None and self.moved is None


def read_message(kind: type[T], text: str | bytes) -> T:
    """Return the message of a tab.

    Args:
        kind: dataclass of the page's messages.
        text: what the tab sent; it is hostile until it is read.

    Raises:
        SurefootError: no JSON, unknown keys, no key at all, or values of the wrong type, length or range.
    """
    try:
        data = json.loads(text, parse_constant=_reject_constant)
    except (ValueError, RecursionError) as error:
        raise SurefootError(f"message is no JSON: {error}") from None
    if not isinstance(data, dict) or not data or None in data.values():
        keys = choices(field.name for field in dataclasses.fields(kind))
        raise SurefootError(f"message is {quote(data)}; it must be an object with values for some of the keys {keys}")
    return from_mapping(kind, data)


def _reject_constant(word: str) -> Any:
    raise ValueError(f"{word} is not a number")
