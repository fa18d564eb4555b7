"""An emulated Go2: body, messages and motion service, advanced in time."""

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
    """Return what the vendor's PD law asks of motors; None if a number is not finite.

    A motor whose mode is not `SERVO` gets no torque. `POS_STOP` as an angle and `VEL_STOP` as a speed mean none: the
    term is left out. What a real robot does with numbers that are not finite is not known; this one ignores the frame.
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
    """The whole emulated robot. Times are whole microseconds since it was switched on.

    It has no watchdog: motors follow the last command for ever. At the end of a servo step the state is sent, then the
    newest command that has arrived becomes the order of the next step. A command in answer to a state thus acts a
    servo step after that state. Where several programs command, the robot's own controller among them, each servo step
    follows one of them at random, as nothing fixes whose command comes last.

    Args:
        plant: the body; its motors have no torque at first.
        link: topics of states and commands.
        lead: time [s] between a state's sending and its use by a deployment, as `Plant.read` takes it.
        controller: the robot's own controller.
        service: its services; none, if they are silent.
        faults: by name.
        seed: of all that is random here.
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
        self._order = self._limp = JointCommand(none, none, none, none, none)
        self._commanded = self._service_back = False
        self._next_state = self._booted = self._switched_on = 0

    @property
    def next_step(self) -> int:
        """When the servo step in progress ends."""
        return (self.plant.ticks + 1) * self._step

    @property
    def next_time(self) -> float:
        """When there is something to do next."""
        return max(min(self.next_step, self.link.next_departure), self.now)

    def counts(self) -> list[str]:
        """Return what happened on its link, for the line at the end."""
        return [*self.link.counts(), f"motion service {self.controller.name or 'released'}"]

    def run_to(self, time: int) -> None:
        """Run everything that happens until a time."""
        while self.next_step <= time:
            self._advance()
        self.now = max(self.now, time)

    def _advance(self) -> None:
        faults, injector = self._faults, self._injector
        self.plant.step(faults.order(self._order) if faults.any else self._order)
        self.now = now = self.plant.ticks * self._step
        self._message.accelerometer.measure()
        if faults.any:
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
        self._obey(now)

    def _apply_faults(self, now: int) -> None:
        """Do what faults do to the whole robot."""
        injector = self._injector
        if injector.active("unplug"):
            self.link.dead = True
        if not self._booted and injector.began("reboot"):
            # A restart takes its time; then ticks count anew, and the last command is forgotten.
            self._booted = self._switched_on = now + BOOT_TIME
            self._order = self._limp
        if not self._service_back and injector.active("service-back"):
            self._service_back = True
            self.controller.activate()
            self.controller.stand_up()

    def _send(self, now: int) -> None:
        faults, message = self._faults, self._message
        sensors = self._injector.sensors(self.plant.read(0.0, self._lead))
        message.fill((now - self._switched_on) // 1000, sensors)
        if not faults.any:
            self.link.send(now, encode(message.record))
            return
        faults.change(message, now)
        for data in faults.packets(encode(message.record)):
            self.link.send(now + faults.delay, data)

    def _obey(self, now: int) -> None:
        """Take the order of the next step from the newest command of everybody who commands."""
        link, faults, motors = self.link, self._faults, self.plant.robot.num_motors
        arrived, link.inbound = link.inbound, []
        orders = []
        for command in reversed(arrived):
            if faults.any and faults.drops_command():
                continue
            order = read_joint_command(command, motors)
            if order is not None:
                orders.append(order)
                self._commanded = True
                break
        angles = self.plant.world.actuation.sample[0, :motors]
        for own in (self.controller.command(now, angles), faults.other_command(angles)):
            if own is not None:
                link.publish_command(own)
                order = read_joint_command(own, motors)
                assert order is not None
                orders.append(order)
        if orders:
            self._order = orders[int(self._random.integers(len(orders)))] if len(orders) > 1 else orders[0]
