"""Sensor readings of a robot, in the form that simulations give them to a policy and an estimator."""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.messages import State
from surefoot.world.interface import SensorReadings


def sensor_readings(state: State, time: float, motor_torque: Array) -> SensorReadings:
    """Return the readings of a state, as a batch of one, without the accelerometer: a simulation has none.

    Args:
        state: state of the robot.
        time: time since the start of the episode [s].
        motor_torque: motor torques (M,) at the time of the other readings [N m], see `TorqueDelay`; or the state's.
    """
    return SensorReadings(
        time=np.array([time]),
        roll_pitch_yaw=state.roll_pitch_yaw[None],
        angular_velocity_base=state.angular_velocity_base[None],
        motor_angle=state.motor_angle[None],
        motor_velocity=state.motor_velocity[None],
        motor_torque=motor_torque[None],
    )
