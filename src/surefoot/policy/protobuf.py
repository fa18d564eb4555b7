"""Strict reader of protobuf messages (https://protobuf.dev/programming-guides/encoding).

The robot's computer has no `onnx` package. A message may hold only the fields of its layout, because onnxruntime might
use fields that this reader skips.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from surefoot.errors import SurefootError

VARINT, LENGTH = 0, 2
NUMBER, NUMBERS, BYTES, BYTES_LIST = (VARINT, False), (VARINT, True), (LENGTH, False), (LENGTH, True)
"""Kinds of fields: an integer, repeated integers, bytes (text or a message), repeated bytes."""
MAX_REPETITIONS = 1024
"""Maximum number of occurrences of a repeated field."""
_SIZES = {1: 8, 5: 4}
"""Size of fixed-size numbers [bytes], by wire type."""


def read_message(data: bytes, name: str, layout: Mapping[int, tuple[int, bool]]) -> dict[int, list[Any]]:
    """Return the list of values of each field of a message, in order; the list of a missing field is empty.

    Args:
        data: bytes of the message.
        name: name of the message, for errors.
        layout: kind of each allowed field, by field number.

    Raises:
        SurefootError: the data are not a message, or a field is not allowed, of another kind, or repeated too often.
    """
    values: dict[int, list[Any]] = {number: [] for number in layout}
    for number, wire, value in _fields(data):
        error = None
        if number not in layout or layout[number][0] != wire:
            error = f"a field {number}.{wire}"
        elif len(values[number]) == (limit := MAX_REPETITIONS if layout[number][1] else 1):
            error = f"field {number} more than {limit} times"
        if error:
            raise SurefootError(f"is damaged or not ONNX as surefoot writes it: its {name} has {error}")
        values[number].append(value)
    return values


def encode_field(number: int, value: bytes) -> bytes:
    """Encode a field that holds bytes."""
    return _encode_varint(number << 3 | LENGTH) + _encode_varint(len(value)) + value


def _encode_varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def _fields(data: bytes) -> Iterator[tuple[int, int, int | bytes]]:
    """Yield field number, wire type and value of each field of a message."""
    at = 0
    while at < len(data):
        start = at
        tag, at = _read_varint(data, at)
        wire = tag & 7
        if wire == VARINT:
            value, at = _read_varint(data, at)
            yield tag >> 3, wire, value
            continue
        if wire == LENGTH:
            size, at = _read_varint(data, at)
        elif wire in _SIZES:
            size = _SIZES[wire]
        else:
            raise SurefootError(f"is damaged or not ONNX: no valid field starts at byte {start}")
        if at + size > len(data):
            raise SurefootError(f"is damaged or not ONNX: cut off at byte {len(data)}")
        yield tag >> 3, wire, data[at : at + size]
        at += size


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """Return a varint (seven bits per byte, lowest first) and the position after it."""
    number = 0
    for place, byte in enumerate(data[at : at + 10]):
        number |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return number, at + place + 1
    raise SurefootError(f"is damaged or not ONNX: no valid number starts at byte {at}")
