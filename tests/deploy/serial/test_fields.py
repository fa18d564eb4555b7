"""Numbers and texts as bytes: answers worked by hand, and what happens at the edges."""

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
"""One field of every sort."""
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
    "00 00 00 3F  00 00 00 C0  00 00 00 00"  # .5, -2, 0
    "61 62 00 00"
    "78 00 79 7A"
    "68 65 6C 6C 6F"
)
LAYOUT = MessageLayout(Sample, WIRES, 2)


def sample(**changes: Any) -> Any:
    return Sample(**{**SAMPLE, **changes})


def sent(**changes: Any) -> Any:
    """What arrives of a sample."""
    return LAYOUT.unpack(LAYOUT.pack(sample(**changes)))


def test_a_message_has_the_bytes_worked_by_hand():
    assert LAYOUT.pack(sample()) == BYTES
    assert LAYOUT.struct.size == len(BYTES) == 47


def test_the_bytes_worked_by_hand_are_the_message():
    found = LAYOUT.unpack(BYTES)
    assert isinstance(found, Sample)
    for name, value in SAMPLE.items():
        np.testing.assert_array_equal(getattr(found, name), value, err_msg=name)
    assert (type(found.name), type(found.names)) == (str, tuple)


def test_arrays_come_as_doubles_that_may_be_written_to():
    found = LAYOUT.unpack(BYTES)
    for name in ("torque", "signs", "angles"):
        array = getattr(found, name)
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
def test_a_field_knows_its_size(spec: FieldEncoding, entries: int, size: int, format: str):
    assert (spec.entries(8), struct.calcsize(f"<{spec.format(8)}"), spec.format(8)) == (entries, size, format)


# Scaled numbers.


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (1.0004, 1.0),
        (1.0006, 1.001),
        (-1.0006, -1.001),
        (32.767, 32.767),
        (32.768, 32.767),
        (1e300, 32.767),
        (math.inf, 32.767),
        (-32.768, -32.768),
        (-33.0, -32.768),
        (-math.inf, -32.768),
        (math.nan, -32.768),
        (-0.0, 0.0),
    ],
)
def test_a_scaled_number_is_rounded_and_clipped(value: float, arrives: float):
    assert sent(torque=[value, 0.0]).torque[0] == arrives


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (4294.967295, 4294.967295),
        (4295.0, 4294.967295),
        (math.inf, 4294.967295),
        (-1e-9, 0.0),
        (-1.0, 0.0),
        (math.nan, 0.0),
    ],
)
def test_a_time_is_clipped(value: float, arrives: float):
    assert sent(time=value).time == arrives


@pytest.mark.parametrize("microseconds", [1, 3, 1000, 3000, 6000, 1_000_001, 2**32 - 1])
def test_whole_microseconds_arrive_as_the_same_double(microseconds: int):
    # Times are compared with numbers such as .006 on both sides.
    assert sent(time=float(f"{microseconds}e-6")).time == float(f"{microseconds}e-6")


@given(st.integers(-(2**15), 2**15 - 1))
def test_every_scaled_number_is_told_exactly(number: int):
    value = number / 1000
    data = LAYOUT.pack(sample(torque=[value, 0.0]))
    assert struct.unpack_from("<h", data, 16) == (number,)
    assert LAYOUT.unpack(data).torque[0] == value


@given(st.floats(), st.floats())
def test_no_float_is_refused_in_a_scaled_field(first: float, second: float):
    torque = sent(torque=[first, second], time=first).torque
    assert np.all((torque >= -32.768) & (torque <= 32.767))


# Numbers of 32 bits.


@given(st.floats(width=32))
def test_a_single_arrives_as_it_is(value: float):
    assert struct.pack("<d", sent(real=value).real) == struct.pack("<d", value) or math.isnan(value)


GREATEST = (2 - 2.0**-23) * 2.0**127  # of 32 bits
ABOVE = math.nextafter((2 - 2.0**-24) * 2.0**127, 0.0)  # the greatest double that still rounds to it


@pytest.mark.parametrize(
    ("value", "arrives"),
    [
        (GREATEST, GREATEST),
        (ABOVE, GREATEST),
        (math.nextafter(ABOVE, math.inf), math.inf),
        (1e39, math.inf),
        (-1e39, -math.inf),
        (1e308, math.inf),
        (1e-60, 0.0),
    ],
)
def test_what_is_too_large_for_32_bits_is_infinite(value: float, arrives: float):
    found = sent(real=value, angles=[ABOVE, value, 1.0])
    assert found.real == arrives
    assert found.angles.tolist() == [GREATEST, arrives, 1.0]
    assert sent(angles=[value, 1e39, 1.0]).angles[0] == arrives  # a neighbour that does not fit changes nothing


