"""Active faults: what they change in orders, readings, messages and the body, and when."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from surefoot.deploy.wire.frames import Frame
from surefoot.deploy.wire.messages import Handshake, Mode, State
from surefoot.emulator.faults import Fault
from surefoot.emulator.line import HARMS
from surefoot.emulator.plant import Plant
from surefoot.emulator.signals import MotorOrder, Sensors

TILT_FORCE = 80.0
"""Force [N] of the push that topples a robot; it weighs about 58 N."""
TILT_TIME = 0.4
"""Duration of the push [s]."""
FALL_OF_VOLTAGE = 2.0
"""Rate [V/s] at which a battery becomes low."""
RISE_OF_TEMPERATURE = 40.0
"""Rate [degC/s] at which a motor becomes hot."""
_IMU_SIGNS = {1: (-1, 1), 2: (1, -1), 3: (-1, -1)}


class FaultInjector:
    """The faults of one robot; without any it changes nothing. Times are whole microseconds.

    Args:
        faults: by name.
        plant: the body.
        introduction: the robot's handshake; `self.introduction` is the one with its faults.
    """

    def __init__(self, faults: dict[str, Fault], plant: Plant, introduction: Handshake) -> None:
        self._faults, self._plant = faults, plant
        self._rest = plant.robot.resting_angles
        self.introduction = self._introduce(introduction)
        self.armed_at: int | None = None
        """When the robot was first armed."""
        self.hangs_until = 0
        """When the microcontroller's program goes on."""
        self._now = 0
        self._given: MotorOrder | None = None
        self._changed: MotorOrder | None = None
        self._old: Frame | None = None
        self._number = 0
        if "late-states" in faults:
            plant.extra_latency = faults["late-states"].value

    def _introduce(self, said: Handshake) -> Handshake:
        faults = self._faults
        if "other-robot" in faults:
            said = replace(said, robot=f"not-{said.robot}"[:24])
        if "other-order" in faults:
            first, second, *others = said.motor_names
            said = replace(said, motor_names=(second, first, *others))
        if "other-gains" in faults:
            factor = faults["other-gains"].value
            said = replace(said, servo_kp=said.servo_kp * factor, servo_kd=said.servo_kd * factor)
        if "slow-servo" in faults:
            said = replace(said, servo_period=faults["slow-servo"].value)
        return said

    def _since(self, fault: Fault) -> float:
        """Return the time since a fault began [s]; below 0 before."""
        return -math.inf if self.armed_at is None else (self._now - self.armed_at) / 1e6 - fault.start

    def _active(self, name: str) -> Fault | None:
        """Return the fault of this name if it was requested and has begun."""
        fault = self._faults.get(name)
        return fault if fault and (fault.start == 0 or self._since(fault) >= 0) else None

    def began(self, name: str) -> bool:
        """Return whether a fault was requested whose time, after arming, has come."""
        return name in self._faults and self._since(self._faults[name]) >= 0

    @property
    def chances(self) -> dict[str, float]:
        """Chance per frame of each harm on the line that has begun."""
        return {name: fault.value for name in HARMS if (fault := self._active(name))}

    def tick(self, now: int, armed: bool) -> None:
        """Take note that a servo step has ended."""
        self._now = now
        if armed and self.armed_at is None:
            self.armed_at = now
        if self.armed_at is None:
            return
        plant = self._plant
        if fault := self._active("battery-low"):
            fall = max(float(plant.params.voltage[0]) - fault.value, 0.0)
            plant.voltage_drop = min(FALL_OF_VOLTAGE * max(self._since(fault), 0.0), fall)
        if (fault := self._active("motor-hot")) and plant.temperature[0] < fault.value:
            plant.temperature[0] += RISE_OF_TEMPERATURE * plant.robot.timing.servo_step
        if fault := self._faults.get("tilt"):
            force = TILT_FORCE if 0 <= self._since(fault) < TILT_TIME else 0.0
            plant.push(np.array([0.0, force, 0.0]))
        if not self.hangs_until and self.began("hang"):
            self.hangs_until = now + round(self._faults["hang"].value * 1e6)

    def order(self, order: MotorOrder) -> MotorOrder:
        """Return what the motors get instead of an order; the same for the same order."""
        if order is not self._given:
            self._given, self._changed = order, self._change(order)
        return self._changed or order

    def _change(self, order: MotorOrder) -> MotorOrder:
        values = order.values.copy()
        if fault := self._active("swap-motors"):
            motor = int(fault.value)
            values[[motor, motor + 1]] = values[[motor + 1, motor]]
        if fault := self._active("flip-sign"):
            motor = int(fault.value)
            # An angle is mirrored at the resting angle, a duty at zero.
            middle = self._rest[motor] if order.mode == Mode.POSITION else 0.0
            values[motor] = 2 * middle - values[motor]
        return replace(order, values=values)

    def sensors(self, seen: Sensors) -> Sensors:
        """Return the readings with the faults of the sensors."""
        if fault := self._active("flip-encoder"):
            motor = int(fault.value)
            angle, velocity = seen.motor_angle.copy(), seen.motor_velocity.copy()
            angle[motor], velocity[motor] = 2 * self._rest[motor] - angle[motor], -velocity[motor]
            seen = replace(seen, motor_angle=angle, motor_velocity=velocity)
        if fault := self._active("imu-flip"):
            angles, rates = seen.roll_pitch_yaw.copy(), seen.angular_velocity_base.copy()
            for array in (angles, rates):
                if fault.value == 0:
                    array[:2] = array[[1, 0]]
                else:
                    array[:2] *= _IMU_SIGNS[int(fault.value)]
            seen = replace(seen, roll_pitch_yaw=angles, angular_velocity_base=rates)
        return seen

    def frame(self, frame: Frame) -> Frame:
        """Return what is sent instead of a frame."""
        if isinstance(frame.message, State):
            if self.began("stale-state"):
                self._old = self._old or frame
                frame = replace(frame, message=self._old.message, time=self._old.time)
            if self.began("repeat-sequence"):
                frame = replace(frame, sequence=max(self._number, 1))
            elif self.began("backward-sequence"):
                frame = replace(frame, sequence=max(self._number - 1, 1))
        self._number = frame.sequence
        return frame
