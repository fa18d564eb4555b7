"""Emulated Go2: simulated body, messages and motion service."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from surefoot.deploy.board.signals import microseconds
from surefoot.deploy.dds.low_level import POS_STOP, SERVO, VEL_STOP, Record, encode
from surefoot.emulator.board import BOOT_TIME
from surefoot.emulator.dds.faults import MessageFaults
from surefoot.emulator.dds.link import LowLevelLink
from surefoot.emulator.dds.low_state import StateMessage
from surefoot.emulator.dds.motion_service import EmulatedMotionService
from surefoot.emulator.dds.own_controller import OwnController
from surefoot.emulator.fault_table import InjectedFault
from surefoot.emulator.faults import FaultInjector
from surefoot.emulator.plant import JointCommand, Plant
from surefoot.seeding import generator


def read_joint_command(command: Record, motors: int) -> JointCommand | None:
    """Return the joint command of a low-level message, or None if a number is not finite.

    A motor with a mode other than `SERVO` gets no torque. `POS_STOP` as angle and `VEL_STOP` as speed switch off their
    terms of the PD law. How a real robot treats values that are not finite is unknown; this one ignores the message.
    """
    sent = command["motor_cmd"][:motors]
    angle, speed, feedforward, kp, kd = (sent[name].astype(float) for name in ("q", "dq", "tau", "kp", "kd"))
    if not np.isfinite([angle, speed, feedforward, kp, kd]).all():
        return None
    on = sent["mode"] == SERVO
    kp *= on & (sent["q"] != np.float32(POS_STOP))
    kd *= on & (sent["dq"] != np.float32(VEL_STOP))
    return JointCommand(angle, speed, feedforward * on, kp, kd)


class Go2Board:
    """Emulated Go2. Times are whole microseconds since it was switched on.

    It has no watchdog: motors follow the last command indefinitely. At the end of a servo step the state is sent, then
    the newest command that has arrived is used for the next step. A command in answer to a state is thus applied one
    servo step after that state. If several programs send commands, including the robot's own controller, each servo
    step follows one of them at random, since the order of arrival is undefined.

    Args:
        plant: simulated body with an accelerometer; its motors start without torque.
        link: topics of states and commands.
        lead: time from the sending of a state to its use by a deployment, see `Plant.read` [s].
        controller: the robot's own controller.
        service: its services; None if they do not answer.
        faults: injected faults by name.
        seed: seed of random commands and faults.
    """

    def __init__(
        self,
        plant: Plant,
        link: LowLevelLink,
        lead: float,
        controller: OwnController | None = None,
        service: EmulatedMotionService | None = None,
        faults: Mapping[str, InjectedFault] | None = None,
        seed: int = 0,
    ) -> None:
        self.plant, self.link, self.controller, self._service = plant, link, controller or OwnController(), service
        self.now = 0
        self.on_step: list[Callable[[int], None]] = []
        """Called with the time [us] after each servo step."""
        self._step, self._lead = microseconds(plant.robot.timing.servo_step), lead
        self._injector = FaultInjector(faults or {}, plant)
        self._faults = MessageFaults(self._injector, seed)
        self._message = StateMessage(plant, lead, seed)
        self._random = generator(seed, "order of commands")
        none = np.zeros(plant.robot.num_motors)
        self._joint_command = self._no_torque = JointCommand(none, none, none, none, none)
        self._commanded = self._service_back = False
        self._next_state = self._booted = self._switched_on = 0

    @property
    def next_step(self) -> int:
        """End of the servo step in progress."""
        return (self.plant.ticks + 1) * self._step

    @property
    def next_time(self) -> float:
        """Time of the next event."""
        return max(min(self.next_step, self.link.next_departure), self.now)

    def counts(self) -> list[str]:
        """Return statistics of the link, for the summary."""
        return [*self.link.counts(), f"motion service {self.controller.name or 'released'}"]

    def run_to(self, time: int) -> None:
        """Process all events until a time."""
        while self.next_step <= time:
            self._advance()
        self.now = max(self.now, time)

    def _advance(self) -> None:
        faults, injector = self._faults, self._injector
        self.plant.step(faults.joint_command(self._joint_command) if faults.enabled else self._joint_command)
        self.now = now = self.plant.ticks * self._step
        if faults.enabled:
            injector.tick(now, self._commanded)
            self._apply_faults(now)
        for observe in self.on_step:
            observe(now)
        if now < max(self._booted, injector.hangs_until):
            self.link.inbound.clear()
            return
        if now >= self._next_state:
            self._next_state = max(self._next_state + faults.period, now + 1)
            self._send(now)
        if self._service is not None:
            self._service.step(now, self._message.record)
        self._receive_commands(now)

    def _apply_faults(self, now: int) -> None:
        """Apply the faults of the whole robot."""
        injector = self._injector
        if injector.active_fault("unplug"):
            self.link.unplugged = True
        if not self._booted and injector.has_started("reboot"):
            # After the startup time, ticks restart at 0, and the last command is lost.
            self._booted = self._switched_on = now + BOOT_TIME
            self._joint_command = self._no_torque
        if not self._service_back and injector.active_fault("service-back"):
            self._service_back = True
            self.controller.activate()
            self.controller.stand_up()

    def _send(self, now: int) -> None:
        faults, message = self._faults, self._message
        sensors = self._injector.sensors(self.plant.read(0.0, self._lead))
        message.fill((now - self._switched_on) // 1000, sensors)
        if not faults.enabled:
            self.link.send(now, encode(message.record))
            return
        faults.change(message, now)
        for data in faults.packets(encode(message.record)):
            self.link.send(now + faults.delay, data)

    def _receive_commands(self, now: int) -> None:
        """Choose the command of the next step from the newest commands of all programs."""
        link, faults, motors = self.link, self._faults, self.plant.robot.num_motors
        received, link.inbound = link.inbound, []
        candidates = []
        for command in reversed(received):
            if faults.enabled and faults.drops_command():
                continue
            joint_command = read_joint_command(command, motors)
            if joint_command is not None:
                candidates.append(joint_command)
                self._commanded = True
                break
        angles = self.plant.world.actuation.sample[0, :motors]
        for own in (self.controller.command(now, angles), faults.other_command(angles)):
            if own is not None:
                link.publish_command(own)
                joint_command = read_joint_command(own, motors)
                assert joint_command is not None
                candidates.append(joint_command)
        if candidates:
            count = len(candidates)
            self._joint_command = candidates[int(self._random.integers(count))] if count > 1 else candidates[0]
