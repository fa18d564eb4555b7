"""Many frames over a bad line: no wrong one is accepted, and no complete one is lost."""

from __future__ import annotations

from types import ModuleType, SimpleNamespace

import pytest

import surefoot.deploy.serial.frames
from surefoot.deploy.serial.codec import Codec


def test_no_wrong_frame_is_accepted_and_no_complete_one_is_lost(link_soak: ModuleType):
    result = link_soak.soak(12_000, seed=1)
    assert (result.wrong, result.lost, result.wrongly_taken, result.wrongly_dropped) == (0, 0, 0, 0)
    assert result.good
    assert result.received == result.whole == result.taken + result.repeated
    # The checks above are not vacuous.
    fates = result.fates
    assert sum(fates.values()) - fates["(garbage between)"] == result.frames == 12_000
    assert min(fates.values()) > 200
    assert 5000 < fates["untouched"] <= result.taken < result.whole < 12_000
    assert result.repeated > 1000
    assert result.damaged_pieces > 3000


def test_the_soak_test_detects_a_receiver_without_a_checksum(link_soak: ModuleType, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(surefoot.deploy.serial.frames, "zlib", SimpleNamespace(crc32=lambda data: 0))
    result = link_soak.soak(3000, seed=0)
    assert result.wrong > 50
    assert not result.good


def test_the_soak_test_detects_a_receiver_that_loses_a_frame(link_soak: ModuleType, monkeypatch: pytest.MonkeyPatch):
    whole = Codec.unpack
    monkeypatch.setattr(Codec, "unpack", lambda self, code, payload: whole(self, code, payload) if code != 2 else None)
    result = link_soak.soak(1000, seed=0)
    assert result.lost > 20
    assert not result.good


def test_the_soak_test_detects_a_link_that_accepts_repeated_frames(
    link_soak: ModuleType, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(link_soak.SerialLink, "_is_next", lambda self, frame: True)
    result = link_soak.soak(1000, seed=0)
    assert result.wrongly_taken > 50
    assert not result.good


def test_an_undamaged_frame_arrives_next_to_damaged_ones(link_soak: ModuleType):
    rng = link_soak.random.Random(5)
    frames = [bytes([0, *[number % 255 + 1] * 20, 0]) for number in range(2000)]
    stream, untouched = link_soak.BadLine(rng).carry(frames)
    pieces = set(stream.split(b"\0"))
    assert 700 < len(untouched) < 1300
    assert all(frames[index].strip(b"\0") in pieces for index in untouched)
