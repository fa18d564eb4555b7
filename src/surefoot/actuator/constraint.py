"""The position motor of physics engines: a constraint on the motor's state at the end of the step."""

from __future__ import annotations

from numba import njit


@njit(cache=True, inline="always")
def constraint_speed_kernel(target: float, angle: float, kp: float, kd: float, dt: float) -> float:
    """Return the speed [rad/s] at the end of a step for which a constraint motor's error is zero.

        e_{n+1} = k_p (q_target - q_{n+1}) - k_d qdot_{n+1} = 0,    q_{n+1} = q_n + dt qdot_{n+1}

    An engine finds the torque, up to `constraint_torque_kernel`, for which this holds together with all its other
    constraints. With the servo's gains the motor approaches its target with the time constant k_d / k_p + dt,
    independent of the load, and never overshoots: the servo sets a voltage, this motor a motion.

    Source: Tan et al. 2018, eq. 4, with target speed 0. Bullet's motor for the joints of articulated bodies meets it
    with position gain k_p dt / (k_p dt + k_d) and velocity gain 1.

    Args:
        target: commanded motor angle [rad].
        angle: motor angle q_n, true and present: the engine's motor has no latency [rad].
        kp: the servo's proportional gain [1/rad].
        kd: the servo's derivative gain [s/rad].
        dt: step [s].
    """
    return kp * (target - angle) / (kp * dt + kd) if kp > 0.0 else 0.0


@njit(cache=True, inline="always")
def constraint_torque_kernel(voltage: float, torque_constant: float, resistance: float, strength: float) -> float:
    """Return the greatest torque [N m] of a constraint motor: strength K_t V / R, at any speed.

    This is the stall torque of an ideal DC motor: a simulator without a model of the motor has neither saturation nor
    back-EMF. Tan et al. 2018 do not state their limit.

    Args:
        voltage: battery voltage V [V].
        torque_constant: K_t [N m/A].
        resistance: armature resistance R [Ohm].
        strength: ratio to the nominal motor.
    """
    return strength * torque_constant * voltage / resistance
