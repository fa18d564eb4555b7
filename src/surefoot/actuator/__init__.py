"""Servo, DC motor and delay: laws of physics as pure functions, the same for every world and every fit.

Each law exists once, as a compiled scalar kernel (`*_kernel`, for the inner loops), and is exposed as an
array function of the same arguments that broadcasts like any NumPy ufunc.
"""

from surefoot.actuator.cache import drop_stale_caches

drop_stale_caches()

from surefoot.actuator.constraint import constraint_speed, constraint_torque  # noqa: E402
from surefoot.actuator.delay import DelayLine  # noqa: E402
from surefoot.actuator.motor import coulomb_friction, motor_current, motor_friction, motor_torque, overheat  # noqa: E402
from surefoot.actuator.servo import servo_duty  # noqa: E402

__all__ = [
    "DelayLine",
    "constraint_speed",
    "constraint_torque",
    "coulomb_friction",
    "motor_current",
    "motor_friction",
    "motor_torque",
    "overheat",
    "servo_duty",
]
