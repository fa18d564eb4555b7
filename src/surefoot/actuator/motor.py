"""Models of servo, DC motor, joint actuator, friction and overheating, and the constraint motor of physics engines."""

from __future__ import annotations

import math

from numba import guvectorize, njit, vectorize

from surefoot.arrays import Array

STICTION_SPEED = 0.1
"""Speed scale [rad/s] of the smoothed sign of Coulomb friction; a sharp sign would chatter at a 1 ms step."""


@njit(cache=True, inline="always")
def servo_duty_kernel(target: float, angle: float, speed: float, kp: float, kd: float) -> float:
    """Return `servo_duty` for scalars."""
    duty = kp * (target - angle) - kd * speed
    # Explicit comparisons, because compiled min and max would turn NaN into full duty.
    return 1.0 if duty > 1.0 else -1.0 if duty < -1.0 else duty


@vectorize(cache=True)
def servo_duty(target, angle, speed, kp, kd):  # type: ignore[no-untyped-def]
    """Return the PWM duty of a PD servo whose target speed is zero: clip(k_p (q_target - q) - k_d qdot, -1, 1).

    Source: Tan et al. 2018, eq. 7, with the duty limited as in the robot's published model.

    Args:
        target: commanded motor angle [rad].
        angle: motor angle as read by the servo, delayed by `servo_latency` [rad].
        speed: motor speed as read by the servo, with the same delay [rad/s].
        kp: proportional gain [1/rad].
        kd: derivative gain [s/rad].

    Returns:
        Duty in [-1, 1], in the broadcast shape of the arguments.
    """
    return servo_duty_kernel(target, angle, speed, kp, kd)


@njit(cache=True, inline="always")
def motor_current_kernel(
    duty: float, speed: float, voltage: float, torque_constant: float, resistance: float, voltage_clip: float
) -> float:
    """Return `motor_current` for scalars."""
    net = duty * voltage - torque_constant * speed
    if net > voltage_clip:
        net = voltage_clip
    elif net < -voltage_clip:
        net = -voltage_clip
    return net / resistance


@vectorize(cache=True)
def motor_current(duty, speed, voltage, torque_constant, resistance, voltage_clip):  # type: ignore[no-untyped-def]
    """Return the armature current [A]: clip(duty V - K_t qdot, +-clip) / R.

    Source: Tan et al. 2018, eq. 5 and 6; the clip models the diodes of the motor controller.

    Args:
        duty: PWM duty in [-1, 1].
        speed: true current motor speed [rad/s]; back-EMF has no latency.
        voltage: battery voltage V [V].
        torque_constant: K_t [N m/A], also the back-EMF constant [V s/rad].
        resistance: R [Ohm].
        voltage_clip: limit of the net voltage [V].
    """
    return motor_current_kernel(duty, speed, voltage, torque_constant, resistance, voltage_clip)


@njit(cache=True, inline="always")
def motor_torque_kernel(current: float, strength: float, table_current: Array, table_torque: Array) -> float:
    """Return `motor_torque` for scalars."""
    magnitude = abs(current)
    if math.isnan(magnitude):
        return magnitude
    last = len(table_current) - 1
    torque = table_torque[last]
    for k in range(last):
        if magnitude <= table_current[k + 1]:
            weight = (magnitude - table_current[k]) / (table_current[k + 1] - table_current[k])
            torque = table_torque[k] + weight * (table_torque[k + 1] - table_torque[k])
            break
    return math.copysign(torque * strength, current)


@guvectorize(["void(float64, float64, float64[:], float64[:], float64[:])"], "(),(),(n),(n)->()", cache=True)
def motor_torque(current, strength, table_current, table_torque, torque):  # type: ignore[no-untyped-def]
    """Return the torque [N m] of a saturating motor: sign(I) table(|I|) strength, constant beyond the last table entry.

    Source: Tan et al. 2018, section V-A ("piece-wise linear function"), after De and Koditschek 2015.

    Args:
        current: armature current [A], any shape.
        strength: torque relative to the nominal motor, broadcast.
        table_current: rising currents of the table, from 0 [A], (n,).
        table_torque: torques at these currents [N m], (n,).
        torque: optional output array, as in every NumPy ufunc.
    """
    torque[0] = motor_torque_kernel(current, strength, table_current, table_torque)


@njit(cache=True, inline="always")
def motor_friction_kernel(speed: float, coulomb: float, viscous: float) -> float:
    """Return `motor_friction` for scalars."""
    torque = -coulomb * math.tanh(speed / STICTION_SPEED) if coulomb > 0.0 else 0.0
    return torque - viscous * speed if viscous > 0.0 else torque


@vectorize(cache=True)
def motor_friction(speed, coulomb, viscous):  # type: ignore[no-untyped-def]
    """Return the Coulomb and viscous friction torque [N m] of a motor: -f tanh(qdot / v_s) - b qdot.

    With v_s = `STICTION_SPEED`, Coulomb friction is within 0.2 % of -f sign(qdot) above 4 v_s = 0.4 rad/s. A motor
    creeps instead of sticking: under a load of half the friction it turns at 0.055 rad/s. Evaluated at the start of a
    step dt, friction brakes a motor with inertia J without overshoot as long as (f / v_s + b) dt < J.

    Args:
        speed: motor speed [rad/s].
        coulomb: magnitude f [N m].
        viscous: coefficient b [N m s/rad].
    """
    return motor_friction_kernel(speed, coulomb, viscous)


