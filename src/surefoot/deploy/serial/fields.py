"""Encoding of message fields as bytes."""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

MOTORS = -1
"""Count of a field with one entry per motor."""
CODES = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "f32": "f"}
"""Number types and their format codes in `struct`."""
_LIMITS = {"u8": (0, 2**8 - 1), "i16": (-(2**15), 2**15 - 1), "u16": (0, 2**16 - 1), "u32": (0, 2**32 - 1)}
_TOO_LARGE = (2 - 2**-24) * 2.0**127
"""Smallest number that is rounded to infinity as an f32."""


@dataclass(frozen=True)
class FieldEncoding:
    """Encoding of a message field."""

    kind: str
    """Type: one of `CODES` (f32 is IEEE 754), or text (UTF-8, ends at the first zero byte or at its full length)."""
    count: int = 1
    """Number of entries; `MOTORS` for one per motor."""
    scale: float = 0.0
    """Scale: value = scale * encoded number; the reciprocal of an integer, or 0 for no scale."""
    length: int = 0
    """Size of a text [bytes]."""
    cut: bool = False
    """Whether a text that is too long is truncated; otherwise it is rejected."""
    unit: str = ""
    meaning: str = ""
    """SI unit and meaning of the value, from the message's dataclass."""

    def entries(self, motors: int) -> int:
        """Return the number of entries for a robot with `motors` motors."""
        return motors if self.count == MOTORS else self.count

    def format(self, motors: int) -> str:
        """Return the format of the field for `struct`."""
        if self.kind == "text":
            return f"{self.length}s" * self.entries(motors)
        return f"{self.entries(motors)}{CODES[self.kind]}"


class MessageLayout:
    """Encodes and decodes the fields of one message type, for robots with a fixed number of motors.

    Every float can be encoded, so that no value stops a control loop. Values of scaled fields are rounded to the
    nearest number and clipped; NaN becomes the minimum. An f32 keeps NaN and infinities, and values out of range become
    infinite.
    """

    def __init__(self, message: type, fields: dict[str, FieldEncoding], motors: int) -> None:
        self.fields = fields
        self.struct = struct.Struct("<" + "".join(spec.format(motors) for spec in fields.values()))
        self._message = message
        ends = list(itertools.accumulate(spec.entries(motors) for spec in fields.values()))
        self._plan = [
            (name, spec, start, end, round(1 / spec.scale) if spec.scale else 0)
            for (name, spec), start, end in zip(fields.items(), [0, *ends], ends, strict=False)
        ]
        """Name, encoding, first and last entry of each field, and its encoded numbers per unit."""

    def pack(self, message: Any) -> bytes:
        """Return the bytes of a message's fields.

        Raises:
            ValueError: an array with a wrong length, a text that is too long, or an integer out of range.
        """
        flat: list[Any] = []
        try:
            for name, spec, start, end, per in self._plan:
                value = getattr(message, name)
                if spec.kind == "text":
                    flat += _texts(name, spec, [value] if spec.count == 1 else value)
                else:
                    flat += _numbers(spec.kind, per, [value] if spec.count == 1 else np.asarray(value).tolist())
                if len(flat) != end:
                    raise ValueError(f"{name} has {len(flat) - start} entries; it must have {end - start}")
            return self._packed(flat)
        except (struct.error, TypeError, OverflowError) as error:
            raise ValueError(f"{type(message).__name__}: {error}") from error

    def unpack(self, payload: bytes, text_errors: str = "strict") -> Any:
        """Return the message of a payload; arrays are float64, lists of texts are tuples.

        `text_errors` is the error handler of `bytes.decode` for bytes that are not UTF-8.

        Raises:
            ValueError: a payload with a wrong length, or text that is not UTF-8.
        """
        if len(payload) != self.struct.size:
            raise ValueError(f"{self._message.__name__} has {len(payload)} bytes; it must have {self.struct.size}")
        flat = self.struct.unpack(payload)
        values: list[Any] = []
        for _, spec, start, end, per in self._plan:
            if spec.kind == "text":
                texts = tuple(raw.partition(b"\0")[0].decode(errors=text_errors) for raw in flat[start:end])
                values.append(texts[0] if spec.count == 1 else texts)
            elif spec.count == 1:
                values.append(flat[start] / per if per else flat[start])
            else:
                array = np.array(flat[start:end], np.float64)
                values.append(array / per if per else array)
        return self._message(*values)

    def _packed(self, flat: list[Any]) -> bytes:
        try:
            return self.struct.pack(*flat)
        except OverflowError:
            return self.struct.pack(
                *(math.copysign(math.inf, x) if isinstance(x, float) and abs(x) >= _TOO_LARGE else x for x in flat)
            )


def _numbers(kind: str, per: int, values: list[Any]) -> list[Any]:
    """Return values as numbers for `struct`; `per` is the encoded number of one unit, or 0 for no scale."""
    if per:
        low, high = _LIMITS[kind]
        return [low if not (x := value * per) > low else high if x > high else round(x) for value in values]
    return values if kind == "f32" else [int(value) for value in values]


def _texts(name: str, spec: FieldEncoding, values: Any) -> list[bytes]:
    encoded = [str(value).encode() for value in values]
    for value, raw in zip(values, encoded, strict=True):
        if len(raw) > spec.length and not spec.cut:
            raise ValueError(f"{name} is '{value}'; it may have at most {spec.length} bytes")
    return [raw[: spec.length].decode(errors="ignore").encode() for raw in encoded]
