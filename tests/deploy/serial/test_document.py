"""The protocol's document: its tables are those of the definitions, and what stands in it can be relied on."""

from __future__ import annotations

import hashlib
import inspect
import re
import struct

import pytest
from wire_vectors import DOCUMENT, EXAMPLES, TEXT, part

from surefoot.deploy.messages import Mode, Position, Reason, State
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec, encodings
from surefoot.deploy.serial.frames import MAX_FRAME, frame_bytes
from surefoot.deploy.serial.port import BAUD


def rows(text: str) -> list[list[str]]:
    """The cells of a part's tables, without their heads."""
    lines = re.findall(r"^\| (.*?) ?\|$", text, re.M)
    return [[cell.strip() for cell in line.replace("\\|", "!").split(" |")] for line in lines if re.match(r"\d", line)]


def test_every_field_of_every_message_stands_in_the_tables():
    expected = []
    for kind in MESSAGES:
        offset = 0
        for name, spec in encodings(kind).items():
            sort = f"text of {spec.length}" if spec.kind == "text" else spec.kind
            sort += "" if spec.count == 1 else f" × {spec.entries(8)}"
            scale = f"{spec.scale:g}".replace("e-0", "e-") if spec.scale else ""
            expected.append([str(offset), f"`{name}`", sort, spec.unit, scale, spec.meaning.replace("|", "!")])
            offset += struct.calcsize("<" + spec.format(8))
        assert " ".join((inspect.getdoc(kind) or "").split()) in part("messages")
    assert rows(part("messages")) == expected


@pytest.mark.parametrize(("name", "numbers"), [("modes", Mode), ("reasons", Reason)])
def test_every_mode_and_reason_stands_in_the_tables(name: str, numbers: type[Mode | Reason]):
    assert rows(part(name)) == [[str(int(one)), one.name, one.meaning] for one in numbers]


# What a firmware's author reads.


def test_state_and_command_at_200_hz_take_under_half_of_the_line():
    # 155 + 59 bytes of ten bits, 200 times a second.
    assert frame_bytes(Codec(8), State) == 1 + 1 + 18 + 130 + 4 + 1 == 155
    assert frame_bytes(Codec(8), Position) == 1 + 1 + 18 + 34 + 4 + 1 == 59
    assert round((155 + 59) * 10 * 200 / BAUD, 3) == 0.464
    for text in ("= 155 ", "= 59 ", "428,000 bits a second", "**46.4 %** of 921,600 baud", "1.68 ms"):
        assert text in part("bandwidth")


def test_the_hash_in_the_document_is_that_of_the_text_in_the_document():
    (canonical,) = re.findall(r"```text\n(.*?)```", part("schema"), re.S)
    digest = hashlib.sha256(canonical.encode()).digest()
    assert f"`0x{int.from_bytes(digest[:4], 'little'):08X}`" in part("schema")
    assert int.from_bytes(digest[:4], "little") == Codec(8).schema


def test_the_vectors_in_the_document_are_frames_with_the_values_in_the_document():
    blocks = re.split(r"^### ", part("vectors"), flags=re.M)[1:]
    assert [type(example.message) for example in EXAMPLES] == list(MESSAGES)
    for block, example in zip(blocks, EXAMPLES, strict=True):
        kind = type(example.message)
        title = re.match(r"(\w+), number (\d+), sent at ([\d.]+) s: (\d+) bytes", block)
        assert title is not None
        assert title.groups() == (kind.__name__, str(example.sequence), f"{example.time:g}", str(len(example.data)))
        values = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", block, re.M))
        assert list(values) == list(encodings(kind))
        for name, value in values.items():
            actual = getattr(example.message, name)
            if isinstance(actual, str | tuple):
                assert value == (actual if isinstance(actual, str) else ", ".join(actual))
            else:
                numbers = [float(number.split(" (")[0]) for number in value.split(", ")]
                assert numbers == (list(actual) if len(numbers) > 1 else [actual]), name


def test_the_ping_taken_apart_adds_up():
    body = b"".join(bytes.fromhex(dump) for dump in re.findall(r"`([0-9A-F ]+)` \|$", part("anatomy"), re.M))
    ping = EXAMPLES[1]
    assert body[: HEADER.size] == HEADER.pack(VERSION, 2, Codec(8).schema, ping.sequence, round(ping.time * 1e6))
    assert ping.data.hex(" ").upper() in part("anatomy")
    assert len(body) == HEADER.size + 4 + 4


def test_offsets_go_without_gaps_to_the_size_in_the_title():
    for kind in MESSAGES:
        block = part("messages").partition(f"### {kind.__name__}: ")[2].partition("\n### ")[0]
        size = Codec(8).size(kind)
        assert block.startswith(
            f"type {NUMBERS[kind]}, {'to' if NUMBERS[kind] < 64 else 'from'} the robot, {size} bytes\n"
        )
        offsets = [int(offset) for offset in re.findall(r"^\| (\d+) \|", block, re.M)]
        sizes = [struct.calcsize("<" + spec.format(8)) for spec in encodings(kind).values()]
        assert [end - start for start, end in zip(offsets, [*offsets[1:], size], strict=True)] == sizes


def test_the_prose_has_the_numbers_of_the_definitions():
    prose = re.sub(r"<!-- begin: (\w+) -->.*?<!-- end: \1 -->", "", TEXT, flags=re.S)
    assert f"{BAUD:,} baud" in prose
    assert f"at most {MAX_FRAME} bytes" in prose
    assert f"**The header** has {HEADER.size} bytes" in prose
    assert f"less than {HEADER.size + 4} bytes" in prose
    for reason in Reason:
        assert reason is Reason.NONE or re.search(rf"\b{reason.name}\b", prose), f"no rule leads to {reason.name}"
    for mode in Mode:
        assert re.search(rf"\b{mode.name}\b", prose)
    for kind in MESSAGES:
        assert re.search(rf"\b{kind.__name__}\b", prose) or kind.__name__ in ("Position", "Pwm")


def test_links_lead_somewhere():
    anchors = {
        re.sub(r"[^\w -]", "", title).lower().replace(" ", "-") for title in re.findall(r"^#+ (.*)$", TEXT, re.M)
    }
    for aim in re.findall(r"\]\(([^)]+)\)", TEXT):
        if aim.startswith("#"):
            assert aim[1:] in anchors, aim
        else:
            assert (DOCUMENT.parent / aim).exists(), aim
