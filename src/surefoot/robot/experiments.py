"""Amplitudes of experiments and checks: the table [experiments] of a sheet, and defaults for a robot's legs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from surefoot.configuration import Positive, Within, from_mapping
from surefoot.robot.actuator import ActuatorData, DcMotorData

_Duty = Annotated[float, Within(0, 1)]

_EXTENSION_FRACTIONS = {
    **{"stance": 0.52, "high": 0.67, "low": 0.43, "squat": 0.14, "nod": 0.057, "lift": 0.12},
    **{"shorter": 0.095, "longer": 0.048},
}
"""Shares of the range of extensions; the first three are above its least."""
_COORDINATE_STEPS = {"sweep": 1.3, "chirp": 0.86, "step": 1.0}
"""Shares of the angle error at which a servo commands the continuous torque."""
_STOP_TORQUE_RATIO = 8 / 7
"""Torque at which an experiment ends, over the continuous torque."""


@dataclass(frozen=True)
class Experiments:
    """Extensions in the legs' own unit, motor angles in rad."""

    stance: Positive
    """Extension in which the robot stands, and around which legs on a rack move."""
    high: Positive
    """Extension from which it drops."""
    low: Positive
    """Extension to which it draws its legs in when it drops."""
    squat: Positive
    """Amplitude of the extension when it squats."""
    nod: Positive
    """Amplitude of the extension when front and back legs move against each other."""
    lift: Positive
    """Reduction of the extension of legs whose feet are dragged."""
    shorter: Positive
    """Reduction of the extension on the side that the doctor lowers."""
    longer: Positive
    """Increase on the other side."""
    sweep: Positive
    """Amplitude of slow sines of motors [rad]."""
    chirp: Positive
    """Amplitude of fast ones [rad]."""
    step: Positive
    """Largest step of a motor's target [rad]."""
    duty: _Duty
    """Greatest duty of PWM pulses."""
    spike: _Duty
    """Duty of PWM spikes of a single command."""
    torque: Positive
    """Torque [N m] beyond which an experiment ends."""

    def part(self, name: str, share: float) -> float:
        """Return a share of one of these, to three decimals, as in the text of plans."""
        return round(share * float(getattr(self, name)), 3)


def read_experiments(table: Mapping[str, Any], extension: tuple[float, float], motors: ActuatorData) -> Experiments:
    """Return the table of a sheet; its missing entries follow from the range of extensions and the motors."""
    low, high = extension
    defaults = {name: share * (high - low) for name, share in _EXTENSION_FRACTIONS.items()}
    defaults |= {name: low + defaults[name] for name in ("stance", "high", "low")}
    duty = 0.0
    if isinstance(motors, DcMotorData):
        torque = motors.overheat_torque
        current = float(np.interp(torque, motors.torque_table_torque, motors.torque_table_current))
        duty = min(current * motors.resistance / motors.voltage, 0.7)
        angle = duty / float(np.max(motors.kp))
    else:
        torque = float(np.min(np.minimum(motors.torque_limit, motors.overheat_torque)))
        angle = torque / float(np.max(motors.kp))
    defaults |= {name: share * angle for name, share in _COORDINATE_STEPS.items()}
    defaults |= {"duty": 1.3 * duty, "spike": 1.15 * duty, "torque": _STOP_TORQUE_RATIO * torque}
    return from_mapping(Experiments, defaults | dict(table), "experiments")
