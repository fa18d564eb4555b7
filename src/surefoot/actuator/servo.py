"""The position servo of the microcontroller, run once per servo step."""

from __future__ import annotations

from numba import njit, vectorize


@njit(cache=True, inline="always")
def servo_duty_kernel(target: float, angle: float, speed: float, kp: float, kd: float) -> float:
    """Return `servo_duty` for scalars."""
    duty = kp * (target - angle) - kd * speed
    # Compiled min and max would turn NaN into full duty.
    return 1.0 if duty > 1.0 else -1.0 if duty < -1.0 else duty


@vectorize(cache=True)
def servo_duty(target, angle, speed, kp, kd):  # type: ignore[no-untyped-def]
    """Return the PWM duty of a PD servo whose target speed is zero: clip(k_p (q_target - q) - k_d qdot, -1, 1).

    Source: Tan et al. 2018, eq. 7, with the duty limited as in the robot's published model.

    Args:
        target: commanded motor angle [rad].
        angle: motor angle that the servo sees, `servo_latency` old [rad].
        speed: motor speed that the servo sees, equally old [rad/s].
        kp: proportional gain [1/rad].
        kd: derivative gain [s/rad].

    Returns:
        Duty in [-1, 1], in the arguments' common shape.
    """
    return servo_duty_kernel(target, angle, speed, kp, kd)
