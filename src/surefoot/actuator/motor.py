"""The DC motor: duty and speed to current, current to torque, friction and overheating."""

from __future__ import annotations

import math

from numba import guvectorize, njit, vectorize

from surefoot.arrays import Array

STICTION_SPEED = 0.1
"""Speed [rad/s] over which Coulomb friction changes sign; a sharp sign would chatter at a 1 ms step."""


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
