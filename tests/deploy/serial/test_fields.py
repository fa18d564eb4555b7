"""Encoding of numbers and texts: bytes worked out by hand, and boundary values."""

from __future__ import annotations

import math
import struct
from dataclasses import make_dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.deploy.serial.fields import MOTORS, FieldEncoding, MessageLayout

WIRES = dict(
    small=FieldEncoding("u8"),
    sign=FieldEncoding("i8"),
    medium=FieldEncoding("u16"),
    large=FieldEncoding("u32"),
    real=FieldEncoding("f32"),
    time=FieldEncoding("u32", scale=1e-6),
    torque=FieldEncoding("i16", MOTORS, scale=1e-3),
    signs=FieldEncoding("i8", MOTORS),
    angles=FieldEncoding("f32", 3),
    name=FieldEncoding("text", length=4),
    names=FieldEncoding("text", MOTORS, length=2),
    words=FieldEncoding("text", length=5, cut=True),
)
Sample = make_dataclass("Sample", WIRES)
"""One field of every type."""
SAMPLE: dict[str, Any] = dict(
    small=7,
    sign=-2,
    medium=0x1234,
    large=0x89ABCDEF,
    real=1.0,
    time=0.006,
    torque=np.array([1.5, -0.001]),
    signs=np.array([1.0, -1.0]),
    angles=np.array([0.5, -2.0, 0.0]),
    name="ab",
    names=("x", "yz"),
    words="hello",
)
BYTES = bytes.fromhex(
    "07"  # 7
    "FE"  # -2
    "34 12"
    "EF CD AB 89"
    "00 00 80 3F"  # 1.0: sign 0, exponent 127, mantissa 0
    "70 17 00 00"  # 6000 microseconds
    "DC 05 FF FF"  # 1500, -1
    "01 FF"
    "00 00 00 3F  00 00 00 C0  00 00 00 00"  # 0.5, -2, 0
    "61 62 00 00"
    "78 00 79 7A"
    "68 65 6C 6C 6F"
)
LAYOUT = MessageLayout(Sample, WIRES, 2)


def sample(**changes: Any) -> Any:
    return Sample(**{**SAMPLE, **changes})


def transmit(**changes: Any) -> Any:
    """Return a sample after encoding and decoding."""
    return LAYOUT.unpack(LAYOUT.pack(sample(**changes)))


def test_a_message_is_encoded_as_worked_out_by_hand():
    assert LAYOUT.pack(sample()) == BYTES
    assert LAYOUT.struct.size == len(BYTES) == 47
    arrived = LAYOUT.unpack(BYTES)
    assert isinstance(arrived, Sample)
    for name, value in SAMPLE.items():
        np.testing.assert_array_equal(getattr(arrived, name), value, err_msg=name)
    assert (type(arrived.name), type(arrived.names)) == (str, tuple)


def test_arrays_arrive_as_doubles_that_may_be_written_to():
    arrived = LAYOUT.unpack(BYTES)
    for name in ("torque", "signs", "angles"):
        array = getattr(arrived, name)
        assert array.dtype == np.float64
        array[0] = 9.0
    assert LAYOUT.unpack(BYTES).angles[0] == 0.5


@pytest.mark.parametrize(
    ("spec", "entries", "size", "format"),
    [
        (FieldEncoding("u8"), 1, 1, "1B"),
        (FieldEncoding("i16", count=3), 3, 6, "3h"),
        (FieldEncoding("f32", count=MOTORS), 8, 32, "8f"),
        (FieldEncoding("text", length=24), 1, 24, "24s"),
        (FieldEncoding("text", length=2, count=3), 3, 6, "2s2s2s"),
    ],
)
def test_an_encoding_has_entries_and_size(spec: FieldEncoding, entries: int, size: int, format: str):
    assert (spec.entries(8), struct.calcsize(f"<{spec.format(8)}"), spec.format(8)) == (entries, size, format)


# Scaled numbers.


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (1.0004, 1.0),
        (1.0006, 1.001),
        (-1.0006, -1.001),
        *((value, 32.767) for value in (32.767, 32.768, 1e300, math.inf)),
        *((value, -32.768) for value in (-32.768, -33.0, -math.inf, math.nan)),
        (-0.0, 0.0),
    ],
)
def test_a_scaled_number_is_rounded_and_clipped(value: float, arrives: float):
    assert transmit(torque=[value, 0.0]).torque[0] == arrives


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        *((value, 4294.967295) for value in (4294.967295, 4295.0, math.inf)),
        *((value, 0.0) for value in (-1e-9, -1.0, math.nan)),
        # Both sides compare times with numbers such as 0.006, so whole microseconds must arrive as the same double.
        *((float(f"{number}e-6"),) * 2 for number in (1, 3, 1000, 3000, 6000, 1_000_001, 2**32 - 1)),
    ],
)
def test_a_time_is_clipped_and_whole_microseconds_are_exact(value: float, arrives: float):
    assert transmit(time=value).time == arrives


@given(st.integers(-(2**15), 2**15 - 1))
def test_every_scaled_number_is_exact(number: int):
    value = number / 1000
    data = LAYOUT.pack(sample(torque=[value, 0.0]))
    assert struct.unpack_from("<h", data, 16) == (number,)
    assert LAYOUT.unpack(data).torque[0] == value


@given(st.floats(), st.floats())
def test_no_float_is_rejected_in_a_scaled_field(first: float, second: float):
    torque = transmit(torque=[first, second], time=first).torque
    assert np.all((torque >= -32.768) & (torque <= 32.767))


