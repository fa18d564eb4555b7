"""Microcontroller, robot and link together, advanced in time, in real time or in lockstep."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Protocol

import numpy as np

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.limits import Limits
from surefoot.deploy.board.signals import MotorCommand, Sensors, microseconds
from surefoot.deploy.messages import Handshake, Mode, Packet, Reason
from surefoot.deploy.robot_link import LinkStatistics
from surefoot.emulator.capture_writer import PERIOD
from surefoot.emulator.fault_table import InjectedFault
from surefoot.emulator.faults import FaultInjector
from surefoot.emulator.plant import Plant
from surefoot.emulator.serial.serial_host_link import SerialHostLink

BOOT_TIME = 200_000
"""Time [us] that a microcontroller takes to start."""


class BoardProgram(Protocol):
    """What an emulated microcontroller needs of its program. Times are whole microseconds."""

    mode: Mode
    reason: Reason
    owner: int
    """Session of the operator; 0: none."""
    next_state: float
    """When the next state is due."""

    @property
    def armed(self) -> bool:
        """Whether motors follow commands."""

    def has_operator(self, now: int) -> bool:
        """Return whether the robot has an operator that may keep it."""

    def take(self) -> list[Packet]:
        """Return and forget the packets to send, oldest first."""

    def report(self, now: int, read: Callable[[], Sensors]) -> None:
        """Send a state if one is due, with the readings of `read`."""


class EmulatedBoard(ABC):
    """The whole emulated robot, whatever program it runs. Times are whole microseconds since it was switched on.

    At one moment, the physics advances first, then a state that is due is sent, then what arrives is received. A
    command that arrives at a servo step acts from that step on.

    While nothing arrives or is due, the physics may advance `stride` servo steps at once. The microcontroller checks
    tilt, battery and heat only between them. With faults, `stride` is 1.
    """

    firmware: BoardProgram

    def __init__(
        self, plant: Plant, link: SerialHostLink, faults: dict[str, InjectedFault] | None = None, stride: int = 1
    ) -> None:
        faults = faults or {}
        self.stride = stride if not faults and plant.servo_every == 1 else 1
        self.plant, self.link = plant, link
        self.injector = FaultInjector(faults, plant)
        if "late-states" in faults:
            plant.extra_latency = faults["late-states"].value
        link.probabilities = self.injector.probabilities
        self.now = self.reboots = 0
        self.on_step: list[Callable[[int], None]] = []
        """Called with the time [us] after servo steps: after all, or at least after each that motion capture sees."""
        self._step = microseconds(plant.robot.timing.servo_step)
        self._start()
        self._booted = 0
        self._order: MotorCommand | None = None
        self._damped = self._last = MotorCommand(Mode.DISARMED, np.zeros(plant.robot.num_motors))

    @abstractmethod
    def _start(self) -> None:
        """Set `firmware` to a program that has just been started."""

    @abstractmethod
    def _receive(self) -> None:
        """Hand the program what arrives next."""

    @abstractmethod
    def _compute_command(self, now: int) -> MotorCommand:
        """Return what the motors do in the servo step that begins."""

    @abstractmethod
    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""

    def _describe(self, seen: LinkStatistics, repeated: int, stale: int) -> list[str]:
        return [
            f"frames received {seen.received}, damaged {seen.damaged}, foreign {seen.foreign}",
            f"repeated {repeated}, stale {stale}, not read {self.link.statistics.unsent}",
            f"mode {self.firmware.mode.name}, reason {self.firmware.reason.name}",
        ]

    @property
    def next_step(self) -> int:
        """When the servo step in progress ends."""
        return (self.plant.ticks + 1) * self._step

    @property
    def next_time(self) -> float:
        """When there is something to do next: physics may wait until it can advance `stride` steps."""
        physics = self.next_step + (self.stride - 1) * self._step
        return max(min(physics, self.link.next_arrival, self.link.next_departure, self.firmware.next_state), self.now)

    def run_to(self, time: int) -> None:
        """Run everything that happens until a time."""
        while True:
            standing = self._stalled_until()
            step, due = self.next_step, max(self.firmware.next_state, standing)
            arrival = max(self.link.next_arrival, self.now, standing)
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
                    self._receive()
            self._send()
        self.now = max(self.now, time)

    def _steps_until(self, moment: float) -> int:
        """Return how many servo steps can be run at once, the last one ending at `moment` or before."""
        if self.stride == 1 or self._order is not None:
            # The step in progress keeps its order; what has arrived meanwhile acts from the next one on.
            return 1
        first = self.next_step
        possible = min(self.stride, int(moment - first) // self._step + 1)
        # Motion capture reads the robot at multiples of its period.
        return min(possible, (-first % PERIOD) // self._step + 1)

    def _stalled_until(self) -> int:
        return max(self.injector.hangs_until, self._booted)

    def _begin_step(self) -> None:
        """Fix the order of the step in progress: nothing that happens within it changes it."""
        if self._order is None and self.now > self.plant.ticks * self._step:
            self._order = self._decide()
            self._send()

    def _decide(self) -> MotorCommand:
        now = self.plant.ticks * self._step
        if now >= self._stalled_until():
            self._last = self._compute_command(now)
        return self._last

    def _physics(self, count: int) -> None:
        order = self._order or self._decide()
        self._order = None
        self._send()
        self.plant.step(order, count)
        end = self.plant.ticks * self._step
        self.now = max(self.now, end)
        self.injector.tick(end, self.firmware.armed)
        self.link.probabilities = self.injector.probabilities
        if self.injector.began("unplug"):
            self.link.cut_off()
        if not self.reboots and self.injector.began("reboot"):
            self._reboot(end)
        for observe in self.on_step:
            observe(end)

    def _reboot(self, now: int) -> None:
        self._start()
        self._last = self._damped
        self.link.restart()
        self.reboots, self._booted = self.reboots + 1, now + BOOT_TIME

    def _read(self) -> Sensors:
        since = (self.now - self.plant.ticks * self._step) / 1e6
        # The control latency counts up to the use: when they are sent, readings are younger by the lead.
        return self.injector.sensors(self.plant.read(since, self.link.lead))

    def _send(self) -> None:
        for packet in map(self.injector.packet, self.firmware.take()):
            self.link.send(self.now, packet)


class Board(EmulatedBoard):
    """The emulated robot with the program that ships, `deploy/board`, and the servos of its body."""

    firmware: Firmware

    def __init__(
        self,
        plant: Plant,
        handshake: Handshake,
        link: SerialHostLink,
        limits: Limits,
        faults: dict[str, InjectedFault] | None = None,
        stride: int = 1,
    ) -> None:
        self._handshake, self.limits = handshake, limits
        super().__init__(plant, link, faults, stride)

    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""
        return self._describe(self.link.statistics, self.firmware.watch.old_numbers, self.firmware.stale)

    def _start(self) -> None:
        self.firmware = Firmware(self._handshake, self.limits)

    def _receive(self) -> None:
        self.link.receive(self.now, self.firmware)

    def _compute_command(self, now: int) -> MotorCommand:
        return self.injector.order(self.firmware.tick(now, self.plant.vitals()))
