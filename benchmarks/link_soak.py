"""Soak test of the serial link: a million frames over a line with bit errors, losses, duplicates, delays and garbage.

Frames go through the bad line, in chunks of random size, into the host's link. The expected result is independent of
the link: a frame is whole if the bytes between two zeros on the line equal a frame that was sent, and it is accepted if
its number is higher than the last one's. Any other output is wrong, and a missing frame is lost; in both cases the
script ends with exit code 1. An undisturbed frame must be received whatever happens to its neighbours.
"""

from __future__ import annotations

import argparse
import json
import random
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field

import numpy as np

from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.messages import Arm, Damp, Message, Packet, Ping, Position, Pwm, State
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import MAX_FRAME, Decoder, encode_frame
from surefoot.deploy.serial.port import SerialPort
from surefoot.deploy.serial.serial_link import SerialLink

BLOCK = 1000
"""Number of frames that are sent and compared at a time."""
CODEC = Codec(8)
STATE = State(
    session=4660,
    mode=1,
    reason=0,
    command=4,
    command_age=0.003,
    dropped=0,
    motor_angle=np.array([1.96875, 1.46875, 1.71875, 2.21875, 1.96875, 1.59375, 1.84375, 2.09375]),
    motor_velocity=np.array([0.0, 1.5, -1.5, 12.25, -12.25, 0.5, -0.5, 3.0]),
    motor_torque=np.array([0.0, 0.5, -0.5, 3.5, -3.5, 0.001, -0.001, 1.234]),
    roll_pitch_yaw=np.array([0.0625, -0.125, 3.0]),
    angular_velocity_base=np.array([0.5, -0.25, 0.0]),
    energy=17.5,
    voltage=16.0,
    temperature=np.array([25.0, 26.0, 27.0, 28.0, 29.0, 30.0, 31.0, 90.0]),
)