# Numbers of 32 bits.


@given(st.floats(width=32))
def test_a_32_bit_float_arrives_unchanged(value: float):
    assert struct.pack("<d", transmit(real=value).real) == struct.pack("<d", value) or math.isnan(value)


GREATEST = (2 - 2.0**-23) * 2.0**127  # of 32 bits
ABOVE = math.nextafter((2 - 2.0**-24) * 2.0**127, 0.0)  # the largest double that is rounded to it


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (GREATEST, GREATEST),
        (ABOVE, GREATEST),
        *((value, math.inf) for value in (math.nextafter(ABOVE, math.inf), 1e39, 1e308)),
        (-1e39, -math.inf),
        (1e-60, 0.0),
    ],
)
def test_a_number_beyond_32_bits_becomes_infinite(value: float, arrives: float):
    arrived = transmit(real=value, angles=[ABOVE, value, 1.0])
    assert arrived.real == arrives
    assert arrived.angles.tolist() == [GREATEST, arrives, 1.0]
    assert (
        transmit(angles=[value, 1e39, 1.0]).angles[0] == arrives
    )  # an entry out of range does not affect its neighbours


@given(st.lists(st.floats(), min_size=3, max_size=3))
def test_no_float_is_rejected_in_a_32_bit_field(values: list[float]):
    with np.errstate(over="ignore"):
        expected = np.array(values).astype(np.float32)
    np.testing.assert_array_equal(transmit(angles=values).angles, expected.astype(np.float64))


# Whole numbers and arrays.


@pytest.mark.parametrize(
    ("field", "least", "greatest"), [("small", 0, 255), ("sign", -128, 127), ("large", 0, 2**32 - 1)]
)
def test_integers_arrive_within_their_range_and_are_rejected_beyond(field: str, least: int, greatest: int):
    for value in (least, greatest):
        arrived = getattr(transmit(**{field: value}), field)
        assert arrived == value
        assert type(arrived) is int
    for value in (least - 1, greatest + 1, 10**400):
        with pytest.raises(ValueError, match="Sample"):
            LAYOUT.pack(sample(**{field: value}))


@pytest.mark.parametrize("kind", [list, tuple, np.array, np.float32])
def test_an_array_may_be_any_sequence(kind: Any):
    assert LAYOUT.pack(sample(angles=kind([0.5, -2.0, 0.0]))) == BYTES


@pytest.mark.parametrize("value", [[1.0], [1.0, 2.0, 3.0], [], 1.0, np.float64(1.0), [[1.0, 2.0]], [[1.0], [2.0]]])
@pytest.mark.parametrize("field", ["torque", "signs"])
def test_an_array_with_a_wrong_shape_is_rejected(field: str, value: Any):
    with pytest.raises(ValueError, match=rf"{field} has|Sample"):
        LAYOUT.pack(sample(**{field: value}))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        *(("signs", [1.0, value]) for value in (128.0, math.nan, math.inf)),
        *((field, None) for field in ("real", "time", "small", "angles")),
    ],
)
def test_a_value_of_the_wrong_type_is_rejected(field: str, value: Any):
    with pytest.raises(ValueError, match=r"Sample|NaN|invalid literal|entries"):
        LAYOUT.pack(sample(**{field: value}))


# Texts.


@pytest.mark.parametrize(
    ("field", "text", "arrives"),
    [
        *(("name", text, text) for text in ("abcd", "", "äß")),  # two bytes each
        # A truncated text ends before the character that does not fit.
        *(("words", "hello, robot", "hello"), ("words", "aaaaä", "aaaa"), ("words", "äää", "ää")),
        *(("words", "€€", "€"), ("words", "aa😀", "aa")),
    ],
)
def test_a_text_may_fill_its_field_or_is_truncated(field: str, text: str, arrives: str):
    assert getattr(transmit(**{field: text}), field) == arrives


@pytest.mark.parametrize(
    ("field", "value", "match"),
    [
        ("name", "abcde", "name is 'abcde'; it may have at most 4 bytes"),
        ("name", "aäß", "name is 'aäß'; it may have at most 4 bytes"),
        ("names", ("x", "xyz"), "names is 'xyz'"),
        ("names", ("x",), "names has 1 entries; it must have 2"),
    ],
)
def test_texts_that_are_too_long_or_too_few_are_rejected(field: str, value: Any, match: str):
    with pytest.raises(ValueError, match=match):
        LAYOUT.pack(sample(**{field: value}))


def test_a_text_ends_at_its_first_zero():
    # Bytes after the zero may have any value.
    assert LAYOUT.unpack(BYTES[:34] + b"a\0\xff\xfe" + BYTES[38:]).name == "a"


@pytest.mark.parametrize("raw", [b"\xff\0\0\0", b"a\xc3\0\0", b"\xed\xa0\x80a"])
def test_bytes_that_are_not_text_are_rejected(raw: bytes):
    with pytest.raises(ValueError, match="decode"):
        LAYOUT.unpack(BYTES[:34] + raw + BYTES[38:])


@pytest.mark.parametrize("size", [0, 1, 46, 48, 94])
def test_a_payload_with_another_size_is_rejected(size: int):
    with pytest.raises(ValueError, match=f"Sample has {size} bytes; it must have 47"):
        LAYOUT.unpack((BYTES * 2)[:size])
