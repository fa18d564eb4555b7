"""State messages rt/lowstate of an emulated Go2, from sensors, motors and battery of the simulated body."""

from __future__ import annotations

import numpy as np

from surefoot.deploy.board.signals import Sensors
from surefoot.deploy.dds.low_level import HEAD, LOW_STATE, SERVO, Record, new_record
from surefoot.emulator.plant import Plant
from surefoot.rotations import rpy_quat
from surefoot.seeding import generator

CELLS = 8
FULL_CELL, EMPTY_CELL = 4.2, 3.2
"""Open-circuit voltage of a cell at 100 and 0 % charge [V], linear in between; a recorded robot had 3.83 V at 63 %."""
_IMU_TEMPERATURE = 79
_BMS_VERSION, _BMS_STATUS = (1, 16), 8
_RESERVE = 0, 525
"""Temperature of the IMU [degC], versions and status of the battery, and `reserve` of motors, from a real robot."""
_LOST_RANGE = 5, 13
"""Range of the initial counts of lost messages per motor; a recorded robot had 5 to 12."""


class StateMessage:
    """State message of a robot, reused for each state.

    Args:
        plant: simulated body of the robot, with an accelerometer.
        lead: time from the sending of a state to its use by a deployment, see `Plant.read` [s].
        seed: seed of the noise and of the initial counts of lost messages.
    """

    def __init__(self, plant: Plant, lead: float, seed: int = 0) -> None:
        self._plant, robot, motors = plant, plant.robot, plant.robot.num_motors
        self._radius = np.array([robot.urdf.links[leg.foot].collisions[0].size[0] for leg in robot.legs])
        self._stiffness = float(plant.params.contact_stiffness[0])
        self.record = record = new_record(LOW_STATE)
        self.motors = record["motor_state"][:motors]
        """Records of the robot's motors in the message (M,)."""
        self._imu, self._bms = record["imu_state"], record["bms_state"]
        record["head"] = HEAD
        self.motors["mode"], self.motors["reserve"] = SERVO, _RESERVE
        self.motors["lost"] = generator(seed, "emulated lost messages").integers(*_LOST_RANGE, motors)
        self._imu["temperature"] = _IMU_TEMPERATURE
        self._bms["version_high"], self._bms["version_low"] = _BMS_VERSION
        self._bms["status"] = _BMS_STATUS
        # Compile and load all code that the first state needs.
        self.fill(0, plant.read(0.0, lead))

    def fill(self, tick: int, sensors: Sensors) -> Record:
        """Write a state with a tick [ms] to the message, and return the message, which is always the same object."""
        plant, record, imu, motors, bms = self._plant, self.record, self._imu, self.motors, self._bms
        attitude = sensors.roll_pitch_yaw.tolist()
        imu["quaternion"], imu["rpy"] = rpy_quat(*attitude), attitude
        imu["gyroscope"], imu["accelerometer"] = sensors.angular_velocity_base, sensors.accelerometer
        motors["q"], motors["dq"], motors["tau_est"] = sensors.motor_angle, sensors.motor_velocity, sensors.motor_torque
        motors["temperature"] = np.clip(sensors.temperature, 0, 255)
        # The contact is a spring: force = stiffness * penetration [N]. Foot forces of a real robot have no unit.
        depth = self._radius - plant.world.engine.foot_positions()[0, :, 2]
        record["foot_force"] = np.clip(self._stiffness * depth, 0, 32767)
        charge = (plant.open_circuit / CELLS - EMPTY_CELL) / (FULL_CELL - EMPTY_CELL)
        bms["soc"] = min(max(round(100 * charge), 0), 100)
        bms["current"] = round(-1000 * plant.current)
        bms["cell_vol"][:CELLS] = round(1000 * sensors.voltage / CELLS)
        record["power_v"], record["power_a"] = sensors.voltage, plant.current
        record["tick"] = tick
        return record
