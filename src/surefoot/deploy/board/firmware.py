"""Program of a robot's microcontroller, independent of the hardware: the reference for the firmware in C.

The program uses neither physics nor ports. Its caller passes received packets to `receive`, calls `tick` once per servo
step to get the motor command, calls `report` when a state is due, and sends the packets returned by `take`. All times
are whole microseconds on the robot's clock.

    mode       motors                            next mode
    DISARMED   damped                            POSITION or PWM by Arm
    POSITION   servos follow position commands   DISARMED by Disarm or Bye; FAULT by any fault
    PWM        duty as commanded                 DISARMED by Disarm or Bye; FAULT by any fault
    FAULT      damped, the reason is stored      POSITION or PWM by Arm, once the link has been clean for long enough
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from surefoot.deploy import messages
from surefoot.deploy.board.limits import Limits
from surefoot.deploy.board.signals import Hazard, MotorCommand, Sensors, Vitals, microseconds
from surefoot.deploy.clock import ClockSync
from surefoot.deploy.messages import Handshake, Hello, Message, Mode, Packet, Position, Pwm, Reason

ARMED = (Mode.POSITION, Mode.PWM)


class LinkMonitor:
    """Checks order, age and continuity of one operator's packets; a clean link has no gaps over `clean_gap`."""

    def __init__(self, clean_gap: int) -> None:
        self.clean_gap = clean_gap
        self.last_number = self.last_received = self.old_numbers = 0
        """Highest sequence number so far, time of the last packet, and number of packets dropped for old numbers."""
        self._clean_since: int | None = None
        self._sync = ClockSync(second=1_000_000)

    def restart(self) -> None:
        """Start a new session, with new sequence numbers and a new clock."""
        self.last_number, self._clean_since = 0, None
        self._sync.reset()

    def is_next(self, number: int) -> bool:
        """Return whether a sequence number is higher than all before, and store it if so."""
        if number <= self.last_number:
            self.old_numbers += 1
            return False
        self.last_number = number
        return True

    def _is_silent(self, now: int) -> bool:
        return self._clean_since is None or now - self.last_received > self.clean_gap

    def receive(self, now: int) -> None:
        """Register the arrival of an undamaged packet."""
        if self._is_silent(now):
            self._clean_since = now
        self.last_received = now

    def note_damage(self) -> None:
        """Register a damaged packet: the link is clean again from the next undamaged packet on."""
        self._clean_since = None

    def clean_for(self, now: int) -> int:
        """Return the time for which the link has been clean."""
        return 0 if self._clean_since is None or self._is_silent(now) else now - self._clean_since

    def age(self, now: int, sent: int) -> float:
        """Return the age of a packet sent at time `sent` on the operator's clock; see `ClockSync`."""
        self._sync.add(sent, now)
        return self._sync.age(sent, now)


