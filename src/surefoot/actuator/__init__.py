"""Servo, DC motor and delay: laws of physics as pure functions, shared by every world, the emulator and the fits.

Each law exists once, as a compiled scalar kernel (`*_kernel`, for the inner loops), and is exposed as an array function of
the same arguments that broadcasts like any NumPy ufunc.
"""

from surefoot.actuator.delay import DelayLine
from surefoot.actuator.motor import coulomb_friction, motor_current, motor_torque, overheat
from surefoot.actuator.servo import servo_duty

__all__ = ["DelayLine", "coulomb_friction", "motor_current", "motor_torque", "overheat", "servo_duty"]
