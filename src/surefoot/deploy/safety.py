"""The control computer's safety: its limits, and the guard that judges every control step by them.

The guard only judges; the loop does what it says. It knows no clock and no link, so that all of it can be tried alone.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from surefoot.deploy.messages import Mode, Reason, State
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

_ROUNDING = 1e-6


@dataclass(frozen=True)
class SafetyLimits:
    """When a run ends early, and how; `docs/deploy.md` has these as a table."""

    battery_warn: float
    """Battery voltage [V] below which, for `battery_time`, it warns once."""
    battery_low: float
    """Battery voltage [V] below which, for `battery_time`, the robot sits and is disarmed."""
    state_age: float = 3
    """Age of the newest state [control steps] that damps: two states may be lost; the fastest motor of the trot turns
    by 0.15 rad in three steps of 6 ms."""
    missed_steps: int = 2
    """Control steps missed in a row, held at first; more of them damp, as for the state's age."""
    tilt: float = 0.5
    """Roll or pitch [rad] that damps, if the policy's task has no `fall_angle`; the robot then sits. It is where an
    episode of the paper ends; no trained gait comes back from there."""
    battery_time: float = 1.0
    """How long [s] the battery may be low: two strides, as the voltage sags for a moment whenever all motors push."""
    temperature_warn: float = 70.0
    """Temperature [degC] of the hottest motor that warns once, some minutes before the next limit at a walk."""
    temperature_high: float = 80.0
    """Temperature [degC] of the hottest motor at which the robot sits and is disarmed: magnets and glue of small
    outrunner motors; the robot itself damps at 90."""

    @classmethod
    def of(cls, robot: RobotDescription) -> SafetyLimits:
        """Return the limits of a robot; its sheet has the battery's."""
        return cls(robot.battery.warn, robot.battery.low)

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


class Act(Enum):
    """What is to be done in a control step."""

    GO = "go"
    """Go on."""
    SIT = "sit"
    """Sit down and disarm."""
    DAMP = "damp"
    """Have the motors damped at once."""
    FALL = "fall"
    """Have the motors damped at once; sit when the robot is still."""
    GONE = "gone"
    """The robot has damped its motors itself."""


@dataclass(frozen=True)
class Verdict:
    """What is to be done, and why."""

    act: Act
    reason: str = ""
    """In one word or two, for traces."""
    text: str = ""
    """In plain words."""


GO = Verdict(Act.GO)


class NotFiniteError(RuntimeError):
    """A number that must be finite is not."""


def check_finite(what: str, names: Sequence[str], values: ArrayLike) -> None:
    """Refuse numbers that are not finite.

    Raises:
        NotFiniteError: names the first one.
    """
    array = np.asarray(values, float).ravel()
    if not np.isfinite(array).all():
        first = int(np.argmin(np.isfinite(array)))
        raise NotFiniteError(f"{what} '{names[first % len(names)]}' is {array[first]:g}; it must be finite")


def is_finite(state: State) -> bool:
    """Whether all readings of a state are finite."""
    parts = (state.roll_pitch_yaw, state.angular_velocity_base, state.motor_angle, state.motor_velocity)
    return math.isfinite(state.energy) and all(np.isfinite(part).all() for part in parts)


