"""State messages rt/lowstate of an emulated Go2, from sensors, motors and battery of the simulated body."""

from __future__ import annotations

from collections import deque

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.board.signals import Sensors
from surefoot.deploy.dds.low_level import HEAD, LOW_STATE, SERVO, Record, new_record
from surefoot.emulator.plant import Plant
from surefoot.rotations import quat_matrix, rpy_matrix, rpy_quat
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


class Accelerometer:
    """Simulates the specific force of the base link, R^T (a - g), from the velocities of consecutive servo steps.

    Args:
        plant: simulated body of the robot.
        latency: age of readings, rounded to servo steps [s].
        seed: seed of the noise.
    """

    def __init__(self, plant: Plant, latency: float, seed: int) -> None:
        self._plant, self._noise = plant, plant.sensors.accelerometer_noise
        self._random = generator(seed, "emulated accelerometer")
        self._step = plant.robot.timing.servo_step
        self._gravity = np.array([0.0, 0.0, plant.world.engine.gravity])
        self._mount = rpy_matrix(*plant.params.imu_mount[0]).T
        self._velocity = np.zeros(3)
        self._forces: deque[Array] = deque(maxlen=round(latency / self._step) + 1)
        self.measure()

    def measure(self) -> None:
        """Sample the force at the end of a servo step."""
        base = self._plant.world.engine.base()[0]
        acceleration, self._velocity = (base[7:] - self._velocity) / self._step, base[7:]
        self._forces.append(self._mount @ quat_matrix(base[3:7]).T @ (acceleration + self._gravity))

    def read(self) -> Array:
        """Return the reading (3,) [m/s2]."""
        force = self._forces[0]
        return force + self._noise * self._random.standard_normal(3) if self._noise else force


class StateMessage:
    """State message of a robot, reused for each state.

    Args:
        plant: simulated body of the robot.
        lead: time from the sending of a state to its use by a deployment, see `Plant.read` [s].
        seed: seed of the noise and of the initial counts of lost messages.
    """

    def __init__(self, plant: Plant, lead: float, seed: int = 0) -> None:
        self._plant, robot, motors = plant, plant.robot, plant.robot.num_motors
        latency = max(float(plant.params.control_latency[0]) - lead, 0.0)
        self.accelerometer = Accelerometer(plant, latency, seed)
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
        imu["gyroscope"], imu["accelerometer"] = sensors.angular_velocity_base, self.accelerometer.read()
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
