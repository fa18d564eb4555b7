"""Messages between control computer and robot, independent of the transport; `serial.codec` encodes them as bytes."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

from surefoot.arrays import Array


class DescribedEnum(IntEnum):
    """Enumeration of numbers with a description each."""

    meaning: str

    def __new__(cls, number: int, meaning: str = "") -> Self:
        """Create a member of the enumeration in the class body; `cls(number)` later looks it up."""
        member = int.__new__(cls, number)
        member._value_, member.meaning = number, meaning
        return member


NAME_BYTES = 24
"""Maximum length of the names of a robot and its motors [bytes]."""


class Mode(DescribedEnum):
    """Motor mode of the robot."""

    DISARMED = 0, "Motors are damped; commands are rejected."
    POSITION = 1, "Servos follow position commands."
    PWM = 2, "Motors get the commanded duty, for identification."
    FAULT = 3, "Motors are damped because of a fault, until the robot is armed again."


class Reason(DescribedEnum):
    """Why the robot rejected a message, or damped its motors."""

    NONE = 0, "No fault."
    HOST = 1, "The operator requested it."
    TIMEOUT = 2, "No command arrived for too long."
    STALE = 3, "Too many consecutive commands were late, repeated or out of order."
    COMMAND = 4, "A command was not finite or outside the limits."
    TILT = 5, "Roll or pitch is beyond the robot's limit."
    BATTERY = 6, "The battery is empty."
    TEMPERATURE = 7, "A motor is too hot."
    BUSY = 8, "Another operator uses the robot."
    SESSION = 9, "The session of the message is unknown."
    NOT_CLEAN = 10, "The link has not been clean for long enough to arm."
    SCHEMA = 11, "The message has another version or schema of this protocol."
    MODE = 12, "The message is not allowed in the robot's mode."
    STATES_LATE = 13, "The robot's states are late or missing."
    STATES_FROZEN = 14, "The robot's states do not change."
    STATES_DAMAGED = 15, "The robot's states are damaged or have another layout."
    NOT_FINITE = 16, "A sensor reading is not finite, or impossible."
    RESTARTED = 17, "The robot's computer has restarted."
    MOTOR_OFF = 18, "A motor is off, or its messages are lost."
    OTHER_PROGRAM = 19, "Another program commands the motors."
    OWN_CONTROLLER = 20, "The robot's own controller is active."
    REMOTE = 21, "The remote control is used."
    WATCHDOG = 22, "The process that monitors the supervisor has ended or hangs."


class Message:
    """Base class of messages."""


def quantity(unit: str, meaning: str, **options: Any) -> Any:
    """Define a message field with its SI unit ("1": dimensionless, "": text) and meaning; options as for `field`."""
    return field(metadata={"unit": unit, "meaning": meaning}, **options)


@dataclass(frozen=True)
class SessionMessage(Message):
    """Base class of messages in a session."""

    session: int = quantity("1", "the operator's session")


@dataclass(frozen=True)
class Hello(Message):
    """Start a session, or continue one; the answer is `Handshake`, or `Fault` with BUSY."""

    session: int = quantity("1", "session number, chosen by the operator at random; not 0")
    state_period: float = quantity("s", "period of states while no commands arrive")


@dataclass(frozen=True)
class Ping(Message):
    """Ask for a `Pong`; needs no session."""

    token: int = quantity("1", "repeated in the pong")


@dataclass(frozen=True)
class Arm(SessionMessage):
    """Let the motors follow commands of one kind; if repeated, it changes the times."""

    mode: int = quantity("1", "Mode.POSITION or Mode.PWM")
    command_period: float = quantity("s", "period of commands")
    report_after: float = quantity("s", "time from a command's arrival to the state that answers it")


@dataclass(frozen=True)
class Position(SessionMessage):
    """Motor angles that the servos hold until the next command."""

    target: Array = quantity("rad", "motor angles, in motor order")


@dataclass(frozen=True)
class Pwm(SessionMessage):
    """Duty of each motor until the next command, without a servo; for identification."""

    duty: Array = quantity("1", "PWM duty, -1 to 1, in motor order")


@dataclass(frozen=True)
class Damp(SessionMessage):
    """Damp the motors at once, until the robot is armed again."""


@dataclass(frozen=True)
class Disarm(SessionMessage):
    """End of commands in normal operation: damp the motors."""


@dataclass(frozen=True)
class Bye(SessionMessage):
    """End the session: the robot disarms and is free for another operator."""


@dataclass(frozen=True)
class Handshake(Message):
    """Name, motors and limits of the robot."""

    session: int = quantity("1", "session that it belongs to")
    robot: str = quantity("", "name of the robot")
    firmware: str = quantity("", "name and version of the firmware")
    motor_names: tuple[str, ...] = quantity("", "motors, in motor order")
    motor_signs: Array = quantity("1", "joint angle = sign * motor angle")
    servo_period: float = quantity("s", "servo period")
    servo_kp: Array = quantity("1/rad", "proportional gains, duty per angle; joint actuators: N m/rad")
    servo_kd: Array = quantity("s/rad", "derivative gains, duty per speed; joint actuators: N m s/rad")
    command_period_min: float = quantity("s", "minimum period of commands")
    command_period_max: float = quantity("s", "maximum period of commands")
    angle_low: Array = quantity("rad", "minimum motor angles of a command")
    angle_high: Array = quantity("rad", "maximum motor angles of a command")
    tilt_limit: float = quantity("rad", "roll or pitch beyond which the robot damps its motors")
    voltage_min: float = quantity("V", "battery voltage below which the robot damps its motors")
    temperature_max: float = quantity("degC", "motor temperature above which the robot damps its motors")
    command_timeout: float = quantity("s", "silence after which an armed robot damps its motors")
    rearm_after: float = quantity("s", "time of a clean link before a damped robot can be armed")


@dataclass(frozen=True)
class Pong(Message):
    """Answer to a ping; its header has the sending time on the robot's clock."""

    token: int = quantity("1", "token of the ping")


