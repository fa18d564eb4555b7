"""Generator of the wire protocol as a C header, for the firmware of a robot.

    python -m surefoot.deploy.serial.c_header --motors 8 --out docs/surefoot_wire.h

The header is C99, needs only headers of the standard library and allocates nothing. Structs and constants are generated
from the messages; the functions that encode and decode frames are in template.h.
"""

from __future__ import annotations

import argparse
import inspect
import textwrap
from collections.abc import Sequence
from pathlib import Path
from string import Template

from surefoot.deploy.messages import DescribedEnum, Message, Mode, Reason
from surefoot.deploy.serial.codec import HEADER, MESSAGES, NUMBERS, VERSION, Codec
from surefoot.deploy.serial.fields import MOTORS, FieldEncoding
from surefoot.deploy.serial.frames import CRC_BYTES, MAX_FRAME, frame_bytes
from surefoot.errors import SurefootError
from surefoot.files import atomic_write

DEFAULT_MOTORS = 8
_TEMPLATE = Path(__file__).with_name("template.h")
_TYPES = {
    **{"u8": "uint8_t", "i8": "int8_t", "u16": "uint16_t", "i16": "int16_t", "u32": "uint32_t"},
    **{"f32": "float", "text": "char"},
}


def c_header(motors: int = DEFAULT_MOTORS, accelerometer: bool = False) -> str:
    """Return the header for robots with `motors` motors, with or without an accelerometer.

    Raises:
        SurefootError: no motors, or more than fit into a frame.
    """
    codec = Codec(motors, accelerometer)
    largest = max(MESSAGES, key=codec.size)
    types = [(_c_name(kind).upper(), NUMBERS[kind], "") for kind in MESSAGES]
    enums = [_enum("surefoot_type", "Type of a payload.", types), *map(_described_enum, (Mode, Reason))]
    sizes = [("float", 4), ("surefoot_header", HEADER.size), *((_c_name(kind), codec.size(kind)) for kind in MESSAGES)]
    return Template(_TEMPLATE.read_text(encoding="utf-8")).substitute(
        version=VERSION,
        robots=f"{motors} motors{' and an accelerometer' * accelerometer}",
        options=f"--motors {motors}{' --accelerometer' * accelerometer}",
        motors=motors,
        schema=f"{codec.schema:08X}",
        max_frame=MAX_FRAME,
        body=HEADER.size + codec.size(largest) + CRC_BYTES,
        frame=frame_bytes(codec, largest),
        enums="\n".join(enums),
        structs="\n".join(_struct(kind, codec) for kind in MESSAGES),
        sizes="".join(f"SUREFOOT_SIZE({name}, {size});\n" for name, size in sizes),
        cases="".join(
            f"    case {_c_name(kind).upper()}:\n        return sizeof({_c_name(kind)});\n" for kind in MESSAGES
        ),
    )


def unit_of_number(spec: FieldEncoding) -> str:
    """Return the unit of a field's encoded number, such as 1e-6 s, or "" for dimensionless numbers and texts."""
    unit = "" if spec.unit == "1" else spec.unit
    scale = f"{spec.scale:g} ".replace("e-0", "e-") if spec.scale not in (0, 1) else ""
    return f"{scale}{unit}"


def _c_name(kind: type[Message]) -> str:
    return f"surefoot_{kind.__name__.lower()}"


def _columns(rows: Sequence[tuple[str, str]]) -> str:
    width = max(len(code) for code, _ in rows)
    return "".join(f"    {code:<{width}} /* {comment} */\n" if comment else f"    {code}\n" for code, comment in rows)


def _enum(name: str, doc: str, members: Sequence[tuple[str, int, str]]) -> str:
    rows = [
        (f"{member} = {number}" + ("," if at < len(members) else ""), meaning)
        for at, (member, number, meaning) in enumerate(members, 1)
    ]
    return f"/* {doc} */\nenum {name} {{\n{_columns(rows)}}};\n"


def _described_enum(numbers: type[DescribedEnum]) -> str:
    name = f"surefoot_{numbers.__name__.lower()}"
    members = [(f"{name.upper()}_{each.name}", int(each), each.meaning) for each in numbers]
    return _enum(name, inspect.getdoc(numbers) or "", members)


def _struct(kind: type[Message], codec: Codec) -> str:
    rows = []
    for name, spec in codec.layouts[kind].fields.items():
        many = "[SUREFOOT_MOTORS]" if spec.count == MOTORS else f"[{spec.count}]" if spec.count > 1 else ""
        length = f"[{spec.length}]" if spec.kind == "text" else ""
        unit = f"[{unit_of_number(spec)}] " if unit_of_number(spec) else ""
        rows.append((f"{_TYPES[spec.kind]} {name}{many}{length};", unit + spec.meaning))
    doc = "\n * ".join(textwrap.wrap(inspect.getdoc(kind) or "", 116))
    return f"/* {doc} */\ntypedef struct {{\n{_columns(rows)}}} {_c_name(kind)};\n"


def main(argv: Sequence[str] | None = None) -> int:
    """Print the header, or write it to a file."""
    summary = (__doc__ or "").splitlines()[0]
    parser = argparse.ArgumentParser(prog="python -m surefoot.deploy.serial.c_header", description=summary)
    parser.add_argument("--motors", type=int, default=DEFAULT_MOTORS, help="number of motors")
    parser.add_argument("--accelerometer", action="store_true", help="states have the reading of an accelerometer")
    parser.add_argument("--out", type=Path, help="file to write; defaults to standard output")
    options = parser.parse_args(argv)
    try:
        text = c_header(options.motors, options.accelerometer)
        if options.out is None:
            print(text, end="")
        else:
            atomic_write(options.out, text)
    except (SurefootError, OSError) as error:
        parser.error(str(error))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
