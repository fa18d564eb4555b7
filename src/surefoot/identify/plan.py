"""The plan of an experiment: phases with their signals, and limits that end it early."""

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
"""Command of the motors (M,) at a time since the phase's start [s], from the last command of the phase before."""
FADE = 0.2
"""Time [s] in which sines grow to their amplitude, and fade at the end."""


@dataclass(frozen=True)
class Phase:
    """A part of an experiment with one kind of command."""

    name: str
    what: str
    """Motion of the robot, for people beside it."""
    duration: float
    """Length [s]."""
    signal: Signal
    """Motor angles [rad] if the mode is `POSITION`, duties if it is `PWM`."""
    mode: Mode = Mode.POSITION
    use: Use = "fit"
    """fit: readings are fitted; check: held out for a check; transition: between poses, not used."""


@dataclass(frozen=True)
class ExperimentLimits:
    """When an experiment ends early, with motors damped."""

    torque: float
    """Torque [N m] that a motor may exceed for `torque_time`."""
    angle_margin: float = 0.7
    """Distance [rad] of a motor from the plan's angles."""
    torque_time: float = 0.4
    """[s]"""
    temperature: float = 70.0
    """Motor temperature [degC]."""
    duration: float = 600.0
    """Robot time [s]."""


@dataclass(frozen=True)
class Plan:
    """A planned experiment."""

    experiment: str
    rack: bool
    """Whether the robot hangs in the air; otherwise it sits on the ground."""
    phases: tuple[Phase, ...]
    angle_low: Array
    """Least commanded motor angles (M,) [rad]."""
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
    """Return a smooth motion from the last command to `target` (M,) [rad]."""
    return lambda t, start: minimum_jerk(start, target, t / duration)


def transition(name: str, what: str, duration: float, target: Array, motion: float | None = None) -> Phase:
    """Return a phase that leads to `target` (M,) [rad], within the time `motion` [s] if it is not the whole phase."""
    return Phase(name, what, duration, go_to(target, motion or duration), use="transition")


def hold(target: Array) -> Signal:
    """Return a constant command."""
    return lambda t, start: target


def chirps(middle: Array, amplitude: Array, first: float, last: float, duration: float, phase: Array) -> Signal:
    """Return sines that fade in and out, and whose frequency [Hz] grows exponentially from `first` to `last`.

    Each motor has its own middle, amplitude and phase (M,) [rad]; the duration is in [s].
    """

    def signal(t: float, start: Array) -> Array:
        angle, fade = sweep(t, first, last, duration)
        value: Array = middle + fade * amplitude * np.sin(angle + phase)
        return value

    return signal


def sweep(t: float, first: float, last: float, duration: float) -> tuple[float, float]:
    """Return the phase angle [rad] of a sine of exponentially growing frequency, and its fading from 0 to 1."""
    rate = math.log(last / first) / duration
    angle = 2 * math.pi * first * (math.expm1(rate * t) / rate if rate else t)
    return angle, min(1.0, t / FADE, max(duration - t, 0.0) / FADE)


def steps(values: Array, period: float) -> Signal:
    """Return the rows of `values` (K, M) one after the other, each for a period [s]."""
    return lambda t, start: values[min(int(t / period + 1e-9), len(values) - 1)]
