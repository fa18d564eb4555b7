"""Gains of the balance of a `FollowingReference`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

from surefoot.configuration import Within

Gain = Annotated[float, Within(-10, 10)]


@dataclass(frozen=True)
class PhaseGains:
    """Gains of legs in stance, or in swing.

    Poses per angle [1/rad], per rate [1/rad] in sqrt(g / l), and per speed error in sqrt(g l). Extension grows and
    abduction goes outward where the base is low; with pitch (nose down) and speed all legs swing alike.
    """

    pitch_extension: Gain = 0.0
    pitch_rate_extension: Gain = 0.0
    roll_extension: Gain = 0.0
    roll_rate_extension: Gain = 0.0
    pitch_swing: Gain = 0.0
    pitch_rate_swing: Gain = 0.0
    speed_swing: Gain = 0.0
    roll_abduction: Gain = 0.0
    roll_rate_abduction: Gain = 0.0
    speed_abduction: Gain = 0.0


@dataclass(frozen=True)
class BalanceConfig:
    """Gains of the balance; 0: none."""

    stance: PhaseGains = field(default_factory=PhaseGains)
    """Of legs in stance."""
    swing: PhaseGains = field(default_factory=PhaseGains)
    """Of legs in swing."""
    slope_swing: Gain = 0.0
    """Swing of all legs per mean pitch: with it feet stay below their legs on slopes."""
    slope_extension: Gain = 0.0
    """Extension of hind legs per mean pitch, less that of front legs: with it the base stays level on slopes."""
    slope_abduction: Gain = 0.0
    """Abduction of left legs per mean roll, less that of right ones."""
    slow_speed_swing: Gain = 0.0
    """Swing of all legs per mean speed error: robots that are too slow lean into their way."""
