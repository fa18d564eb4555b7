"""The protocol's document: made parts are as the definitions are, and what stands in it can be relied on."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

from surefoot.deploy.link import BAUD
from surefoot.deploy.wire.document import link_share, main, renewed, sections
from surefoot.deploy.wire.examples import EXAMPLES
from surefoot.deploy.wire.fields import wires
from surefoot.deploy.wire.frames import MAX_FRAME, Decoder
from surefoot.deploy.wire.messages import HEADER, MESSAGES, VERSION, Codec, Mode, Reason
from surefoot.errors import SurefootError

ROOT = Path(__file__).resolve().parents[3]
DOCUMENT = ROOT / "docs" / "wire-protocol.md"
TEXT = DOCUMENT.read_text(encoding="utf-8")


def part(name: str) -> str:
    """What stands between two markers of the document."""
    return TEXT.partition(f"<!-- begin: {name} -->\n")[2].partition(f"<!-- end: {name} -->\n")[0]


def test_the_document_is_as_it_would_be_made_anew():
    assert renewed(TEXT, sections()) == TEXT, "run: python -m surefoot.deploy.wire.document"


def test_the_command_writes_it_anew(tmp_path: Path):
    stale = tmp_path / "wire-protocol.md"
    stale.write_text(TEXT.replace(part("bandwidth"), "\nold\n").replace(part("vectors"), ""), encoding="utf-8")
    command = [sys.executable, "-m", "surefoot.deploy.wire.document", str(stale)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert stale.read_text(encoding="utf-8") == TEXT
    assert list(tmp_path.iterdir()) == [stale]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("<!-- begin: vectors -->\n", ""),
        ("<!-- end: vectors -->\n", ""),
        ("<!-- begin: vectors -->\n", "<!-- begin: vectors -->\n" * 2),
        ("<!-- begin: vectors -->\n", "<!-- end: vectors -->\n"),
    ],
)
def test_a_document_without_a_place_for_a_part_is_left_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], old: str, new: str
):
    broken = tmp_path / "wire-protocol.md"
    broken.write_text(TEXT.replace(old, new), encoding="utf-8")
    with pytest.raises(SurefootError, match="no place for 'vectors'"):
        renewed(broken.read_text(encoding="utf-8"), sections())
    with pytest.raises(SystemExit) as stop:
        main([str(broken)])
    assert stop.value.code == 2
    assert "no place for 'vectors'" in capsys.readouterr().err
    assert broken.read_text(encoding="utf-8") == TEXT.replace(old, new)


def test_a_document_that_is_not_there_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main([str(tmp_path / "none.md")])
    assert stop.value.code == 2
    assert "No such file or directory" in capsys.readouterr().err


# What a firmware's author reads.


def test_state_and_command_at_200_hz_take_under_half_of_the_line():
    # 155 + 59 bytes of ten bits, 200 times a second.
    assert link_share(Codec(8)) == pytest.approx((155 + 59) * 10 * 200 / 921_600)
    assert link_share(Codec(8)) < 0.5
    assert link_share(Codec(8), 400) == pytest.approx(2 * link_share(Codec(8)))
    for told in ("= 155 ", "= 59 ", "428,000 bits a second", "**46.4 %** of 921,600 baud", "1.68 ms"):
        assert told in part("bandwidth")
    assert BAUD == 921_600


def test_the_hash_in_the_document_is_that_of_the_text_in_the_document():
    (canonical,) = re.findall(r"```text\n(.*?)```", part("schema"), re.S)
    digest = hashlib.sha256(canonical.encode()).digest()
    assert f"`0x{int.from_bytes(digest[:4], 'little'):08X}`" in part("schema")
    assert int.from_bytes(digest[:4], "little") == Codec(8).schema


def test_the_vectors_in_the_document_are_frames_with_the_values_in_the_document():
    blocks = re.split(r"^### ", part("vectors"), flags=re.M)[1:]
    assert len(blocks) == len(MESSAGES)
    decoder = Decoder(Codec(8))
    for block, kind in zip(blocks, MESSAGES, strict=True):
        title = re.match(r"(\w+), number (\d+), sent at ([\d.]+) s: (\d+) bytes", block)
        assert title is not None
        (dump,) = re.findall(r"```text\n(.*?)```", block, re.S)
        data = bytes.fromhex(dump)
        (frame,) = decoder.feed(data)
        assert type(frame.message) is kind
        assert title.groups() == (kind.__name__, str(frame.sequence), f"{frame.time:g}", str(len(data)))
        told = dict(re.findall(r"^\| `(\w+)` \| (.*) \|$", block, re.M))
        assert list(told) == list(wires(kind))
        for name, value in told.items():
            found = getattr(frame.message, name)
            if isinstance(found, str | tuple):
                assert value == (found if isinstance(found, str) else ", ".join(found))
            else:
                numbers = [float(number.split(" (")[0]) for number in value.split(", ")]
                assert numbers == (list(found) if len(numbers) > 1 else [found]), name


def test_the_examples_can_be_told_exactly():
    for example in EXAMPLES:
        (frame,) = Decoder(Codec(8)).feed(example.frame())
        for name in wires(type(example.message)):
            assert str(getattr(frame.message, name)) == str(getattr(example.message, name)), name


def test_the_ping_taken_apart_adds_up():
    body = b"".join(bytes.fromhex(dump) for dump in re.findall(r"`([0-9A-F ]+)` \|$", part("anatomy"), re.M))
    ping = EXAMPLES[1]
    assert body[: HEADER.size] == HEADER.pack(VERSION, 2, Codec(8).schema, ping.sequence, round(ping.time * 1e6))
    assert ping.frame().hex(" ").upper() in part("anatomy")
    assert len(body) == HEADER.size + 4 + 4


def test_offsets_go_without_gaps_to_the_size_in_the_title():
    for kind in MESSAGES:
        block = part("messages").partition(f"### {kind.__name__}: ")[2].partition("\n### ")[0]
        size = Codec(8).size(kind)
        assert block.startswith(f"type {kind.CODE}, {'to' if kind.CODE < 64 else 'from'} the robot, {size} bytes\n")
        offsets = [int(offset) for offset in re.findall(r"^\| (\d+) \|", block, re.M)]
        sizes = [spec.bytes(8) for spec in wires(kind).values()]
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
