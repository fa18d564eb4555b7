"""An emulated robot whose microcontroller runs a firmware in C."""

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
    """The whole emulated robot. The firmware has its own servo, limits and handshake, and takes bytes of the line.

    Args:
        program: the firmware's program.

    Raises:
        SurefootError: the program can't be started, or is not one of this robot.
    """

    firmware: FirmwareProcess

    def __init__(
        self, plant: Plant, program: Path, link: SerialHostLink, faults: dict[str, InjectedFault] | None = None
    ) -> None:
        self._program, self._fed = program, 0
        super().__init__(plant, link, faults)

    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""
        return self._describe(self.firmware.statistics, self.firmware.old_numbers, self.firmware.stale)

    def _start(self) -> None:
        self.firmware = FirmwareProcess(self._program, self.plant.robot.name, self.plant.robot.num_motors)
        self.firmware.share_priority()

    def _receive(self) -> None:
        self.firmware.receive(self.now, self.link.inbound.take())

    def _decide(self) -> MotorCommand:
        now = self.plant.ticks * self._step
        if self._fed + self.firmware.watchdog < now < self.injector.hangs_until:
            # The microcontroller's watchdog resets a program that stands still.
            self.injector.hangs_until = now
            self._reboot(now)
        return super()._decide()

    def _compute_command(self, now: int) -> MotorCommand:
        if not self._fed:
            self.firmware.share_priority()  # which the loop has raised by now
        self._fed = now
        if self.plant.ticks % self.plant.servo_every:
            return self._last  # a servo that runs less often than the physics
        injector, plant = self.injector, self.plant
        effort = injector.efforts(self.firmware.tick(now, injector.servo_readings(plant.servo_readings())))
        if plant.robot.actuator.kind == "joint":
            effort = effort / plant.world.actuation.max_torque[0]
        return MotorCommand(Mode.PWM, effort)
