"""Microcontroller, robot and link together, advanced in time, in real time or in lockstep."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.limits import Limits
from surefoot.deploy.board.signals import MotorOrder, Sensors, microseconds
from surefoot.deploy.messages import Handshake, Mode
from surefoot.emulator.capture_writer import PERIOD
from surefoot.emulator.faults import FaultInjector, InjectedFault
from surefoot.emulator.host_link import HostLink
from surefoot.emulator.plant import Plant

BOOT_TIME = 200_000
"""Time [us] that a microcontroller takes to start."""


class Board:
    """The whole emulated robot. Times are whole microseconds since it was switched on.

    At one moment, the physics advances first, then a state that is due is sent, then what arrives is received. A
    command that arrives at a servo step acts from that step on.

    While nothing arrives or is due, the physics may advance `stride` servo steps at once. The microcontroller checks
    tilt, battery and heat only between them. With faults, `stride` is 1.
    """

    def __init__(
        self,
        plant: Plant,
        handshake: Handshake,
        link: HostLink,
        limits: Limits,
        faults: dict[str, InjectedFault] | None = None,
        stride: int = 1,
    ) -> None:
        faults = faults or {}
        self.stride = stride if not faults and plant.servo_every == 1 else 1
        self.plant, self.limits, self.link = plant, limits, link
        self.injector = FaultInjector(faults, plant)
        self._handshake = self.injector.change_handshake(handshake)
        if "late-states" in faults:
            plant.extra_latency = faults["late-states"].value
        link.chances = self.injector.chances
        self.now = self.reboots = 0
        self.on_step: list[Callable[[int], None]] = []
        """Called with the time [us] after servo steps: after all, or at least after each that motion capture sees."""
        self._step = microseconds(plant.robot.timing.servo_step)
        self.firmware = Firmware(self._handshake, limits)
        self._booted = 0
        self._order: MotorOrder | None = None
        self._damped = self._last = MotorOrder(Mode.DISARMED, np.zeros(plant.robot.num_motors))

    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""
        statistics, firmware = self.link.statistics, self.firmware
        return [
            f"frames received {statistics.received}, damaged {statistics.damaged}, foreign {statistics.foreign}",
            f"repeated {firmware.watch.old_numbers}, stale {firmware.stale}, not read {statistics.unsent}",
            f"mode {firmware.mode.name}, reason {firmware.reason.name}",
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
            standing = self._standing_until()
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
                    self.link.receive(self.now, self.firmware)
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

    def _standing_until(self) -> int:
        return max(self.injector.hangs_until, self._booted)

    def _begin_step(self) -> None:
        """Fix the order of the step in progress: nothing that happens within it changes it."""
        if self._order is None and self.now > self.plant.ticks * self._step:
            self._order = self._decide()
            self._send()

    def _decide(self) -> MotorOrder:
        now = self.plant.ticks * self._step
        if now >= self._standing_until():
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
        self.link.chances = self.injector.chances
        if self.injector.began("unplug"):
            self.link.cut_off()
        if not self.reboots and self.injector.began("reboot"):
            self.firmware, self._last = Firmware(self._handshake, self.limits), self._damped
            self.link.restart()
            self.reboots, self._booted = 1, end + BOOT_TIME
        for observe in self.on_step:
            observe(end)

    def _read(self) -> Sensors:
        since = (self.now - self.plant.ticks * self._step) / 1e6
        # The control latency counts up to the use: when they are sent, readings are younger by the lead.
        return self.injector.sensors(self.plant.read(since, self.link.lead))

    def _send(self) -> None:
        for packet in map(self.injector.packet, self.firmware.take()):
            self.link.send(self.now, packet)
