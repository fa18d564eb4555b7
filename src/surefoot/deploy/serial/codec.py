"""Encoding of messages as packed little-endian structs, as docs/wire-protocol.md specifies them.

Tests compare that page with `SCHEMA`.
"""

from __future__ import annotations

import hashlib
import struct
from dataclasses import fields, replace

from surefoot.deploy import messages
from surefoot.deploy.messages import NAME_BYTES, Message
from surefoot.deploy.serial.fields import MOTORS, FieldEncoding, MessageLayout
from surefoot.errors import SurefootError

VERSION = 1
"""Version of framing and header."""
HEADER = struct.Struct("<BBIIQ")
"""Version, type, schema hash, sequence number, time [us]."""
MAX_PAYLOAD = 997
"""Maximum size of a message in a frame [bytes]; see `frames.MAX_FRAME`."""
ACCELEROMETER = "accelerometer"
"""Field of a state that only boards with an accelerometer send; their schema differs in this field."""
_U8, _U16, _U32, _F32 = FieldEncoding("u8"), FieldEncoding("u16"), FieldEncoding("u32"), FieldEncoding("f32")
_TIME = FieldEncoding("u32", scale=1e-6)
_MOTORS, _VECTOR = FieldEncoding("f32", MOTORS), FieldEncoding("f32", 3)
SCHEMA: dict[type[Message], tuple[int, dict[str, FieldEncoding]]] = {
    messages.Hello: (1, {"session": _U16, "state_period": _TIME}),
    messages.Ping: (2, {"token": _U32}),
    messages.Arm: (3, {"session": _U16, "mode": _U8, "command_period": _TIME, "report_after": _TIME}),
    messages.Position: (4, {"session": _U16, "target": _MOTORS}),
    messages.Pwm: (5, {"session": _U16, "duty": _MOTORS}),
    messages.Damp: (6, {"session": _U16}),
    messages.Disarm: (7, {"session": _U16}),
    messages.Bye: (8, {"session": _U16}),
    messages.Handshake: (
        65,
        {
            "session": _U16,
            "robot": FieldEncoding("text", length=NAME_BYTES),
            "firmware": FieldEncoding("text", length=40),
            "motor_names": FieldEncoding("text", MOTORS, length=NAME_BYTES),
            "motor_signs": FieldEncoding("i8", MOTORS),
            "servo_period": _TIME,
            "servo_kp": _MOTORS,
            "servo_kd": _MOTORS,
            "command_period_min": _TIME,
            "command_period_max": _TIME,
            "angle_low": _MOTORS,
            "angle_high": _MOTORS,
            "tilt_limit": _F32,
            "voltage_min": _F32,
            "temperature_max": _F32,
            "command_timeout": _TIME,
            "rearm_after": _TIME,
        },
    ),
    messages.Pong: (66, {"token": _U32}),
    messages.State: (
        67,
        {
            "session": _U16,
            "mode": _U8,
            "reason": _U8,
            "command": _U32,
            "command_age": FieldEncoding("u16", scale=1e-5),
            "dropped": _U16,
            "motor_angle": _MOTORS,
            "motor_velocity": _MOTORS,
            "motor_torque": FieldEncoding(
                "i16", MOTORS, scale=5e-3
            ),  # up to 163 N m; the resolution is finer than sensor noise
            "roll_pitch_yaw": _VECTOR,
            "angular_velocity_base": _VECTOR,
            "energy": _F32,
            "voltage": FieldEncoding("u16", scale=1e-3),
            "temperature": FieldEncoding("u8", MOTORS, scale=1.0),
            ACCELEROMETER: _VECTOR,
        },
    ),
    messages.Fault: (68, {"session": _U16, "reason": _U8, "text": FieldEncoding("text", length=80, cut=True)}),
}
"""Number of each message type, and the encoding of its fields."""
MESSAGES = tuple(SCHEMA)
NUMBERS = {kind: number for kind, (number, _) in SCHEMA.items()}


def encodings(kind: type[Message], accelerometer: bool = False) -> dict[str, FieldEncoding]:
    """Return the encoding of each field of a message type, with its unit and meaning.

    Args:
        kind: message type.
        accelerometer: whether the board has an accelerometer.
    """
    _, encodings = SCHEMA[kind]
    return {
        item.name: replace(encodings[item.name], **item.metadata)
        for item in fields(kind)  # type: ignore[arg-type]
        if accelerometer or item.name != ACCELEROMETER
    }


class Codec:
    """Encodes messages as payloads and decodes them, for robots with a fixed number of motors.

    Args:
        motors: number of motors.
        accelerometer: whether states have the reading of an accelerometer.
        text_errors: error handler for texts that are not UTF-8; with "strict" their message counts as unknown.

    Raises:
        SurefootError: no motors, or more than fit into a frame.
    """

    def __init__(self, motors: int, accelerometer: bool = False, text_errors: str = "strict") -> None:
        self.motors, self.accelerometer, self._text_errors = motors, accelerometer, text_errors
        self.kinds = {number: kind for kind, number in NUMBERS.items()}
        self.layouts = {kind: MessageLayout(kind, encodings(kind, accelerometer), max(motors, 1)) for kind in MESSAGES}
        largest = max(map(self.size, MESSAGES))
        if motors < 1 or largest > MAX_PAYLOAD:
            raise SurefootError(f"motors is {motors}; it must be 1 or more, and messages at most {MAX_PAYLOAD} bytes")
        digest = hashlib.sha256(self.describe().encode()).digest()
        self.schema = int.from_bytes(digest[:4], "little")
        """Schema hash: first four bytes of the SHA-256 of `describe`, little-endian."""

    def describe(self) -> str:
        """Return the schema in canonical form: one line per message, and one per field."""
        lines = [f"surefoot {VERSION} motors {self.motors}"]
        for kind, layout in self.layouts.items():
            lines.append(f"{NUMBERS[kind]} {kind.__name__}")
            lines += [
                f"{name} {spec.kind} {spec.entries(self.motors)} {spec.length} {spec.scale:g} {spec.unit or '-'}"
                for name, spec in layout.fields.items()
            ]
        return "\n".join(lines) + "\n"

    def size(self, kind: type[Message]) -> int:
        """Return the size of a message's payload [bytes]."""
        return self.layouts[kind].struct.size

    def pack(self, message: Message) -> bytes:
        """Return the payload of a message.

        Raises:
            ValueError: an array with a wrong length, a text that is too long, or an integer out of range.
        """
        return self.layouts[type(message)].pack(message)

    def unpack(self, number: int, payload: bytes) -> Message | None:
        """Return the message of a payload, or None for an unknown type, a wrong length, or text that is not UTF-8."""
        try:
            message: Message = self.layouts[self.kinds[number]].unpack(payload, self._text_errors)
        except (KeyError, ValueError):
            return None
        return message
