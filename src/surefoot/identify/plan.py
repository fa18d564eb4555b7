"""Plan of an experiment: phases with command signals, and limits that stop the experiment early."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import Mode
from surefoot.deploy.poses import minimum_jerk

Use = Literal["fit", "check", "transition"]
Signal = Callable[[float, Array], Array]
"""Function (time since the start of the phase [s], last command of the previous phase (M,)) -> motor command (M,)."""
FADE = 0.2
"""Time [s] in which sines fade in, and fade out at the end."""


@dataclass(frozen=True)
class Phase:
    """A phase of an experiment, with one kind of command."""

    name: str
    description: str
    """Motion of the robot, in words for the operator."""
    duration: float
    """Duration [s]."""
    signal: Signal
    """Command: motor angles [rad] in mode `POSITION`, duties in mode `PWM`."""
    mode: Mode = Mode.POSITION
    use: Use = "fit"
    """What its readings are used for. fit: fitted; check: held out as a check; transition: a pose change, not used."""


@dataclass(frozen=True)
class ExperimentLimits:
    """Limits beyond which an experiment stops early and damps all motors."""

    torque: Array | float
    """Torque [N m] of each motor (M,), or of all, that may be exceeded for `torque_time` at most."""
    angle_margin: float = 0.7
    """Maximum distance [rad] of a motor from the range of the plan's angles."""
    torque_time: float = 0.4
    """Maximum time above `torque` [s]."""
    temperature: float = 70.0
    """Maximum motor temperature [degC]."""
    duration: float = 600.0
    """Maximum duration of the experiment on the robot's clock [s]."""


@dataclass(frozen=True)
class Plan:
    """Plan of an experiment on a robot with M motors."""

    experiment: str
    """Name of the experiment."""
    rack: bool
    """Whether the robot hangs in the air; otherwise it sits on the ground."""
    phases: tuple[Phase, ...]
    angle_low: Array
    """Minimum commanded motor angles (M,) [rad]."""
    angle_high: Array
    """Maximum commanded motor angles (M,) [rad]."""
    largest_duty: float
    """Maximum duty of PWM commands."""
    limits: ExperimentLimits

    @property
    def duration(self) -> float:
        """Duration from arming to disarming, on the robot's clock [s]."""
        return sum(phase.duration for phase in self.phases)


def go_to(target: Array, duration: float) -> Signal:
    """Return a minimum-jerk motion from the last command to `target` (M,) [rad]."""
    return lambda t, start: minimum_jerk(start, target, t / duration)


def transition(name: str, description: str, duration: float, target: Array, motion: float | None = None) -> Phase:
    """Return a transition phase to `target` (M,) [rad]; the motion takes `motion` [s], by default the whole phase."""
    return Phase(name, description, duration, go_to(target, motion or duration), use="transition")


def hold(target: Array) -> Signal:
    """Return a constant command."""
    return lambda t, start: target


def chirps(middle: Array, amplitude: Array, first: float, last: float, duration: float, phase: Array) -> Signal:
    """Return exponential chirps from frequency `first` to `last` [Hz] that fade in and out.

    Each motor has its own centre, amplitude and phase angle (M,) [rad]; the duration is in [s].
    """

    def signal(t: float, start: Array) -> Array:
        angle, fade = sweep(t, first, last, duration)
        value: Array = middle + fade * amplitude * np.sin(angle + phase)
        return value

    return signal


def sweep(t: float, first: float, last: float, duration: float) -> tuple[float, float]:
    """Return the phase angle [rad] and the fade factor (0 to 1) of an exponential chirp at time t [s]."""
    rate = math.log(last / first) / duration
    angle = 2 * math.pi * first * (math.expm1(rate * t) / rate if rate else t)
    return angle, min(1.0, t / FADE, max(duration - t, 0.0) / FADE)


def steps(values: Array, period: float) -> Signal:
    """Return steps through the rows of `values` (K, M), each held for one period [s]."""
    return lambda t, start: values[min(int(t / period + 1e-9), len(values) - 1)]
