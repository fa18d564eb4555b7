"""Injection of faults into an emulated robot: its body, sensors, motor commands and packets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.board.signals import MotorCommand, Sensors
from surefoot.deploy.messages import Handshake, Mode, Packet, State
from surefoot.emulator.fault_table import LINE_FAULTS, InjectedFault
from surefoot.emulator.plant import Plant

TILT_FORCE, TILT_TIME = 1.1, 0.4
"""Force of the push that topples a robot, relative to its weight, and its duration [s]."""
VOLTAGE_FALL_RATE, HEATING_RATE = 2.0, 40.0
"""Rates at which the battery voltage falls [V/s] and the motor temperature rises [degC/s]."""
_IMU_SIGNS = {1: (-1, 1), 2: (1, -1), 3: (-1, -1)}


def flip_bits(data: bytes, random: np.random.Generator, first: int = 0) -> bytes:
    """Flip one to three random bits, at bit `first` or later."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    bits[first + random.choice(len(bits) - first, int(random.integers(1, 4)), replace=False)] ^= 1
    return np.packbits(bits).tobytes()


class FaultInjector:
    """Injects the requested faults into one robot. Times are whole microseconds."""

    def __init__(self, faults: Mapping[str, InjectedFault], plant: Plant) -> None:
        self.faults, self._plant = faults, plant
        self.rest = plant.robot.resting_angles
        self.armed_at: int | None = None
        self.hangs_until = 0
        """Time at which a hanging program continues."""
        self._now = 0
        self._command: MotorCommand | None = None
        self._changed_command: MotorCommand | None = None
        self._old: Packet | None = None
        self._number = 0

    def change_handshake(self, handshake: Handshake) -> Handshake:
        """Return the handshake with the requested faults."""
        faults = self.faults
        if "other-robot" in faults:
            handshake = replace(handshake, robot=f"not-{handshake.robot}"[:24])
        if "other-order" in faults:
            first, second, *others = handshake.motor_names
            handshake = replace(handshake, motor_names=(second, first, *others))
        if fault := faults.get("other-gains"):
            kp, kd = handshake.servo_kp * fault.value, handshake.servo_kd * fault.value
            handshake = replace(handshake, servo_kp=kp, servo_kd=kd)
        if fault := faults.get("slow-servo"):
            handshake = replace(handshake, servo_period=fault.value)
        return handshake

    def _since(self, fault: InjectedFault) -> float:
        return -math.inf if self.armed_at is None else (self._now - self.armed_at) / 1e6 - fault.start

    def active_fault(self, name: str) -> InjectedFault | None:
        """Return a fault if it is active now, else None; a fault that starts at 0 is active before arming."""
        fault = self.faults.get(name)
        return fault if fault and (fault.start == 0 or self._since(fault) >= 0) else None

    def has_started(self, name: str) -> bool:
        """Return whether a fault was requested and its start time after arming has passed."""
        return name in self.faults and self._since(self.faults[name]) >= 0

    @property
    def probabilities(self) -> dict[str, float]:
        """Probability per frame of each active line fault."""
        return {name: fault.value for name in LINE_FAULTS if (fault := self.active_fault(name))}

    def tick(self, now: int, armed: bool) -> None:
        """Update the faults at the end of a servo step; `armed` is whether the robot is armed."""
        self._now = now
        if armed and self.armed_at is None:
            self.armed_at = now
        if self.armed_at is None:
            return
        plant = self._plant
        if fault := self.active_fault("battery-low"):
            fall = max(plant.start_voltage - fault.value, 0.0)
            plant.voltage_drop = min(VOLTAGE_FALL_RATE * max(self._since(fault), 0.0), fall)
        if (fault := self.active_fault("motor-hot")) and plant.temperature[0] < fault.value:
            plant.temperature[0] += HEATING_RATE * plant.robot.timing.servo_step
        if fault := self.faults.get("tilt"):
            force = TILT_FORCE * plant.robot.weight if 0 <= self._since(fault) < TILT_TIME else 0.0
            plant.push(np.array([0.0, force, 0.0]))
        if not self.hangs_until and self.has_started("hang"):
            self.hangs_until = now + round(self.faults["hang"].value * 1e6)

    def motor_command(self, command: MotorCommand) -> MotorCommand:
        """Return the command that reaches the motors; the same object for the same input."""
        if command is not self._command:
            self._command, self._changed_command = command, self._change_command(command)
        return self._changed_command or command

    def _change_command(self, command: MotorCommand) -> MotorCommand:
        servo, sign = self.wiring()
        values = command.values[servo]
        # An angle is mirrored at the resting angle, a duty at zero.
        middle = self.rest if command.mode == Mode.POSITION else 0.0
        return replace(command, values=np.where(sign < 0, 2 * middle - values, values))

    def wiring(self) -> tuple[NDArray[np.int64], Array]:
        """Return the index of the servo to which each motor is wired (M,), and its sign, -1 if it is reversed (M,)."""
        servo, sign = np.arange(len(self.rest)), np.ones(len(self.rest))
        if fault := self.active_fault("swap-motors"):
            motor = int(fault.value)
            servo[[motor, motor + 1]] = motor + 1, motor
        if fault := self.active_fault("flip-sign"):
            sign[int(fault.value)] = -1.0
        return servo, sign

    def servo_readings(self, seen: Sensors) -> Sensors:
        """Return the readings of a microcontroller's servos, with swapped and reversed motors."""
        if not self.faults:
            return seen
        servo, sign = self.wiring()
        angle = self.rest + sign * (seen.motor_angle - self.rest)
        velocity, torque = sign * seen.motor_velocity, sign * seen.motor_torque
        return replace(seen, motor_angle=angle[servo], motor_velocity=velocity[servo], motor_torque=torque[servo])

    def efforts(self, effort: Array) -> Array:
        """Return the efforts (M,) that reach the motors from a microcontroller's servos."""
        if not self.faults:
            return effort
        servo, sign = self.wiring()
        return np.asarray(sign * effort[servo])

    def sensors(self, seen: Sensors) -> Sensors:
        """Return sensor readings with the faults of the sensors."""
        if fault := self.active_fault("flip-encoder"):
            motor = int(fault.value)
            angle, velocity = seen.motor_angle.copy(), seen.motor_velocity.copy()
            angle[motor], velocity[motor] = 2 * self.rest[motor] - angle[motor], -velocity[motor]
            seen = replace(seen, motor_angle=angle, motor_velocity=velocity)
        if fault := self.active_fault("imu-flip"):
            angles, rates = seen.roll_pitch_yaw.copy(), seen.angular_velocity_base.copy()
            for array in (angles, rates):
                array[:2] = array[[1, 0]] if fault.value == 0 else array[:2] * _IMU_SIGNS[int(fault.value)]
            force = seen.accelerometer
            if force is not None:
                # Consistent with the angles: it is g (-sin pitch, sin roll cos pitch, ...) at rest.
                x, y, z = force.tolist()
                rolls, pitches = _IMU_SIGNS.get(int(fault.value), (1, 1))
                force = np.array([-y, -x, z] if fault.value == 0 else [pitches * x, rolls * y, z])
            seen = replace(seen, roll_pitch_yaw=angles, angular_velocity_base=rates, accelerometer=force)
        return seen

    def packet(self, packet: Packet) -> Packet:
        """Return the packet to send instead of `packet`."""
        if isinstance(packet.message, Handshake):
            packet = replace(packet, message=self.change_handshake(packet.message))
        elif isinstance(packet.message, State):
            if self.has_started("stale-state"):
                self._old = self._old or packet
                packet = replace(packet, message=self._old.message, time=self._old.time)
            if self.has_started("repeat-sequence"):
                packet = replace(packet, sequence=max(self._number, 1))
            elif self.has_started("backward-sequence"):
                packet = replace(packet, sequence=max(self._number - 1, 1))
        self._number = packet.sequence
        return packet
