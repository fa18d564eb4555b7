"""Microcontroller, robot and line together, moved by time: what both the real-time and the lockstep emulator run."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.wire.frames import Frame, encode_frame
from surefoot.deploy.wire.messages import Codec, Handshake, Mode
from surefoot.emulator.fault_injector import FaultInjector
from surefoot.emulator.faults import Fault, line_config
from surefoot.emulator.firmware import Firmware
from surefoot.emulator.limits import Limits
from surefoot.emulator.line import Line
from surefoot.emulator.motion_capture import PERIOD
from surefoot.emulator.plant import Plant
from surefoot.emulator.signals import MotorOrder, Sensors
from surefoot.seeding import generator

Array = NDArray[np.float64]
_BOOT_TIME = 200_000
"""Time [us] that a microcontroller takes to start."""


class Board:
    """The whole emulated robot. Times are whole microseconds since it was switched on.

    At the same moment, first the physics gets there, then a state that is due is sent, then what arrives is heard: a
    command that arrives at a servo step acts from that step on.

    Args:
        plant: the body.
        introduction: what the robot says of itself.
        limits: when it damps itself.
        faults: what goes wrong.
        baud: bits a second of the line; 0: bytes take no time.
        seed: of what goes wrong at random.
        stride: servo steps that the physics may go through at once while nothing comes or is due. The microcontroller
            looks at tilt, battery and heat between them alone. With faults it is 1.
        lead: how long [s] before they are used a deployment asks for states: the control latency counts up to there,
            so that sensors are younger by this when a state is sent.
    """

    def __init__(
        self,
        plant: Plant,
        introduction: Handshake,
        limits: Limits | None = None,
        faults: dict[str, Fault] | None = None,
        baud: float = 0.0,
        seed: int = 0,
        stride: int = 1,
        lead: float = 0.0,
    ) -> None:
        self.stride = stride if not faults and plant.servo_every == 1 else 1
        self.plant, self.limits, self.lead = plant, limits or Limits(), lead
        faults = faults or {}
        self.injector = FaultInjector(faults, plant, introduction)
        self._introduction = self.injector.introduction
        self.codec = Codec(len(introduction.motor_names))
        if "other-schema" in faults:
            self.codec.schema ^= 0xFFFF
        self.firmware = self._boot()
        self.inbound, self.outbound = (
            Line(line_config(faults, baud, to_host), generator(seed, "line to host" if to_host else "line to robot"))
            for to_host in (False, True)
        )
        self._harm_lines()
        self.now = 0
        self.reboots = 0
        self.on_step: list[Callable[[int], None]] = []
        """Called after servo steps with the time [us]; if not after all, then after each that motion capture sees."""
        self._step = round(plant.robot.timing.servo_step * 1e6)
        self._booted = 0
        self._order: MotorOrder | None = None
        self._last = MotorOrder(Mode.DISARMED, np.zeros(self.codec.motors))

    def _boot(self) -> Firmware:
        return Firmware(self.codec, self._introduction, self.limits)

    @property
    def next_step(self) -> int:
        """When the servo step ends that the physics goes through."""
        return (self.plant.ticks + 1) * self._step

    @property
    def next_time(self) -> int:
        """When there is something to do next: physics may wait until it can go through `stride` steps."""
        physics = self.next_step + (self.stride - 1) * self._step
        times = [physics, self.inbound.next_time, self.outbound.next_time, self.firmware.next_state]
        return max(min(time for time in times if time is not None), self.now)

    def hear(self, now: int, data: bytes) -> None:
        """Bytes go on the line to the robot."""
        self.inbound.send(now, data)

    def run_to(self, time: int) -> None:
        """Let everything happen until then."""
        while True:
            step, due, arrival = self.next_step, self._due(), self._arrival()
            at = min(step, due, arrival)
            if at > time:
                break
            self.now = max(self.now, int(at))
            if at == step:
                self._physics(self._steps_until(min(time, due, arrival)))
            else:
                self._begin_step()
                if at == due:
                    self.firmware.report(self.now, self._read)
                else:
                    self.firmware.receive(self.now, self.inbound.take())
            self._send()
        self.now = max(self.now, time)

    def _steps_until(self, moment: float) -> int:
        """Servo steps that can be gone through at once, the last one ending at `moment` or before."""
        if self.stride == 1 or self._order is not None:
            # The step that is under way keeps its order; what has come meanwhile acts from the next one on.
            return 1
        first = self.next_step
        possible = min(self.stride, int(moment - first) // self._step + 1)
        # Motion capture looks at the robot at multiples of its period.
        return min(possible, (-first % PERIOD) // self._step + 1)

    def said(self) -> bytes:
        """Bytes that have reached the host by now."""
        parts = []
        while (time := self.outbound.next_time) is not None and time <= self.now:
            parts.append(self.outbound.take())
        return b"".join(parts)

    def _due(self) -> float:
        due = self.firmware.next_state
        return math.inf if due is None else max(due, self._standing_until())

    def _arrival(self) -> float:
        arrival = self.inbound.next_time
        return math.inf if arrival is None else max(arrival, self.now, self._standing_until())

    def _standing_until(self) -> float:
        return max(self.injector.hangs_until, self._booted)

    def _begin_step(self) -> None:
        """What happens within a servo step changes nothing of it: its order stands from its start."""
        if self._order is None and self.now > self.plant.ticks * self._step:
            self._order = self._decide()
            self._send()

    def _decide(self) -> MotorOrder:
        now = self.plant.ticks * self._step
        if now < self._standing_until():
            return self._last
        self._last = self.injector.order(self.firmware.tick(now, self.plant.vitals()))
        return self._last

    def _physics(self, count: int) -> None:
        order = self._order or self._decide()
        self._order = None
        self._send()
        self.plant.step(order, count)
        end = self.plant.ticks * self._step
        self.now = max(self.now, end)
        self.injector.tick(end, self.firmware.armed)
        self._harm_lines()
        if self.injector.unplugged and not self.inbound.dead:
            self.inbound.cut_off()
            self.outbound.cut_off()
        if self.injector.reboots():
            self.firmware, self._booted = self._boot(), end + _BOOT_TIME
            self._last = MotorOrder(Mode.DISARMED, np.zeros(self.codec.motors))
            self.reboots += 1
        for look in self.on_step:
            look(end)

    def _harm_lines(self) -> None:
        self.inbound.harmful = self.outbound.harmful = self.injector.harms_lines

    def _read(self) -> Sensors:
        since = (self.now - self.plant.ticks * self._step) / 1e6
        return self.injector.sensors(self.plant.read(since, self.lead))

    def _send(self) -> None:
        for frame in self.firmware.take():
            self._send_frame(self.injector.frame(frame))

    def _send_frame(self, frame: Frame) -> None:
        self.outbound.send(self.now, encode_frame(self.codec, frame.message, frame.sequence, frame.time))
