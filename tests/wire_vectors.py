"""The test vectors of docs/wire-protocol.md: one frame of each kind, for a robot of eight motors."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from surefoot.deploy.messages import Packet
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "wire-protocol.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")


def part(name: str) -> str:
    """What stands between two markers of the document."""
    return TEXT.partition(f"<!-- begin: {name} -->\n")[2].partition(f"<!-- end: {name} -->\n")[0]


@dataclass(frozen=True)
class Example(Packet):
    """A frame of the document, with its bytes; every value is exactly representable on the line."""

    data: bytes


def _examples() -> list[Example]:
    dumps = [bytes.fromhex(dump) for dump in re.findall(r"```text\n(.*?)```", part("vectors"), re.S)]
    frames = [frame for data in dumps for frame in Decoder(Codec(8)).feed(data)]
    return [Example(frame.message, frame.sequence, frame.time, data) for frame, data in zip(frames, dumps, strict=True)]


EXAMPLES = _examples()
