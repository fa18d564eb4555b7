"""Simulated body of an emulated robot: physics, battery, motor heat and sensors."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from surefoot.actuator.motor import joint_torque, servo_duty
from surefoot.arrays import Array
from surefoot.deploy.board.signals import MotorCommand, Sensors, Vitals
from surefoot.deploy.messages import Mode
from surefoot.emulator.accelerometer import Accelerometer
from surefoot.emulator.hardware import PowerConfig, SensorConfig, power_tick
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.seeding import generator
from surefoot.world.actuation import read_delayed, read_imu
from surefoot.world.ground import FLAT, Ground
from surefoot.world.interface import WorldConfig
from surefoot.world.registry import DEFAULT_WORLD
from surefoot.world.sim_world import SimWorld


@dataclass(frozen=True)
class CaptureSample:
    """Sample of a motion capture system and foot switches."""

    position: Array
    """Position (3,) of the base link's origin in the world [m]."""
    quat: Array
    """Orientation (4,) of the base link in the world, w x y z."""
    contact_ticks: Array
    """Number of servo steps with ground contact for each foot (L,), since the robot was switched on."""


@dataclass(frozen=True)
class JointCommand:
    """Command to joint actuators (M,): torque = feedforward + kp (angle - q) + kd (speed - dq).

    Units: rad, rad/s, N m, N m/rad, N m s/rad. The torque is limited by the actuator.
    """

    angle: Array
    speed: Array
    feedforward: Array
    kp: Array
    kd: Array


