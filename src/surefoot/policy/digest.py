"""Digest of a policy file, which verifies that network and contract were exported together.

An export stores the SHA-256 of both, and of the robot if the file contains one, in another property of the file:

    SHA-256( contract as JSON | 00 | graph )
    SHA-256( contract as JSON | 00 | robot's archive in base64 | 00 | graph )

`graph` is the content of field 7 of ONNX's `ModelProto`: operators, normalizer, weights, bounds. The robot's computer
has no `onnx` package and onnxruntime does not expose these bytes, so this module reads the top level of the protobuf
message. All other content that a model could have there (functions, other properties, another operator version) is
rejected, so that only the graph decides what is computed. The digest does not cover the producer (`producer_name`,
`producer_version`) and the format version (`ir_version`): they can be changed without notice, and surefoot does not use
them.

The digest detects damage and stale exports. It is not a signature: anybody who changes a file can write a new digest.
"""

from __future__ import annotations

import base64
import hashlib
from dataclasses import dataclass

from surefoot.errors import SurefootError
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.network import MAX_BYTES, OPSET
from surefoot.policy.protobuf import BYTES, BYTES_LIST, NUMBER, encode_field, read_message

DIGEST_KEY = "surefoot-digest"
"""Metadata key of the ONNX file under which the digest is stored, in hexadecimal."""
ROBOT_KEY = "surefoot-robot"
"""Metadata key of the archive of a robot that is not built in, in base64."""
_GRAPH, _OPSET, _PROPERTIES, _KEY, _VALUE = 7, 8, 14, 1, 2
_MODEL = {1: NUMBER, 2: BYTES, 3: BYTES, _GRAPH: BYTES, _OPSET: BYTES, _PROPERTIES: BYTES_LIST}
"""Allowed fields of a model: format version, producer name and version, graph, operator sets, properties."""


@dataclass(frozen=True)
class PolicyParts:
    """Parts of a policy file that the digest covers, and the digest stored in the file."""

    graph: bytes
    """The ONNX graph with all its constants."""
    contract: bytes
    """The contract as JSON."""
    robot: bytes
    """Archive of the robot in base64; empty for a built-in robot."""
    stored_digest: bytes | None
    """The digest stored in the file, in hexadecimal; None if it has none."""

    @property
    def digest(self) -> str:
        """Actual SHA-256 of contract, robot and graph, in hexadecimal."""
        robot = self.robot + b"\0" if self.robot else b""
        return hashlib.sha256(self.contract + b"\0" + robot + self.graph).hexdigest()

    def robot_archive(self) -> bytes:
        """Return the robot's archive without checking its contents; empty if the file has none.

        Raises:
            SurefootError: it is not base64.
        """
        try:
            return base64.b64decode(self.robot, validate=True)
        except ValueError:
            raise SurefootError("its robot is damaged: it is not base64") from None


def read_parts(data: bytes) -> PolicyParts:
    """Split a policy file into its parts, without checking the digest.

    Raises:
        SurefootError: the bytes are not an ONNX file, have no contract, or contain anything that surefoot does not
            write.
    """
    if len(data) > MAX_BYTES:
        raise SurefootError(f"has over {MAX_BYTES >> 20} MiB; a policy is smaller")
    model = read_message(data, "model", _MODEL)
    for opset in model[_OPSET]:
        entry = read_message(opset, "operator set", {1: BYTES, 2: NUMBER})
        if entry[1] not in ([], [b""]) or entry[2] != [OPSET]:
            raise SurefootError(f"has operators of another set or version; surefoot reads ONNX's version {OPSET}")
    properties: dict[str, bytes] = {}
    for value in model[_PROPERTIES]:
        entry = read_message(value, "property", {_KEY: BYTES, _VALUE: BYTES})
        name = b"".join(entry[_KEY]).decode(errors="replace")
        if name in properties or name not in (METADATA_KEY, ROBOT_KEY, DIGEST_KEY):
            raise SurefootError(
                f"has a property {name[:40]!r} that surefoot does not write, or has it twice; contract or digest may "
                "be damaged: export the policy again"
            )
        properties[name] = b"".join(entry[_VALUE])
    if METADATA_KEY not in properties:
        raise SurefootError("has no contract; surefoot runs only policies that it exported")
    robot = properties.get(ROBOT_KEY, b"")
    return PolicyParts(b"".join(model[_GRAPH]), properties[METADATA_KEY], robot, properties.get(DIGEST_KEY))


def check_digest(data: bytes) -> PolicyParts:
    """Return the parts of a policy file after checking its digest.

    Raises:
        SurefootError: the digest is missing or does not match, or as in `read_parts`.
    """
    parts = read_parts(data)
    if parts.stored_digest is None:
        raise SurefootError("has no digest; surefoot runs only policies that it exported")
    if parts.stored_digest != parts.digest.encode():
        raise SurefootError(
            "its digest does not match: the network or the contract was changed after the export, so that the contract "
            "may no longer describe the network; export the policy again"
        )
    return parts


def add_digest(data: bytes) -> bytes:
    """Return a policy file with its digest appended; all other bytes stay unchanged."""
    pairs = ((_KEY, DIGEST_KEY.encode()), (_VALUE, read_parts(data).digest.encode()))
    # The fields of a protobuf message may be in any order, so the property can be appended.
    return data + encode_field(_PROPERTIES, b"".join(encode_field(number, value) for number, value in pairs))
