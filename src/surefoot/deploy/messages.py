"""What the control computer and the robot exchange, whatever carries it; form on a serial line: `serial.codec`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, Self

from surefoot.arrays import Array


class DescribedEnum(IntEnum):
    """Numbers with a meaning in plain words."""

    meaning: str

    def __new__(cls, number: int, meaning: str = "") -> Self:
        """Create a member of the enumeration in the class body; `cls(number)` later looks it up."""
        member = int.__new__(cls, number)
        member._value_, member.meaning = number, meaning
        return member


class Mode(DescribedEnum):
    """What the robot does with its motors."""

    DISARMED = 0, "Motors are damped; commands are refused."
    POSITION = 1, "Servos follow position commands."
    PWM = 2, "Motors get the duty that is sent, for identification."
    FAULT = 3, "Motors are damped because of a fault, and stay so until armed again."


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
    STATES_LATE = 13, "The robot's states do not come, or not in time."
    STATES_FROZEN = 14, "The robot's states come and do not change."
    STATES_DAMAGED = 15, "The robot's states are damaged, or of another layout."
    NOT_FINITE = 16, "A reading is not a finite number, or none that is possible."
    RESTARTED = 17, "The robot's computer has restarted."
    MOTOR_OFF = 18, "A motor is off, or its messages are lost."
    OTHER_PROGRAM = 19, "Another program commands the motors."
    OWN_CONTROLLER = 20, "The robot's own controller is active."
    REMOTE = 21, "Somebody uses the remote control."
    WATCHDOG = 22, "The process that monitors the supervisor has ended or hangs."


class Message:
    """A message of any kind."""


def quantity(unit: str, meaning: str) -> Any:
    """Return a field of a message: its SI unit ("1": a pure number, "": a text) and its meaning."""
    return field(metadata={"unit": unit, "meaning": meaning})


@dataclass(frozen=True)
class SessionMessage(Message):
    """A message of the operator who has the robot."""

    session: int = quantity("1", "the operator's session")


@dataclass(frozen=True)
class Hello(Message):
    """Start a session, or continue one; the answer is `Handshake`, or `Fault` with BUSY."""

    session: int = quantity("1", "number of the session, drawn by the operator; not 0")
    state_period: float = quantity("s", "time between two states while no command comes")


@dataclass(frozen=True)
class Ping(Message):
    """Ask for a `Pong`; needs no session."""

    token: int = quantity("1", "comes back in the pong")


@dataclass(frozen=True)
class Arm(SessionMessage):
    """Let the motors follow commands of one kind; a repeated message changes the times."""

    mode: int = quantity("1", "Mode.POSITION or Mode.PWM")
    command_period: float = quantity("s", "time between two commands")
    report_after: float = quantity("s", "time from a command's arrival to the state that answers it")


@dataclass(frozen=True)
class Position(SessionMessage):
    """Motor angles that the servos hold until the next command."""

    target: Array = quantity("rad", "motor angles, in motor order")


@dataclass(frozen=True)
class Pwm(SessionMessage):
    """Duty of every motor until the next command, without a servo; for identification."""

    duty: Array = quantity("1", "PWM duty, -1 to 1, in motor order")


@dataclass(frozen=True)
class Damp(SessionMessage):
    """Damp the motors at once and stay so until armed again."""


@dataclass(frozen=True)
class Disarm(SessionMessage):
    """End of commands in good order: damp the motors."""


@dataclass(frozen=True)
class Bye(SessionMessage):
    """End the session: the robot disarms and is free for another operator."""


@dataclass(frozen=True)
class Handshake(Message):
    """Name, motors and limits of the robot."""

    session: int = quantity("1", "the session that it belongs to")
    robot: str = quantity("", "name of the robot")
    firmware: str = quantity("", "name and version of the firmware")
    motor_names: tuple[str, ...] = quantity("", "motors, in motor order")
    motor_signs: Array = quantity("1", "joint angle = sign * motor angle")
    servo_period: float = quantity("s", "time between two servo steps")
    servo_kp: Array = quantity("1/rad", "proportional gains, duty per angle; joint actuators: N m/rad")
    servo_kd: Array = quantity("s/rad", "derivative gains, duty per speed; joint actuators: N m s/rad")
    command_period_min: float = quantity("s", "shortest time between commands")
    command_period_max: float = quantity("s", "longest time between commands")
    angle_low: Array = quantity("rad", "lowest motor angles that a command may request")
    angle_high: Array = quantity("rad", "highest motor angles that a command may request")
    tilt_limit: float = quantity("rad", "roll or pitch beyond which the robot damps itself")
    voltage_min: float = quantity("V", "battery voltage below which the robot damps itself")
    temperature_max: float = quantity("degC", "motor temperature beyond which the robot damps itself")
    command_timeout: float = quantity("s", "silence after which an armed robot damps itself")
    rearm_after: float = quantity("s", "time that the link must be clean before a damped robot arms")


@dataclass(frozen=True)
class Pong(Message):
    """Answer to a ping; its header has the robot's time of sending."""

    token: int = quantity("1", "the ping's")


@dataclass(frozen=True)
class State(Message):
    """Readings of the robot's sensors; sent `report_after` each command, and periodically while none come."""

    session: int = quantity("1", "operator that the robot obeys; 0: none")
    mode: int = quantity("1", "see Mode")
    reason: int = quantity("1", "why the motors are damped, or an armed robot should sit; see Reason")
    command: int = quantity("1", "sequence number of the last command that was accepted; 0: none")
    command_age: float = quantity("s", "time since then, at most 0.655 s")
    dropped: int = quantity("1", "commands refused since the session began, modulo 65536")
    motor_angle: Array = quantity("rad", "motor angles, in motor order")
    motor_velocity: Array = quantity("rad/s", "motor speeds")
    motor_torque: Array = quantity("N m", "motor torques, from the currents")
    roll_pitch_yaw: Array = quantity("rad", "base in world: yaw about z, then pitch about y, then roll about x")
    angular_velocity_base: Array = quantity("rad/s", "in the base frame: x forward, y left, z up")
    energy: float = quantity("J", "integral of |sum of torque times speed| since the session began")
    voltage: float = quantity("V", "battery")
    temperature: Array = quantity("degC", "motors")


@dataclass(frozen=True)
class Fault(Message):
    """A refusal or a fault."""

    session: int = quantity("1", "operator that it is meant for; 0: whoever listens")
    reason: int = quantity("1", "see Reason")
    text: str = quantity("", "in plain words")


@dataclass(frozen=True)
class Packet:
    """A message as it is sent."""

    message: Message
    sequence: int
    """Its number; each sender counts its own from 1."""
    time: float
    """When it was sent, on the sender's clock [s]."""
