"""Models of sensors, battery and motor heat of an emulated robot, in addition to `PhysicalParams`.

All values are assumptions typical of data sheets of such parts; none was measured on a robot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from numba import njit

from surefoot.arrays import Array
from surefoot.robot import RobotDescription
from surefoot.robot.actuator import HEAT_LOSS
from surefoot.robot.data_sheet import Battery, Heat
from surefoot.world.actuation import ActuationState


@dataclass(frozen=True)
class SensorConfig:
    """Errors of encoders, IMU and current sensors. Bias and noise of roll and pitch are physical parameters."""

    encoder_step: float = 2 * math.pi / 2**14
    """Resolution of the motor angles [rad]: 14 bits per turn, as in magnetic encoders like the AS5047."""
    speed_noise: float = 0.05
    """Standard deviation of the motor speeds [rad/s]: differences of 14-bit angles over 1 ms have a resolution of
    0.38 rad/s, and a microcontroller's filter leaves about an eighth of it."""
    gyro_noise: float = 0.003
    """Standard deviation of the angular velocity [rad/s]: 0.01 deg/s/sqrt(Hz) over a bandwidth of 300 Hz."""
    gyro_bias: float = 0.005
    """Standard deviation of the gyro's constant bias [rad/s], sampled once: about 0.3 deg/s after calibration."""
    torque_noise: float = 0.02
    """Standard deviation of the motor torques [N m], from phase currents with noise of about 0.2 A at 0.1 N m/A."""
    torque_gain: float = 0.01
    """Standard deviation of the constant relative error of each motor's torque, sampled once: errors of current sense
    resistors (1 % parts) and of the torque curve after calibration."""
    accelerometer_noise: float = 0.03
    """Standard deviation of the specific force [m/s2]: 180 ug/sqrt(Hz) over a bandwidth of 300 Hz."""

    @classmethod
    def ideal(cls) -> SensorConfig:
        """Return sensors without errors."""
        return cls(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class PowerConfig(NamedTuple):
    """Parameters of battery and motor heat; the defaults apply to data sheets without these values."""

    battery_resistance: float = Battery.resistance
    """Internal resistance [Ohm]."""
    battery_capacity: float = 3600.0 * Battery.capacity
    """Usable charge [C]."""
    battery_drop: float = Battery.drop
    """Decrease of the open-circuit voltage from full to empty [V], assumed to be linear."""
    ambient: float = 25.0
    """Air temperature, and initial temperature of the motors [degC]."""
    heat_capacity: float = Heat.capacity
    """Heat capacity of one motor [J/K]."""
    heat_resistance: float = Heat.resistance
    """Thermal resistance from winding to air [K/W]."""

    @classmethod
    def from_robot(cls, robot: RobotDescription) -> PowerConfig:
        """Return the values of a robot's data sheet."""
        battery, heat = robot.battery, robot.heat
        return cls(
            battery_resistance=battery.resistance,
            battery_capacity=3600.0 * battery.capacity,
            battery_drop=battery.drop,
            heat_capacity=heat.capacity,
            heat_resistance=heat.resistance,
        )

    @classmethod
    def ideal(cls, robot: RobotDescription | None = None) -> PowerConfig:
        """Return a battery with constant voltage; motors still heat up, as in the robot's data sheet if given."""
        power = cls() if robot is None else cls.from_robot(robot)
        return power._replace(battery_resistance=0.0, battery_capacity=math.inf)


@njit(cache=True)
def power_tick(state: ActuationState, power: PowerConfig, dt: float, temperature: Array) -> float:
    """Update the motor temperatures over one step; return the current drawn from the battery [A].

    A motor's current I follows from its torque by inverting the torque table; where the table is flat, the smallest
    current is used. At speed w the motor draws the power I (R I + K_t w) from the battery; R I^2 becomes heat:

        C dT/dt = R I^2 - (T - T_air) / R_heat

    For a joint actuator, heat is the fraction `HEAT_LOSS` of its power at maximum torque and the highest speed with
    that torque, times the square of torque relative to the limit.

    Args:
        state: state of one robot after the step.
        power: C, T_air and R_heat.
        dt: duration of the step [s].
        temperature: motor temperatures (M,) [degC]; updated in place.
    """
    motors, total = len(temperature), 0.0
    table_current, table_torque = state.table_current, state.table_torque
    for m in range(motors):
        torque, speed = state.motor_torque[0, m], state.sample[0, motors + m]
        if state.joint[0]:
            limit, full = state.max_torque[0, m], state.joint_limits[0, m]
            heat = HEAT_LOSS * limit * full * (torque / limit) ** 2
            work = torque * speed
        else:
            strength = state.strength[0, m]
            nominal = abs(torque) / strength if strength > 0.0 else 0.0
            current = table_current[-1]
            for k in range(len(table_torque) - 1):
                if nominal <= table_torque[k + 1]:
                    rise = table_torque[k + 1] - table_torque[k]
                    fraction = (nominal - table_torque[k]) / rise if rise > 0.0 else 0.0
                    current = table_current[k] + fraction * (table_current[k + 1] - table_current[k])
                    break
            current = math.copysign(current, torque)
            heat = state.resistance[0] * current * current
            work = current * state.torque_constant[0] * speed
        total += heat + work
        temperature[m] += dt / power.heat_capacity * (heat - (temperature[m] - power.ambient) / power.heat_resistance)
    return total / state.voltage[0]
