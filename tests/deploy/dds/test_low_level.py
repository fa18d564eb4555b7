"""Low-level messages of a Go2: published and recorded checksums, the bytes of the vendor's classes, hostile bytes."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import LOW_COMMAND, LOW_STATE, BadMessageError, RemoteControl

RECORDED = json.loads((Path(__file__).parent / "recorded_messages.json").read_text())
KINDS = {"low_state": LOW_STATE, "low_cmd": LOW_COMMAND}


def fill(record: Any, values: dict[str, Any]) -> None:
    """Set fields of a record from nested tables and lists; the other fields keep their values."""
    for name, value in values.items():
        if isinstance(value, dict):
            fill(record[name], value)
        elif isinstance(value, list) and isinstance(value[0], dict):
            for part, fields in zip(record[name], value, strict=False):
                fill(part, fields)
        elif isinstance(value, list):
            record[name][: len(value)] = value
        else:
            record[name] = value


def recorded(name: str) -> np.ndarray:
    record = low_level.new_record(KINDS[name])
    fill(record, {key: value for key, value in RECORDED[name].items() if key in KINDS[name].names})
    return record


def noise(kind: np.dtype, seed: int) -> np.ndarray:
    """Return a random message; integers are in the lower half, since the vendor's checksum treats some as signed."""
    rng, record = np.random.default_rng(seed), low_level.new_record(kind)

    def draw(part: Any) -> None:
        for name in part.dtype.names:
            if part[name].dtype.names:
                for inner in part[name].reshape(-1) if part[name].ndim else [part[name]]:
                    draw(inner)
            elif part[name].dtype.kind == "f":
                part[name] = rng.normal(size=part[name].shape)
            else:
                limits, shape = np.iinfo(part[name].dtype), part[name].shape
                part[name] = rng.integers(limits.min, limits.max // 2, shape, part[name].dtype)

    draw(record)
    return record


def test_checksums_of_the_vendors_examples() -> None:
    assert low_level.checksum(low_level.new_record(LOW_COMMAND)) == 1264208000
    assert low_level.checksum(low_level.new_record(LOW_STATE)) == 2247171750
    assert low_level.checksum(low_level.new_command()) == 115701709


@pytest.mark.parametrize(("name", "crc"), [("low_state", 2726957031), ("low_cmd", 4194941488)])
def test_checksums_of_a_real_robot(name: str, crc: int) -> None:
    assert RECORDED[name]["crc"] == crc
    assert low_level.checksum(recorded(name)) == crc


@pytest.mark.parametrize(("kind", "length"), [(LOW_STATE, 1176), (LOW_COMMAND, 808)])
def test_a_message_has_the_lengths_on_the_wire_and_comes_back(kind: np.dtype, length: int) -> None:
    record = low_level.decode(kind, low_level.encode(low_level.new_record(kind)))
    record["sn"] = 7, 9
    data = low_level.encode(record)
    assert len(data) == length + 4
    assert low_level.decode(kind, data) == record


@pytest.mark.parametrize("kind", [LOW_STATE, LOW_COMMAND])
@given(position=st.integers(4, 807), bit=st.integers(0, 7))
@settings(max_examples=60, deadline=None)
def test_a_flipped_bit_is_detected_unless_it_is_padding(kind: np.dtype, position: int, bit: int) -> None:
    record = low_level.new_record(kind)
    data = bytearray(low_level.encode(record))
    data[position] ^= 1 << bit
    try:
        read = low_level.decode(kind, bytes(data))
    except BadMessageError:
        return
    assert read == record


@pytest.mark.parametrize("data", [b"", bytes(3), bytes(1179), bytes(1181), b"\0\0" + bytes(1178), os.urandom(1180)])
def test_other_layouts_are_rejected(data: bytes) -> None:
    with pytest.raises(BadMessageError):
        low_level.decode(LOW_STATE, data)


@pytest.mark.sdk
@pytest.mark.parametrize(("kind", "name"), [(LOW_STATE, "LowState_"), (LOW_COMMAND, "LowCmd_")])
def test_bytes_and_checksums_agree_with_the_vendors_classes(kind: np.dtype, name: str) -> None:
    pytest.importorskip("unitree_sdk2py.idl.unitree_go.msg.dds_", exc_type=ImportError)
    from unitree_sdk2py.idl.unitree_go.msg import dds_
    from unitree_sdk2py.utils.crc import CRC

    for seed in range(3):
        data = low_level.encode(noise(kind, seed))
        theirs = getattr(dds_, name).deserialize(data)
        assert theirs.crc == CRC().Crc(theirs)
        assert theirs.serialize() == data


def test_the_bytes_of_the_remote_control() -> None:
    data = np.zeros(40, np.uint8)
    assert RemoteControl.decode(data) == RemoteControl(frozenset(), 0.0, 0.0, 0.0, 0.0)
    data[2:4] = 0b00100000, 0b00000010  # bit 5: L2, bit 9: B
    data[4:8] = np.frombuffer(np.float32(-0.5).tobytes(), np.uint8)
    data[20:24] = np.frombuffer(np.float32(1.0).tobytes(), np.uint8)
    remote = RemoteControl.decode(data)
    assert remote == RemoteControl(frozenset({"L2", "B"}), -0.5, 1.0, 0.0, 0.0)
    assert np.array_equal(remote.encode(), data)
