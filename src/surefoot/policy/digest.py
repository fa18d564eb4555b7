"""The digest of a policy file: shows that its network and its contract are those that were exported together.

A contract that says what the network no longer does is worse than none: joint order, normalizer and rate would be
checked, found right, and be wrong. So an export writes the SHA-256 of both as one more property of the file:

    SHA-256( contract as JSON | 00 | graph )

`graph` are the bytes of field 7 of the ONNX file's `ModelProto` as they stand in the file: operators, normalizer,
weights, bounds. The robot's computer has no `onnx` package and onnxruntime does not give these bytes out, so a walk
over the top level of the protobuf message finds them (https://protobuf.dev/programming-guides/encoding).

`python -m surefoot.policy.digest FILE...` adds the digest to files that were written without one.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from surefoot.errors import SurefootError
from surefoot.files import whole_file
from surefoot.policy.contract import METADATA_KEY

DIGEST_KEY = "surefoot-digest"
"""Property of the ONNX file that holds the digest, in hexadecimal."""
_GRAPH, _PROPERTIES, _KEY, _VALUE = 7, 14, 1, 2
_VARINT, _EIGHT_BYTES, _LENGTH, _FOUR_BYTES = 0, 1, 2, 5
MISMATCH = (
    "its digest does not fit: the network or the contract was changed after the export, so that the contract may no "
    "longer say what the network does; export the policy again"
)


@dataclass(frozen=True)
class Parts:
    """What the digest is made of, as it stands in the file."""

    graph: bytes
    """The computation, with all of its constants."""
    properties: dict[str, bytes]
    """Metadata, by name."""

    @property
    def digest(self) -> str:
        """SHA-256 of contract and graph, in hexadecimal."""
        return hashlib.sha256(self.properties.get(METADATA_KEY, b"") + b"\0" + self.graph).hexdigest()

    @property
    def stated(self) -> str | None:
        """The digest that the file has, or None."""
        value = self.properties.get(DIGEST_KEY)
        return None if value is None else value.decode(errors="replace")


def read_parts(data: bytes) -> Parts:
    """Graph and metadata of an ONNX file.

    Raises:
        SurefootError: the bytes are no protobuf message.
    """
    graph, properties = b"", {}
    for number, value in _fields(data):
        if number == _GRAPH:
            # A message that stands twice is one message: protobuf joins them.
            graph += value
        elif number == _PROPERTIES:
            entry = dict(_fields(value))
            properties[entry.get(_KEY, b"").decode(errors="replace")] = entry.get(_VALUE, b"")
    return Parts(graph, properties)


def check_digest(data: bytes) -> str | None:
    """The digest of a policy file; None if it was written without one.

    Raises:
        SurefootError: the digest does not fit what the file holds.
    """
    parts = read_parts(data)
    if parts.stated is not None and parts.stated != parts.digest:
        raise SurefootError(MISMATCH)
    return parts.stated


def stamped(data: bytes) -> bytes:
    """The file with its digest; all else stays as it is, to the byte.

    Raises:
        SurefootError: no policy, or one with a digest that does not fit: that is told, never mended.
    """
    if METADATA_KEY not in read_parts(data).properties:
        raise SurefootError("has no contract; surefoot stamps only policies that it exported")
    if check_digest(data) is not None:
        return data
    pairs = ((_KEY, DIGEST_KEY.encode()), (_VALUE, read_parts(data).digest.encode()))
    # Fields of a protobuf message may stand in any order: one more property goes to the end.
    return data + _field(_PROPERTIES, b"".join(_field(number, value) for number, value in pairs))


def _field(number: int, value: bytes) -> bytes:
    return _varint(number << 3 | _LENGTH) + _varint(len(value)) + value


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*out, number])


def _fields(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Number and bytes of each field of a message that has a length; the others are passed over."""
    at = 0
    while at < len(data):
        tag, at = _read_varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            _, at = _read_varint(data, at)
            continue
        if kind == _LENGTH:
            size, at = _read_varint(data, at)
        elif kind in (_EIGHT_BYTES, _FOUR_BYTES):
            size = 8 if kind == _EIGHT_BYTES else 4
        else:
            raise SurefootError(f"is damaged or not ONNX: byte {at} starts no field")
        if at + size > len(data):
            raise SurefootError(f"is damaged or not ONNX: cut off at byte {len(data)}")
        if kind == _LENGTH:
            yield tag >> 3, data[at : at + size]
        at += size


def _read_varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, the lowest first, and where the next thing stands."""
    number = 0
    for place in range(10):
        if at + place >= len(data):
            break
        byte = data[at + place]
        number |= (byte & 0x7F) << 7 * place
        if byte < 0x80:
            return number, at + place + 1
    raise SurefootError(f"is damaged or not ONNX: byte {at} starts no number")


def main(words: Sequence[str] | None = None) -> int:
    """Stamp policy files; returns the exit code: 0, or 2 if one of them was refused."""
    code = 0
    paths = [Path(word) for word in (sys.argv[1:] if words is None else words)]
    if not paths:
        print("usage: python -m surefoot.policy.digest FILE...", file=sys.stderr)
        return 2
    for path in paths:
        try:
            data = path.read_bytes()
            whole = stamped(data)
        except (OSError, SurefootError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            print(f"policy file {path}: {reason}", file=sys.stderr)
            code = 2
            continue
        if whole == data:
            print(f"{path}: had its digest, and it fits")
            continue
        with whole_file(path) as file:
            file.write(whole)
        print(f"{path}: stamped {read_parts(whole).stated}")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
