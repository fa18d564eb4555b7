"""The digest of a policy file: shows that its network and its contract are those that were exported together.

A contract that does not match its network is worse than none: checks of joint order, normalizer and rate would pass
and mean nothing. So an export writes the SHA-256 of both as a further property of the file:

    SHA-256( contract as JSON | 00 | graph )

`graph` are the bytes of field 7 of the ONNX file's `ModelProto` as they stand in the file: operators, normalizer,
weights, bounds. The robot's computer has no `onnx` package and onnxruntime does not expose these bytes, so the
top level of the protobuf message is read here. Whatever else a model could have there (functions, other
properties, another version of the operators) is refused, so that nothing beside the two decides what is computed.

Whoever changes a file can write a new digest too: it detects damage and stale exports, and is not a signature.

`python -m surefoot.policy.digest FILE...` adds the digest to files that were written without one.
"""

from __future__ import annotations

import hashlib
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from surefoot.errors import SurefootError
from surefoot.files import whole_file
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.network import MAX_BYTES, OPSET
from surefoot.policy.protobuf import BYTES, MANY, NUMBER, field, message

DIGEST_KEY = "surefoot-digest"
"""Property of the ONNX file that holds the digest, in hexadecimal."""
_GRAPH, _OPSET, _PROPERTIES, _KEY, _VALUE = 7, 8, 14, 1, 2
_MODEL = {1: NUMBER, 2: BYTES, 3: BYTES, _GRAPH: BYTES, _OPSET: BYTES, _PROPERTIES: MANY}
"""Fields of a model: version of the format, who wrote it, and these."""
MISMATCH = (
    "its digest does not match: the network or the contract was changed after the export, so that the contract may no "
    "longer say what the network does; export the policy again"
)


@dataclass(frozen=True)
class Parts:
    """The parts of a policy file that the digest covers, and the digest."""

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
    """Return the graph and metadata of a policy file.

    Raises:
        SurefootError: the bytes are not an ONNX file, or hold more than surefoot writes.
    """
    if len(data) > MAX_BYTES:
        raise SurefootError(f"has over {MAX_BYTES >> 20} MiB; a policy is smaller")
    model = message(data, "model", _MODEL)
    for opset in model[_OPSET]:
        entry = message(opset, "operator set", {1: BYTES, 2: NUMBER})
        if entry[1] not in ([], [b""]) or entry[2] != [OPSET]:
            raise SurefootError(f"has operators of another set or version; surefoot reads ONNX's version {OPSET}")
    properties = {}
    for value in model[_PROPERTIES]:
        entry = message(value, "property", {_KEY: BYTES, _VALUE: BYTES})
        name = b"".join(entry[_KEY]).decode(errors="replace")
        if name in properties or name not in (METADATA_KEY, DIGEST_KEY):
            raise SurefootError(
                f"has a property {name[:40]!r} that surefoot does not write, or has it twice; contract or digest may "
                "be damaged: export the policy again"
            )
        properties[name] = b"".join(entry[_VALUE])
    return Parts(b"".join(model[_GRAPH]), properties)


def check_digest(data: bytes) -> str | None:
    """Return the digest of a policy file; None if it has none.

    Raises:
        SurefootError: the digest is damaged, or does not fit what the file holds.
    """
    parts = read_parts(data)
    if parts.stated is None:
        return None
    if not re.fullmatch("[0-9a-f]{64}", parts.stated):
        raise SurefootError("its digest is damaged: it must be 64 hexadecimal digits; export the policy again")
    if parts.stated != parts.digest:
        raise SurefootError(MISMATCH)
    return parts.stated


def stamped(data: bytes) -> bytes:
    """Return the file with its digest added; all else stays the same, to the byte.

    Raises:
        SurefootError: not a policy, or one with a digest that does not match; that is never repaired.
    """
    if METADATA_KEY not in read_parts(data).properties:
        raise SurefootError("has no contract; surefoot stamps only policies that it exported")
    if check_digest(data) is not None:
        return data
    pairs = ((_KEY, DIGEST_KEY.encode()), (_VALUE, read_parts(data).digest.encode()))
    # Fields of a protobuf message may stand in any order: one more property goes to the end.
    return data + field(_PROPERTIES, b"".join(field(number, value) for number, value in pairs))


def main(words: Sequence[str] | None = None) -> int:
    """Stamp policy files; return the exit code: 0, or 2 if one of them was refused."""
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
            print(f"{path}: had its digest, and it matches")
            continue
        with whole_file(path) as file:
            file.write(whole)
        print(f"{path}: stamped {read_parts(whole).stated}")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
