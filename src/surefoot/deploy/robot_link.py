"""Link between the control computer and a robot, independent of the transport."""

from __future__ import annotations

import contextlib
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
"""Period of states while a robot receives no commands [s]."""
LISTEN_TIME = 5.0
"""Time without motor commands of other programs that is required before arming [s]."""
_POLL_PERIOD, _PING_PERIOD = 0.002, 0.05


class LinkLostError(RuntimeError):
    """The link is lost: it was unplugged, or the other end has closed it."""


@dataclass(frozen=True)
class ReceivedPacket:
    """A packet and its time of arrival on the receiver's clock [s]."""

    packet: Packet
    time: float


@dataclass
class LinkStatistics:
    """Packet counts at one end of a link since it was opened."""

    sent: int = 0
    unsent: int = 0
    """Packets that the port did not accept."""
    received: int = 0
    """Valid packets."""
    damaged: int = 0
    foreign: int = 0
    """Packets of another protocol version or schema."""
    unknown: int = 0
    """Packets with a type, length or text that this version does not know."""
    repeated: int = 0
    """Packets dropped because their sequence number did not increase."""
    missing: int = 0
    """Gaps in the sequence numbers of received packets."""


class RobotLink(ABC):
    """One operator's link to a robot, with the latest data that the robot has reported.

    Only `connect` and the methods that wait take time. A robot damps its motors when it receives no command for
    `Handshake.command_timeout`. If the motors of a robot hold the last command instead, its link must run another
    process that damps them.

    Args:
        clock: this computer's clock; in lockstep the robot follows it.
        lead: time from the sending of a state to the control step that uses it, in real time [s].
        session: number of the operator's session. Defaults to a random one.
    """

    advice = "check that it is switched on"
    """Advice to the operator if the robot does not answer."""
    detects_other_programs = False
    """Whether the link reports other programs that command the motors."""

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
        """Latest state, the time at which it was sent on the robot's clock [s], and the number of states received."""
        self.faults: list[Fault] = []
        """Faults that the robot has reported, oldest first."""
        self.pongs: dict[int, ReceivedPacket] = {}
        """Answers to pings, by token."""
        self.on_state: Callable[[State, float, float], None] | None = None
        """Called with each state, its sending time on the robot's clock and its arrival on this computer's [s]."""
        self.preliminary_checks: list[CheckResult] = []
        """Results of checks made before the link was opened."""
        self.foreign_commands: list[float] = []
        """Times at which the disarmed robot reported motor commands of another program [s]."""
        self.connected = -math.inf
        """Time of the handshake [s]."""
        self._tokens = 0

    # Transport.

    @property
    @abstractmethod
    def next_number(self) -> int:
        """Sequence number of the next message, as in `State.command`; consecutive while only commands are sent."""

    @abstractmethod
    def send(self, message: Message) -> object:
        """Send a message without waiting."""

    @abstractmethod
    def receive(self) -> list[ReceivedPacket]:
        """Return all packets that have arrived since the last call, in order, without waiting.

        Raises:
            LinkLostError: the link is lost.
        """

    @abstractmethod
    def wait(self, timeout: float) -> None:
        """Wait until data can be received, at most `timeout` [s]."""

    @abstractmethod
    def close(self) -> None:
        """End the session and close the link."""

    def protocol_error(self) -> str | None:
        """Return how the protocol of received packets differs from this one, or None."""
        return None

    # Messages to the robot.

    def connect(self, timeout: float = 2.0, state_period: float = STATE_PERIOD) -> Handshake:
        """Start or continue a session, with a state every `state_period` [s] while no commands are sent.

        Raises:
            SurefootError: no answer, another protocol, or a robot that another operator uses.
        """
        end = self.clock.now() + timeout
        self.handshake = None
        while self.clock.now() < end:
            self.send(messages.Hello(self.session, state_period))
            try:
                self.wait_for(lambda: self.handshake is not None or self._rejection() is not None, 0.1)
            except SurefootError as error:
                # In lockstep, a robot with another protocol does not answer pings either.
                raise SurefootError(self.protocol_error() or str(error)) from error
            if self.handshake is not None:
                return self.handshake
            if self._rejection() is not None:
                raise SurefootError(f"the robot rejects the connection: {self._rejection()}")
            if (different := self.protocol_error()) is not None:
                raise SurefootError(different)
        raise SurefootError(f"no robot answers within {timeout:g} s; {self.advice}")

    def _rejection(self) -> str | None:
        return next((fault.text for fault in self.faults if fault.reason == Reason.BUSY), None)

    def ping(self) -> int:
        """Send a ping, which keeps the session alive; return the token that its answer in `pongs` repeats."""
        self._tokens += 1
        self.send(messages.Ping(self._tokens))
        return self._tokens

    def arm(self, mode: Mode, command_period: float, lead: float | None = None) -> None:
        """Ask the robot to follow commands with period `command_period` [s]; `lead` [s] defaults to the link's.

        A state is due a whole number of microseconds after a command. The delay is rounded down, so that the state is
        never due after the next command.
        """
        report_after = max(command_period - (self.lead if lead is None else lead), 0.0)
        report_after = math.floor(1e6 * report_after + 1e-3) * 1e-6
        self.send(messages.Arm(self.session, int(mode), command_period, report_after))

    def command(self, mode: Mode, values: Array) -> None:
        """Send a motor command (M,): angles [rad], or duties in PWM mode."""
        self.send((messages.Pwm if mode == Mode.PWM else messages.Position)(self.session, values))

    def damp(self) -> None:
        """Ask the robot to damp its motors immediately."""
        self.send(messages.Damp(self.session))

    def disarm(self) -> None:
        """Ask the robot to disarm: it damps its motors and rejects commands."""
        self.send(messages.Disarm(self.session))

    # Messages from the robot.

    def update(self) -> None:
        """Process all packets that have arrived."""
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
                # Earlier states were meant for another operator.
                self.handshake, self.state, self.connected = message, None, arrival.time
                self.sync.reset()
            self.sync.add(packet.time, arrival.time)

    def last_state(self) -> State:
        """Return the latest state.

        Raises:
            SurefootError: none has arrived yet.
        """
        if self.state is None:
            raise SurefootError("the robot has sent no state yet")
        return self.state

    def fault_text(self, reason: int) -> str:
        """Return the text of the last fault with this reason, or ""."""
        return next((fault.text for fault in reversed(self.faults) if fault.reason == reason), "")

    def listen(self) -> str:
        """Check for `LISTEN_TIME` since the handshake whether other programs command the motors.

        Returns:
            A message about commands seen in the last `LISTEN_TIME`, or "".
        """
        if not self.detects_other_programs:
            return ""
        left = self.connected + LISTEN_TIME - self.clock.now()
        if left > 0:
            self.ping_until(lambda: bool(self.foreign_commands), left)
        now = self.clock.now()
        ages = [now - at for at in self.foreign_commands if now - at < LISTEN_TIME]
        if not ages:
            return ""
        count = f"{len(ages)} message{'s' if len(ages) > 1 else ''}"
        return f"another program commands the motors: {count}, the last {ages[-1]:.1f} s ago"

    def ping_until(self, condition: Callable[[], bool], timeout: float, period: float = _PING_PERIOD) -> bool:
        """Ping every `period` [s] until a condition holds, at most `timeout` [s]; return whether it holds."""
        last = -math.inf

        def ping() -> None:
            nonlocal last
            if self.clock.now() - last >= period:
                last = self.clock.now()
                self.ping()

        return self.wait_for(condition, timeout, ping)

    def state_age(self) -> float:
        """Return the age of the latest state [s], since its sending; the fastest packet counts as instantaneous."""
        return self.sync.age(self.state_sent, self.clock.now()) if self.state is not None else math.inf

    def wait_for(self, condition: Callable[[], bool], timeout: float, each: Callable[[], None] | None = None) -> bool:
        """Receive packets until a condition holds; return whether it did within `timeout` [s] of this computer's clock.

        `each` is called each time the condition does not hold yet, for example to ping.
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
            self.clock.wait_until(min(self.clock.now() + _POLL_PERIOD, end))


def close_link(link: RobotLink, warn: Callable[[str], object]) -> None:
    """Close a link whose session has its result: a Go2's own controller that is not activated is a warning."""
    try:
        with contextlib.suppress(LinkLostError, OSError):
            link.close()
    except SurefootError as error:
        warn(str(error))