@given(st.lists(st.floats(), min_size=3, max_size=3))
def test_no_float_is_refused_in_a_single(values: list[float]):
    with np.errstate(over="ignore"):
        expected = np.array(values).astype(np.float32)
    np.testing.assert_array_equal(sent(angles=values).angles, expected.astype(np.float64))


# Whole numbers.


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("small", -1),
        ("small", 256),
        ("sign", -129),
        ("sign", 128),
        ("medium", 65536),
        ("large", 2**32),
        ("large", 10**400),
        ("signs", [1.0, 128.0]),
        ("signs", [1.0, math.nan]),
        ("signs", [math.inf, 1.0]),
    ],
)
def test_a_whole_number_that_does_not_fit_is_refused(field: str, value: Any):
    with pytest.raises(ValueError, match=r"Sample|NaN"):
        LAYOUT.pack(sample(**{field: value}))


@pytest.mark.parametrize(
    ("field", "least", "greatest"), [("small", 0, 255), ("sign", -128, 127), ("large", 0, 2**32 - 1)]
)
def test_whole_numbers_arrive_from_the_least_to_the_greatest(field: str, least: int, greatest: int):
    for value in (least, greatest):
        arrived = getattr(sent(**{field: value}), field)
        assert arrived == value
        assert type(arrived) is int


# Arrays.


@pytest.mark.parametrize("kind", [list, tuple, np.array, np.float32])
def test_an_array_may_be_any_sequence(kind: Any):
    assert LAYOUT.pack(sample(angles=kind([0.5, -2.0, 0.0]))) == BYTES


@pytest.mark.parametrize("value", [[1.0], [1.0, 2.0, 3.0], [], 1.0, np.float64(1.0), [[1.0, 2.0]], [[1.0], [2.0]]])
@pytest.mark.parametrize("field", ["torque", "signs"])
def test_an_array_of_another_shape_is_refused(field: str, value: Any):
    with pytest.raises(ValueError, match=rf"{field} has|Sample"):
        LAYOUT.pack(sample(**{field: value}))


def test_what_is_no_number_is_refused():
    for field in ("real", "time", "small", "angles"):
        with pytest.raises(ValueError, match=r"Sample|invalid literal|entries"):
            LAYOUT.pack(sample(**{field: None}))


# Texts.


def test_a_text_may_fill_its_field():
    assert sent(name="abcd").name == "abcd"
    assert sent(name="").name == ""
    assert sent(name="äß").name == "äß"  # two bytes each


def test_a_text_that_is_too_long_is_refused():
    with pytest.raises(ValueError, match="name is 'abcde'; it may have 4 bytes"):
        LAYOUT.pack(sample(name="abcde"))
    with pytest.raises(ValueError, match="name is 'aäß'; it may have 4 bytes"):
        LAYOUT.pack(sample(name="aäß"))
    with pytest.raises(ValueError, match="names is 'xyz'"):
        LAYOUT.pack(sample(names=("x", "xyz")))


@pytest.mark.parametrize(
    ("text", "arrives"), [("hello, robot", "hello"), ("aaaaä", "aaaa"), ("äää", "ää"), ("€€", "€"), ("aa😀", "aa")]
)
def test_a_text_that_may_be_cut_ends_before_the_character_that_does_not_fit(text: str, arrives: str):
    assert sent(words=text).words == arrives


def test_the_wrong_number_of_texts_is_refused():
    with pytest.raises(ValueError, match="names has 1 entries; it must have 2"):
        LAYOUT.pack(sample(names=("x",)))


def test_a_text_ends_at_its_first_zero():
    # Firmware may leave anything behind it.
    data = bytearray(BYTES)
    data[34:38] = b"a\0\xff\xfe"
    assert LAYOUT.unpack(bytes(data)).name == "a"


@pytest.mark.parametrize("raw", [b"\xff\0\0\0", b"a\xc3\0\0", b"\xed\xa0\x80a"])
def test_bytes_that_are_no_text_are_refused(raw: bytes):
    data = BYTES[:34] + raw + BYTES[38:]
    with pytest.raises(ValueError, match="decode"):
        LAYOUT.unpack(data)


@pytest.mark.parametrize("size", [0, 1, 46, 48, 94])
def test_another_number_of_bytes_is_refused(size: int):
    with pytest.raises(ValueError, match=f"Sample has {size} bytes; it must have 47"):
        LAYOUT.unpack((BYTES * 2)[:size])
