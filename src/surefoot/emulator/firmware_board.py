"""Emulated robot whose microcontroller runs firmware in C."""

from __future__ import annotations

from pathlib import Path

from surefoot.deploy.board.signals import MotorCommand
from surefoot.deploy.messages import Mode
from surefoot.emulator.board import EmulatedBoard
from surefoot.emulator.fault_table import InjectedFault
from surefoot.emulator.firmware_process import FirmwareProcess
from surefoot.emulator.plant import Plant
from surefoot.emulator.serial.serial_host_link import SerialHostLink


class FirmwareBoard(EmulatedBoard):
    """Emulated robot with firmware in C, which has its own servo, limits and handshake, and reads bytes of the line.

    Args:
        plant: simulated body of the robot.
        program: path of the compiled firmware.
        link: serial link to hosts.
        faults: injected faults by name.

    Raises:
        SurefootError: the program cannot be started, or is for another robot.
    """

    firmware: FirmwareProcess

    def __init__(
        self, plant: Plant, program: Path, link: SerialHostLink, faults: dict[str, InjectedFault] | None = None
    ) -> None:
        self._program, self._fed = program, 0
        super().__init__(plant, link, faults)

    def counts(self) -> list[str]:
        """Return statistics of the link, for the summary."""
        return self._describe(self.firmware.statistics, self.firmware.old_numbers, self.firmware.stale)

    def _start(self) -> None:
        self.firmware = FirmwareProcess(self._program, self.plant.robot.name, self.plant.robot.num_motors)
        self.firmware.share_priority()

    def _receive(self) -> None:
        self.firmware.receive(self.now, self.link.inbound.take())

    def _decide(self) -> MotorCommand:
        now = self.plant.ticks * self._step
        if self._fed + self.firmware.watchdog < now < self.injector.hangs_until:
            # The microcontroller's watchdog resets a program that hangs.
            self.injector.hangs_until = now
            self._reboot(now)
        return super()._decide()

    def _compute_command(self, now: int) -> MotorCommand:
        if not self._fed:
            self.firmware.share_priority()  # the loop has raised it by now
        self._fed = now
        if self.plant.ticks % self.plant.servo_every:
            return self._last  # the servo runs less often than the physics
        injector, plant = self.injector, self.plant
        effort = injector.efforts(self.firmware.tick(now, injector.servo_readings(plant.servo_readings())))
        if plant.robot.actuator.kind == "joint":
            effort = effort / plant.world.actuation.max_torque[0]
        return MotorCommand(Mode.PWM, effort)
