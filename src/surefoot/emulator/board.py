"""Emulated robot: microcontroller, simulated body and link, advanced together in real time or in lockstep."""

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
"""Startup time of a microcontroller [us]."""


class BoardProgram(Protocol):
    """Interface to the program of an emulated microcontroller. Times are whole microseconds."""

    mode: Mode
    reason: Reason
    owner: int
    """Session of the operator; 0: none."""
    next_state: float
    """Time at which the next state is due."""

    @property
    def armed(self) -> bool:
        """Whether motors follow commands."""

    def has_operator(self, now: int) -> bool:
        """Return whether an operator uses the robot, so that others are rejected."""

    def take(self) -> list[Packet]:
        """Remove and return the packets to send, oldest first."""

    def report(self, now: int, read: Callable[[], Sensors]) -> None:
        """Send a state with the sensor readings of `read`, if one is due."""


class EmulatedBoard(ABC):
    """Emulated robot with any program. Times are whole microseconds since it was switched on.

    If several events have the same time, the physics advances first, then a due state is sent, then packets are
    received. A command that arrives at the time of a servo step is applied from that step on.

    While no packet arrives and no state is due, the physics may advance `stride` servo steps at once. The
    microcontroller then checks tilt, battery and temperature only once per stride. With faults, `stride` is 1.
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
        """Called with the time [us] after servo steps: at least after each that motion capture records."""
        self._step = microseconds(plant.robot.timing.servo_step)
        self._start()
        self._booted = 0
        self._command: MotorCommand | None = None
        self._damped = self._last = MotorCommand(Mode.DISARMED, np.zeros(plant.robot.num_motors))

    @abstractmethod
    def _start(self) -> None:
        """Set `firmware` to a program that has just been started."""

    @abstractmethod
    def _receive(self) -> None:
        """Pass the next arriving data to the program."""

    @abstractmethod
    def _compute_command(self, now: int) -> MotorCommand:
        """Return the motor command for the servo step that begins."""

    @abstractmethod
    def counts(self) -> list[str]:
        """Return statistics of the link, for the summary."""

    def _describe(self, seen: LinkStatistics, repeated: int, stale: int) -> list[str]:
        return [
            f"frames received {seen.received}, damaged {seen.damaged}, foreign {seen.foreign}",
            f"repeated {repeated}, stale {stale}, not read {self.link.statistics.unsent}",
            f"mode {self.firmware.mode.name}, reason {self.firmware.reason.name}",
        ]

    @property
    def next_step(self) -> int:
        """End of the servo step in progress."""
        return (self.plant.ticks + 1) * self._step

    @property
    def next_time(self) -> float:
        """Time of the next event; the physics may wait until it can advance `stride` steps."""
        physics = self.next_step + (self.stride - 1) * self._step
        return max(min(physics, self.link.next_arrival, self.link.next_departure, self.firmware.next_state), self.now)

    def run_to(self, time: int) -> None:
        """Process all events until a time."""
        while True:
            stalled = self._stalled_until()
            step, due = self.next_step, max(self.firmware.next_state, stalled)
            arrival = max(self.link.next_arrival, self.now, stalled)
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
        """Return how many servo steps can be run at once, with the last one ending at `moment` or earlier."""
        if self.stride == 1 or self._command is not None:
            # The step in progress keeps its command; commands that arrive during it apply from the next step on.
            return 1
        first = self.next_step
        possible = min(self.stride, int(moment - first) // self._step + 1)
        # Motion capture samples the robot at multiples of its period.
        return min(possible, (-first % PERIOD) // self._step + 1)

    def _stalled_until(self) -> int:
        """Return the time until which the program does not run, because it hangs or starts."""
        return max(self.injector.hangs_until, self._booted)

    def _begin_step(self) -> None:
        """Compute the command of the step in progress; events during the step do not change it."""
        if self._command is None and self.now > self.plant.ticks * self._step:
            self._command = self._decide()
            self._send()

    def _decide(self) -> MotorCommand:
        now = self.plant.ticks * self._step
        if now >= self._stalled_until():
            self._last = self._compute_command(now)
        return self._last

    def _physics(self, count: int) -> None:
        command = self._command or self._decide()
        self._command = None
        self._send()
        self.plant.step(command, count)
        end = self.plant.ticks * self._step
        self.now = max(self.now, end)
        self.injector.tick(end, self.firmware.armed)
        self.link.probabilities = self.injector.probabilities
        if self.injector.has_started("unplug"):
            self.link.cut_off()
        if not self.reboots and self.injector.has_started("reboot"):
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
        # The control latency ends at the use of the readings; when sent, they are younger by the lead.
        return self.injector.sensors(self.plant.read(since, self.link.lead))

    def _send(self) -> None:
        for packet in map(self.injector.packet, self.firmware.take()):
            self.link.send(self.now, packet)


class Board(EmulatedBoard):
    """Emulated robot with the program of `deploy/board` and the servos of the simulated body."""

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
        """Return statistics of the link, for the summary."""
        return self._describe(self.link.statistics, self.firmware.link_monitor.old_numbers, self.firmware.stale)

    def _start(self) -> None:
        self.firmware = Firmware(self._handshake, self.limits)

    def _receive(self) -> None:
        self.link.receive(self.now, self.firmware)

    def _compute_command(self, now: int) -> MotorCommand:
        return self.injector.motor_command(self.firmware.tick(now, self.plant.vitals()))
