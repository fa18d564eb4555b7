"""The serial line: transmission time, and faults of frames."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from surefoot.deploy.messages import Ping
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.emulator.fault_table import LINE_FAULTS
from surefoot.emulator.serial.line import Line


def line(probabilities: dict[str, float] | None = None, **config: float) -> Line:
    made = Line(np.random.default_rng(5), **config)
    made.probabilities = probabilities or {}
    return made


def arrivals(line: Line) -> list[tuple[int, bytes]]:
    arrived = []
    while line.next_time < math.inf:
        arrived.append((line.next_time, line.take()))
    return arrived


def test_bytes_take_transmission_time():
    slow = line(baud=100_000)  # 10 bytes per millisecond
    slow.send(1000, b"\0aaaaaaaa\0" + b"\0bbb\0")
    slow.send(5000, b"\0cccccccc\0")
    assert arrivals(slow) == [(2000, b"\0aaaaaaaa\0"), (2500, b"\0bbb\0"), (6000, b"\0cccccccc\0")]
    assert arrivals(line()) == []


def test_without_a_baud_rate_bytes_take_no_time():
    quick = line()
    quick.send(7, b"\0aa\0\0bb")
    assert arrivals(quick) == [(7, b"\0aa\0")]
    quick.send(9, b"b\0")
    assert arrivals(quick) == [(9, b"\0bbb\0")]


def test_bytes_without_a_frame_are_passed_on():
    quick = line()
    for _ in range(100):
        quick.send(0, b"x" * 100)
    assert sum(len(data) for _, data in arrivals(quick)) > 4000


def test_batches_arrive_at_multiples_of_their_period():
    batched = line(batch=0.016)
    for at in (0, 1, 15_999, 16_000, 16_001):
        batched.send(at, b"\0a\0")
    assert [at for at, _ in arrivals(batched)] == [0, 16_000, 16_000, 16_000, 32_000]


def test_a_cut_line_loses_bytes_in_transit():
    pulled = line(baud=9600)
    pulled.send(0, b"\0a\0")
    pulled.cut_off()
    pulled.send(1, b"\0b\0")
    assert arrivals(pulled) == []


@pytest.mark.parametrize("harm", LINE_FAULTS)
def test_each_line_fault_occurs_at_its_rate(harm):
    codec = Codec(8)
    struck, decoder, received, count = line({harm: 0.2}), Decoder(codec), [], 2000
    for number in range(1, count + 1):
        struck.send(number, encode_frame(codec, Ping(number), number, 0.0))
        for _, data in arrivals(struck):
            received += [frame.sequence for frame in decoder.feed(data)]
    times = struck.counts.total()
    assert times == struck.counts[harm] == pytest.approx(0.2 * count, rel=0.15)
    in_order = all(a < b for a, b in itertools.pairwise(received))
    if harm in ("corrupt", "drop", "cut-frames"):
        # A flipped bit in the zeros around a frame, or a cut that removes only one of them, has no effect.
        assert count - times <= len(received) <= count - (times if harm == "drop" else 0)
        assert in_order
    elif harm == "duplicate":
        assert len(received) == count + times
        assert sorted(set(received)) == list(range(1, count + 1))
    elif harm == "reorder":
        assert set(range(1, count)) <= set(received)
        assert not in_order
    else:
        assert received == list(range(1, count + 1))
    assert (decoder.statistics.damaged > 0) == (harm in ("corrupt", "cut-frames", "garbage"))


def test_equal_seeds_give_equal_faults():
    def run() -> list[tuple[int, bytes]]:
        again = line(dict.fromkeys(LINE_FAULTS, 0.1))
        for number in range(300):
            again.send(number, b"\0" + bytes([number % 255 + 1] * 20) + b"\0")
        return arrivals(again)

    assert run() == run()
