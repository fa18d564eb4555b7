"""Frames on a line: bytes worked out by hand, and a decoder that finds every complete frame in any stream."""

from __future__ import annotations

import itertools
import math
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import EXAMPLES, Example

from surefoot.deploy.messages import Fault, Handshake, Packet, Ping, Pong, State
from surefoot.deploy.robot_link import LinkStatistics
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec
from surefoot.deploy.serial.frames import MAX_FRAME, Decoder, encode_frame, frame_bytes

CODEC = Codec(8)
PING = encode_frame(CODEC, Ping(1), 2, 0.001)
PONG = encode_frame(CODEC, Pong(7), 3, 0.002)


def crc32(data: bytes) -> bytes:
    """Return the CRC-32 as documented, bit by bit."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    return (crc ^ 0xFFFFFFFF).to_bytes(4, "little")


def cobs(data: bytes) -> bytes:
    """Return the COBS encoding of bytes as documented, block by block."""
    out = b""
    pieces = data.split(b"\0")
    for number, piece in enumerate(pieces, 1):
        full = len(piece) // 254
        for at in range(full):
            out += b"\xff" + piece[254 * at : 254 * (at + 1)]
        rest = piece[254 * full :]
        if rest or not full or number < len(pieces):
            out += bytes([len(rest) + 1]) + rest
    return out


def frame_of(body: bytes) -> bytes:
    return b"\0" + cobs(body + crc32(body)) + b"\0"


def header(code: int, version: int = VERSION, schema: int = CODEC.schema) -> bytes:
    return HEADER.pack(version, code, schema, 5, 6)


def numbers(frames: list[Packet]) -> list[int]:
    return [frame.sequence for frame in frames]


def decode(data: bytes) -> tuple[list[int], LinkStatistics]:
    """Return the numbers of the frames in a stream, and the counts."""
    decoder = Decoder(CODEC)
    return numbers(decoder.feed(data)), decoder.statistics


# Known bytes.


def test_cobs_and_crc32_agree_with_the_document():
    assert crc32(b"123456789") == bytes.fromhex("26 39 F4 CB")
    run = bytes([0x11]) * 254
    for data, stuffed in [
        (b"", "01"),
        (b"\0", "01 01"),
        (b"\x11\x22\0\x33", "03 11 22 02 33"),
        (b"\x11\0\0\0", "02 11 01 01 01"),
        (run, "FF" + run.hex()),
        (run + b"\x11", "FF" + run.hex() + "02 11"),
        (run + b"\0", "FF" + run.hex() + "01 01"),
    ]:
        assert cobs(data) == bytes.fromhex(stuffed)


def test_a_ping_has_the_bytes_worked_out_by_hand():
    body = bytes.fromhex(
        "01"  # version
        "02"  # Ping
        "1C 5D 0C 16"  # schema
        "02 00 00 00"  # number
        "E8 03 00 00 00 00 00 00"  # 1000 microseconds
        "01 00 00 00"  # token
    )
    assert crc32(body) == bytes.fromhex("E0 03 AF 45")
    on_the_line = (
        "00"
        "08 01 02 1C 5D 0C 16 02"  # seven bytes and a zero
        "01 01"
        "03 E8 03"
        "01 01 01 01 01"
        "02 01"
        "01 01"
        "05 E0 03 AF 45"
        "00"
    )
    assert bytes.fromhex(on_the_line) == PING
    (frame,) = Decoder(CODEC).feed(PING)
    assert frame == Packet(Ping(1), 2, 0.001)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: type(example.message).__name__)
def test_every_kind_of_frame_is_as_documented(example: Example):
    message = example.message
    body = HEADER.pack(VERSION, NUMBERS[type(message)], CODEC.schema, example.sequence, round(example.time * 1e6))
    body += CODEC.pack(message)
    assert example.data == frame_of(body) == encode_frame(CODEC, message, example.sequence, example.time)


@pytest.mark.parametrize("motors", [8, 21])
def test_frames_with_254_bytes_without_a_zero_and_of_the_largest_robot_fit(motors: int):
    codec, full = Codec(motors), np.full(motors, 1.2345678)
    names = tuple(chr(97 + motor) * 24 for motor in range(motors))
    times, limits = (0.12, full, full, 0.1, 0.1), (full, full, *[1.2345] * 5)
    message = Handshake(0x1111, "r" * 24, "f" * 40, names, np.ones(motors), *times, *limits)
    body = header(NUMBERS[Handshake], schema=codec.schema) + codec.pack(message)
    assert max(map(len, (body + crc32(body)).split(b"\0"))) > 254
    data = encode_frame(codec, message, 5, 6e-6)
    assert data == frame_of(body)
    assert numbers(Decoder(codec).feed(data)) == [5]
    # Each motor takes 41 bytes: name, sign, gains and range.
    assert (MAX_FRAME - 41 < frame_bytes(codec, Handshake) - 2 <= MAX_FRAME) == (motors == 21)


@given(st.sampled_from(EXAMPLES), st.integers(1, 2**32 - 1), st.floats(0, 1e9))
def test_number_and_time_arrive(example: Example, sequence: int, time: float):
    data = encode_frame(CODEC, example.message, sequence, time)
    assert len(data) <= frame_bytes(CODEC, type(example.message))
    assert data[0] == data[-1] == 0
    assert 0 not in data[1:-1]
    (frame,) = Decoder(CODEC).feed(data)
    assert frame.sequence == sequence
    assert abs(frame.time - time) <= 0.5e-6 + 2 * math.ulp(time)
    assert encode_frame(CODEC, frame.message, frame.sequence, frame.time) == data


@pytest.mark.parametrize(
    ("sequence", "time", "match"),
    [
        *((number, 0.0, f"the number of a frame is {number}; it must be 1 to 4294967295") for number in (0, -1, 2**32)),
        *((1, time, f"the time of a frame is {time}; it must be finite") for time in (math.nan, math.inf, -math.inf)),
    ],
)
def test_a_frame_needs_a_number_and_a_time(sequence: int, time: float, match: str):
    with pytest.raises(ValueError, match=match):
        encode_frame(CODEC, Ping(1), sequence, time)


@pytest.mark.parametrize(
    ("time", "arrives"), [(-1.0, 0.0), (-1e-9, 0.0), (1e-7, 0.0), (6e-7, 1e-6), (1e300, 2**64 / 1e6)]
)
def test_a_time_is_rounded_and_clipped(time: float, arrives: float):
    (frame,) = Decoder(CODEC).feed(encode_frame(CODEC, Ping(1), 1, time))
    assert frame.time == pytest.approx(arrives, rel=1e-15, abs=0)


# Damage.


def test_frames_may_be_close_or_far_apart_or_share_zeros():
    for stream in (PING + PONG, PING + bytes(1000) + PONG, PING[:-1] + PONG, PING[1:] + PONG[:-1] + b"\0"):
        assert decode(stream) == ([2, 3], LinkStatistics(received=2))


def test_zeros_without_data_are_not_frames():
    assert decode(b"") == decode(bytes(5000)) == ([], LinkStatistics())


@pytest.mark.parametrize("cut", range(len(PING) + 1))
def test_a_frame_cut_at_its_start_or_end_does_not_damage_the_next_one(cut: int):
    sequences, counts = decode(PING[:cut] + PONG)
    whole = cut >= len(PING) - 1  # the next frame's zero also ends it
    assert sequences == ([2, 3] if whole else [3])
    assert counts.damaged == (not whole and cut > 1)
    sequences, counts = decode(PING[cut:] + PONG)
    assert sequences == ([2, 3] if cut <= 1 else [3])
    assert counts.damaged == (1 < cut < len(PING) - 1)


@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: type(example.message).__name__)
def test_a_flipped_bit_damages_only_one_frame(example: Example):
    data = example.data
    for at, bit in itertools.product(range(len(data)), range(8)):
        flipped = bytearray(data)
        flipped[at] ^= 1 << bit
        sequences, counts = decode(PING + flipped + PONG)
        assert sequences == [2, 3], f"byte {at}, bit {bit}"
        assert counts.damaged >= 1


def test_two_flipped_bits_are_detected():
    data = encode_frame(CODEC, Ping(0x11223344), 0x55667788, 1.0)
    decoder = Decoder(CODEC)
    bits = range(8, 8 * len(data) - 8)
    for one, other in itertools.combinations(bits, 2):
        flipped = bytearray(data)
        flipped[one // 8] ^= 1 << one % 8
        flipped[other // 8] ^= 1 << other % 8
        assert decoder.feed(flipped) == []


def test_a_byte_lost_doubled_or_swapped_is_detected():
    for example in EXAMPLES:
        data = example.data
        for at in range(1, len(data) - 1):
            lost = data[:at] + data[at + 1 :]
            doubled = data[: at + 1] + data[at:]
            swapped = data[:at] + data[at : at + 2][::-1] + data[at + 2 :]
            for damaged in (lost, doubled, swapped):
                sequences, _ = decode(damaged + PONG)
                assert sequences == ([example.sequence, 3] if damaged == data else [3])


def test_garbage_between_frames_is_counted_and_costs_no_frame():
    sequences, counts = decode(PING + b"garbage" + PONG + b"\x01\0more" + PING)
    assert sequences == [2, 3, 2]
    assert counts == LinkStatistics(received=3, damaged=3)


@pytest.mark.parametrize("body", [b"", b"\0" * 17, header(2)[:17]])
def test_a_checksum_without_payload_is_not_a_frame(body: bytes):
    sequences, counts = decode(frame_of(body) + PONG)
    assert sequences == [3]
    assert counts.damaged == 1


@pytest.mark.parametrize(
    ("version", "schema"), [(2, CODEC.schema), (0, CODEC.schema), (1, 0), (1, CODEC.schema ^ 1 << 31)]
)
def test_a_frame_of_another_version_or_schema_is_foreign(version: int, schema: int):
    decoder = Decoder(CODEC)
    assert decoder.foreign is None
    stream = frame_of(header(NUMBERS[Ping], version, schema) + b"whatever") + PONG
    assert numbers(decoder.feed(stream)) == [3]
    assert decoder.statistics == LinkStatistics(received=1, foreign=1)
    assert decoder.foreign == (version, schema)


def test_foreign_frames_are_recognized_up_to_the_maximum_size():
    for size in range(980, 1010):
        data = frame_of(header(NUMBERS[Ping], version=2) + b"\7" * size)
        whole = len(data) - 2 <= MAX_FRAME
        sequences, counts = decode(data + PONG)
        assert sequences == [3]
        assert (counts.foreign, counts.damaged) == (whole, not whole)
        assert whole or size > 980


@pytest.mark.parametrize(
    "body",
    [
        header(0),
        header(9) + bytes(4),
        header(255) + bytes(300),
        header(NUMBERS[Ping]),
        header(NUMBERS[Ping]) + bytes(3),
        header(NUMBERS[Ping]) + bytes(5),
        header(NUMBERS[State]) + bytes(129),
        header(NUMBERS[Fault]) + b"\1\0\1" + b"\xff" * 80,
    ],
)
def test_a_frame_with_an_unknown_type_length_or_text_is_unknown(body: bytes):
    sequences, counts = decode(frame_of(body) + PONG)
    assert sequences == [3]
    assert (counts.unknown, counts.damaged, counts.foreign) == (1, 0, 0)


# Memory.


@pytest.mark.parametrize(("size", "held"), [(MAX_FRAME - 1, True), (MAX_FRAME, True), (MAX_FRAME + 1, False)])
def test_data_beyond_the_limit_are_not_buffered(size: int, held: bool):
    for step in (size, 1, 100):
        decoder = Decoder(CODEC)
        for at in range(0, size, step):
            decoder.feed(b"x" * min(step, size - at))
        assert len(decoder._buffer) == (size if held else 0)
        assert numbers(decoder.feed(PONG)) == [3]
        assert decoder.statistics.damaged == 1


def test_endless_data_count_as_one_damaged_frame_and_use_no_memory():
    decoder = Decoder(CODEC)
    for size in (1, 100, 1000, 5_000_000, 7, 1024, 1025):
        assert decoder.feed(b"\xaa" * size) == []
        assert sys.getsizeof(decoder._buffer) < 2 * MAX_FRAME
    assert decoder.statistics.damaged == 0
    # A frame without a leading zero is lost together with it.
    assert numbers(decoder.feed(PING[1:] + PONG)) == [3]
    assert decoder.statistics.damaged == 1


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_bytes_may_have_any_type(kind: type):
    assert numbers(Decoder(CODEC).feed(kind(PING))) == [2]


PIECES = st.one_of(
    st.binary(max_size=60),
    st.sampled_from([example.data for example in EXAMPLES]),
    st.builds(lambda size, byte: bytes([byte]) * size, st.integers(0, 3000), st.integers(0, 255)),
    st.sampled_from(MESSAGES).map(lambda kind: frame_of(header(NUMBERS[kind]) + bytes(CODEC.size(kind)))),
    st.binary(max_size=40).map(lambda body: frame_of(header(1) + body)),
    st.binary(max_size=40).map(frame_of),
)


@given(st.binary(max_size=4000))
def test_random_bytes_neither_raise_nor_pass(data: bytes):
    decoder = Decoder(CODEC)
    decoder.feed(data)
    assert len(decoder._buffer) <= MAX_FRAME
    assert decoder.statistics.received == 0


@given(st.lists(PIECES, max_size=12), st.data())
def test_the_split_of_a_stream_changes_nothing(pieces: list[bytes], data: st.DataObject):
    stream = b"".join(pieces)
    whole, parts, single = Decoder(CODEC), Decoder(CODEC), Decoder(CODEC)
    expected = [(frame.sequence, frame.time, CODEC.pack(frame.message)) for frame in whole.feed(stream)]
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=20)))
    split, bytewise = [], []
    for start, end in itertools.pairwise([0, *cuts, len(stream)]):
        split += parts.feed(stream[start:end])
        assert len(parts._buffer) <= MAX_FRAME
    for byte in stream:
        bytewise += single.feed(bytes([byte]))
    for frames, decoder in ((split, parts), (bytewise, single)):
        assert [(frame.sequence, frame.time, CODEC.pack(frame.message)) for frame in frames] == expected
        assert decoder.statistics == whole.statistics
        assert decoder.foreign == whole.foreign


@given(st.lists(st.one_of(st.sampled_from(EXAMPLES), st.binary(max_size=50)), max_size=12))
def test_every_complete_frame_between_garbage_is_found(pieces: list[Example | bytes]):
    # Garbage is accepted as a frame with a probability of 2^-32.
    stream = b"".join(piece if isinstance(piece, bytes) else piece.data for piece in pieces)
    sequences, _ = decode(stream)
    assert sequences == [piece.sequence for piece in pieces if isinstance(piece, Example)]
