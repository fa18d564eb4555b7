"""Injection of faults into an emulated robot's body, sensors, orders and packets."""

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
"""Force of the push that topples a robot, over its weight, and its duration [s]."""
VOLTAGE_FALL_RATE, HEATING_RATE = 2.0, 40.0
"""Rates at which a battery becomes low [V/s] and a motor hot [degC/s]."""
_IMU_SIGNS = {1: (-1, 1), 2: (1, -1), 3: (-1, -1)}


def flip_bits(data: bytes, random: np.random.Generator, first: int = 0) -> bytes:
    """Return bytes with one to three bits flipped, from bit `first` on."""
    bits = np.unpackbits(np.frombuffer(data, np.uint8))
    bits[first + random.choice(len(bits) - first, int(random.integers(1, 4)), replace=False)] ^= 1
    return np.packbits(bits).tobytes()


class FaultInjector:
    """The faults of one robot; without any it changes nothing. Times are whole microseconds."""

    def __init__(self, faults: Mapping[str, InjectedFault], plant: Plant) -> None:
        self.faults, self._plant = faults, plant
        self.rest = plant.robot.resting_angles
        self.armed_at: int | None = None
        self.hangs_until = 0
        """When the microcontroller's program goes on."""
        self._now = 0
        self._order: MotorCommand | None = None
        self._changed_order: MotorCommand | None = None
        self._old: Packet | None = None
        self._number = 0

    def change_handshake(self, handshake: Handshake) -> Handshake:
        """Return what the robot states about itself."""
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

    def active(self, name: str) -> InjectedFault | None:
        """Return a fault that was requested and acts now; one that begins at 0 acts before anything is armed."""
        fault = self.faults.get(name)
        return fault if fault and (fault.start == 0 or self._since(fault) >= 0) else None

    def began(self, name: str) -> bool:
        """Return whether a fault was requested and its time after arming has passed."""
        return name in self.faults and self._since(self.faults[name]) >= 0

    @property
    def probabilities(self) -> dict[str, float]:
        """Chance per frame of each harm on the line that has begun."""
        return {name: fault.value for name in LINE_FAULTS if (fault := self.active(name))}

    def tick(self, now: int, armed: bool) -> None:
        """Take the end of a servo step, and whether the robot is armed."""
        self._now = now
        if armed and self.armed_at is None:
            self.armed_at = now
        if self.armed_at is None:
            return
        plant = self._plant
        if fault := self.active("battery-low"):
            fall = max(plant.start_voltage - fault.value, 0.0)
            plant.voltage_drop = min(VOLTAGE_FALL_RATE * max(self._since(fault), 0.0), fall)
        if (fault := self.active("motor-hot")) and plant.temperature[0] < fault.value:
            plant.temperature[0] += HEATING_RATE * plant.robot.timing.servo_step
        if fault := self.faults.get("tilt"):
            force = TILT_FORCE * plant.robot.weight if 0 <= self._since(fault) < TILT_TIME else 0.0
            plant.push(np.array([0.0, force, 0.0]))
        if not self.hangs_until and self.began("hang"):
            self.hangs_until = now + round(self.faults["hang"].value * 1e6)

    def order(self, order: MotorCommand) -> MotorCommand:
        """Return what the motors get instead of an order; the same object for the same order."""
        if order is not self._order:
            self._order, self._changed_order = order, self._change_command(order)
        return self._changed_order or order

    def _change_command(self, order: MotorCommand) -> MotorCommand:
        servo, sign = self.wiring()
        values = order.values[servo]
        # An angle is mirrored at the resting angle, a duty at zero.
        middle = self.rest if order.mode == Mode.POSITION else 0.0
        return replace(order, values=np.where(sign < 0, 2 * middle - values, values))

    def wiring(self) -> tuple[NDArray[np.int64], Array]:
        """Return, for each motor, the servo that it is wired to, and -1 where it turns the wrong way (M,)."""
        servo, sign = np.arange(len(self.rest)), np.ones(len(self.rest))
        if fault := self.active("swap-motors"):
            motor = int(fault.value)
            servo[[motor, motor + 1]] = motor + 1, motor
        if fault := self.active("flip-sign"):
            sign[int(fault.value)] = -1.0
        return servo, sign

    def servo_readings(self, seen: Sensors) -> Sensors:
        """Return what a microcontroller's own servos read, wired to the wrong motors or the wrong way round."""
        if not self.faults:
            return seen
        servo, sign = self.wiring()
        angle = self.rest + sign * (seen.motor_angle - self.rest)
        velocity, torque = sign * seen.motor_velocity, sign * seen.motor_torque
        return replace(seen, motor_angle=angle[servo], motor_velocity=velocity[servo], motor_torque=torque[servo])

    def efforts(self, effort: Array) -> Array:
        """Return what motors get (M,), of a microcontroller's own servos."""
        if not self.faults:
            return effort
        servo, sign = self.wiring()
        return np.asarray(sign * effort[servo])

    def sensors(self, seen: Sensors) -> Sensors:
        """Return the readings with the faults of the sensors."""
        if fault := self.active("flip-encoder"):
            motor = int(fault.value)
            angle, velocity = seen.motor_angle.copy(), seen.motor_velocity.copy()
            angle[motor], velocity[motor] = 2 * self.rest[motor] - angle[motor], -velocity[motor]
            seen = replace(seen, motor_angle=angle, motor_velocity=velocity)
        if fault := self.active("imu-flip"):
            angles, rates = seen.roll_pitch_yaw.copy(), seen.angular_velocity_base.copy()
            for array in (angles, rates):
                array[:2] = array[[1, 0]] if fault.value == 0 else array[:2] * _IMU_SIGNS[int(fault.value)]
            seen = replace(seen, roll_pitch_yaw=angles, angular_velocity_base=rates)
        return seen

    def packet(self, packet: Packet) -> Packet:
        """Return what is sent instead of a packet."""
        if isinstance(packet.message, Handshake):
            packet = replace(packet, message=self.change_handshake(packet.message))
        elif isinstance(packet.message, State):
            if self.began("stale-state"):
                self._old = self._old or packet
                packet = replace(packet, message=self._old.message, time=self._old.time)
            if self.began("repeat-sequence"):
                packet = replace(packet, sequence=max(self._number, 1))
            elif self.began("backward-sequence"):
                packet = replace(packet, sequence=max(self._number - 1, 1))
        self._number = packet.sequence
        return packet