@dataclass(frozen=True)
class State(Message):
    """Sensor readings; sent `report_after` seconds after each command, and periodically while no commands arrive."""

    session: int = quantity("1", "session of the current operator; 0: none")
    mode: int = quantity("1", "see Mode")
    reason: int = quantity("1", "why the motors are damped, or an armed robot should sit; see Reason")
    command: int = quantity("1", "sequence number of the last accepted command; 0: none")
    command_age: float = quantity("s", "time since that command, at most 0.655 s")
    dropped: int = quantity("1", "commands rejected since the session began, modulo 65536")
    motor_angle: Array = quantity("rad", "motor angles, in motor order")
    motor_velocity: Array = quantity("rad/s", "motor speeds")
    motor_torque: Array = quantity("N m", "motor torques, estimated from currents")
    roll_pitch_yaw: Array = quantity("rad", "base in world: yaw about z, then pitch about y, then roll about x")
    angular_velocity_base: Array = quantity("rad/s", "in the base frame: x forward, y left, z up")
    energy: float = quantity("J", "integral of |sum of torque times speed| since the session began")
    voltage: float = quantity("V", "battery voltage")
    temperature: Array = quantity("degC", "motor temperatures")
    accelerometer: Array | None = quantity(
        "m/s^2", "specific force in the base frame: (0, 0, g) at rest; only of boards that measure it", default=None
    )


@dataclass(frozen=True)
class Fault(Message):
    """A rejected message, or a fault of the robot."""

    session: int = quantity("1", "session that it is addressed to; 0: all")
    reason: int = quantity("1", "see Reason")
    text: str = quantity("", "description in plain words")


@dataclass(frozen=True)
class Packet:
    """A message with its sequence number and sending time."""

    message: Message
    sequence: int
    """Sequence number; each sender counts from 1."""
    time: float
    """Sending time on the sender's clock [s]."""
