"""The parts of docs/wire-protocol.md that follow from the definitions: tables, sizes, test vectors.

    python -m surefoot.deploy.wire.document

They stand between markers, `<!-- begin: NAME -->` and `<!-- end: NAME -->`, and are written anew; the prose around
them is left as it is.
"""

from __future__ import annotations

import argparse
import inspect
from collections.abc import Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from cobs import cobs

from surefoot.deploy.link import BAUD
from surefoot.deploy.wire.examples import EXAMPLES, MOTORS, Example
from surefoot.deploy.wire.fields import Wire
from surefoot.deploy.wire.frames import CRC_BYTES, frame_bytes
from surefoot.deploy.wire.messages import HEADER, MESSAGES, Codec, Message, Mode, Ping, Position, Reason, State, Told
from surefoot.errors import SurefootError
from surefoot.files import whole_file

DOCUMENT = Path("docs/wire-protocol.md")
RATE = 200
"""Commands, and states, a second [Hz]."""
BITS_PER_BYTE = 10
"""On the line: a start bit, eight of data, a stop bit."""


def link_share(codec: Codec, rate: float = RATE) -> float:
    """Share of the line's bits that a state and a command, both `rate` times a second, take together."""
    return (frame_bytes(codec, State) + frame_bytes(codec, Position)) * BITS_PER_BYTE * rate / BAUD


def sections() -> dict[str, str]:
    """Text of every part, by name, for a robot of eight motors."""
    codec = Codec(MOTORS)
    schema = f"For {MOTORS} motors this is the text, its last line ended like the others, and the schema hash is"
    return {
        "anatomy": _anatomy(next(one for one in EXAMPLES if isinstance(one.message, Ping))),
        "messages": "\n".join(_message(kind, codec) for kind in MESSAGES),
        "modes": _numbers(Mode),
        "reasons": _numbers(Reason),
        "bandwidth": _bandwidth(codec),
        "schema": f"{schema} `0x{codec.schema:08X}`:\n\n```text\n{codec.describe()}```\n",
        "vectors": "\n".join(map(_vector, EXAMPLES)),
    }


def renewed(text: str, parts: dict[str, str]) -> str:
    """A document with its parts written anew.

    Raises:
        SurefootError: a part has no place, or several.
    """
    for name, part in parts.items():
        begin, end = f"<!-- begin: {name} -->\n", f"<!-- end: {name} -->\n"
        if text.count(begin) != 1 or text.count(end) != 1 or text.index(begin) > text.index(end):
            raise SurefootError(
                f"the document has no place for '{name}'; it must have {begin.strip()} and {end.strip()}"
            )
        text = f"{text[: text.index(begin)]}{begin}\n{part}\n{text[text.index(end) :]}"
    return text


def _table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def _message(kind: type[Message], codec: Codec) -> str:
    rows, offset = [], 0
    for name, spec in codec.layouts[kind].fields.items():
        scale = f"{spec.scale:g}".replace("e-0", "e-") if spec.scale else ""
        rows.append((offset, f"`{name}`", _type(spec), spec.unit, scale, spec.meaning))
        offset += spec.bytes(codec.motors)
    way = "to the robot" if kind.CODE < 64 else "from the robot"
    said = " ".join((inspect.getdoc(kind) or "").split())
    table = _table(("offset", "field", "type", "unit", "scale", "meaning"), rows)
    return f"### {kind.__name__}: type {kind.CODE}, {way}, {offset} bytes\n\n{said}\n\n{table}"


def _type(spec: Wire) -> str:
    kind = f"text of {spec.length}" if spec.kind == "text" else spec.kind
    return kind if spec.count == 1 else f"{kind} × {spec.entries(MOTORS)}"


def _numbers(kind: type[Told]) -> str:
    return _table(("number", kind.__name__.lower(), "meaning"), [(int(one), one.name, one.meaning) for one in kind])


def _bandwidth(codec: Codec) -> str:
    kinds = {"state": State, "command": Position}
    sizes = {name: frame_bytes(codec, kind) for name, kind in kinds.items()}
    rows = []
    for name, kind in kinds.items():
        payload, size = codec.size(kind), sizes[name]
        body = HEADER.size + payload + CRC_BYTES
        sum_of_bytes = f"{HEADER.size} + {payload} + {CRC_BYTES} + {size - body - 2} + 2 = {size}"
        rows.append((name, sum_of_bytes, f"{size * BITS_PER_BYTE / BAUD * 1e3:.2f} ms"))
    both = sum(sizes.values())
    each = [f"{size * BITS_PER_BYTE * RATE / BAUD * 100:.1f} %" for size in sizes.values()]
    return (
        _table(("frame", "header + payload + CRC-32 + COBS + zeros, in bytes", "time on the line"), rows)
        + f"\nTogether {both} bytes. At {RATE} Hz: {both} bytes × {BITS_PER_BYTE} bits × {RATE} Hz = "
        f"{both * BITS_PER_BYTE * RATE:,} bits a second, **{link_share(codec) * 100:.1f} %** of {BAUD:,} baud. Each "
        f"direction has a wire of its own: states take {each[0]} of the one, commands {each[1]} of the other.\n"
    )


def _hex(data: bytes) -> str:
    return data.hex(" ").upper()


def _anatomy(example: Example) -> str:
    frame = example.frame()
    body = cobs.decode(frame[1:-1])
    parts = [
        *(("version", 1), ("type", 1), ("schema hash", 4), ("number", 4), ("time", 8)),
        *(("payload", len(body) - HEADER.size - CRC_BYTES), ("CRC-32 of all above", CRC_BYTES)),
    ]
    rows, at = [], 0
    for name, size in parts:
        rows.append((at, name, f"`{_hex(body[at : at + size])}`"))
        at += size
    return f"{_table(('offset', 'part', 'bytes'), rows)}\nThe frame on the line:\n\n```text\n{_hex(frame)}\n```\n"


def _vector(example: Example) -> str:
    message, frame = example.message, example.frame()
    rows = [(f"`{item.name}`", _value(getattr(message, item.name))) for item in fields(message)]  # type: ignore[arg-type]
    text = "\n".join(_hex(frame[at : at + 32]) for at in range(0, len(frame), 32))
    return (
        f"### {type(message).__name__}, number {example.sequence}, sent at {example.time:g} s: {len(frame)} bytes\n\n"
        f"{_table(('field', 'value'), rows)}\n```text\n{text}\n```\n"
    )


def _value(value: Any) -> str:
    if isinstance(value, np.ndarray | tuple):
        return ", ".join(map(_value, value))
    if isinstance(value, Told):
        return f"{int(value)} ({value.name})"
    return f"{value:g}" if isinstance(value, float) else str(value)


def main(argv: Sequence[str] | None = None) -> int:
    """Write the parts of the document anew."""
    parser = argparse.ArgumentParser(prog="python -m surefoot.deploy.wire.document", description=__doc__)
    parser.add_argument("file", type=Path, nargs="?", default=DOCUMENT, help="default: %(default)s")
    options = parser.parse_args(argv)
    try:
        text = renewed(options.file.read_text(encoding="utf-8"), sections())
        with whole_file(options.file) as file:
            file.write(text.encode())
    except (SurefootError, OSError) as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
