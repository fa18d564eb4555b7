"""How well a simulator can know a robot at all: least deviations of what fits find.

A recording of a robot that is emulated in Bullet, fitted in MuJoCo, gives values that are off by more than the noise of
its readings explains: two engines close loops differently, and voltage and time are sampled. No interval is narrower.
"""

from __future__ import annotations

RELATIVE = 0.004
"""Of a value; as found with ten robots in both engines (`benchmarks/identification.py --seeds 101-110`)."""
ABSOLUTE = {
    "servo_latency": 3e-5,
    "control_latency": 3e-5,
    "motor_friction": 2e-4,
    "motor_viscous_friction": 5e-5,
}
"""Of values that may be near 0, in their units."""


def with_floor(name: str, value: float, deviation: float) -> float:
    """A deviation that counts the simulator's own accuracy."""
    floor = ABSOLUTE.get(name, 0.0)
    return float((deviation**2 + (RELATIVE * value) ** 2 + floor**2) ** 0.5)