class Guard:
    """Judges what each control step sees.

    Args:
        limits: the limits.
        control_step: time between two control steps [s].
        session: the operator's session.
        tilt: roll or pitch [rad] that is a fall; the limits', if not given.
        mode: in which an armed robot must be.
    """

    def __init__(
        self,
        limits: SafetyLimits,
        control_step: float,
        session: int,
        tilt: float | None = None,
        mode: Mode = Mode.POSITION,
    ) -> None:
        self.limits, self.control_step, self.session, self.mode = limits, control_step, session, mode
        self.tilt = limits.tilt if tilt is None else tilt
        self.warnings: list[str] = []
        """What the operator should know, each once, oldest first."""
        self._low_since: dict[float, float] = {}

    def judge(
        self,
        time: float,
        state: State,
        state_age: float,
        missed: int = 0,
        stops: int = 0,
        armed: bool = True,
        upright: bool = True,
    ) -> Verdict:
        """What is to be done in a control step, by what it knows when it starts.

        Args:
            time: this computer's clock [s].
            state: the newest state.
            state_age: how old it is [s].
            missed: control steps that passed since the last one that was done.
            stops: how often the operator has asked to stop.
            armed: whether the robot should be following commands.
            upright: whether a robot that tilts too far has fallen; False while a fallen one sits.
        """
        for verdict in (
            Verdict(Act.DAMP, "operator", "stopped at once by the operator") if stops > 1 else GO,
            self._robot(state) if armed else GO,
            self._lateness(state_age, missed),
            GO if is_finite(state) else Verdict(Act.DAMP, "not finite", "a reading of the robot is not finite"),
            self._tilt(state) if upright else GO,
            self._battery(time, state.voltage),
            self._temperature(state),
            Verdict(Act.SIT, "operator", "stopped by the operator") if stops else GO,
        ):
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def _robot(self, state: State) -> Verdict:
        if state.session != self.session:
            return Verdict(Act.DAMP, "session", "the robot has forgotten this operator; it was switched on anew")
        if state.mode == Mode.FAULT:
            reason = Reason(state.reason) if state.reason in {*Reason} else None
            name = reason.name.lower() if reason is not None else str(state.reason)
            return Verdict(Act.GONE, f"robot {name}", f"the robot has damped its motors ({name})")
        if state.mode != self.mode:
            return Verdict(Act.DAMP, "mode", f"the robot is in mode {state.mode}; it must be in {int(self.mode)}")
        return GO

    def _lateness(self, state_age: float, missed: int) -> Verdict:
        steps, limits = state_age / self.control_step, self.limits
        if not steps <= limits.state_age + _ROUNDING:
            told = f"{1e3 * state_age:.0f} ms old, {steps:.1f} control steps; at most {limits.state_age:g}"
            return Verdict(Act.DAMP, "stale state", f"the newest state is {told}")
        if missed > limits.missed_steps:
            told = f"{missed} control steps in a row were missed; at most {limits.missed_steps}"
            return Verdict(Act.DAMP, "late", told)
        return GO

    def _tilt(self, state: State) -> Verdict:
        roll, pitch = state.roll_pitch_yaw[:2]
        if abs(roll) <= self.tilt and abs(pitch) <= self.tilt:
            return GO
        return Verdict(
            Act.FALL, "tilt", f"roll {roll:+.2f} and pitch {pitch:+.2f} rad; beyond {self.tilt:g} rad is a fall"
        )

    def _battery(self, time: float, voltage: float) -> Verdict:
        limits = self.limits

        def low_for(limit: float) -> float:
            """How long the voltage has been seen below a limit [s]."""
            if voltage >= limit:
                self._low_since.pop(limit, None)
                return 0.0
            return time - self._low_since.setdefault(limit, time)

        # It sags for a moment whenever motors push.
        if low_for(limits.battery_warn) >= limits.battery_time:
            self.warn(f"battery below {limits.battery_warn:g} V; charge it soon")
        if low_for(limits.battery_low) < limits.battery_time:
            return GO
        told = f"the battery has {voltage:.1f} V, below {limits.battery_low:g} V for {limits.battery_time:g} s"
        return Verdict(Act.SIT, "battery", told)

    def _temperature(self, state: State) -> Verdict:
        hottest = float(state.temperature.max())
        if hottest > self.limits.temperature_warn:
            self.warn(f"a motor is hotter than {self.limits.temperature_warn:g} degC")
        if hottest <= self.limits.temperature_high:
            return GO
        return Verdict(
            Act.SIT, "temperature", f"a motor has {hottest:.0f} degC; at most {self.limits.temperature_high:g}"
        )

    def warn(self, text: str) -> None:
        """Keep something that the operator should know, once."""
        if text not in self.warnings:
            self.warnings.append(text)
