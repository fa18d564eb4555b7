"""Servo, DC motor, joint actuator, friction, overheating; the constraint motor of physics engines."""

from __future__ import annotations

import math

from numba import guvectorize, njit, vectorize

from surefoot.arrays import Array

STICTION_SPEED = 0.1
"""Speed [rad/s] over which Coulomb friction changes sign; a sharp sign would chatter at a 1 ms step."""


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
        angle: motor angle as the servo reads it, `servo_latency` old [rad].
        speed: motor speed as the servo reads it, equally old [rad/s].
        kp: proportional gain [1/rad].
        kd: derivative gain [s/rad].

    Returns:
        Duty in [-1, 1], in the arguments' common shape.
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

    Source: Tan et al. 2018, eq. 5 and 6; the clip stands for the diodes of the motor controller.

    Args:
        duty: PWM duty in [-1, 1].
        speed: true present motor speed [rad/s]; back-EMF has no latency.
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
            share = (magnitude - table_current[k]) / (table_current[k + 1] - table_current[k])
            torque = table_torque[k] + share * (table_torque[k + 1] - table_torque[k])
            break
    return math.copysign(torque * strength, current)


@guvectorize(["void(float64, float64, float64[:], float64[:], float64[:])"], "(),(),(n),(n)->()", cache=True)
def motor_torque(current, strength, table_current, table_torque, torque):  # type: ignore[no-untyped-def]
    """Return the torque [N m] of the saturating motor: sign(I) table(|I|) strength, flat beyond the table's last point.

    Source: Tan et al. 2018, section V-A ("piece-wise linear function"), after De and Koditschek 2015.

    Args:
        current: armature current [A], any shape.
        strength: ratio to the nominal motor, broadcast.
        table_current: rising currents of the curve, from 0 [A], (n,).
        table_torque: their torques [N m], (n,).
        torque: output, as every NumPy ufunc takes it; leave it out.
    """
    torque[0] = motor_torque_kernel(current, strength, table_current, table_torque)


@njit(cache=True, inline="always")
def motor_friction_kernel(speed: float, coulomb: float, viscous: float) -> float:
    """Return `motor_friction` for scalars."""
    torque = -coulomb * math.tanh(speed / STICTION_SPEED) if coulomb > 0.0 else 0.0
    return torque - viscous * speed if viscous > 0.0 else torque


@vectorize(cache=True)
def motor_friction(speed, coulomb, viscous):  # type: ignore[no-untyped-def]
    """Return the friction torque [N m] of a motor, Coulomb and viscous: -f tanh(qdot / v_s) - b qdot.

    With v_s = `STICTION_SPEED`, Coulomb friction is within 0.2 % of -f sign(qdot) above 4 v_s = 0.4 rad/s. A motor at
    rest creeps instead of sticking: under a load of half the friction it turns at .055 rad/s. Taken at the start of a
    step of dt, friction brakes a motor that turns an inertia J without overshoot as long as (f / v_s + b) dt < J.

    Args:
        speed: motor speed [rad/s].
        coulomb: magnitude f [N m].
        viscous: coefficient b [N m s/rad].
    """
    return motor_friction_kernel(speed, coulomb, viscous)


@njit(cache=True, inline="always")
def presliding_kernel(stretch: float, greatest: float) -> float:
    """Return the stretch z [rad] of a friction that sticks, cut at its greatest one z_m.

    Friction is -f z / z_m: a spring that follows the motor's motion, and slides along at the Coulomb friction f (Dahl's
    model, 1968, with a straight rise). Unlike `motor_friction` it holds a motor at rest under any load below f.

    Args:
        stretch: z of the last step, and the motion since then [rad].
        greatest: z_m [rad].
    """
    return greatest if stretch > greatest else -greatest if stretch < -greatest else stretch


@njit(cache=True, inline="always")
def joint_torque_kernel(target: float, angle: float, speed: float, kp: float, kd: float) -> float:
    """Return `joint_torque` for scalars."""
    return kp * (target - angle) - kd * speed


@vectorize(cache=True)
def joint_torque(target, angle, speed, kp, kd):  # type: ignore[no-untyped-def]
    """Return the torque [N m] of a joint actuator's PD controller, before its limit: k_p (q_target - q) - k_d qdot.

    Args:
        target: commanded angle [rad].
        angle: angle as the actuator reads it, `servo_latency` old [rad].
        speed: speed as it reads it, equally old and filtered [rad/s].
        kp: proportional gain [N m/rad].
        kd: derivative gain [N m s/rad].
    """
    return joint_torque_kernel(target, angle, speed, kp, kd)


@njit(cache=True, inline="always")
def joint_limit_kernel(torque: float, speed: float, limit: float, corner_speed: float, no_load_speed: float) -> float:
    """Return a joint actuator's torque [N m] within its limit at a speed.

    A braking actuator has its whole torque. A driving one has it up to `corner_speed`; from there the torque falls
    linearly to zero at `no_load_speed`, where the supply's voltage is used up.

    Args:
        torque: torque of the controller [N m].
        speed: present speed [rad/s].
        limit: greatest torque [N m].
        corner_speed: speed up to which a driving motor has it [rad/s].
        no_load_speed: speed at which a driving motor has no torque [rad/s].
    """
    available = limit
    if torque * speed > 0.0 and abs(speed) > corner_speed:
        share = (no_load_speed - abs(speed)) / (no_load_speed - corner_speed) if no_load_speed > corner_speed else 0.0
        available = limit * (share if share > 0.0 else 0.0)
    # Compiled min and max would turn NaN into a torque.
    return available if torque > available else -available if torque < -available else torque


@njit(cache=True, inline="always")
def overheat_kernel(torque: float, hot_time: float, dt: float, limit: float) -> float:
    """Return the time [s] that a motor has been over its thermal torque limit without a break.

    The motor is switched off, until the next reset, once this time passes the robot's `overheat_time`
    (thermal protection in the robot's published model).

    Args:
        torque: motor torque of this servo step [N m].
        hot_time: the same time one servo step ago [s].
        dt: servo step [s].
        limit: torque limit [N m].
    """
    return hot_time + dt if abs(torque) > limit else 0.0


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
