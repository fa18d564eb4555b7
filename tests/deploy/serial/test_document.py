"""Page and test vectors of the wire protocol agree with the definitions."""

from __future__ import annotations

import hashlib
import inspect
import re
import struct

import pytest
from wire_vectors import EXAMPLES, TEXT, VECTORS, WITH_ACCELEROMETER, part

from surefoot.deploy.messages import Mode, Position, Reason, SessionMessage, State
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec, encodings
from surefoot.deploy.serial.frames import MAX_FRAME, frame_bytes
from surefoot.deploy.serial.port import BAUD


def rows(text: str) -> list[list[str]]:
    """Return the cells of the tables in a text, without their headers."""
    lines = re.findall(r"^\| (.*?) ?\|$", text, re.M)
    return [[cell.strip() for cell in line.replace("\\|", "!").split(" |")] for line in lines if re.match(r"\d", line)]


def test_every_field_of_every_message_is_in_the_tables():
    expected = []
    for kind in MESSAGES:
        offset = 0
        for name, spec in encodings(kind).items():
            sort = f"text of {spec.length}" if spec.kind == "text" else spec.kind
            sort += "" if spec.count == 1 else f" × {spec.entries(8)}"
            scale = f"{spec.scale:g}".replace("e-0", "e-") if spec.scale else ""
            unit = "" if spec.unit == "1" else spec.unit
            if name != "session" or not issubclass(kind, SessionMessage):
                expected.append([str(offset), f"`{name}`", sort, unit, scale, spec.meaning.replace("|", "!")])
            offset += struct.calcsize("<" + spec.format(8))
        assert " ".join((inspect.getdoc(kind) or "").split()) in part("Messages")
    assert rows(part("Messages")) == expected


@pytest.mark.parametrize(("name", "numbers"), [("Modes", Mode), ("Reasons", Reason)])
def test_every_mode_and_reason_is_in_the_tables(name: str, numbers: type[Mode | Reason]):
    assert rows(part(name)) == [[str(int(one)), one.name, one.meaning] for one in numbers]


def test_the_field_of_a_board_with_an_accelerometer_is_in_its_table():
    name, spec = list(encodings(State, accelerometer=True).items())[-1]
    section, codec = part("Boards with an accelerometer"), Codec(8, accelerometer=True)
    offset = Codec(8).size(State)
    assert rows(section) == [[str(offset), f"`{name}`", f"{spec.kind} × {spec.count}", spec.unit, "", spec.meaning]]
    assert f"{codec.size(State)} bytes" in section
    assert f"`0x{codec.schema:08X}`" in section
    assert f"`{name} {spec.kind} {spec.count} 0 0 {spec.unit}`" in section


# Statements for authors of firmware.


def test_state_and_command_at_200_hz_take_under_half_of_the_line():
    # 155 + 59 bytes of ten bits, 200 times per second.
    assert frame_bytes(Codec(8), State) == 1 + 1 + 18 + 130 + 4 + 1 == 155
    assert frame_bytes(Codec(8), Position) == 1 + 1 + 18 + 34 + 4 + 1 == 59
    assert round((155 + 59) * 10 * 200 / BAUD, 3) == 0.464
    for text in ("= 155 ", "= 59 ", "428,000 bits per second", "**46.4 %** of 921,600 baud", "1.68 ms"):
        assert text in part("Bandwidth")


def test_the_schema_hash_agrees_with_the_text_in_the_vectors():
    canonical = "".join(f"{line}\n" for line in VECTORS["schema_text"])
    schema = int.from_bytes(hashlib.sha256(canonical.encode()).digest()[:4], "little")
    assert schema == Codec(VECTORS["motors"]).schema
    assert VECTORS["schema"] == f"0x{schema:08X}"
    section = part("The schema hash")
    (beginning,) = re.findall(r"```text\n(.*?)```", section, re.S)
    assert f"`0x{schema:08X}`" in section
    assert canonical.startswith(beginning)


def test_the_vectors_are_frames_with_their_values():
    assert [type(example.message) for example in EXAMPLES] == list(MESSAGES)
    with_accelerometer = VECTORS["with_accelerometer"]
    assert with_accelerometer["schema"] == f"0x{Codec(8, accelerometer=True).schema:08X}"
    vectors = [*VECTORS["frames"], with_accelerometer["frame"]]
    for vector, example in zip(vectors, [*EXAMPLES, WITH_ACCELEROMETER], strict=True):
        kind = type(example.message)
        stated = (vector["message"], vector["type"], vector["number"], vector["time"])
        assert stated == (kind.__name__, NUMBERS[kind], example.sequence, example.time)
        assert list(vector["values"]) == list(encodings(kind, example is WITH_ACCELEROMETER))
        for name, value in vector["values"].items():
            actual = getattr(example.message, name)
            assert value == (list(actual) if isinstance(value, list) else actual), name


def test_the_ping_taken_apart_adds_up():
    section, ping = part("A frame taken apart"), EXAMPLES[1]
    body = b"".join(bytes.fromhex(dump) for dump in re.findall(r"`([0-9A-F ]+)` \|$", section, re.M))
    assert body[: HEADER.size] == HEADER.pack(VERSION, 2, Codec(8).schema, ping.sequence, round(ping.time * 1e6))
    assert ping.data.hex(" ").upper() in section
    assert len(body) == HEADER.size + 4 + 4


def test_offsets_go_without_gaps_to_the_size_in_the_title():
    for kind in MESSAGES:
        block = part("Messages").partition(f"### {kind.__name__}: ")[2].partition("\n### ")[0]
        size = Codec(8).size(kind)
        assert block.startswith(f"type {NUMBERS[kind]}, {size} bytes\n")
        offsets = [int(offset) for offset in re.findall(r"^\| (\d+) \|", block, re.M)]
        if issubclass(kind, SessionMessage):
            assert kind.__name__ in part("Messages").partition("begin with the operator's `session` (u16)")[0]
            offsets = [0, *offsets]
        sizes = [struct.calcsize("<" + spec.format(8)) for spec in encodings(kind).values()]
        assert [end - start for start, end in zip(offsets, [*offsets[1:], size], strict=True)] == sizes


def test_numbers_in_the_text_agree_with_the_definitions():
    prose = TEXT.replace(part("Messages"), "").replace(part("Reasons"), "")
    prose = re.sub(r"^\| \d.*\n", "", prose, flags=re.M)
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
