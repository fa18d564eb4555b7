"""Amplitudes of identification experiments and checks: table [experiments] of the data sheet, and its defaults."""

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
"""Default extensions as fractions of the extension range; the first three are measured from its lower bound."""
_ANGLE_FRACTIONS = {"sweep": 1.3, "chirp": 0.86, "step": 1.0}
"""Default angle amplitudes as fractions of the position error at which the servo commands the continuous torque."""
_STOP_TORQUE_RATIO = 8 / 7
"""Default torque at which an experiment is stopped, relative to the continuous torque."""


@dataclass(frozen=True)
class Experiments:
    """Amplitudes of experiments: extensions in the unit of the legs, motor angles in rad."""

    stance: Positive
    """Extension at which the robot stands, and around which legs on a rack move."""
    high: Positive
    """Extension from which the robot drops."""
    low: Positive
    """Extension to which the robot retracts its legs when it drops."""
    squat: Positive
    """Amplitude of the extension during squats."""
    nod: Positive
    """Amplitude of the extension when front and back legs move in opposite directions."""
    lift: Positive
    """Reduction of the extension of legs whose feet are dragged."""
    shorter: Positive
    """Reduction of the extension on the side that the doctor lowers."""
    longer: Positive
    """Increase of the extension on the other side."""
    sweep: Positive
    """Amplitude of slow sinusoidal motor motion [rad]."""
    chirp: Positive
    """Amplitude of fast sinusoidal motor motion [rad]."""
    step: Positive
    """Maximum step of a motor target [rad]."""
    duty: _Duty
    """Maximum duty of PWM pulses."""
    spike: _Duty
    """Duty of PWM spikes, which last one command."""
    torque: Positive
    """Torque [N m] above which an experiment is stopped."""

    def fraction(self, name: str, ratio: float) -> float:
        """Return a fraction of an amplitude, rounded to three decimals as in the text of plans."""
        return round(ratio * float(getattr(self, name)), 3)


def read_experiments(table: Mapping[str, Any], extension: tuple[float, float], motors: ActuatorData) -> Experiments:
    """Parse the table [experiments]; missing entries are derived from the extension range and the motors."""
    low, high = extension
    defaults = {name: fraction * (high - low) for name, fraction in _EXTENSION_FRACTIONS.items()}
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
    defaults |= {name: fraction * angle for name, fraction in _ANGLE_FRACTIONS.items()}
    defaults |= {"duty": 1.3 * duty, "spike": 1.15 * duty, "torque": _STOP_TORQUE_RATIO * torque}
    return from_mapping(Experiments, defaults | dict(table), "experiments")