class Plant:
    """Simulated body of one robot, which starts in the sitting pose with damped motors. Steps are servo steps.

    Args:
        robot: description of the robot.
        params: physical parameters, one row. Default to nominal; the control step is set by the host and not used.
        seed: seed of all noise.
        sensors: errors of the sensors.
        power: battery and motor heat. Default to the data sheet's.
        rack: whether to hold the base in the air.
        engine: name of the physics engine in the registry of worlds.
        servo_every: number of physics steps per servo step.
        ground: ground on which the robot sits.
        accelerometer: whether its IMU reports the specific force.

    Raises:
        SurefootError: invalid parameters, or a robot that does not come to rest in the sitting pose.
    """

    def __init__(
        self,
        robot: RobotDescription,
        params: PhysicalParams | None = None,
        seed: int = 0,
        sensors: SensorConfig | None = None,
        power: PowerConfig | None = None,
        rack: bool = False,
        engine: str = DEFAULT_WORLD,
        servo_every: int = 1,
        ground: Ground = FLAT,
        accelerometer: bool = False,
    ) -> None:
        self.robot, self.params = robot, params or PhysicalParams.nominal(robot)
        self.sensors, self.power = sensors or SensorConfig(), power or PowerConfig.from_robot(robot)
        self.servo_every = servo_every
        config = WorldConfig(rest=robot.poses.sit, rack=rack, ground=ground, threads=1)
        self.world = SimWorld(robot, 1, self.params, seed, config, engine)
        self.extra_latency = self.voltage_drop = 0.0
        """Additional age of all readings [s], and additional decrease of the open-circuit voltage [V]."""
        motors = robot.num_motors
        self._noise = generator(seed, "emulated sensors")
        self._gyro_bias = self.sensors.gyro_bias * self._noise.standard_normal(3)
        self._torque_noise = generator(seed, "emulated torque sensors")
        self._torque_gain = 1.0 + self.sensors.torque_gain * self._torque_noise.standard_normal(motors)
        self._imu_noise = float(self.params.imu_noise[0])
        self.start_voltage = float(self.params.voltage[0]) if robot.actuator.kind == "dc" else robot.battery.nominal
        """Initial open-circuit voltage of the battery [V]."""
        self.world.actuation.voltage[0] = self.start_voltage
        self._count = np.ones(1, np.int64)
        self._row = np.empty(2 * motors + 6)
        self.temperature = np.full(motors, self.power.ambient)
        self.energy = self.current = self._used = 0.0
        steps = round(float(self.params.servo_latency[0]) / robot.timing.servo_step)
        self._torques: deque[Array] = deque(maxlen=max(steps, 1))
        """Torques of the last servo steps, for a microcontroller with its own servos."""
        self._contact = np.zeros(len(robot.legs))
        self._accelerometer: Accelerometer | None = None
        if accelerometer:
            gravity, noise = self.world.engine.gravity, self.sensors.accelerometer_noise
            self._accelerometer = Accelerometer(robot, self.params, gravity, noise, seed, self.world.engine.base()[0])
        self._command: MotorCommand | JointCommand
        self._apply(MotorCommand(Mode.DISARMED, np.zeros(motors)))
        # Load compiled code before the first step; the physics was already run by the world.
        self._delayed_state(0.0, 0.0)
        self._draw_power(np.zeros(motors))

    @property
    def _seconds(self) -> Array:
        return np.asarray(self.world.actuation.ticks * self.robot.timing.servo_step, np.float64)

    @property
    def ticks(self) -> int:
        """Servo steps since the robot was switched on."""
        return int(self.world.actuation.ticks[0])

    @property
    def voltage(self) -> float:
        """Battery voltage under load [V]."""
        return float(self.world.actuation.voltage[0])

    @property
    def open_circuit(self) -> float:
        """Open-circuit voltage of the battery [V]."""
        used = self.power.battery_drop * self._used / self.power.battery_capacity
        return self.start_voltage - self.voltage_drop - used

    def step(self, command: MotorCommand | JointCommand, count: int = 1) -> None:
        """Run `count` servo steps with one command; update battery and temperatures after the last one.

        If the servo runs less often than the physics, `count` must be 1, and joint commands are not supported.

        Raises:
            SurefootError: the physics diverged.
        """
        world, actuation = self.world, self.world.actuation
        if command is not self._command:
            self._apply(command)
        slow = self.servo_every > 1 and self.ticks % self.servo_every == 0
        if slow and isinstance(command, MotorCommand) and command.mode != Mode.PWM:
            seen = self._delayed_state(0.0, float(self.params.servo_latency[0]))
            motors = self.robot.num_motors
            actuation.duty[0] = self._duty(command.values, seen[:motors], seen[motors : 2 * motors])
        self._count[0] = count
        world.engine.advance(self._count)
        if world.engine.diverged[0]:
            raise SurefootError(f"the physics of the emulated robot diverged after {self.ticks} servo steps")
        self.energy += float(actuation.energy[0])
        self._contact += actuation.contact_ticks[0]
        if self._accelerometer is not None:
            self._accelerometer.measure(world.engine.base()[0], count)
        self._draw_power(self.temperature, count)

    def _apply(self, command: MotorCommand | JointCommand) -> None:
        actuation, none = self.world.actuation, np.zeros(self.robot.num_motors)
        self._command = command
        if isinstance(command, JointCommand):
            actuation.target[0], actuation.kp[0], actuation.kd[0] = command.angle, command.kp, command.kd
            # A joint actuator adds its duty, relative to the maximum torque, to the torque of its PD law.
            actuation.duty[0] = (command.feedforward + command.kd * command.speed) / actuation.max_torque[0]
            return
        position, pwm = command.mode == Mode.POSITION, command.mode == Mode.PWM
        if position:
            self._gains = self.params.servo_kp[0], self.params.servo_kd[0]
        else:
            # Damped motors have the servo's derivative gain: with twice the gain and delayed speeds, they oscillate.
            self._gains = none, none if pwm else np.asarray(self.robot.actuator.kd)
        actuation.duty[0] = command.values if pwm else 0.0
        actuation.target[0] = command.values if position else 0.0
        # A servo that runs less often than the physics is computed in `step`; its duty is constant in between.
        actuation.kp[0], actuation.kd[0] = self._gains if self.servo_every == 1 else (none, none)

    def _duty(self, target: Array, angle: Array, speed: Array) -> Array:
        """Return the output of the servos: duties of DC motors, or torques of joint actuators relative to the limit."""
        if self.robot.actuator.kind == "dc":
            return np.asarray(servo_duty(target, angle, speed, *self._gains))
        return np.asarray(joint_torque(target, angle, speed, *self._gains) / self.world.actuation.max_torque[0])

    def _draw_power(self, temperature: Array, count: int = 1) -> None:
        actuation, power, dt = self.world.actuation, self.power, count * self.robot.timing.servo_step
        self.current = power_tick(actuation, power, dt, temperature)
        self._used += self.current * dt
        actuation.voltage[0] = max(self.open_circuit - power.battery_resistance * self.current, 1.0)

    def _delayed_state(self, since_step: float, latency: float) -> Array:
        """Return the state `latency` [s] ago; the present time is `since_step` [s] after the last servo step."""
        read_delayed(self.world.actuation, np.array([latency - since_step]), self._row[None])
        return self._row

    def vitals(self) -> Vitals:
        """Return the present readings that the microcontroller checks."""
        now, motors = self.world.actuation.sample[0], self.robot.num_motors
        tilt, rate = now[-6:-3].copy(), now[-3:].copy()
        read_imu(tilt[None], rate[None], self._seconds, self.params)
        return Vitals(
            motor_angle=now[:motors],
            # numpy's maximum propagates NaN, Python's may not.
            tilt=float(np.abs(tilt[:2]).max()),
            voltage=self.voltage,
            temperature=float(self.temperature.max()),
        )

    def servo_readings(self) -> Sensors:
        """Return the readings of a microcontroller with its own servos; call once per servo step.

        Angles, speeds and torques are delayed by the servo latency.
        """
        actuation, motors = self.world.actuation, self.robot.num_motors
        seen = self._delayed_state(0.0, float(self.params.servo_latency[0])).copy()
        now, speed = actuation.sample[0].copy(), seen[motors : 2 * motors]
        self._torques.append(actuation.motor_torque[0].copy())
        tilt, rate = now[-6:-3], now[-3:]
        read_imu(tilt[None], rate[None], self._seconds, self.params)
        if actuation.joint[0]:
            # Joint actuators filter the speed; this is the filtered value at the end of the step.
            step = self.robot.timing.servo_step
            weight = step / (float(actuation.speed_filter[0]) + step)
            speed = actuation.filtered_speed[0] + weight * (speed - actuation.filtered_speed[0])
        return Sensors(
            motor_angle=seen[:motors],
            motor_velocity=speed,
            motor_torque=self._torques[0],
            roll_pitch_yaw=tilt,
            angular_velocity_base=rate,
            energy=self.energy,
            voltage=self.voltage,
            temperature=self.temperature,
        )

    def read(self, since_step: float, lead: float) -> Sensors:
        """Return noisy sensor readings, delayed by the control latency minus `lead` [s].

        The last servo step ended `since_step` [s] ago.
        """
        latency = max(float(self.params.control_latency[0]) + self.extra_latency - lead, 0.0)
        row, motors = self._delayed_state(since_step, latency).copy(), self.robot.num_motors
        config, noise = self.sensors, self._noise
        angle, speed, tilt, rate = row[:motors], row[motors : 2 * motors], row[-6:-3], row[-3:]
        if config.encoder_step:
            angle = np.round(angle / config.encoder_step) * config.encoder_step
        if config.speed_noise:
            speed = speed + config.speed_noise * noise.standard_normal(motors)
        read_imu(tilt[None], rate[None], self._seconds, self.params)
        if self._imu_noise:
            tilt[:2] += self._imu_noise * noise.standard_normal(2)
        rate = rate + self._gyro_bias
        if config.gyro_noise:
            rate = rate + config.gyro_noise * noise.standard_normal(3)
        torque = self._torque_gain * self.world.actuation.motor_torque[0]
        if config.torque_noise:
            torque += config.torque_noise * self._torque_noise.standard_normal(motors)
        return Sensors(
            motor_angle=angle,
            motor_velocity=speed,
            motor_torque=torque,
            roll_pitch_yaw=tilt,
            angular_velocity_base=rate,
            energy=self.energy,
            voltage=self.voltage,
            temperature=self.temperature.copy(),
            accelerometer=self._accelerometer.read(latency) if self._accelerometer is not None else None,
        )

    def capture(self) -> CaptureSample:
        """Return the present sample of motion capture and foot switches."""
        base = self.world.engine.base()[0]
        return CaptureSample(base[:3].copy(), base[3:7].copy(), self._contact.copy())

    def push(self, force_world: Array) -> None:
        """Set the external force (3,) on the base's centre of mass from now on [N]."""
        self.world.push(force_world[None])
