"""The wire protocol: what the control computer and the robot's microcontroller say to each other.

Every message is a little-endian packed struct behind a header, in a COBS frame with a CRC-32; `frames` has the framing,
docs/wire-protocol.md all of it for a firmware's author. The definitions here are the only ones: the codec, the schema
hash and the C header come from them, and tests compare the tables of the document.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Self

from surefoot.arrays import Array
from surefoot.deploy.wire.fields import MOTORS, Layout, wire
from surefoot.errors import SurefootError

VERSION = 1
"""Version of the framing and the header."""
HEADER = struct.Struct("<BBIIQ")
"""Version, type, schema hash, sequence number, time [us]."""
MAX_PAYLOAD = 997
"""Bytes of a message that still fit a frame; see `frames.MAX_FRAME`."""


class DescribedEnum(IntEnum):
    """Numbers with a meaning in plain words."""

    meaning: str

    def __new__(cls, number: int, meaning: str = "") -> Self:
        """Make a member, in the class only: elsewhere `cls(number)` finds one."""
        member = int.__new__(cls, number)
        member._value_, member.meaning = number, meaning
        return member


class Mode(DescribedEnum):
    """What the robot does with its motors."""

    DISARMED = 0, "Motors are damped; commands are refused."
    POSITION = 1, "Servos follow position commands."
    PWM = 2, "Motors get the duty that is sent, for identification."
    FAULT = 3, "Motors are damped because something went wrong, and stay so until armed anew."


class Reason(DescribedEnum):
    """Why a robot refuses something, or has damped its motors."""

    NONE = 0, "Nothing is wrong."
    HOST = 1, "The operator asked for it."
    TIMEOUT = 2, "No command came for too long."
    STALE = 3, "Too many commands in a row were old, repeated or out of order."
    COMMAND = 4, "A command was not finite or outside the limits."
    TILT = 5, "Roll or pitch passed the robot's limit."
    BATTERY = 6, "The battery is empty."
    TEMPERATURE = 7, "A motor is too hot."
    BUSY = 8, "Another operator has the robot."
    SESSION = 9, "The message names a session that the robot does not know."
    NOT_CLEAN = 10, "The link has not been clean for long enough to arm."
    SCHEMA = 11, "The message is of another version or schema of this protocol."
    MODE = 12, "The message does not go with the robot's mode."


class Message:
    """A message; each kind has a number of its own."""

    CODE: ClassVar[int]


@dataclass(frozen=True)
class Hello(Message):
    """Ask for the robot. Starts a session, or goes on with one; the answer is `Handshake`, or `Fault` with BUSY."""

    CODE = 1
    session: int = wire("u16", "1", "number of the session, drawn by the operator; not 0")
    state_period: float = wire("u32", "s", "time between two states while no command comes", scale=1e-6)


@dataclass(frozen=True)
class Ping(Message):
    """Ask for a `Pong`; anybody may."""

    CODE = 2
    token: int = wire("u32", "1", "comes back in the pong")


@dataclass(frozen=True)
class Arm(Message):
    """Let the motors follow commands of one kind; asked again it changes the times."""

    CODE = 3
    session: int = wire("u16", "1", "the operator's session")
    mode: int = wire("u8", "1", "Mode.POSITION or Mode.PWM")
    command_period: float = wire("u32", "s", "time between two commands", scale=1e-6)
    report_after: float = wire("u32", "s", "time from a command's arrival to the state that answers it", scale=1e-6)


@dataclass(frozen=True)
class Position(Message):
    """Motor angles that the servos hold until the next command."""

    CODE = 4
    session: int = wire("u16", "1", "the operator's session")
    target: Array = wire("f32", "rad", "motor angles, in motor order", count=MOTORS)


@dataclass(frozen=True)
class Pwm(Message):
    """Duty of every motor until the next command, without a servo; for identification."""

    CODE = 5
    session: int = wire("u16", "1", "the operator's session")
    duty: Array = wire("f32", "1", "PWM duty, -1 to 1, in motor order", count=MOTORS)


@dataclass(frozen=True)
class Damp(Message):
    """Damp the motors at once and stay so until armed anew."""

    CODE = 6
    session: int = wire("u16", "1", "the operator's session")


@dataclass(frozen=True)
class Disarm(Message):
    """End of commands in good order: damp the motors."""

    CODE = 7
    session: int = wire("u16", "1", "the operator's session")


@dataclass(frozen=True)
class Bye(Message):
    """End the session: the robot disarms and is free for another operator."""

    CODE = 8
    session: int = wire("u16", "1", "the operator's session")


@dataclass(frozen=True)
class Handshake(Message):
    """What the robot is."""

    CODE = 65
    session: int = wire("u16", "1", "the session that it belongs to")
    robot: str = wire("text", "", "name of the robot", length=24)
    firmware: str = wire("text", "", "name and version of the firmware", length=40)
    motor_names: tuple[str, ...] = wire("text", "", "motors, in motor order", count=MOTORS, length=24)
    motor_signs: Array = wire("i8", "1", "joint angle = sign * motor angle", count=MOTORS)
    servo_period: float = wire("u32", "s", "time between two servo steps", scale=1e-6)
    servo_kp: Array = wire("f32", "1/rad", "proportional gains, duty per angle; joint actuators: N m/rad", count=MOTORS)
    servo_kd: Array = wire("f32", "s/rad", "derivative gains, duty per speed; joint actuators: N m s/rad", count=MOTORS)
    command_period_min: float = wire("u32", "s", "shortest time between commands", scale=1e-6)
    command_period_max: float = wire("u32", "s", "longest time between commands", scale=1e-6)
    angle_low: Array = wire("f32", "rad", "least motor angles that a command may ask for", count=MOTORS)
    angle_high: Array = wire("f32", "rad", "greatest motor angles that a command may ask for", count=MOTORS)
    tilt_limit: float = wire("f32", "rad", "roll or pitch beyond which the robot damps itself")
    voltage_min: float = wire("f32", "V", "battery voltage below which the robot damps itself")
    temperature_max: float = wire("f32", "degC", "motor temperature beyond which the robot damps itself")
    command_timeout: float = wire("u32", "s", "silence after which an armed robot damps itself", scale=1e-6)
    rearm_after: float = wire("u32", "s", "time that the link must be clean before a damped robot arms", scale=1e-6)


@dataclass(frozen=True)
class Pong(Message):
    """Answer to a ping; its header has the robot's time of sending."""

    CODE = 66
    token: int = wire("u32", "1", "the ping's")


