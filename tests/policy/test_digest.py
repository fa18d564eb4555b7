"""The digest: known bytes, a stale file refused, an older one accepted, and no mismatch hidden."""

from __future__ import annotations

import contextlib
import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.cli.helpers.policies import find_policy, shipped_policies
from surefoot.errors import SurefootError
from surefoot.policy.contract import METADATA_KEY
from surefoot.policy.digest import DIGEST_KEY, check_digest, main, read_parts, stamped
from surefoot.policy.protobuf import field
from surefoot.policy.runtime import PolicyRuntime

# A ModelProto worked by hand: ir_version 8 (field 1, varint), graph "abc" (field 7), opset (field 8, skipped), and
# the metadata property "surefoot" = "{}" (field 14: key is field 1, value is field 2).
GRAPH = bytes([7 << 3 | 2, 3]) + b"abc"
CONTRACT = bytes([14 << 3 | 2, 14]) + bytes([1 << 3 | 2, 8]) + b"surefoot" + bytes([2 << 3 | 2, 2]) + b"{}"
MODEL = bytes([1 << 3, 8]) + GRAPH + bytes([8 << 3 | 2, 2, 16, 17]) + CONTRACT


def test_the_digest_of_a_model_worked_by_hand():
    parts = read_parts(MODEL)
    assert parts.graph == b"abc"
    assert parts.properties == {METADATA_KEY: b"{}"}
    assert parts.digest == hashlib.sha256(b"{}\0abc").hexdigest()
    assert parts.stated is None
    assert check_digest(MODEL) is None


def test_stamping_adds_one_property_and_changes_nothing():
    whole = stamped(MODEL)
    assert whole.startswith(MODEL)
    assert check_digest(whole) == read_parts(MODEL).digest
    assert read_parts(whole).properties == {METADATA_KEY: b"{}", DIGEST_KEY: read_parts(MODEL).digest.encode()}
    assert stamped(whole) == whole


def test_a_long_field_has_a_length_of_two_bytes():
    graph = bytes(range(256)) * 2
    model = bytes([7 << 3 | 2, 0x80, 0x04]) + graph + CONTRACT  # 512 = 4 * 128 + 0
    assert read_parts(stamped(model)).graph == graph


@pytest.mark.parametrize(
    ("before", "after"), [(b"abc", b"abd"), (b"{}", b"[]")], ids=["another network", "another contract"]
)
def test_a_change_after_the_stamp_is_found_and_not_mended(before: bytes, after: bytes):
    stale = stamped(MODEL).replace(before, after)
    for act in (check_digest, stamped):
        with pytest.raises(SurefootError, match=r"its digest does not match.*export the policy again"):
            act(stale)


@pytest.mark.parametrize("data", [MODEL[:-1], MODEL[:3], b"\xff" * 12, bytes([1 << 3 | 4]), bytes([1 << 3 | 1, 0])])
def test_what_is_no_message_is_refused(data: bytes):
    with pytest.raises(SurefootError, match="is damaged or not ONNX"):
        read_parts(data)


@given(st.binary(max_size=200))
def test_no_bytes_do_worse_than_be_refused(data: bytes):
    with contextlib.suppress(SurefootError):
        check_digest(data)


def test_what_has_no_contract_is_not_stamped():
    with pytest.raises(SurefootError, match="has no contract"):
        stamped(GRAPH)


def test_the_policies_that_ship_have_a_digest_that_fits():
    shipped = shipped_policies()
    assert {"trot", "gallop"} <= set(shipped)
    for path in shipped.values():
        assert PolicyRuntime.load(path).digest == read_parts(path.read_bytes()).digest


def test_every_damage_to_the_digest_is_found():
    """A digest that is there, in whatever state, is never taken for one that is not."""
    data = stamped(MODEL)
    for at in range(len(MODEL), len(data)):
        for bit in range(8):
            damaged = data[:at] + bytes([data[at] ^ 1 << bit]) + data[at + 1 :]
            with pytest.raises(SurefootError):
                check_digest(damaged)
        if at > len(MODEL):
            with pytest.raises(SurefootError, match="is damaged or not ONNX"):
                check_digest(data[:at])


