"""The wire protocol as a C header, for a robot's firmware.

    python -m surefoot.deploy.serial.c_header --motors 8 --out docs/surefoot_wire.h

C99, nothing but the standard library's headers, no memory of its own: structs and constants from the definitions in
`wire`, and the functions of functions.h, which encode frames and find them in a stream.
"""

from __future__ import annotations

import argparse
import inspect
import textwrap
from collections.abc import Sequence
from pathlib import Path

from surefoot.deploy.messages import DescribedEnum, Message, Mode, Reason
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec
from surefoot.deploy.serial.fields import MOTORS, FieldEncoding
from surefoot.deploy.serial.frames import CRC_BYTES, MAX_FRAME, frame_bytes
from surefoot.errors import SurefootError
from surefoot.files import atomic_write

DEFAULT_MOTORS = 8
FUNCTIONS = Path(__file__).with_name("functions.h")
_TYPES = {
    **{"u8": "uint8_t", "i8": "int8_t", "u16": "uint16_t", "i16": "int16_t", "u32": "uint32_t"},
    **{"f32": "float", "text": "char"},
}
_TOP = """\
/* surefoot wire protocol, version {version}, for robots of {motors} motors. docs/wire-protocol.md specifies it.
 *
 * Made by `python -m surefoot.deploy.serial.c_header --motors {motors}`: change the definitions, not this file.
 *
 * A field's comment begins with what its number counts: [0.001 N m] makes 1500 stand for 1.5 N m. Texts are UTF-8, and
 * end at the first zero byte or at their full length. Structs go over the line as they lie in memory, so the
 * processor must be little-endian and its floats IEEE 754. To send, fill a struct and call surefoot_encode. To receive,
 * give every byte to surefoot_decode, and copy the payload into the struct of its type with memcpy. */
#ifndef SUREFOOT_WIRE_H
#define SUREFOOT_WIRE_H

#include <stddef.h>
#include <stdint.h>
#include <string.h>

#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "the structs of this header are for little-endian processors"
#endif

#define SUREFOOT_VERSION {version}u
#define SUREFOOT_SCHEMA 0x{schema:08X}u
#define SUREFOOT_MOTORS {motors}
#define SUREFOOT_MAX_FRAME {max_frame}u /* bytes between two zeros beyond which nothing is a frame */
#define SUREFOOT_BODY_BYTES {body}u /* most bytes of header, payload and CRC-32 together */
#define SUREFOOT_FRAME_BYTES {frame}u /* most bytes of a frame on the line, with its zeros */

#if defined(__cplusplus) && __cplusplus >= 201103L
#define SUREFOOT_SIZE(type, size) static_assert(sizeof(type) == (size), "size of " #type)
#elif defined(__STDC_VERSION__) && __STDC_VERSION__ >= 201112L
#define SUREFOOT_SIZE(type, size) _Static_assert(sizeof(type) == (size), "size of " #type)
#else
#define SUREFOOT_SIZE(type, size) typedef char size_of_##type[sizeof(type) == (size) ? 1 : -1]
#endif

#ifdef __cplusplus
extern "C" {{
#endif
"""
_HEADER = """\
#pragma pack(push, 1)

/* Stands in front of every payload. */
typedef struct {
    uint8_t version;   /* SUREFOOT_VERSION; first in every version */
    uint8_t type;      /* a surefoot_type */
    uint32_t schema;   /* SUREFOOT_SCHEMA; at this place in every version */
    uint32_t sequence; /* counts all frames of this sender, from 1 */
    uint64_t time;     /* [1e-6 s] when it was sent, on the sender's clock */
} surefoot_header;
"""
_END = """\
#ifdef __cplusplus
}
#endif

#endif /* SUREFOOT_WIRE_H */
"""


