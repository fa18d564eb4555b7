"""Test vectors of the wire protocol (docs/wire-vectors.json), and sections of its page (docs/wire-protocol.md)."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from surefoot.deploy.messages import Packet
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder

DOCUMENT = Path(__file__).resolve().parents[1] / "docs" / "wire-protocol.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")
VECTORS: dict[str, Any] = json.loads(DOCUMENT.with_name("wire-vectors.json").read_text(encoding="utf-8"))


def part(title: str) -> str:
    """Return a section of the page, including its subsections."""
    found = re.search(rf"^(##+) {re.escape(title)}\n", TEXT, re.M)
    assert found is not None, title
    rest = TEXT[found.end() :]
    following = re.search(rf"^##{{1,{len(found[1]) - 1}}} ", rest, re.M)
    return rest[: following.start()] if following else rest


@dataclass(frozen=True)
class Example(Packet):
    """Frame of the test vectors, with its bytes; every value is exactly representable on the line."""

    data: bytes


def _examples(vectors: list[dict[str, Any]], codec: Codec) -> list[Example]:
    dumps = [bytes.fromhex(" ".join(vector["bytes"])) for vector in vectors]
    frames = [frame for data in dumps for frame in Decoder(codec).feed(data)]
    return [Example(frame.message, frame.sequence, frame.time, data) for frame, data in zip(frames, dumps, strict=True)]


EXAMPLES = _examples(VECTORS["frames"], Codec(8))
(WITH_ACCELEROMETER,) = _examples([VECTORS["with_accelerometer"]["frame"]], Codec(8, accelerometer=True))
"""State of a board with an accelerometer."""
