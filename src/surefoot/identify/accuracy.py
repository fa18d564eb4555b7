"""How well a simulator can know a robot at all: least deviations of what fits find.

A recording of a robot that is emulated in Bullet, fitted in MuJoCo, gives values that are off by more than the noise of
its readings explains: two engines close loops differently, and voltage and time are sampled. No interval is narrower.
"""

from __future__ import annotations

RELATIVE = 0.005
"""Of a value."""
LESS_SURE = {
    "torque_constant": 0.01,
    "servo_kp": 0.01,
    "leg_mass_ratio": 0.01,
    "leg_inertia_ratio": 0.02,
    "base_inertia_ratio": 0.02,
}
"""Of values that the engines disagree about more."""
ABSOLUTE = {
    "servo_latency": 6e-5,
    "control_latency": 6e-5,
    "motor_friction": 2e-4,
    "motor_viscous_friction": 1e-4,
}
"""Of values that may be near 0, in their units."""


def with_floor(name: str, value: float, deviation: float) -> float:
    """A deviation that counts the simulator's own accuracy."""
    floor = ABSOLUTE.get(name, 0.0)
    return float((deviation**2 + (LESS_SURE.get(name, RELATIVE) * value) ** 2 + floor**2) ** 0.5)