DIGEST = read_parts(MODEL).digest.encode()


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (b"surefoot-digest", b"", "its digest is damaged: it must be 64 hexadecimal digits"),
        (b"surefoot-digest", DIGEST[:-1], "its digest is damaged"),
        (b"surefoot-digest", DIGEST.upper(), "its digest is damaged"),
        (b"surefoot-digest", b"\xff" * 64, "its digest is damaged"),
        (b"surefoot-digest", b"0" * 64, "its digest does not match"),
        (b"surefoot-digesu", DIGEST, "property 'surefoot-digesu' that surefoot does not write"),
        (b"surefoot", b"{}", "property 'surefoot' that surefoot does not write, or has it twice"),
    ],
)
def test_a_damaged_digest_is_told(name: bytes, value: bytes, message: str):
    with pytest.raises(SurefootError, match=message):
        check_digest(MODEL + field(14, field(1, name) + field(2, value)))


@pytest.mark.parametrize(
    "more", [field(25, b"function"), field(6, b"note"), GRAPH, bytes([5 << 3, 1]), field(8, b"\x10\x11")]
)
def test_what_surefoot_does_not_write_beside_graph_and_contract_is_refused(more: bytes):
    """Nothing but what the digest covers may decide what is computed."""
    with pytest.raises(SurefootError, match="not ONNX as surefoot writes it: its model has"):
        check_digest(stamped(MODEL) + more)


@pytest.mark.parametrize("opset", [b"\x10\x10", b"\x0a\x02me\x10\x11", b""])
def test_operators_of_another_set_are_refused(opset: bytes):
    with pytest.raises(SurefootError, match="operators of another set or version"):
        check_digest(stamped(GRAPH + CONTRACT) + field(8, opset))


def changed(path: Path, edit: Callable[[Any], None]) -> Path:
    """The trot that ships, after an edit of its model by someone who knows ONNX and nothing of digests."""
    onnx = pytest.importorskip("onnx")
    model = onnx.load(find_policy("trot"))
    edit(model)
    onnx.checker.check_model(model, full_check=True)
    onnx.save(model, path)
    return path


def test_a_file_written_before_there_was_a_digest_still_loads(tmp_path: Path):
    def edit(model: Any) -> None:
        kept = [prop for prop in model.metadata_props if prop.key != DIGEST_KEY]
        del model.metadata_props[:]
        model.metadata_props.extend(kept)

    runtime = PolicyRuntime.load(changed(tmp_path / "old.onnx", edit))
    assert runtime.digest is None
    assert main([str(tmp_path / "old.onnx")]) == 0
    again = PolicyRuntime.load(tmp_path / "old.onnx")
    assert again.digest == PolicyRuntime.load(find_policy("trot")).digest
    assert again.contract == runtime.contract
    assert np.array_equal(again.feedback(np.ones((3, 4))), runtime.feedback(np.ones((3, 4))))


def test_the_command_stamps_and_refuses_file_by_file(tmp_path: Path):
    good, stale, text = tmp_path / "good.onnx", tmp_path / "stale.onnx", tmp_path / "text.onnx"
    good.write_bytes(MODEL)
    stale.write_bytes(stamped(MODEL).replace(b"abc", b"abd"))
    text.write_text("I am no policy.")
    before = stale.read_bytes()
    words = [sys.executable, "-m", "surefoot.policy.digest", stale, text, tmp_path / "none.onnx", good]
    done = subprocess.run(words, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stdout.startswith(f"{good}: stamped ")
    said = done.stderr.splitlines()
    assert len(said) == 3
    assert "digest does not match" in said[0]
    assert "is damaged or not ONNX" in said[1] or "has no contract" in said[1]
    assert "No such file" in said[2]
    assert stale.read_bytes() == before
    assert good.read_bytes() == stamped(MODEL)
    assert subprocess.run([*words[:3], good], capture_output=True, timeout=60).returncode == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["good.onnx", "stale.onnx", "text.onnx"]


def test_the_command_without_files_tells_its_use(capsys: pytest.CaptureFixture[str]):
    assert main([]) == 2
    assert "usage: python -m surefoot.policy.digest FILE..." in capsys.readouterr().err
