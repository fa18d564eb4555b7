"""The control computer's limits, each with its reason; `docs/deploy.md` has them as a table."""

from __future__ import annotations

from dataclasses import dataclass, fields

from surefoot.errors import SurefootError


@dataclass(frozen=True)
class SafetyLimits:
    """When a run ends early, and how."""

    state_age: float = 3
    """Age of the newest state [control steps] that damps: two states may be lost; the fastest motor of the trot turns
    by 0.15 rad in three steps of 6 ms."""
    missed_steps: int = 2
    """Control steps missed in a row, held at first; more of them damp, as for the state's age."""
    tilt: float = 0.5
    """Roll or pitch [rad] that damps, if the policy's task has no `fall_angle`; the robot then sits. It is where an
    episode of the paper ends; no trained gait comes back from there."""
    battery_warn: float = 14.4
    """Battery voltage [V] below which, for `battery_time`, it warns once: the sheet's robot is used at 14 to 16.8 V."""
    battery_low: float = 14.0
    """Battery voltage [V] below which, for `battery_time`, the robot sits and is disarmed: 3.5 V a cell."""
    battery_time: float = 1.0
    """How long [s] the battery may be low: two strides, as the voltage sags for a moment whenever all motors push."""
    temperature_warn: float = 70.0
    """Temperature [degC] of the hottest motor that warns once, some minutes before the next limit at a walk."""
    temperature_high: float = 80.0
    """Temperature [degC] of the hottest motor at which the robot sits and is disarmed: magnets and glue of small
    outrunner motors; the robot itself damps at 90."""

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
