"""Fields of a message as bytes."""

from __future__ import annotations

import itertools
import math
import struct
from dataclasses import dataclass
from typing import Any

import numpy as np

MOTORS = -1
"""Count of a field that has one entry a motor."""
CODES = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "f32": "f"}
"""Kinds of numbers, and their codes in `struct`."""
_LIMITS = {"u8": (0, 2**8 - 1), "i16": (-(2**15), 2**15 - 1), "u16": (0, 2**16 - 1), "u32": (0, 2**32 - 1)}
_TOO_LARGE = (2 - 2**-24) * 2.0**127
"""Least number that an f32 rounds to infinity."""


@dataclass(frozen=True)
class FieldEncoding:
    """How a field stands in a frame."""

    kind: str
    """One of `CODES` (f32 is IEEE 754), or text (UTF-8, ends at the first zero byte or at its full length)."""
    count: int = 1
    """Number of entries; `MOTORS` for one a motor."""
    scale: float = 0.0
    """Value = scale * number on the wire; 0: the number itself. One over a whole number."""
    length: int = 0
    """Bytes of a text."""
    cut: bool = False
    """Whether the end of a text that is too long is cut off; otherwise the text is refused."""
    unit: str = ""
    meaning: str = ""
    """SI unit and meaning of the value, from the message's dataclass."""

    def entries(self, motors: int) -> int:
        """Return the number of entries for a robot of so many motors."""
        return motors if self.count == MOTORS else self.count

    def format(self, motors: int) -> str:
        """Return the field's format of `struct`."""
        if self.kind == "text":
            return f"{self.length}s" * self.entries(motors)
        return f"{self.entries(motors)}{CODES[self.kind]}"


class MessageLayout:
    """The fields of one kind of message as bytes and back, for robots of so many motors.

    No float of a scaled field or of an f32 is refused, so that none stops a control loop. Scaled numbers are rounded to
    the nearest, those that do not fit are clipped, and NaN becomes the least. An f32 keeps NaN and infinities, and what
    is too large becomes infinite.
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
        """Of each field its name, encoding, first and last entry, and numbers on the wire in one of its unit."""

    def pack(self, message: Any) -> bytes:
        """Return the bytes of a message's fields.

        Raises:
            ValueError: an array of another length, a text too long, or a whole number that does not fit.
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
        """Return the message of these bytes; arrays are float64, several texts a tuple.

        `text_errors` is what `bytes.decode` does with bytes that are no UTF-8.

        Raises:
            ValueError: another number of bytes, or bytes that are no text.
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
    """Return values as `struct` takes them; `per` numbers on the wire make one of the value's unit, 0: no scale."""
    if per:
        low, high = _LIMITS[kind]
        return [low if not (x := value * per) > low else high if x > high else round(x) for value in values]
    return values if kind == "f32" else [int(value) for value in values]


def _texts(name: str, spec: FieldEncoding, values: Any) -> list[bytes]:
    encoded = [str(value).encode() for value in values]
    for value, raw in zip(values, encoded, strict=True):
        if len(raw) > spec.length and not spec.cut:
            raise ValueError(f"{name} is '{value}'; it may have {spec.length} bytes")
    return [raw[: spec.length].decode(errors="ignore").encode() for raw in encoded]
