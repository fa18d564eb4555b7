"""Actuator models (servo, DC motor, joint actuator, delay) as pure functions, shared by all worlds and fits.

Each model exists once, as a compiled scalar kernel (`*_kernel`) for the inner loops. Models that fits also use are
exposed as an array function with the same arguments, which broadcasts like any NumPy ufunc.
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
