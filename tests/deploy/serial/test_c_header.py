"""The C header compiles without a warning, and encodes and decodes like Python."""

from __future__ import annotations

import random
import shutil
import struct
import subprocess
import zlib
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from cobs import cobs
from wire_vectors import EXAMPLES, WITH_ACCELEROMETER

from surefoot.deploy.messages import Fault, Handshake, Message, State
from surefoot.deploy.serial.c_header import c_header, main
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec, encodings
from surefoot.deploy.serial.frames import CRC_BYTES, MAX_FRAME, Decoder, encode_frame

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
CODEC = Codec(8)
CC = shutil.which("cc")
needs_cc = pytest.mark.skipif(CC is None, reason="no C compiler on this machine")
STRICT = ["-Wall", "-Wextra", "-Werror", "-pedantic", "-Wconversion", "-Wshadow", "-Wcast-qual", "-Wwrite-strings"]


def numbers_on_the_line(kind: type[Message], name: str, value: Any) -> list[Any]:
    """Return a field's value in C: numbers, or bytes of a text."""
    spec = encodings(kind, accelerometer=True)[name]
    values = [value] if spec.count == 1 else list(value)
    if spec.kind == "text":
        return [text.encode() for text in values]
    if spec.scale:
        return [round(one / spec.scale) for one in values]
    return [float(one) if spec.kind == "f32" else int(one) for one in values]


def c_examples() -> str:
    """Return C code that fills the structs of all examples field by field, and code that prints them."""
    fill, show = ["static void emit_examples(void)\n{"], []
    for example in EXAMPLES:
        message, kind = example.message, type(example.message)
        name = kind.__name__
        fill.append(f"    surefoot_{name.lower()} m_{name};")
    for example in EXAMPLES:
        message, kind = example.message, type(example.message)
        name = kind.__name__
        prints = []
        fill.append(f"    memset(&m_{name}, 0, sizeof(m_{name}));")
        for field, spec in encodings(kind).items():
            numbers = numbers_on_the_line(kind, field, getattr(message, field))
            for at, number in enumerate(numbers):
                place = f"{field}[{at}]" if spec.count != 1 else field
                if spec.kind == "text":
                    fill.append(f'    memcpy(m_{name}.{place}, "{number.decode()}", {len(number)});')
                    prints.append(f'printf("{name} {place} %.*s\\n", (int)sizeof(m.{place}), m.{place});')
                elif spec.kind == "f32":
                    fill.append(f"    m_{name}.{place} = {number!r}f;")
                    prints.append(f'printf("{name} {place} %.9g\\n", (double)m.{place});')
                else:
                    fill.append(f"    m_{name}.{place} = {number};")
                    prints.append(f'printf("{name} {place} %ld\\n", (long)m.{place});')
        time = round(example.time * 1e6)
        fill.append(f"    emit(SUREFOOT_{name.upper()}, &m_{name}, {example.sequence}u, {time}u);")
        body = "\n        ".join([f"surefoot_{name.lower()} m;", "memcpy(&m, payload, sizeof(m));", *prints])
        show.append(f"    if (type == SUREFOOT_{name.upper()}) {{\n        {body}\n    }}")
    shown = "\n".join(["static void print_fields(uint8_t type, const uint8_t *payload)\n{", *show, "}"])
    return "\n".join([*fill, "}", "", shown, ""])


def warnings_of(source: Path, *options: str, compiler: str | None = CC) -> str:
    """Return a compiler's messages for a file, with warnings as errors; without `-o`, only the syntax is checked."""
    words = [str(compiler), *STRICT, *(options or ["-std=c11"]), f"-I{ROOT / 'docs'}", f"-I{source.parent}"]
    if "-o" not in options:
        words.append("-fsyntax-only")
    done = subprocess.run([*words, str(source)], capture_output=True, text=True, timeout=120)
    assert (done.returncode == 0) == (not done.stderr)
    return done.stderr


