"""A link between the control computer and a robot, whatever carries its messages."""

from __future__ import annotations

import math
import secrets
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

from surefoot.arrays import Array
from surefoot.check_result import CheckResult
from surefoot.deploy import messages
from surefoot.deploy.clock import Clock, ClockSync, LockstepClock
from surefoot.deploy.messages import Fault, Handshake, Message, Mode, Packet, Pong, Reason, State
from surefoot.errors import SurefootError

STATE_PERIOD = 0.010
"""Time [s] between two states while a robot receives no commands."""
LISTEN_TIME = 5.0
"""Time [s] for which nobody else must have commanded the motors before they are armed."""
_POLL, _PING_PERIOD = 0.002, 0.05


class LinkLostError(RuntimeError):
    """The link is gone: unplugged, or its other end has closed."""


@dataclass(frozen=True)
class ReceivedPacket:
    """A packet, and when it was received [s], on the receiver's clock."""

    packet: Packet
    time: float


@dataclass
class LinkStatistics:
    """Counts of packets at one end of a link since it was opened."""

    sent: int = 0
    unsent: int = 0
    """Not accepted by the port."""
    received: int = 0
    """Valid packets."""
    damaged: int = 0
    foreign: int = 0
    """Packets of another protocol version or schema."""
    unknown: int = 0
    """Packets whose kind, length or text this version does not have."""
    repeated: int = 0
    """Dropped, because their sequence number was not above the last one's."""
    missing: int = 0
    """Gaps in the sequence numbers of received packets."""