class Firmware:
    """Program of a microcontroller; see the module."""

    def __init__(self, handshake: Handshake, limits: Limits) -> None:
        self.handshake, self.limits = handshake, limits
        self.link_monitor = LinkMonitor(microseconds(limits.clean_gap))
        self.mode, self.reason, self.owner = Mode.DISARMED, Reason.NONE, 0
        self.period = 0
        self.next_state = math.inf
        """Time at which the next state is due."""
        self.stale = 0
        """Number of commands dropped because they were too old."""
        self._out: list[Packet] = []
        self._sent = 0
        self._motor_command = self._damped = MotorCommand(Mode.DISARMED, np.zeros(len(handshake.motor_names)))
        self._fresh = self._first = False
        self._state_period = microseconds(limits.state_period[1])
        self._report_after = self._command = self._command_time = 0
        self._dropped = self._dropped_in_a_row = 0
        self._low_since = math.inf
        self._vitals: Vitals | None = None
        self._energy_start: float | None = None
        self._rejection_times: dict[Reason, deque[int]] = {}

    @property
    def armed(self) -> bool:
        """Whether motors follow commands."""
        return self.mode in ARMED

    def has_operator(self, now: int) -> bool:
        """Return whether an operator uses the robot, so that others are rejected."""
        silent = now - self.link_monitor.last_received > microseconds(self.limits.owner_timeout)
        return bool(self.owner) and (self.armed or not silent)

    def take(self) -> list[Packet]:
        """Remove and return the packets to send, oldest first."""
        packets, self._out = self._out, []
        return packets

    def _send(self, now: int, message: Message) -> None:
        self._sent += 1
        self._out.append(Packet(message, self._sent, now / 1e6))

    def reject_foreign(self, now: int, text: str) -> None:
        """Reject a packet of another version or schema of the protocol."""
        self.link_monitor.note_damage()
        self._reject(now, 0, Reason.SCHEMA, text)

    def announce(self, now: int, hazard: Hazard) -> None:
        """Report an external hazard to the operator, even if the motors are not armed."""
        self._reject(now, self.owner, *hazard)

    def receive(self, now: int, packet: Packet) -> None:
        """Process a packet from a host."""
        message = packet.message
        if isinstance(message, messages.Ping):
            # A ping has no session and changes nothing, so it is answered whatever its number.
            if self.owner:
                self.link_monitor.receive(now)
            self._send(now, messages.Pong(message.token))
            return
        session = getattr(message, "session", 0)
        if isinstance(message, Hello) and session and session != self.owner:
            self._start_session(now, packet, message)
            return
        if not session or session != self.owner:
            self._reject(now, session, Reason.SESSION, f"session {session} is unknown")
            return
        age = self.link_monitor.age(now, microseconds(packet.time))
        if not self.link_monitor.is_next(packet.sequence):
            if isinstance(message, Position | Pwm):
                self._drop(now, "commands were repeated or out of order")
            return
        self.link_monitor.receive(now)
        if isinstance(message, Position | Pwm):
            self._take_command(now, packet.sequence, message, age)
        elif isinstance(message, Hello):
            self._answer_hello(now, message)
        elif isinstance(message, messages.Arm):
            self._arm(now, message)
        elif isinstance(message, messages.Damp):
            self._fail(now, Reason.HOST, "the operator requested it")
        elif isinstance(message, messages.Disarm):
            if self.armed:
                self._disarm(now)
        elif isinstance(message, messages.Bye):
            self._disarm(now)
            self.owner, self.next_state = 0, math.inf

    def _start_session(self, now: int, packet: Packet, hello: Hello) -> None:
        if self.has_operator(now):
            self._reject(now, hello.session, Reason.BUSY, "another operator uses the robot")
            return
        self._disarm(now)
        self.owner = hello.session
        self.link_monitor.restart()
        self.link_monitor.is_next(packet.sequence)
        self.link_monitor.receive(now)
        self.link_monitor.age(now, microseconds(packet.time))
        self._command = self._command_time = self._dropped = 0
        self._energy_start = None
        self._answer_hello(now, hello)

    def _answer_hello(self, now: int, hello: Hello) -> None:
        shortest, longest = self.limits.state_period
        self._state_period = microseconds(min(max(hello.state_period, shortest), longest))
        self._send(now, replace(self.handshake, session=self.owner))
        self.next_state = min(self.next_state, now + self._state_period)

    def _arm(self, now: int, arm: messages.Arm) -> None:
        shortest, longest = self.limits.command_period
        no_duty = arm.mode == Mode.PWM and not self.limits.duty
        if arm.mode not in ARMED or no_duty or (self.armed and arm.mode != self.mode):
            self._reject(now, self.owner, Reason.MODE, f"mode {arm.mode} can't be armed while {self.mode.name}")
        elif not (shortest <= arm.command_period <= longest and arm.report_after <= arm.command_period):
            text = f"command period is {arm.command_period:.3f} s; it must be {shortest:g} to {longest:g}"
            self._reject(now, self.owner, Reason.COMMAND, text)
        elif (
            not self.armed and self.reason and self.link_monitor.clean_for(now) < microseconds(self.limits.rearm_after)
        ):
            text = f"the link must be clean for {self.limits.rearm_after:g} s ({self.reason.name.lower()})"
            self._reject(now, self.owner, Reason.NOT_CLEAN, text)
        elif (hazard := self._hazard(now)) is not None:
            self._reject(now, self.owner, *hazard)
        else:
            self.period = microseconds(arm.command_period)
            self._report_after = microseconds(arm.report_after)
            if not self.armed:
                self.mode, self.reason = Mode(arm.mode), Reason.NONE
                self._command_time, self._dropped_in_a_row = now, 0
                self._fresh = self._first = True
            self.next_state = now + self._report_after

    def _take_command(self, now: int, number: int, message: Position | Pwm, age: float) -> None:
        handshake = self.handshake
        if isinstance(message, Position):
            mode, values, low, high = Mode.POSITION, message.target, handshake.angle_low, handshake.angle_high
        else:
            high = np.full_like(message.duty, self.limits.duty)
            mode, values, low = Mode.PWM, message.duty, -high
        if self.mode != mode:
            self._dropped += 1
            if self.mode != Mode.FAULT:  # every state of a faulted robot has the reason
                self._reject(now, self.owner, Reason.MODE, f"a command arrived while {self.mode.name}")
            return
        if age > self.limits.stale_after * self.period:
            self.stale += 1
            self._drop(now, f"commands were late, the last by {age / 1e6:.3f} s")
            return
        bad = np.flatnonzero(~((values >= low) & (values <= high)))
        if bad.size:
            self._dropped += 1
            self._fail(now, Reason.COMMAND, f"{handshake.motor_names[bad[0]]} was commanded to {values[bad[0]]:.3f}")
            return
        if self._first and mode == Mode.POSITION and self._vitals is not None:
            torque = handshake.servo_kp * np.abs(values - self._vitals.motor_angle)
            if not (maximum := float(torque.max())) <= self.limits.first_torque:
                text = f"the first command would give {maximum:.1f} N m at once; at most {self.limits.first_torque:g}"
                self._fail(now, Reason.COMMAND, text)
                return
        self._first = False
        self._command, self._command_time, self._dropped_in_a_row, self._fresh = number, now, 0, False
        self._motor_command = MotorCommand(self.mode, values)
        self.next_state = now + self._report_after

    def _drop(self, now: int, text: str) -> None:
        self._dropped += 1
        self._dropped_in_a_row += 1
        if self.armed and self._dropped_in_a_row >= self.limits.stale_drops:
            self._fail(now, Reason.STALE, text)

    def tick(self, now: int, vitals: Vitals) -> MotorCommand:
        """Return the motor command for the servo step that begins."""
        self._vitals = vitals
        # NaN counts as low voltage.
        self._low_since = math.inf if vitals.voltage >= self.limits.voltage else min(self._low_since, now)
        if self.armed:
            if now - self._command_time >= microseconds(self.limits.command_timeout):
                self._fail(now, Reason.TIMEOUT, f"no command for {self.limits.command_timeout:g} s")
            elif (hazard := self._hazard(now)) is not None:
                self._fail(now, *hazard)
            elif vitals.sit is not None and not self.reason:
                self.reason = vitals.sit[0]
                self._send_fault(now, self.owner, *vitals.sit)
        if not self.armed:
            return self._damped
        if self._fresh:
            # Before the first command, servos hold the present angles, and motors get zero duty.
            self._fresh = False
            angle = np.array(vitals.motor_angle, float)
            held = angle if self.mode == Mode.POSITION else np.zeros_like(angle)
            self._motor_command = MotorCommand(self.mode, held)
        return self._motor_command

    def _hazard(self, now: int) -> Hazard | None:
        """Return why the motors must not move, from the sensors of the last servo step, or None."""
        vitals, limits = self._vitals, self.limits
        if vitals is None:
            return None
        if vitals.hazard is not None:
            return vitals.hazard
        if not vitals.tilt <= limits.tilt:
            return Reason.TILT, f"tilt is {vitals.tilt:.2f} rad; the limit is {limits.tilt:g}"
        if now - self._low_since >= microseconds(limits.voltage_time):
            return Reason.BATTERY, f"battery voltage is {vitals.voltage:.2f} V; the limit is {limits.voltage:g}"
        if not vitals.temperature <= limits.temperature:
            return (
                Reason.TEMPERATURE,
                f"a motor is at {vitals.temperature:.0f} degC; the limit is {limits.temperature:g}",
            )
        return None

    def _fail(self, now: int, reason: Reason, text: str) -> None:
        if self.mode == Mode.FAULT:
            return  # keep the first reason
        self.mode, self.reason = Mode.FAULT, reason
        self._send_fault(now, self.owner, reason, text)
        if self.owner:
            self.next_state = min(self.next_state, now)

    def _disarm(self, now: int) -> None:
        self.mode = Mode.DISARMED
        if self.owner:
            self.next_state = min(self.next_state, now + self._state_period)

    def _send_fault(self, now: int, session: int, reason: Reason, text: str) -> None:
        self._send(now, messages.Fault(session, int(reason), text))

    def _reject(self, now: int, session: int, reason: Reason, text: str) -> None:
        """Answer a message with a fault, at most `Limits.refusals` times per second for each reason."""
        times = self._rejection_times.setdefault(reason, deque(maxlen=self.limits.refusals))
        if len(times) == self.limits.refusals and now - times[0] < 1_000_000:
            return
        times.append(now)
        self._send_fault(now, session, reason, text)

    def report(self, now: int, read: Callable[[], Sensors]) -> None:
        """Send a state with the sensor readings of `read`, if one is due."""
        if now < self.next_state:
            return
        sensors = read()
        if self._energy_start is None:
            self._energy_start = sensors.energy
        self._send(
            now,
            messages.State(
                session=self.owner,
                mode=int(self.mode),
                reason=int(self.reason),
                command=self._command,
                command_age=(now - self._command_time) / 1e6 if self._command else 1.0,
                dropped=self._dropped % 2**16,
                **{**vars(sensors), "energy": sensors.energy - self._energy_start},
            ),
        )
        following = self.next_state + (self.period if self.armed else self._state_period)
        self.next_state = following if following > now else now + 1000