def compile_program(folder: Path, *options: str) -> Path:
    """Compile the test's program without a warning."""
    (folder / "examples.h").write_text(c_examples(), encoding="utf-8")
    source, program = folder / "wire_program.c", folder / "wire_program"
    shutil.copy(HERE / source.name, source)
    assert warnings_of(source, *options, "-o", str(program)) == ""
    return program


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Program compiled with sanitizers for memory and undefined behaviour, if the compiler has them."""
    folder = tmp_path_factory.mktemp("c")
    watch = ["-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    (folder / "try.c").write_text("int main(void) { return 0; }\n")
    tried = subprocess.run([str(CC), *watch, str(folder / "try.c"), "-o", str(folder / "try")], capture_output=True)
    watched = tried.returncode == 0 and subprocess.run([folder / "try"], capture_output=True).returncode == 0
    return compile_program(folder, "-std=c11", "-O1", *(watch if watched else []))


def run(program: Path, mode: str, data: bytes = b"") -> tuple[bytes, str]:
    done = subprocess.run([program, mode], input=data, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout, done.stderr.decode()


# The file.


def test_the_header_in_docs_is_up_to_date():
    committed = (ROOT / "docs" / "surefoot_wire.h").read_text(encoding="utf-8")
    assert committed == c_header(8), "run: python -m surefoot.deploy.serial.c_header --out docs/surefoot_wire.h"


def test_the_command_prints_or_writes_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main([]) == 0
    assert capsys.readouterr().out == c_header(8)
    assert main(["--motors", "12", "--out", str(tmp_path / "wire.h")]) == 0
    assert (tmp_path / "wire.h").read_text(encoding="utf-8") == c_header(12)
    assert "#define SUREFOOT_MOTORS 12\n" in c_header(12)
    assert f"#define SUREFOOT_SCHEMA 0x{Codec(12).schema:08X}u\n" in c_header(12)


def test_the_header_of_a_board_with_an_accelerometer_differs_in_schema_and_state(capsys: pytest.CaptureFixture[str]):
    assert main(["--accelerometer"]) == 0
    lines, plain = capsys.readouterr().out.splitlines(), c_header(8).splitlines()
    assert [line for line in lines if line not in plain] == [
        "/* surefoot wire protocol, version 1, for robots with 8 motors and an accelerometer. docs/wire-protocol.md "
        "specifies it.",
        " * Generated by `python -m surefoot.deploy.serial.c_header --motors 8 --accelerometer`: change the "
        "definitions, not this file.",
        "#define SUREFOOT_SCHEMA 0xB3AAEA90u",
        next(line for line in lines if line.startswith("    float accelerometer[3];")),
        "SUREFOOT_SIZE(surefoot_state, 142);",
    ]
    assert len(lines) == len(plain) + 1


@needs_cc
def test_c_encodes_the_state_of_a_board_with_an_accelerometer(tmp_path: Path):
    (tmp_path / "wire.h").write_text(c_header(8, accelerometer=True), encoding="utf-8")
    message = WITH_ACCELEROMETER.message
    lines = []
    for field, spec in encodings(State, accelerometer=True).items():
        for at, number in enumerate(numbers_on_the_line(State, field, getattr(message, field))):
            place = f"{field}[{at}]" if spec.count != 1 else field
            lines.append(f"    state.{place} = {number!r}{'f' if spec.kind == 'f32' else ''};")
    source = tmp_path / "state.c"
    source.write_text(
        "\n".join(
            [
                '#include "wire.h"',
                "#include <stdio.h>",
                "int main(void)\n{",
                "    static surefoot_state state;\n    uint8_t frame[SUREFOOT_FRAME_BYTES];",
                *lines,
                f"    fwrite(frame, 1, surefoot_encode(SUREFOOT_STATE, &state, {WITH_ACCELEROMETER.sequence}u, "
                f"{round(WITH_ACCELEROMETER.time * 1e6)}u, frame), stdout);",
                "    return 0;\n}\n",
            ]
        ),
        encoding="utf-8",
    )
    assert warnings_of(source, "-std=c11", "-o", str(tmp_path / "state")) == ""
    assert subprocess.run([tmp_path / "state"], capture_output=True, check=True).stdout == WITH_ACCELEROMETER.data


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--motors", "0"], "error: motors is 0; it must be"),
        (["--motors", "28"], "error: motors is 28; it must be"),
        (["--out", "/none/wire.h"], "No such file or directory"),
    ],
)
def test_the_command_rejects_a_wrong_number_of_motors_or_a_folder(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str]
):
    with pytest.raises(SystemExit) as stop:
        main(words)
    assert stop.value.code == 2
    assert message in capsys.readouterr().err


# The compiler.


@needs_cc
@pytest.mark.parametrize("options", ["-std=c99 -O0", "-std=gnu11 -O2"])
def test_it_compiles_without_a_warning(tmp_path: Path, options: str):
    program = compile_program(tmp_path, *options.split())
    memory, motors = map(int, run(program, "sizes")[0].split())
    assert memory <= MAX_FRAME + 64
    assert motors == 8


@pytest.mark.parametrize("standard", ["c++98", "c++17"])
def test_it_compiles_as_cpp(tmp_path: Path, standard: str):
    compiler = shutil.which("c++")
    if compiler is None:
        pytest.skip("no C++ compiler on this machine")
    source = tmp_path / "firmware.cpp"
    source.write_text('#include "surefoot_wire.h"\nint main() { return 0; }\n')
    assert warnings_of(source, f"-std={standard}", compiler=compiler) == ""


@needs_cc
@pytest.mark.parametrize("motors", [1, 21])
def test_sizes_hold_for_any_number_of_motors(tmp_path: Path, motors: int):
    # The header's own static assertions are the test.
    source = tmp_path / "wire.c"
    source.write_text(c_header(motors) + "\nint main(void) { return 0; }\n", encoding="utf-8")
    assert warnings_of(source) == ""


@needs_cc
@pytest.mark.parametrize("standard", ["c99", "c11"])
def test_the_example_of_the_document_compiles(tmp_path: Path, standard: str):
    source = tmp_path / "firmware.c"
    source.write_text((ROOT / "docs" / "surefoot_wire_example.c").read_text(encoding="utf-8"), encoding="utf-8")
    assert warnings_of(source, f"-std={standard}") == ""


@needs_cc
@pytest.mark.parametrize("standard", ["c99", "c11"])
def test_a_wrong_size_does_not_compile(tmp_path: Path, standard: str):
    text = c_header(8).replace("SUREFOOT_SIZE(surefoot_state, 130)", "SUREFOOT_SIZE(surefoot_state, 132)")
    source = tmp_path / "wire.c"
    source.write_text(text, encoding="utf-8")
    assert "surefoot_state" in warnings_of(source, f"-std={standard}")


# C and Python agree.


@needs_cc
def test_structs_filled_in_c_give_the_frames_of_python(program: Path):
    output, _ = run(program, "examples")
    frames = [bytes(1) + piece + bytes(1) for piece in output.split(b"\0") if piece]
    assert len(frames) == len(MESSAGES)
    for example, frame in zip(EXAMPLES, frames, strict=True):
        assert frame == example.data, type(example.message).__name__
    assert output == b"".join(frames)


@needs_cc
def test_frames_of_python_give_the_fields_in_c(program: Path):
    output, counts = run(program, "fields", b"".join(example.data for example in EXAMPLES))
    expected = []
    for example in EXAMPLES:
        kind = type(example.message)
        for field, spec in encodings(kind).items():
            numbers = numbers_on_the_line(kind, field, getattr(example.message, field))
            many = spec.count != 1
            for at, number in enumerate(numbers):
                shown = number.decode() if isinstance(number, bytes) else f"{number:.9g}"
                shown = str(number) if isinstance(number, int) else shown
                expected.append(f"{kind.__name__} {field}{f'[{at}]' if many else ''} {shown}")
    assert output.decode().splitlines() == expected
    assert counts.split() == [str(len(EXAMPLES)), "0", "0", "0"]


def random_frames(count: int, seed: int) -> list[bytes]:
    """Return frames of every type with random payloads, and full and empty texts."""
    rng = random.Random(seed)
    frames = []
    for _ in range(count):
        kind = rng.choice(MESSAGES)
        if kind is Fault:
            message: Any = Fault(rng.randrange(65536), rng.randrange(256), "x" * rng.randrange(81))
        elif kind is Handshake:
            names = tuple(rng.choice("ab") * 24 for _ in range(8))
            kp, kd, low, high = np.reshape([rng.uniform(-9, 9) for _ in range(32)], (4, 8))
            firmware = "f" * rng.randrange(41)
            message = Handshake(7, "r" * 24, firmware, names, np.ones(8), 0.3, kp, kd, 0.3, 0.3, low, high, *[0.7] * 5)
        else:
            message = CODEC.unpack(NUMBERS[kind], rng.randbytes(CODEC.size(kind)))
        frames.append(encode_frame(CODEC, message, rng.randrange(1, 2**32), rng.uniform(0, 1e6)))
    return frames


@needs_cc
def test_thousands_of_frames_pass_through_c_unchanged(program: Path):
    stream = b"".join(random_frames(3000, seed=1))
    again, counts = run(program, "again", stream)
    assert again == stream
    assert counts.split() == ["3000", "0", "0", "0"]


def whole_frame(body: bytes) -> bytes:
    return b"\0" + cobs.encode(body + zlib.crc32(body).to_bytes(CRC_BYTES, "little")) + b"\0"


def odd_frames(rng: random.Random) -> list[bytes]:
    """Return complete frames that are foreign, unknown or too short."""
    schema = CODEC.schema
    made = []
    for version, third_party_policies in [(VERSION, schema ^ 1), (2, schema), (0, 0)]:
        made.append(
            whole_frame(HEADER.pack(version, 2, third_party_policies, 1, 2) + rng.randbytes(rng.randrange(300)))
        )
    for code, size in [(0, 0), (2, 0), (2, 3), (2, 5), (67, 129), (67, 131), (200, 0), (200, 4)]:
        made.append(whole_frame(HEADER.pack(VERSION, code, schema, 1, 2) + rng.randbytes(size)))
    made += [whole_frame(HEADER.pack(2, 2, schema, 1, 2) + b"\7" * size) for size in range(990, 1005)]
    assert {MAX_FRAME, MAX_FRAME + 1} <= {len(frame) - 2 for frame in made}
    return [*made, *(whole_frame(rng.randbytes(size)) for size in (0, 1, 17))]


@needs_cc
@pytest.mark.parametrize("seed", range(3))
def test_both_find_the_same_frames_in_a_damaged_stream(program: Path, link_soak: ModuleType, seed: int):
    rng = random.Random(seed)
    frames = random_frames(800, seed)
    for odd in odd_frames(rng) * 8:
        frames.insert(rng.randrange(len(frames)), odd)
    stream, _ = link_soak.BadLine(rng).carry(frames)
    stream += b"".join(
        bytes([byte]) * size for size in (MAX_FRAME - 1, MAX_FRAME, MAX_FRAME + 1, 9999) for byte in (5, 0)
    )
    decoder, expected = Decoder(CODEC), []
    for at in range(len(stream)):
        third_party_policies = decoder.statistics.foreign
        for frame in decoder.feed(stream[at : at + 1]):
            payload = CODEC.pack(frame.message)
            expected.append((NUMBERS[type(frame.message)], frame.sequence, round(frame.time * 1e6), payload))
        if decoder.statistics.foreign > third_party_policies:
            expected.append(("foreign", *decoder.foreign))
    output, counts = run(program, "list", stream)
    decoded = []
    for line in output.decode().splitlines():
        first, *rest = line.split()
        if first == "foreign":
            decoded.append((first, *map(int, rest)))
        else:
            message = CODEC.unpack(int(first), bytes.fromhex(rest[2]))
            decoded.append((int(first), int(rest[0]), int(rest[1]), CODEC.pack(message)))
    assert decoded == expected
    seen = decoder.statistics
    assert counts.split() == [str(count) for count in (seen.received, seen.damaged, seen.foreign, seen.unknown)]
    assert seen.received > 400
    assert min(seen.damaged, seen.foreign, seen.unknown) > 15


@needs_cc
def test_cobs_and_crc32_agree_with_the_libraries(program: Path):
    rng = random.Random(3)
    texts = [
        b"",
        b"\0",
        b"123456789",
        *(b"\1" * size for size in range(250, 260)),
        *(b"\0" * size for size in (2, 300)),
    ]
    texts += [b"\1" * 254 + b"\0", b"\0" + b"\1" * 254, b"\1" * 508, b"\1" * 254 + b"\0" + b"\1" * 254]
    texts += [
        bytes(rng.choices(range(256), [rng.choice((0, 1, 50)), *[1] * 255], k=rng.randrange(900))) for _ in range(500)
    ]
    output, _ = run(program, "stuff", b"".join(struct.pack("<H", len(text)) + text for text in texts))
    expected = [f"{zlib.crc32(text):08x} {cobs.encode(text).hex()}" for text in texts]
    assert output.decode().splitlines() == expected
    assert expected[2].startswith("cbf43926")


def unstuff(data: bytes) -> bytes:
    try:
        return cobs.decode(data)
    except cobs.DecodeError:
        return b""


@needs_cc
def test_c_and_python_reject_invalid_cobs(program: Path):
    rng = random.Random(4)
    texts = [rng.randbytes(rng.randrange(12)) for _ in range(3000)]
    texts += [bytes(rng.choices((0, 1, 2, 3, 255), [1, 9, 9, 9, 1], k=rng.randrange(20))) for _ in range(3000)]
    texts += [b"\xff" + b"\1" * size for size in (253, 254, 255)] + [b"\xff" + b"\1" * 254 + b"\1"]
    output, _ = run(program, "unstuff", b"".join(struct.pack("<H", len(text)) + text for text in texts))
    assert [line.partition(" ")[2] for line in output.decode().splitlines()] == [unstuff(text).hex() for text in texts]
