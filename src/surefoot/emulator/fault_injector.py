"""Faults at work: what they change in orders, readings, messages and the body, and when."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.wire.frames import Frame
from surefoot.deploy.wire.messages import Handshake, State
from surefoot.emulator.faults import RATES, Fault
from surefoot.emulator.plant import Plant
from surefoot.emulator.signals import MotorOrder, Sensors

Array = NDArray[np.float64]

TILT_FORCE = 80.0
"""Force [N] of the push that topples a robot; it weighs about 58 N."""
TILT_TIME = 0.4
"""How long it lasts [s]."""
FALL_OF_VOLTAGE = 2.0
"""Rate [V/s] at which a battery gets low."""
RISE_OF_TEMPERATURE = 40.0
"""Rate [degC/s] at which a motor gets hot."""


class FaultInjector:
    """The faults of one robot; without any it changes nothing. Times are whole microseconds.

    Args:
        faults: by name.
        plant: the body.
        introduction: what the robot says of itself; `introduction` has what it says with its faults.
    """

    def __init__(self, faults: dict[str, Fault], plant: Plant, introduction: Handshake) -> None:
        self._faults, self._plant = faults, plant
        self._rest = plant.robot.resting_angles
        self.introduction = self._introduce(introduction)
        self.armed_at: int | None = None
        """When the robot was armed first."""
        self.hangs_until = 0
        """When the microcontroller's program goes on."""
        self.unplugged = False
        """Whether the cable is pulled."""
        self._now = 0
        self._booted = self._hung = self._pushing = False
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

    def _on(self, name: str) -> Fault | None:
        """The fault of this name, if it is there and its time has come."""
        fault = self._faults.get(name)
        if fault is None:
            return None
        return fault if fault.start == 0 or self._since(fault) >= 0 else None

    def _since(self, fault: Fault) -> float:
        """Time since a fault has begun [s]; below 0 before."""
        return -math.inf if self.armed_at is None else (self._now - self.armed_at) / 1e6 - fault.start

    def tick(self, now: int, armed: bool) -> None:
        """A servo step has ended."""
        if not self._faults:
            return
        self._now = now
        if armed and self.armed_at is None:
            self.armed_at = now
        if self.armed_at is None:
            return
        plant = self._plant
        self.unplugged = self._began("unplug")
        if fault := self._on("battery-low"):
            fall = max(float(plant.params.voltage[0]) - fault.value, 0.0)
            plant.voltage_drop = min(FALL_OF_VOLTAGE * max(self._since(fault), 0.0), fall)
        if (fault := self._on("motor-hot")) and plant.temperature[0] < fault.value:
            plant.temperature[0] += RISE_OF_TEMPERATURE * plant.robot.timing.servo_step
        if fault := self._faults.get("tilt"):
            pushing = 0 <= self._since(fault) < TILT_TIME
            if pushing != self._pushing:
                self._pushing = pushing
                plant.push(np.array([0.0, TILT_FORCE if pushing else 0.0, 0.0]))
        if not self._hung and self._began("hang"):
            self._hung, self.hangs_until = True, now + round(self._faults["hang"].value * 1e6)

    def _began(self, name: str) -> bool:
        """Whether a fault is there whose time, after arming, has come."""
        return name in self._faults and self._since(self._faults[name]) >= 0

    @property
    def harms_lines(self) -> bool:
        """Whether anything happens to frames on the line by now."""
        return bool(self._faults) and any(self._on(name) is not None for name in RATES)

    def reboots(self) -> bool:
        """Whether the microcontroller starts anew now."""
        if self._booted or not self._began("reboot"):
            return False
        self._booted = True
        return True

    def order(self, order: MotorOrder) -> MotorOrder:
        """What the motors get instead of an order."""
        if order is not self._given:
            self._given, self._changed = order, self._change(order)
        return self._changed or order

    def _change(self, order: MotorOrder) -> MotorOrder:
        values = order.values
        if fault := self._on("swap-motors"):
            motor = int(fault.value)
            values = values.copy()
            values[[motor, motor + 1]] = values[[motor + 1, motor]]
        if fault := self._on("flip-sign"):
            motor = int(fault.value)
            values = values.copy()
            # PWM has no rest to turn round: it is simply turned over.
            middle = self._rest[motor] if order.mode == 1 else 0.0
            values[motor] = 2 * middle - values[motor]
        return replace(order, values=values)

    def sensors(self, seen: Sensors) -> Sensors:
        """What the sensors tell instead."""
        if fault := self._on("flip-encoder"):
            motor = int(fault.value)
            angle, velocity = seen.motor_angle.copy(), seen.motor_velocity.copy()
            angle[motor], velocity[motor] = 2 * self._rest[motor] - angle[motor], -velocity[motor]
            seen = replace(seen, motor_angle=angle, motor_velocity=velocity)
        if fault := self._on("imu-flip"):
            angles, rates = seen.roll_pitch_yaw.copy(), seen.angular_velocity_base.copy()
            for array in (angles, rates):
                if fault.value == 0:
                    array[:2] = array[[1, 0]]
                if fault.value in (1, 3):
                    array[0] *= -1
                if fault.value in (2, 3):
                    array[1] *= -1
            seen = replace(seen, roll_pitch_yaw=angles, angular_velocity_base=rates)
        return seen

    def frame(self, frame: Frame) -> Frame:
        """What is sent instead of a frame."""
        if not self._faults or not isinstance(frame.message, State):
            self._number = frame.sequence
            return frame
        if self._began("stale-state"):
            self._old = self._old or frame
            frame = replace(frame, message=self._old.message, time=self._old.time)
        if self._began("repeat-sequence"):
            frame = replace(frame, sequence=max(self._number, 1))
        elif self._began("backward-sequence"):
            self._number = max(self._number - 1, 1)
            frame = replace(frame, sequence=self._number)
        else:
            self._number = frame.sequence
        return frame