class BadLine:
    """Line that disturbs every second frame in one way, and inserts garbage between some.

    Args:
        rng: random generator of the disturbances.
    """

    def __init__(self, rng: random.Random) -> None:
        self.rng = rng
        self.fates: Counter[str] = Counter()
        """Number of frames by disturbance."""

    def carry(self, frames: Sequence[bytes]) -> tuple[bytes, list[int]]:
        """Transmit frames over the line.

        Returns:
            The received bytes, and the indices of frames that are undisturbed, except for garbage between them.
        """
        rng = self.rng
        chunks: list[tuple[float, bytes]] = []  # with their position in the order of arrival
        untouched, at = [], 0
        while at < len(frames):
            data, place, last = frames[at], float(at), at
            fate = rng.choices(*FATES)[0]
            if fate == "flipped":
                data = self._flipped(data, rng.randint(1, 8))
            elif fate == "burst":
                data = self._burst(data)
            elif fate == "lost":
                data = b""
            elif fate == "doubled":
                chunks.append((place + rng.choice((0.0, rng.randint(1, 5))), data))
            elif fate == "late":
                place += rng.randint(1, 5) + 0.5
            elif fate == "cut":
                data = self._cut(data)
            elif fate == "byte added":
                where = rng.randint(1, len(data) - 1)
                data = data[:where] + rng.randbytes(1) + data[where:]
            elif fate == "cable pulled":
                last = min(at + rng.randint(1, 20), len(frames) - 1)
                data = data[: rng.randrange(len(data))] + frames[last][rng.randrange(len(frames[last])) :]
            else:
                untouched.append(at)
            self.fates[fate] += last - at + 1
            chunks.append((place, data))
            if rng.random() < 0.1:
                self.fates["(garbage between)"] += 1
                chunks.append((float(at), self._garbage(frames[: at + 1])))
            at = last + 1
        chunks.sort(key=lambda chunk: chunk[0])
        return b"".join(data for _, data in chunks), untouched

    def _flipped(self, data: bytes, bits: int) -> bytes:
        changed = bytearray(data)
        for bit in self.rng.sample(range(8 * len(data)), bits):
            changed[bit // 8] ^= 1 << bit % 8
        return bytes(changed)

    def _burst(self, data: bytes) -> bytes:
        start = self.rng.randrange(len(data))
        length = self.rng.randint(1, 16)
        return data[:start] + self.rng.randbytes(len(data[start : start + length])) + data[start + length :]

    def _cut(self, data: bytes) -> bytes:
        """Remove the beginning, the middle or the end of a frame."""
        start, end = sorted(self.rng.sample(range(len(data) + 1), 2))
        return self.rng.choice((data[start:], data[:end], data[:start] + data[end:]))

    def _garbage(self, frames: Sequence[bytes]) -> bytes:
        """Return noise, a part of a frame that was sent, zeros, or more bytes without a zero than any frame has."""
        kind = self.rng.randrange(40)
        if kind == 0:
            return b"\x55" * (MAX_FRAME + self.rng.randint(-2, 200))
        if kind < 4:
            return bytes(self.rng.randint(1, 60))
        if kind < 14:
            return self._cut(self.rng.choice(frames))
        return self.rng.randbytes(self.rng.randint(1, 60))


FATES = (
    ["untouched", "flipped", "burst", "lost", "doubled", "late", "cut", "byte added", "cable pulled"],
    [50, 16, 4, 5, 7, 8, 6, 3, 1],
)


class Tape(SerialPort):
    """Serial port that returns bytes in chunks of random size."""

    def __init__(self, rng: random.Random) -> None:
        self.rng, self.data = rng, b""

    def read(self) -> bytes:
        size = self.rng.randint(1, 400)
        piece, self.data = self.data[:size], self.data[size:]
        return piece


class Listener(Decoder):
    """Decoder that stores all decoded packets."""

    def __init__(self) -> None:
        super().__init__(CODEC)
        self.heard: list[Packet] = []

    def feed(self, data: bytes) -> list[Packet]:
        received = super().feed(data)
        self.heard += received
        return received


@dataclass
class Result:
    """Counts of sent and received frames."""

    frames: int = 0
    bytes_on_line: int = 0
    fates: dict[str, int] = field(default_factory=dict)
    whole: int = 0
    """Frames on the line that equal a sent frame; duplicates count twice."""
    received: int = 0
    wrong: int = 0
    """Received frames that differ from sent ones, or are in the wrong order."""
    lost: int = 0
    """Whole frames that were not received, and undisturbed frames that were not whole on the line."""
    taken: int = 0
    """Received frames that were accepted by their number."""
    repeated: int = 0
    """Received frames that were dropped because their number was not above the last one's."""
    wrongly_taken: int = 0
    wrongly_dropped: int = 0
    damaged_pieces: int = 0
    foreign_pieces: int = 0
    unknown_pieces: int = 0
    seconds: float = 0.0

    @property
    def good(self) -> bool:
        return not (self.wrong or self.lost or self.wrongly_taken or self.wrongly_dropped)


def traffic(rng: random.Random, count: int) -> list[Message]:
    """Return messages to send; most are commands, as on a real line."""
    values = np.random.default_rng(rng.randrange(2**32))
    made: list[Message] = []
    for _ in range(count):
        session, kind = rng.randint(1, 65535), rng.randrange(20)
        if kind == 0:
            made.append(STATE)
        elif kind < 3:
            made.append(Ping(rng.randrange(2**32)))
        elif kind < 5:
            made.append(rng.choice((Damp(session), Arm(session, 1, 0.006, 0.003))))
        elif kind < 10:
            made.append(Pwm(session, values.uniform(-1, 1, 8)))
        else:
            made.append(Position(session, values.uniform(-0.5, 3.8, 8)))
    return made


def soak(count: int, seed: int) -> Result:
    """Send that many frames."""
    rng, result, start = random.Random(seed), Result(), time.perf_counter()
    pool = traffic(rng, 512)
    payloads = [CODEC.pack(message) for message in pool]
    line, tape, listener = BadLine(rng), Tape(rng), Listener()
    link = SerialLink(tape, CODEC, MonotonicClock())
    link.decoder = listener
    before: dict[bytes, int] = {}
    rest, last = b"", 0
    for first in range(1, count + 1, BLOCK):
        numbers = range(first, min(first + BLOCK, count + 1))
        frames = [encode_frame(CODEC, pool[number % len(pool)], number, number * 0.005) for number in numbers]
        stream, untouched = line.carry(frames)
        stream += b"\0"  # an additional zero, so that the block's last frame does not wait for the next block
        result.bytes_on_line += len(stream)
        # Expected output.
        sent = {frame[1:-1]: number for frame, number in zip(frames, numbers, strict=True)}
        *pieces, rest = (rest + stream).split(b"\0")
        whole = [number for piece in pieces if (number := sent.get(piece, before.get(piece))) is not None]
        result.lost += len({numbers[index] for index in untouched} - set(whole))
        taken = []
        for number in whole:
            if number > last:
                taken.append(number)
                last = number
        # Actual output.
        tape.data, arrivals = stream, []
        while tape.data:
            arrivals += link.receive()
        heard = [
            frame.sequence
            if CODEC.pack(frame.message) == payloads[frame.sequence % len(pool)]
            and frame.time == round(frame.sequence * 5000) / 1e6
            else -1
            for frame in listener.heard
        ]
        listener.heard.clear()
        result.received += len(heard)
        result.whole += len(whole)
        if heard != whole:
            extra, missing = Counter(heard) - Counter(whole), Counter(whole) - Counter(heard)
            result.wrong += extra.total() if extra or missing else 1  # all there, but in another order
            result.lost += missing.total()
        numbers_taken = [arrival.packet.sequence for arrival in arrivals]
        result.taken += len(numbers_taken)
        result.wrongly_taken += (Counter(numbers_taken) - Counter(taken)).total()
        result.wrongly_dropped += (Counter(taken) - Counter(numbers_taken)).total()
        before = sent
    result.frames, result.fates, result.repeated = count, dict(line.fates), link.statistics.repeated
    counts = listener.statistics
    result.damaged_pieces, result.foreign_pieces, result.unknown_pieces = counts.damaged, counts.foreign, counts.unknown
    result.seconds = time.perf_counter() - start
    return result


def main() -> int:
    """Run, print the counts, and return 1 after a failure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    result = soak(options.frames, options.seed)
    if options.json:
        print(json.dumps(asdict(result)))
        return 0 if result.good else 1
    print(f"{result.frames:,} frames sent, {result.bytes_on_line:,} bytes on the line, {result.seconds:.1f} s")
    for fate in [*FATES[0], "(garbage between)"]:
        print(f"  {result.fates.get(fate, 0):>9,}  {fate}")
    print(f"  {result.whole:>9,}  whole, {result.received:,} received: {result.wrong} wrong, {result.lost} lost")
    print(f"  {result.taken:>9,}  taken: {result.wrongly_taken} wrongly, {result.wrongly_dropped} wrongly dropped")
    print(f"  {result.repeated:>9,}  dropped by their number, which was not above the last one's")
    print(f"  {result.damaged_pieces:>9,}  damaged pieces between zeros")
    print(f"  {result.foreign_pieces + result.unknown_pieces:>9,}  pieces taken for foreign or unknown frames")
    return 0 if result.good else 1


if __name__ == "__main__":
    raise SystemExit(main())
