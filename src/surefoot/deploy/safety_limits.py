"""The control computer's limits, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any

from surefoot.errors import SurefootError


def limit(default: float, unit: str, what: str, follows: str, why: str) -> Any:
    """A field of `SafetyLimits` that can be told as a row of a table."""
    return field(default=default, metadata={"unit": unit, "what": what, "follows": follows, "why": why})


@dataclass(frozen=True)
class SafetyLimits:
    """When a run ends early, and how. Each field says what it limits, what follows, and why it is so."""

    state_age: float = limit(
        *(3, "control steps", "age of the newest state", "damp"),
        why="two states may be lost; the fastest motor of the trot turns by 0.15 rad in three steps of 6 ms",
    )
    missed_steps: int = limit(
        *(2, "control steps", "control steps missed in a row", "held at first, damp beyond"),
        why="as for the state's age, in the other direction",
    )
    tilt: float = limit(
        *(0.5, "rad", "roll or pitch, if the policy's task has no `fall_angle`", "damp, then sit"),
        why="where an episode of the paper ends; no trained gait comes back from there",
    )
    battery_warn: float = limit(
        *(14.4, "V", "battery voltage, for as long as `battery_time`", "warn once"),
        why="the sheet's robot is used at 14.0 to 16.8 V",
    )
    battery_low: float = limit(
        *(14.0, "V", "battery voltage, for as long as `battery_time`", "sit, disarm"),
        why="lower end of what the sheet's robot is used at; 3.5 V a cell",
    )
    battery_time: float = limit(
        *(1.0, "s", "how long the battery may be low", "sit, disarm"),
        why="two strides: the voltage sags for a moment whenever all motors push",
    )
    temperature_warn: float = limit(
        *(70.0, "degC", "hottest motor", "warn once"),
        why="some minutes before the next limit at a walk",
    )
    temperature_high: float = limit(
        *(80.0, "degC", "hottest motor", "sit, disarm"),
        why="magnets and glue of small outrunner motors; the robot itself damps at 90",
    )

    def __post_init__(self) -> None:
        """Refuse limits that no run could keep, or that come in the wrong order."""
        for item in fields(self):
            number = getattr(self, item.name)
            if not 0 < number < float("inf"):
                raise SurefootError(f"safety limit {item.name} is {number}; it must be a finite number over 0")
        for soft, hard in (("battery_low", "battery_warn"), ("temperature_warn", "temperature_high")):
            if getattr(self, soft) > getattr(self, hard):
                raise SurefootError(
                    f"safety limit {soft} is {getattr(self, soft):g}; it must not be above {hard} "
                    f"({getattr(self, hard):g})"
                )


def limits_table(limits: SafetyLimits | None = None) -> list[tuple[str, str, str, str, str]]:
    """Rows of name, limit with unit, what it limits, what follows, why; for the document."""
    limits = limits or SafetyLimits()
    return [
        (
            item.name,
            f"{getattr(limits, item.name):g} {item.metadata['unit']}",
            item.metadata["what"],
            item.metadata["follows"],
            item.metadata["why"],
        )
        for item in fields(limits)
    ]