class RobotLink(ABC):
    """One operator's link to a robot, and the newest that the robot has reported. Only `connect` and waits take time.

    A robot damps its motors by itself when no command comes for `Handshake.command_timeout`. A link to motors that
    hold the last command instead must keep a process beside the control loop that damps them.

    Args:
        clock: this computer's; in lockstep the robot follows it.
        lead: time [s] between a state's sending and the control step that uses it, in real time.
        session: number of the operator's session; drawn, if not given.
    """

    advice = "check that it is switched on"
    """Remedy for a robot that does not answer."""
    hears_others = False
    """Whether the link would tell of other programs that command the motors."""

    def __init__(self, clock: Clock, lead: float, session: int | None = None) -> None:
        self.clock, self.session = clock, session or 1 + secrets.randbelow(2**16 - 1)
        self.lockstep = isinstance(clock, LockstepClock)
        """Whether the robot follows this computer's clock."""
        self.lead = 0.0 if self.lockstep else lead
        self.statistics = LinkStatistics()
        self.sync = ClockSync()
        self.handshake: Handshake | None = None
        self.state: State | None = None
        self.state_sent, self.states = 0.0, 0
        """The newest state, when it was sent on the robot's clock [s], and the number of states received."""
        self.faults: list[Fault] = []
        """Faults that the robot has reported, oldest first."""
        self.pongs: dict[int, ReceivedPacket] = {}
        """Answers to pings, by token."""
        self.on_state: Callable[[State, float, float], None] | None = None
        """Called for each state with the robot's time [s] and this computer's [s]."""
        self.preliminary_checks: list[CheckResult] = []
        """Results of checks that were done before the link was opened."""
        self.foreign_commands: list[float] = []
        """When the robot reported that another program commands its motors, while it was not armed [s]."""
        self.connected = -math.inf
        """When the handshake came [s]."""
        self._tokens = 0

    # What carries the messages.

    @property
    @abstractmethod
    def next_number(self) -> int:
        """Number of the next message, as in `State.command`; consecutive while only commands are sent."""

    @abstractmethod
    def send(self, message: Message) -> object:
        """Send a message; never waits."""

    @abstractmethod
    def receive(self) -> list[ReceivedPacket]:
        """Return all packets that have arrived since the last call, in order; never waits.

        Raises:
            LinkLostError: the link is gone.
        """

    @abstractmethod
    def wait(self, timeout: float) -> None:
        """Wait until something can be received, at most `timeout` [s]."""

    @abstractmethod
    def close(self) -> None:
        """End the session and the link."""

    def protocol_error(self) -> str | None:
        """Return how the protocol of what was received differs from this one; None if it does not."""
        return None

    # What an operator sends.

    def connect(self, timeout: float = 2.0, state_period: float = STATE_PERIOD) -> Handshake:
        """Start or continue a session, with a state every `state_period` [s] while no command comes.

        Raises:
            SurefootError: no answer, a robot of another protocol, or one that another operator has.
        """
        end = self.clock.now() + timeout
        self.handshake = None
        while self.clock.now() < end:
            self.send(messages.Hello(self.session, state_period))
            try:
                self.wait_for(lambda: self.handshake is not None or self._refusal() is not None, 0.1)
            except SurefootError as error:
                # In lockstep a robot of another protocol does not answer pings either.
                raise SurefootError(self.protocol_error() or str(error)) from error
            if self.handshake is not None:
                return self.handshake
            if self._refusal() is not None:
                raise SurefootError(f"the robot refuses: {self._refusal()}")
            if (different := self.protocol_error()) is not None:
                raise SurefootError(different)
        raise SurefootError(f"no robot answers within {timeout:g} s; {self.advice}")

    def _refusal(self) -> str | None:
        return next((fault.text for fault in self.faults if fault.reason == Reason.BUSY), None)

    def ping(self) -> int:
        """Send a ping, which keeps the session alive; return the token that its pong in `pongs` repeats."""
        self._tokens += 1
        self.send(messages.Ping(self._tokens))
        return self._tokens

    def arm(self, mode: Mode, command_period: float, lead: float | None = None) -> None:
        """Ask the robot to follow commands that come every `command_period` [s]; `lead` in place of the link's [s].

        A state is due a whole number of microseconds after a command. It is rounded down, so that it is never due after
        the next command.
        """
        report_after = max(command_period - (self.lead if lead is None else lead), 0.0)
        report_after = math.floor(1e6 * report_after + 1e-3) * 1e-6
        self.send(messages.Arm(self.session, int(mode), command_period, report_after))

    def command(self, mode: Mode, values: Array) -> None:
        """Send motor angles (M,) [rad], or a duty for each motor (M,) in the mode of duties."""
        self.send((messages.Pwm if mode == Mode.PWM else messages.Position)(self.session, values))

    def damp(self) -> None:
        """Ask the robot to damp its motors at once."""
        self.send(messages.Damp(self.session))

    def disarm(self) -> None:
        """Ask the robot to disarm: it damps its motors and refuses commands."""
        self.send(messages.Disarm(self.session))

    # What the robot has sent.

    def update(self) -> None:
        """Receive all that has come."""
        for arrival in self.receive():
            packet = arrival.packet
            message = packet.message
            if isinstance(message, State):
                self.state, self.state_sent = message, packet.time
                self.states += 1
                if self.on_state is not None:
                    self.on_state(message, packet.time, arrival.time)
            elif isinstance(message, Pong):
                self.pongs[message.token] = arrival
            elif isinstance(message, Fault):
                if message.session in (0, self.session):
                    self.faults.append(message)
                    if message.reason == Reason.OTHER_PROGRAM:
                        self.foreign_commands.append(arrival.time)
            elif isinstance(message, Handshake) and message.session == self.session and self.handshake is None:
                # States before it were meant for another operator.
                self.handshake, self.state, self.connected = message, None, arrival.time
                self.sync.reset()
            self.sync.add(packet.time, arrival.time)

    def last_state(self) -> State:
        """Return the newest state.

        Raises:
            SurefootError: none has come yet.
        """
        if self.state is None:
            raise SurefootError("the robot has sent no state yet")
        return self.state

    def fault_text(self, reason: int) -> str:
        """Return the text of the last fault with a reason; empty if there was none."""
        return next((fault.text for fault in reversed(self.faults) if fault.reason == reason), "")

    def listen(self) -> str:
        """Wait until the link has heard for `LISTEN_TIME` whether other programs command the motors.

        Return what was heard in that time, empty if nothing.
        """
        if not self.hears_others:
            return ""
        left = self.connected + LISTEN_TIME - self.clock.now()
        if left > 0:
            self.ping_until(lambda: bool(self.foreign_commands), left)
        now = self.clock.now()
        heard = [now - at for at in self.foreign_commands if now - at < LISTEN_TIME]
        if not heard:
            return ""
        count = f"{len(heard)} message{'s' if len(heard) > 1 else ''}"
        return f"another program commands the motors: {count}, the last {heard[-1]:.1f} s ago"

    def ping_until(self, condition: Callable[[], bool], timeout: float, period: float = _PING_PERIOD) -> bool:
        """Wait until a condition holds, at most `timeout` [s], and ping every `period` [s]; return whether it does."""
        last = -math.inf

        def ping() -> None:
            nonlocal last
            if self.clock.now() - last >= period:
                last = self.clock.now()
                self.ping()

        return self.wait_for(condition, timeout, ping)

    def state_age(self) -> float:
        """Return how long ago the newest state was sent [s], the transmission time of the quickest packet left out."""
        return self.sync.age(self.state_sent, self.clock.now()) if self.state is not None else math.inf

    def wait_for(self, condition: Callable[[], bool], timeout: float, each: Callable[[], None] | None = None) -> bool:
        """Receive until a condition holds; return whether it did within `timeout` [s] of this computer's clock.

        `each` is called whenever it does not hold yet, such as to ping.
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
