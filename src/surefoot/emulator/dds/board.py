"""An emulated Go2: body, messages and motion service, advanced in time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from surefoot.deploy.board.signals import microseconds
from surefoot.deploy.dds.low_level import POS_STOP, SERVO, VEL_STOP, Record, encode
from surefoot.emulator.dds.link import LowLevelLink
from surefoot.emulator.dds.low_state import StateMessage
from surefoot.emulator.plant import JointOrder, Plant

STATE_PERIOD = 2_000
"""Time between two states [us]."""


def read_order(command: Record, motors: int) -> JointOrder | None:
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
    return JointOrder(angle, speed, feedforward * on, kp, kd)


class Go2Board:
    """The whole emulated robot. Times are whole microseconds since it was switched on.

    It has no watchdog: motors follow the last command for ever. At the end of a servo step the state is sent, then the
    newest command that has arrived becomes the order of the next step. A command in answer to a state thus acts a
    servo step after that state.
    """

    def __init__(self, plant: Plant, link: LowLevelLink, lead: float, seed: int = 0) -> None:
        self.plant, self.link = plant, link
        self.now = 0
        self.on_step: list[Callable[[int], None]] = []
        """Called with the time [us] after each servo step."""
        self._step = microseconds(plant.robot.timing.servo_step)
        self._lead = lead
        self._message = StateMessage(plant, lead, seed)
        none = np.zeros(plant.robot.num_motors)
        self._order = JointOrder(none, none, none, none, none)

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
        link = self.link
        return [f"states sent {link.sent}", f"commands received {link.received}, damaged {link.damaged}"]

    def run_to(self, time: int) -> None:
        """Run everything that happens until a time."""
        while self.next_step <= time:
            self._advance()
        self.now = max(self.now, time)

    def _advance(self) -> None:
        self.plant.step(self._order)
        self.now = now = self.plant.ticks * self._step
        self._message.accelerometer.measure()
        for observe in self.on_step:
            observe(now)
        if now % STATE_PERIOD < self._step:
            self.link.send(now, encode(self._message.fill(now // 1000, self.plant.read(0.0, self._lead))))
        self._obey()

    def _obey(self) -> None:
        """Take the order of the next step from the newest command."""
        commands, self.link.inbound = self.link.inbound, []
        for command in reversed(commands):
            order = read_order(command, self.plant.robot.num_motors)
            if order is not None:
                self._order = order
                return
