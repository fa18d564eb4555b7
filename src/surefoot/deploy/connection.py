"""A robot at the other end of a link: greeting it, what it last said, and what can be asked of it."""

from __future__ import annotations

import math
import secrets
from collections.abc import Callable

from surefoot.arrays import Array
from surefoot.deploy.clock import Clock, ClockSync, LockstepClock, MonotonicClock
from surefoot.deploy.messages import (
    Arm,
    Bye,
    Damp,
    Disarm,
    Fault,
    Handshake,
    Hello,
    Mode,
    Pong,
    Position,
    Pwm,
    Reason,
    State,
)
from surefoot.deploy.serial.codec import VERSION, Codec
from surefoot.deploy.serial.port import BAUD, SerialPort
from surefoot.deploy.serial.serial_link import Arrival, Link
from surefoot.errors import SurefootError

STATE_PERIOD = 0.010
"""Time [s] between two states that a robot is asked for while it gets no commands."""
LEAD = 0.005
"""How long [s] before the next control step the robot is to send its state.

At 921,600 baud a command of 8 motors takes 0.6 ms to come and a state 1.7 ms to go; 0.5 ms for the policy. The rest is
to spare: a state that comes too late is a whole control step older, one that comes too early a millisecond or two."""
_POLL = 0.002


class RobotConnection:
    """What one operator knows of a robot, and may ask of it. Nothing here waits but `connect` and `wait_for`.

    Args:
        link: to the robot.
        clock: this computer's.
        session: number of this operator's session; drawn, if not given.
    """

    def __init__(self, link: Link, clock: Clock, session: int | None = None) -> None:
        self.link, self.clock = link, clock
        self.session = session or 1 + secrets.randbelow(2**16 - 1)
        self.sync = ClockSync()
        self.handshake: Handshake | None = None
        self.state: State | None = None
        """The newest state."""
        self.state_sent = 0.0
        """When it was sent, on the robot's clock [s]."""
        self.states = 0
        """States that have come."""
        self.faults: list[Fault] = []
        """What the robot has complained about, oldest first."""
        self.pongs: dict[int, Arrival] = {}
        """Answers to pings, by token."""
        self.on_state: Callable[[State, float, float], None] | None = None
        """Called for each state with the robot's time [s] and this computer's [s]."""

    @property
    def lockstep(self) -> bool:
        """Whether the robot follows this computer's clock."""
        return isinstance(self.clock, LockstepClock)

    @property
    def lead(self) -> float:
        """How long before the next control step the robot is to send its state [s]."""
        return 0.0 if self.lockstep else LEAD

    def connect(self, timeout: float = 2.0, state_period: float = STATE_PERIOD) -> Handshake:
        """Greet the robot and take what it says of itself.

        Raises:
            SurefootError: no answer, a robot of another protocol, or one that another operator has.
        """
        end = self.clock.now() + timeout
        self.handshake = None
        while self.clock.now() < end:
            self.link.greeted = self.session
            self.link.send(Hello(self.session, state_period))
            try:
                answered = self.wait_for(lambda: self.handshake is not None or self._refusal() is not None, 0.1)
            except SurefootError:
                # In lockstep a robot of another protocol does not answer pings either: say so, if it was heard.
                self._check_protocol()
                raise
            if answered:
                if self.handshake is not None:
                    return self.handshake
                raise SurefootError(f"the robot refuses: {self._refusal()}")
            self._check_protocol()
        raise SurefootError(
            f"no robot answers within {timeout:g} s; check port, cable and baud rate, and that it is switched on"
        )

    def _refusal(self) -> str | None:
        return next((fault.text for fault in self.faults if fault.reason == Reason.BUSY), None)

    def _check_protocol(self) -> None:
        foreign = self.link.decoder.foreign
        if foreign is not None:
            codec = self.link.codec
            raise SurefootError(
                f"the robot speaks version {foreign[0]} and schema {foreign[1]:#010x} of the protocol; this surefoot "
                f"speaks version {VERSION} and schema {codec.schema:#010x} (for {codec.motors} motors): "
                f"build its firmware with python -m surefoot.deploy.serial.c_header --motors {codec.motors}"
            )

    def update(self) -> None:
        """Take all that has come."""
        for arrival in self.link.receive():
            message = arrival.frame.message
            if isinstance(message, Handshake):
                if message.session == self.session and self.handshake is None:
                    # What was heard before was meant for another operator.
                    self.handshake, self.state = message, None
                    self.sync.forget()
            elif isinstance(message, Fault):
                if message.session in (0, self.session):
                    self.faults.append(message)
            elif isinstance(message, Pong):
                self.pongs[message.token] = arrival
            elif isinstance(message, State):
                self.state, self.state_sent = message, arrival.frame.time
                self.states += 1
                if self.on_state is not None:
                    self.on_state(message, arrival.frame.time, arrival.time)
            self.sync.add(arrival.frame.time, arrival.time)

    def last_state(self) -> State:
        """The newest state.

        Raises:
            SurefootError: none has come yet.
        """
        if self.state is None:
            raise SurefootError("the robot has told nothing of itself yet")
        return self.state

    def state_age(self) -> float:
        """How long ago the newest state was sent [s], the quickest way of a frame not counted."""
        return self.sync.age(self.state_sent, self.clock.now()) if self.state is not None else float("inf")

    def wait_for(self, condition: Callable[[], bool], timeout: float, each: Callable[[], None] | None = None) -> bool:
        """Take what comes until a condition holds; whether it did within `timeout` [s].

        Args:
            condition: looked at after each look at the link.
            timeout: on this computer's clock.
            each: called before each look, such as to ping.
        """
        end = self.clock.now() + timeout
        while True:
            self.update()
            if condition():
                return True
            if self.clock.now() >= end:
                return False
            if each is not None:
                each()
            self.clock.wait_until(min(self.clock.now() + _POLL, end))

    def arm(self, mode: Mode, command_period: float, lead: float | None = None) -> None:
        """Ask the robot to follow commands that come every `command_period` [s].

        Times of sending are rounded to a microsecond: a state that is due so much before the next command, rounded
        down, is never due after it.
        """
        report_after = max(command_period - (self.lead if lead is None else lead), 0.0)
        report_after = math.floor(1e6 * report_after + 1e-3) * 1e-6
        self.link.send(Arm(self.session, int(mode), command_period, report_after))

    def command(self, mode: Mode, values: Array) -> None:
        """Send motor angles (M,) [rad], or a duty for each motor (M,) if the mode is that of duties."""
        kind = Pwm if mode == Mode.PWM else Position
        self.link.send(kind(self.session, values))

    def damp(self) -> None:
        """Have the motors damped at once."""
        self.link.send(Damp(self.session))

    def disarm(self) -> None:
        """End commands in good order."""
        self.link.send(Disarm(self.session))

    def close(self) -> None:
        """End the session and give the port back."""
        try:
            self.link.send(Bye(self.session))
        finally:
            self.link.close()


def open_connection(port: str, motors: int, lockstep: bool = False, baud: int = BAUD) -> RobotConnection:
    """Open a port to a robot.

    Args:
        port: path of a serial port or pseudo-terminal.
        motors: number of motors.
        lockstep: the other end is an emulator that follows this computer's clock.
        baud: bits a second.

    Raises:
        SurefootError: a port that can't be opened, or that another program has.
    """
    clock = LockstepClock() if lockstep else MonotonicClock()
    return RobotConnection(Link(SerialPort(port, baud), Codec(motors), clock), clock)