def c_header(motors: int = DEFAULT_MOTORS) -> str:
    """The whole header, for robots of so many motors.

    Raises:
        SurefootError: none, or more than fit a frame.
    """
    codec = Codec(motors)
    largest = max(MESSAGES, key=codec.size)
    top = _TOP.format(
        version=VERSION,
        motors=motors,
        schema=codec.schema,
        max_frame=MAX_FRAME,
        body=HEADER.size + codec.size(largest) + CRC_BYTES,
        frame=frame_bytes(codec, largest),
    )
    parts = [
        top,
        _enum(
            "surefoot_type",
            "What a payload is.",
            [(f"SUREFOOT_{kind.__name__.upper()}", NUMBERS[kind], "") for kind in MESSAGES],
        ),
        *(_described_enum(numbers) for numbers in (Mode, Reason)),
        _HEADER,
        *(_struct(kind, codec) for kind in MESSAGES),
        "#pragma pack(pop)\n",
        _assertions(codec),
        _payload_size(),
        FUNCTIONS.read_text(encoding="utf-8"),
        _END,
    ]
    return "\n".join(parts)


def counts(spec: FieldEncoding) -> str:
    """What a field's number on the line counts, such as 1e-6 s; nothing for pure numbers and texts."""
    unit = "" if spec.unit == "1" else spec.unit
    scale = f"{spec.scale:g} ".replace("e-0", "e-") if spec.scale not in (0, 1) else ""
    return f"{scale}{unit}"


def _c_name(kind: type[Message]) -> str:
    return f"surefoot_{kind.__name__.lower()}"


def _doc(kind: type) -> str:
    return "/* " + "\n * ".join(textwrap.wrap(inspect.getdoc(kind) or "", 116)) + " */\n"


def _columns(rows: Sequence[tuple[str, str]], indent: str = "    ") -> str:
    """Lines of code, with their comments one below the other."""
    width = max(len(code) for code, _ in rows)
    return "".join(
        f"{indent}{code:<{width}} /* {comment} */\n" if comment else f"{indent}{code}\n" for code, comment in rows
    )


def _enum(name: str, doc: str, members: Sequence[tuple[str, int, str]]) -> str:
    rows = [
        (f"{member} = {number}" + ("," if at < len(members) else ""), told)
        for at, (member, number, told) in enumerate(members, 1)
    ]
    return f"/* {doc} */\nenum {name} {{\n{_columns(rows)}}};\n"


def _described_enum(numbers: type[DescribedEnum]) -> str:
    name = numbers.__name__
    members = [(f"SUREFOOT_{name.upper()}_{each.name}", int(each), each.meaning) for each in numbers]
    return _enum(f"surefoot_{name.lower()}", inspect.getdoc(numbers) or "", members)


def _struct(kind: type[Message], codec: Codec) -> str:
    rows = []
    for name, spec in codec.layouts[kind].fields.items():
        many = "[SUREFOOT_MOTORS]" if spec.count == MOTORS else f"[{spec.count}]" if spec.count > 1 else ""
        length = f"[{spec.length}]" if spec.kind == "text" else ""
        unit = f"[{counts(spec)}] " if counts(spec) else ""
        rows.append((f"{_TYPES[spec.kind]} {name}{many}{length};", unit + spec.meaning))
    return f"{_doc(kind)}typedef struct {{\n{_columns(rows)}}} {_c_name(kind)};\n"


def _assertions(codec: Codec) -> str:
    sizes = [("float", 4), ("surefoot_header", HEADER.size), *((_c_name(kind), codec.size(kind)) for kind in MESSAGES)]
    return "".join(f"SUREFOOT_SIZE({name}, {size});\n" for name, size in sizes)


def _payload_size() -> str:
    cases = "".join(
        f"    case SUREFOOT_{kind.__name__.upper()}:\n        return sizeof({_c_name(kind)});\n" for kind in MESSAGES
    )
    return (
        "/* Bytes of a payload; 0 for a type that is none. */\n"
        "static inline size_t surefoot_payload_size(uint8_t type)\n{\n"
        f"    switch (type) {{\n{cases}    default:\n        return 0;\n    }}\n}}\n"
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Print the header, or write it to a file."""
    parser = argparse.ArgumentParser(
        prog="python -m surefoot.deploy.serial.c_header", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--motors", type=int, default=DEFAULT_MOTORS, help="number of motors")
    parser.add_argument("--out", type=Path, help="file to write; printed, if not given")
    options = parser.parse_args(argv)
    try:
        text = c_header(options.motors)
        if options.out is None:
            print(text, end="")
        else:
            atomic_write(options.out, text)
    except (SurefootError, OSError) as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