@njit(cache=True, inline="always")
def presliding_kernel(stretch: float, max_stretch: float) -> float:
    """Return the presliding stretch z [rad] of a sticking friction, limited to its maximum z_m.

    The friction torque is -f z / z_m: a spring that follows the motion of the motor, and slides once it reaches the
    Coulomb friction f (Dahl's model, 1968, with a linear rise). Unlike `motor_friction`, it holds a motor at rest under
    any load below f.

    Args:
        stretch: z of the last step plus the motion since then [rad].
        max_stretch: z_m [rad].
    """
    return max_stretch if stretch > max_stretch else -max_stretch if stretch < -max_stretch else stretch


@njit(cache=True, inline="always")
def joint_torque_kernel(target: float, angle: float, speed: float, kp: float, kd: float) -> float:
    """Return `joint_torque` for scalars."""
    return kp * (target - angle) - kd * speed


@vectorize(cache=True)
def joint_torque(target, angle, speed, kp, kd):  # type: ignore[no-untyped-def]
    """Return the unlimited torque [N m] of a joint actuator's PD controller: k_p (q_target - q) - k_d qdot.

    Args:
        target: commanded angle [rad].
        angle: angle as read by the actuator, delayed by `servo_latency` [rad].
        speed: filtered speed as read by the actuator, with the same delay [rad/s].
        kp: proportional gain [N m/rad].
        kd: derivative gain [N m s/rad].
    """
    return joint_torque_kernel(target, angle, speed, kp, kd)


@njit(cache=True, inline="always")
def joint_limit_kernel(torque: float, speed: float, limit: float, corner_speed: float, no_load_speed: float) -> float:
    """Return the torque [N m] of a joint actuator, limited by its torque-speed curve.

    A braking actuator has its full torque. A driving actuator has it up to `corner_speed`; above, the limit falls
    linearly to zero at `no_load_speed`, where the back-EMF equals the supply voltage.

    Args:
        torque: torque demanded by the controller [N m].
        speed: current speed [rad/s].
        limit: maximum torque [N m].
        corner_speed: speed up to which a driving motor has its maximum torque [rad/s].
        no_load_speed: speed at which a driving motor has no torque left [rad/s].
    """
    available = limit
    if torque * speed > 0.0 and abs(speed) > corner_speed:
        ratio = (no_load_speed - abs(speed)) / (no_load_speed - corner_speed) if no_load_speed > corner_speed else 0.0
        available = limit * (ratio if ratio > 0.0 else 0.0)
    # Explicit comparisons, because compiled min and max would turn NaN into a torque.
    return available if torque > available else -available if torque < -available else torque


@njit(cache=True, inline="always")
def overheat_kernel(torque: float, hot_time: float, dt: float, limit: float) -> float:
    """Return the time [s] for which a motor has continuously exceeded its thermal torque limit.

    Once this time exceeds the robot's `overheat_time`, the motor is switched off until the next reset (thermal
    protection in the robot's published model).

    Args:
        torque: motor torque of this servo step [N m].
        hot_time: value of the previous servo step [s].
        dt: servo step [s].
        limit: torque limit [N m].
    """
    return hot_time + dt if abs(torque) > limit else 0.0


@njit(cache=True, inline="always")
def constraint_speed_kernel(target: float, angle: float, kp: float, kd: float, dt: float) -> float:
    """Return the speed [rad/s] of a constraint motor at the end of a step, for which its error is zero.

        e_{n+1} = k_p (q_target - q_{n+1}) - k_d qdot_{n+1} = 0,    q_{n+1} = q_n + dt qdot_{n+1}

    The physics engine solves for the torque, up to `constraint_torque_kernel`, that satisfies this together with all
    other constraints. With the servo's gains, the motor approaches its target with the time constant k_d / k_p + dt,
    independent of the load, and never overshoots: a servo sets a voltage, a constraint motor sets the motion.

    Source: Tan et al. 2018, eq. 4, with target speed 0. Bullet's motor for joints of articulated bodies is equivalent,
    with position gain k_p dt / (k_p dt + k_d) and velocity gain 1.

    Args:
        target: commanded motor angle [rad].
        angle: true current motor angle q_n [rad]; the motor of an engine has no latency.
        kp: proportional gain of the servo [1/rad].
        kd: derivative gain of the servo [s/rad].
        dt: time step [s].
    """
    return kp * (target - angle) / (kp * dt + kd) if kp > 0.0 else 0.0


@njit(cache=True, inline="always")
def constraint_torque_kernel(voltage: float, torque_constant: float, resistance: float, strength: float) -> float:
    """Return the maximum torque [N m] of a constraint motor, which is independent of speed: strength K_t V / R.

    This is the stall torque of an ideal DC motor, because a simulator without a motor model has neither saturation nor
    back-EMF. Tan et al. 2018 do not state their limit.

    Args:
        voltage: battery voltage V [V].
        torque_constant: K_t [N m/A].
        resistance: armature resistance R [Ohm].
        strength: torque relative to the nominal motor.
    """
    return strength * torque_constant * voltage / resistance
