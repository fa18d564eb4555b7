"""Fields of wire messages: how a number or a text stands in a frame."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

MOTORS = -1
"""Count of a field that has one entry a motor."""
_CODES = {"u8": "B", "i8": "b", "u16": "H", "i16": "h", "u32": "I", "u64": "Q", "f32": "f"}
_LIMITS = {"u8": (0, 2**8 - 1), "i8": (-(2**7), 2**7 - 1), "u16": (0, 2**16 - 1), "i16": (-(2**15), 2**15 - 1)}


@dataclass(frozen=True)
class Wire:
    """How a field stands in a frame."""

    kind: str
    """u8, i8, u16, i16, u32, u64, f32 (IEEE 754), or text (UTF-8, padded with zeros)."""
    unit: str
    """Unit of the value in Python, SI."""
    meaning: str
    """What it is."""
    count: int = 1
    """How many; `MOTORS` for one a motor."""
    scale: float = 0.0
    """Value = scale * number on the wire; 0: the number itself. What does not fit is clipped."""
    length: int = 0
    """Bytes of a text."""

    def entries(self, motors: int) -> int:
        """How many entries a robot of that many motors has."""
        return motors if self.count == MOTORS else self.count

    def format(self, motors: int) -> str:
        """As `struct` writes it."""
        if self.kind == "text":
            return f"{self.length}s" * self.entries(motors)
        return f"{self.entries(motors)}{_CODES[self.kind]}"


def wire(kind: str, unit: str, meaning: str, **more: Any) -> Any:
    """A dataclass field that stands in a frame; see `Wire`."""
    return field(metadata={"wire": Wire(kind, unit, meaning, **more)})


def wires(message: type) -> dict[str, Wire]:
    """The fields of a message, by name, in the order of the frame."""
    return {item.name: item.metadata["wire"] for item in fields(message)}


def pack_values(packer: struct.Struct, layout: dict[str, Wire], message: Any, motors: int) -> bytes:
    """The bytes of a message's fields.

    Raises:
        ValueError: an array of another length, a text too long, or a whole number that does not fit.
    """
    flat: list[Any] = []
    for name, spec in layout.items():
        value, entries = getattr(message, name), spec.entries(motors)
        listed = [value] if spec.count == 1 else list(value)
        if len(listed) != entries:
            raise ValueError(f"{name} has {len(listed)} entries; it must have {entries}")
        flat += [_to_wire(name, spec, one) for one in listed]
    try:
        return packer.pack(*flat)
    except struct.error as error:
        raise ValueError(f"{type(message).__name__}: {error}") from error


def unpack_values(packer: struct.Struct, layout: dict[str, Wire], payload: bytes, motors: int) -> dict[str, Any]:
    """The values of a message's fields, by name; arrays are float64, texts of several entries tuples.

    Raises:
        ValueError: bytes that are no text.
    """
    flat = packer.unpack(payload)
    values: dict[str, Any] = {}
    at = 0
    for name, spec in layout.items():
        entries = spec.entries(motors)
        part = flat[at : at + entries]
        at += entries
        if spec.kind == "text":
            texts = tuple(raw.rstrip(b"\0").decode() for raw in part)
            values[name] = texts[0] if spec.count == 1 else texts
        elif spec.count == 1:
            values[name] = part[0] * spec.scale if spec.scale else part[0]
        else:
            array: NDArray[np.float64] = np.array(part, np.float64)
            values[name] = array * spec.scale if spec.scale else array
    return values


def _to_wire(name: str, spec: Wire, value: Any) -> Any:
    if spec.kind == "text":
        raw = str(value).encode()
        if len(raw) > spec.length:
            raise ValueError(f"{name} is '{value}'; it may have {spec.length} bytes")
        return raw
    if spec.kind == "f32":
        return float(value)
    if spec.scale:
        low, high = _LIMITS[spec.kind]
        number = float(value) / spec.scale
        return low if not number > low else high if number > high else round(number)
    return int(value)