@dataclass(frozen=True)
class State(Message):
    """What the robot's sensors tell; sent `report_after` each command, and by itself while none come."""

    CODE = 67
    session: int = wire("u16", "1", "operator that the robot obeys; 0: none")
    mode: int = wire("u8", "1", "see Mode")
    reason: int = wire("u8", "1", "why the motors are damped, see Reason")
    command: int = wire("u32", "1", "sequence number of the last command that was accepted; 0: none")
    command_age: float = wire("u16", "s", "time since then, at most .655 s", scale=1e-5)
    dropped: int = wire("u16", "1", "commands refused since the session began, modulo 65536")
    motor_angle: Array = wire("f32", "rad", "motor angles, in motor order", count=MOTORS)
    motor_velocity: Array = wire("f32", "rad/s", "motor speeds", count=MOTORS)
    motor_torque: Array = wire("i16", "N m", "motor torques, from the currents", count=MOTORS, scale=1e-3)
    roll_pitch_yaw: Array = wire(
        "f32", "rad", "base in world: yaw about z, then pitch about y, then roll about x", count=3
    )
    angular_velocity_base: Array = wire("f32", "rad/s", "in the base frame: x forward, y left, z up", count=3)
    energy: float = wire("f32", "J", "integral of |sum of torque times speed| since the session began")
    voltage: float = wire("u16", "V", "battery", scale=1e-3)
    temperature: Array = wire("u8", "degC", "motors", count=MOTORS, scale=1.0)


@dataclass(frozen=True)
class Fault(Message):
    """Something was refused or went wrong."""

    CODE = 68
    session: int = wire("u16", "1", "operator that it is meant for; 0: whoever listens")
    reason: int = wire("u8", "1", "see Reason")
    text: str = wire("text", "", "in plain words", length=80, cut=True)


MESSAGES: tuple[type[Message], ...] = (
    *(Hello, Ping, Arm, Position, Pwm, Damp, Disarm, Bye),
    *(Handshake, Pong, State, Fault),
)
COMMANDS: tuple[type[Message], ...] = (Position, Pwm)


class Codec:
    """Messages to payloads and back, for robots of a number of motors.

    Raises:
        SurefootError: none, or more than fit a frame.
    """

    def __init__(self, motors: int) -> None:
        self.motors = motors
        self.kinds = {kind.CODE: kind for kind in MESSAGES}
        self.layouts = {kind: Layout(kind, max(motors, 1)) for kind in MESSAGES}
        largest = max(map(self.size, MESSAGES))
        if motors < 1 or largest > MAX_PAYLOAD:
            raise SurefootError(f"motors is {motors}; it must be 1 or more, and messages at most {MAX_PAYLOAD} bytes")
        digest = hashlib.sha256(self.describe().encode()).digest()
        self.schema = int.from_bytes(digest[:4], "little")
        """First four bytes of the SHA-256 of `describe`, little-endian."""

    def describe(self) -> str:
        """All messages in canonical form: a line for each message, and one for each of its fields."""
        lines = [f"surefoot {VERSION} motors {self.motors}"]
        for kind, layout in self.layouts.items():
            lines.append(f"{kind.CODE} {kind.__name__}")
            lines += [
                f"{name} {spec.kind} {spec.entries(self.motors)} {spec.length} {spec.scale:g} {spec.unit or '-'}"
                for name, spec in layout.fields.items()
            ]
        return "\n".join(lines) + "\n"

    def size(self, kind: type[Message]) -> int:
        """Bytes of a message's payload."""
        return self.layouts[kind].struct.size

    def pack(self, message: Message) -> bytes:
        """The payload of a message.

        Raises:
            ValueError: an array of another length, a text too long, or a whole number that does not fit.
        """
        return self.layouts[type(message)].pack(message)

    def unpack(self, code: int, payload: bytes) -> Message | None:
        """The message of a payload; None for an unknown kind, another length, or bytes that are no text."""
        kind = self.kinds.get(code)
        if kind is None:
            return None
        try:
            message: Message = self.layouts[kind].unpack(payload)
        except ValueError:
            return None
        return message
