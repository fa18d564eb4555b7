"""The position motor that physics engines bring along: a constraint on the motor's speed at the end of the step."""

from __future__ import annotations

from numba import njit, vectorize


@njit(cache=True, inline="always")
def constraint_speed_kernel(target: float, angle: float, speed: float, kp: float, kd: float, dt: float) -> float:
    """Scalar form of `constraint_speed`."""
    return speed + kp * (target - angle) / dt - kd * speed


@vectorize(cache=True)
def constraint_speed(target, angle, speed, kp, kd, dt):  # type: ignore[no-untyped-def]
    """Speed [rad/s] at the end of a step that a constraint motor seeks, with target speed 0.

        qdot_{n+1} = qdot_n + k_p (q_target - q_n) / dt - k_d qdot_n

    An engine finds the torque, up to a limit, for which this holds together with all its other constraints. With
    k_p = k_d = 1 and enough torque the motor is at its target one step later, q_n + dt qdot_{n+1} = q_target: no
    servo, however stiff, could follow so without swinging, and none that is late at all.

    Source: the row that Bullet's joint motor for articulated bodies gives to its solver, the constraint of Tan et al.
    2018, eq. 3 ("the error at the end of the current time step"), with the error linear in the motor's present state.

    Args:
        target: motor angle asked for [rad].
        angle: motor angle q_n [rad], true and of now: the engine's motor knows no latency.
        speed: motor speed qdot_n [rad/s], likewise.
        kp: proportional gain k_p, share of the angle error taken away in a step.
        kd: derivative gain k_d, share of the speed taken away in a step.
        dt: step [s].
    """
    return constraint_speed_kernel(target, angle, speed, kp, kd, dt)
