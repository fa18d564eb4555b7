"""Digests of policy files."""

from __future__ import annotations

import contextlib
import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.errors import SurefootError
from surefoot.policy import digest
from surefoot.policy.digest import add_digest, check_digest, read_parts
from surefoot.policy.protobuf import encode_field

# A ModelProto written by hand: ir_version 8 (field 1, varint), graph "abc" (field 7), opset (field 8), and the metadata
# property "surefoot" = "{}" (field 14: key is field 1, value is field 2).
GRAPH = bytes([7 << 3 | 2, 3]) + b"abc"
CONTRACT = bytes([14 << 3 | 2, 14]) + bytes([1 << 3 | 2, 8]) + b"surefoot" + bytes([2 << 3 | 2, 2]) + b"{}"
OPSET = bytes([8 << 3 | 2, 2, 16, 17])
MODEL = bytes([1 << 3, 8]) + GRAPH + OPSET + CONTRACT
DIGEST = hashlib.sha256(b"{}\0abc").hexdigest().encode()


def test_the_digest_of_a_model_worked_by_hand():
    parts = read_parts(MODEL)
    assert (parts.graph, parts.contract, parts.stored_digest) == (b"abc", b"{}", None)
    assert parts.digest.encode() == DIGEST


def test_a_digest_is_one_more_property_at_the_end():
    whole = add_digest(MODEL)
    assert whole.startswith(MODEL)
    assert check_digest(whole).stored_digest == DIGEST


def carried(robot: bytes) -> bytes:
    """Return the model with a property for the robot, whose key has 14 letters."""
    entry = bytes([1 << 3 | 2, 14]) + b"surefoot-robot" + bytes([2 << 3 | 2, len(robot)]) + robot
    return MODEL + bytes([14 << 3 | 2, len(entry)]) + entry


def test_the_digest_covers_a_carried_robot():
    whole = add_digest(carried(b"UEs="))
    assert check_digest(whole).robot_archive() == b"PK"
    assert check_digest(whole).stored_digest == hashlib.sha256(b"{}\0UEs=\0abc").hexdigest().encode()
    with pytest.raises(SurefootError, match="its digest does not match"):
        check_digest(whole.replace(b"UEs=", b"UEt="))


def test_a_robot_that_is_not_base64_is_rejected():
    with pytest.raises(SurefootError, match="its robot is damaged: it is not base64"):
        check_digest(add_digest(carried(b"U*s="))).robot_archive()


def test_a_long_field_has_a_length_of_two_bytes():
    graph = bytes(range(256)) * 2
    model = bytes([7 << 3 | 2, 0x80, 0x04]) + graph + CONTRACT  # 512 = 4 * 128 + 0
    assert read_parts(add_digest(model)).graph == graph


@pytest.mark.parametrize(
    ("before", "after"), [(b"abc", b"abd"), (b"{}", b"[]")], ids=["another network", "another contract"]
)
def test_a_change_after_the_export_is_rejected(before: bytes, after: bytes):
    with pytest.raises(SurefootError, match=r"its digest does not match.*export the policy again"):
        check_digest(add_digest(MODEL).replace(before, after))


@pytest.mark.parametrize("data", [MODEL[:-1], MODEL[:3], b"\xff" * 12, bytes([1 << 3 | 4]), bytes([1 << 3 | 1, 0])])
def test_bytes_that_are_no_message_are_rejected(data: bytes):
    with pytest.raises(SurefootError, match="is damaged or not ONNX"):
        read_parts(data)


@given(st.binary(max_size=200))
def test_random_bytes_are_read_or_rejected(data: bytes):
    with contextlib.suppress(SurefootError):
        check_digest(data)


def test_every_damage_to_the_digest_is_rejected():
    data = add_digest(MODEL)
    for at in range(len(MODEL), len(data)):
        for bit in range(8):
            with pytest.raises(SurefootError):
                check_digest(data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :])
        with pytest.raises(SurefootError, match=r"is damaged or not ONNX|has no digest"):
            check_digest(data[:at])


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (b"surefoot-digest", b"", "its digest does not match"),
        (b"surefoot-digest", DIGEST.upper(), "its digest does not match"),
        (b"surefoot-digest", b"\xff" * 64, "its digest does not match"),
        (b"surefoot-digesu", DIGEST, "property 'surefoot-digesu' that surefoot does not write"),
        (b"surefoot", b"{}", "property 'surefoot' that surefoot does not write, or has it twice"),
    ],
)
def test_another_property_than_the_digest_is_rejected(name: bytes, value: bytes, message: str):
    with pytest.raises(SurefootError, match=message):
        check_digest(MODEL + encode_field(14, encode_field(1, name) + encode_field(2, value)))


@pytest.mark.parametrize(
    "more",
    [encode_field(25, b"function"), encode_field(6, b"note"), GRAPH, bytes([5 << 3, 1]), encode_field(8, b"\x10\x11")],
)
def test_more_than_graph_and_contract_is_rejected(more: bytes):
    """Only content that the digest covers may affect what is computed."""
    with pytest.raises(SurefootError, match="not ONNX as surefoot writes it: its model has"):
        check_digest(add_digest(MODEL) + more)


@pytest.mark.parametrize("opset", [b"\x10\x10", b"\x0a\x02me\x10\x11", b""])
def test_operators_of_another_set_are_rejected(opset: bytes):
    with pytest.raises(SurefootError, match="operators of another set or version"):
        read_parts(GRAPH + CONTRACT + encode_field(8, opset))


def test_the_digest_does_not_cover_who_made_the_file():
    """Producer and format version do not affect what is computed, see `surefoot.policy.digest`."""
    whole = add_digest(MODEL)
    other = encode_field(2, b"somebody else") + whole
    assert check_digest(other).digest == check_digest(whole).digest
    assert "does not cover" in (digest.__doc__ or "")
