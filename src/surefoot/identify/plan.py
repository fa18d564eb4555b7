"""What an experiment is going to do, before it does it: phases, and the limits within which it stays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from surefoot.arrays import Array
from surefoot.deploy.wire.messages import Mode

Use = Literal["fit", "check", "way"]
Signal = Callable[[float, Array], Array]
"""What the motors are asked for (M,) at a time since the phase's start [s], from what they were asked for before."""


@dataclass(frozen=True)
class Phase:
    """A part of an experiment in which one kind of command is sent."""

    name: str
    """In a word or two."""
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

    angle_room: float = 0.7
    """How far [rad] a motor may be beyond the angles that the plan asks for."""
    torque: float = 2.8
    """Torque [N m] that a motor may give for `torque_time`; the Minitaur's own protection takes 2.45 for a second."""
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
    """Its name."""
    rack: bool
    """Whether the robot hangs in the air; otherwise it sits on the ground."""
    phases: tuple[Phase, ...]
    """In order."""
    angle_low: Array
    """Least motor angles (M,) [rad] that it asks for."""
    angle_high: Array
    """Greatest ones."""
    largest_duty: float
    """Of PWM commands."""
    limits: ExperimentLimits = ExperimentLimits()

    @property
    def duration(self) -> float:
        """Robot time from arming to disarming [s]."""
        return sum(phase.duration for phase in self.phases)
