"""Safety limits of the control computer, and the guard that checks every control step against them.

The guard decides, and the control loop acts. The guard has neither clock nor link, so it can be tested separately.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from surefoot.deploy.messages import Mode, Reason, State
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.data_sheet import Heat

_ROUNDING = 1e-6
ROBOT_REASON = "robot "
"""Prefix of a verdict's reason if the robot itself has reported it."""


@dataclass(frozen=True)
class SafetyLimits:
    """Limits at which a run ends early; `docs/safety.md` lists them in a table."""

    battery_warn: float
    """Battery voltage that causes one warning if it stays lower for `battery_time` [V]."""
    battery_low: float
    """Battery voltage at which the robot sits and is disarmed if it stays lower for `battery_time` [V]."""
    state_age: float = 3
    """Maximum age of the latest state; an older one damps the motors [control steps]. Two states may be lost: the
    fastest motor of the trot turns by 0.15 rad in three steps of 6 ms."""
    missed_steps: int = 2
    """Maximum number of consecutive missed control steps, in which the target is held; more damp the motors."""
    tilt: float = 0.5
    """Roll or pitch beyond which the motors are damped [rad]; a deployment uses the task's `fall_angle` instead.
    Episodes of the paper end at this angle; no trained gait recovers from it."""
    battery_time: float = 1.0
    """Maximum time of low battery voltage [s]: two strides, since the voltage sags briefly when all motors push."""
    map_age: float = 2.0
    """Maximum age of the height map of a perceptive policy; at this age the robot sits and is disarmed [s]. It has
    stood still since the map was late, so the last map is still valid around it."""
    temperature_warn: float = Heat.warn
    """Temperature of the hottest motor that causes one warning [degC]."""
    temperature_high: float = Heat.high
    """Temperature of the hottest motor at which the robot sits and is disarmed [degC]."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> SafetyLimits:
        """Return the limits of a robot, with battery and motor limits from its data sheet."""
        battery, heat = robot.battery, robot.heat
        return cls(battery.warn, battery.low, temperature_warn=heat.warn, temperature_high=heat.high)

    def __post_init__(self) -> None:
        """Check that limits are positive and finite, and that warnings come before shutdowns."""
        for name, number in vars(self).items():
            if not 0 < number < math.inf:
                raise SurefootError(f"safety limit {name} is {number}; it must be a finite number over 0")
        for soft, hard in (("battery_low", "battery_warn"), ("temperature_warn", "temperature_high")):
            low, high = getattr(self, soft), getattr(self, hard)
            if low > high:
                raise SurefootError(f"safety limit {soft} is {low:g}; it must not be above {hard} ({high:g})")


class Act(Enum):
    """Action of the control loop in a control step."""

    GO = "continue"
    SIT = "sit down and disarm"
    DAMP = "damp the motors at once"
    FALL = "damp the motors at once; sit when the robot lies still"
    GONE = "nothing: the robot has damped its motors itself, or the link is lost"


@dataclass(frozen=True)
class Verdict:
    """Action of the control loop, its reason in one or two words for traces, and a description for the operator."""

    act: Act
    reason: str = ""
    text: str = ""


GO = Verdict(Act.GO)


class NotFiniteError(RuntimeError):
    """A value that must be finite is NaN or infinite."""


def check_finite(what: str, names: Sequence[str], values: ArrayLike) -> None:
    """Raise `NotFiniteError` with the name of the first value that is not finite."""
    array = np.asarray(values, float).ravel()
    if not np.isfinite(array).all():
        first = int(np.argmin(np.isfinite(array)))
        raise NotFiniteError(f"{what} '{names[first % len(names)]}' is {array[first]:g}; it must be finite")


def is_finite(state: State) -> bool:
    """Return whether all sensor readings of a state are finite."""
    parts = [state.roll_pitch_yaw, state.angular_velocity_base, state.motor_angle, state.motor_velocity]
    if state.accelerometer is not None:
        parts.append(state.accelerometer)
    return math.isfinite(state.energy) and all(np.isfinite(part).all() for part in parts)


def _reason_name(state: State) -> str:
    if state.reason not in {*Reason}:
        return str(state.reason)
    return Reason(state.reason).name.lower().replace("_", " ")


class Guard:
    """Checks the robot's state in each control step against the safety limits.

    Args:
        limits: safety limits.
        control_step: period of the control loop [s].
        session: number of the operator's session.
        tilt: roll or pitch that counts as a fall [rad]. Defaults to the tilt limit.
        mode: mode that an armed robot must be in.
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
        """Warnings for the operator, oldest first, each only once."""
        self.map_age = 0.0
        """Age of the latest height map [s]; set by the caller for a perceptive policy."""
        self._low_since: dict[float, float] = {}

    def check(
        self,
        time: float,
        state: State,
        state_age: float,
        missed: int = 0,
        stops: int = 0,
        armed: bool = True,
        upright: bool = True,
    ) -> Verdict:
        """Return the verdict of a control step; the most urgent one has priority.

        Args:
            time: time on this computer's clock [s].
            state: latest state of the robot.
            state_age: age of the state [s].
            missed: control steps missed since the last one.
            stops: number of stop requests of the operator.
            armed: whether the robot should follow commands.
            upright: whether a tilt beyond the limit is a fall; False while a fallen robot sits down.
        """
        for verdict in (
            Verdict(Act.DAMP, "operator", "stopped at once by the operator") if stops > 1 else GO,
            self._robot(state) if armed else GO,
            self._lateness(state_age, missed),
            GO if is_finite(state) else Verdict(Act.DAMP, "not finite", "a reading of the robot is not finite"),
            self._tilt(state) if upright else GO,
            self._request(state) if armed else GO,
            self._battery(time, state.voltage),
            self._temperature(state),
            self._map(),
            Verdict(Act.SIT, "operator", "stopped by the operator") if stops else GO,
        ):
            if verdict.act is not Act.GO:
                return verdict
        return GO

    def _robot(self, state: State) -> Verdict:
        if state.session != self.session:
            return Verdict(Act.DAMP, "session", "the robot has restarted and lost this session")
        if state.mode == Mode.FAULT:
            name = _reason_name(state)
            return Verdict(Act.GONE, f"{ROBOT_REASON}{name}", f"the robot has damped its motors ({name})")
        if state.mode != self.mode:
            return Verdict(Act.DAMP, "mode", f"the robot is in mode {state.mode}; it must be in mode {int(self.mode)}")
        return GO

    def _request(self, state: State) -> Verdict:
        """Return the verdict of a robot that asks to sit; it asks in every state, so other checks come first."""
        if state.reason == Reason.REMOTE:
            return Verdict(Act.SIT, "operator", "stopped with the remote control")
        if state.reason:
            name = _reason_name(state)
            return Verdict(Act.SIT, f"{ROBOT_REASON}{name}", f"the robot asks to sit ({name})")
        return GO

    def _lateness(self, state_age: float, missed: int) -> Verdict:
        steps, limits = state_age / self.control_step, self.limits
        if not steps <= limits.state_age + _ROUNDING:
            text = f"the newest state is {1e3 * state_age:.0f} ms old, {steps:.1f} control steps"
            return Verdict(Act.DAMP, "stale state", f"{text}; at most {limits.state_age:g}")
        if missed > limits.missed_steps:
            text = f"{missed} consecutive control steps were missed; at most {limits.missed_steps}"
            return Verdict(Act.DAMP, "late", text)
        return GO

    def _tilt(self, state: State) -> Verdict:
        roll, pitch = state.roll_pitch_yaw[:2]
        if abs(roll) <= self.tilt and abs(pitch) <= self.tilt:
            return GO
        text = f"roll {roll:+.2f} and pitch {pitch:+.2f} rad; more than {self.tilt:g} rad counts as a fall"
        return Verdict(Act.FALL, "tilt", text)

    def _battery(self, time: float, voltage: float) -> Verdict:
        limits = self.limits

        def low_for(limit: float) -> float:
            """Return the time for which the voltage has been below a limit [s]."""
            if voltage >= limit:
                self._low_since.pop(limit, None)
                return 0.0
            return time - self._low_since.setdefault(limit, time)

        if low_for(limits.battery_warn) >= limits.battery_time:
            self.warn(f"battery below {limits.battery_warn:g} V; charge it soon")
        if low_for(limits.battery_low) < limits.battery_time:
            return GO
        text = f"the battery voltage is {voltage:.1f} V, below {limits.battery_low:g} V for {limits.battery_time:g} s"
        return Verdict(Act.SIT, "battery", text)

    def _temperature(self, state: State) -> Verdict:
        hottest = float(state.temperature.max())
        if hottest > self.limits.temperature_warn:
            self.warn(f"a motor is hotter than {self.limits.temperature_warn:g} degC")
        if hottest <= self.limits.temperature_high:
            return GO
        text = f"a motor is at {hottest:.0f} degC; at most {self.limits.temperature_high:g}"
        return Verdict(Act.SIT, "temperature", text)

    def _map(self) -> Verdict:
        if self.map_age <= self.limits.map_age:
            return GO
        text = f"the latest height map is {self.map_age:.1f} s old; at most {self.limits.map_age:g}"
        return Verdict(Act.SIT, "map", text)

    def warn(self, text: str) -> None:
        """Add a warning for the operator, unless it was given before."""
        if text not in self.warnings:
            self.warnings.append(text)
