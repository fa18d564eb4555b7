"""Servo, DC motor and delay: laws of physics as pure functions, the same for every world and every fit.

Each law exists once, as a compiled scalar kernel (`*_kernel`, for the inner loops); those that fits take too are
exposed as an array function of the same arguments that broadcasts like any NumPy ufunc.
"""

from surefoot.actuator.compiled import drop_stale_caches

drop_stale_caches()

from surefoot.actuator.motor import (  # noqa: E402
    joint_torque,
    motor_current,
    motor_friction,
    motor_torque,
    servo_duty,
)

__all__ = ["joint_torque", "motor_current", "motor_friction", "motor_torque", "servo_duty"]
