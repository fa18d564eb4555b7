"""What an experiment is going to do, before it does it: phases, their signals, and limits within which it stays."""

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
"""What the motors are asked for (M,) at a time since the phase's start [s], from what they were asked for before."""
FADE = 0.2
"""Time [s] within which sines grow to their amplitude, and fade at the end."""


@dataclass(frozen=True)
class Phase:
    """A part of an experiment in which one kind of command is sent."""

    name: str
    what: str
    """What the motors are going to do, for whoever stands beside the robot."""
    duration: float
    """Length [s]."""
    signal: Signal
    """Motor angles [rad], or duties."""
    mode: Mode = Mode.POSITION
    """Which of the two."""
    use: Use = "fit"
    """fit: its readings are fitted; check: kept back, to try the fit on; way: it only leads from pose to pose."""


@dataclass(frozen=True)
class ExperimentLimits:
    """When an experiment ends early, with motors damped."""

    torque: float
    """Torque [N m] that a motor may give for `torque_time`."""
    angle_room: float = 0.7
    """How far [rad] a motor may be beyond the angles that the plan asks for."""
    torque_time: float = 0.4
    """How long [s] a motor may give more than that."""
    temperature: float = 70.0
    """Motor temperature [degC]."""
    duration: float = 600.0
    """Robot time [s]."""


@dataclass(frozen=True)
class Plan:
    """An experiment that has not begun."""

    experiment: str
    rack: bool
    """Whether the robot hangs in the air; otherwise it sits on the ground."""
    phases: tuple[Phase, ...]
    angle_low: Array
    """Least motor angles (M,) [rad] that it asks for."""
    angle_high: Array
    """Greatest ones."""
    largest_duty: float
    """Of PWM commands."""
    limits: ExperimentLimits

    @property
    def duration(self) -> float:
        """Robot time from arming to disarming [s]."""
        return sum(phase.duration for phase in self.phases)


def go_to(target: Array, duration: float) -> Signal:
    """Smoothly from wherever the motors were sent to `target` (M,) [rad]."""
    return lambda t, start: minimum_jerk(start, target, t / duration)


def hold(target: Array) -> Signal:
    """Stay at `target`."""
    return lambda t, start: target


def chirps(middle: Array, amplitude: Array, first: float, last: float, duration: float, phase: Array) -> Signal:
    """Sines that fade in and out, and whose frequency [Hz] grows exponentially from `first` to `last`.

    Each motor has its own middle, amplitude and phase (M,) [rad]; the duration is in [s].
    """

    def signal(t: float, start: Array) -> Array:
        turned, faded = sweep(t, first, last, duration)
        value: Array = middle + faded * amplitude * np.sin(turned + phase)
        return value

    return signal


def sweep(t: float, first: float, last: float, duration: float) -> tuple[float, float]:
    """Angle [rad] that a sine of exponentially growing frequency has turned, and its fading in and out from 0 to 1."""
    rate = math.log(last / first) / duration
    turned = 2 * math.pi * first * (math.expm1(rate * t) / rate if rate else t)
    return turned, min(1.0, t / FADE, max(duration - t, 0.0) / FADE)


def steps(values: Array, each: float) -> Signal:
    """One row of `values` (K, M) after the other, for a time [s] each."""
    return lambda t, start: values[min(int(t / each + 1e-9), len(values) - 1)]
