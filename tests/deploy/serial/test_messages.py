"""Messages as payloads: bytes worked out by hand, the schema's hash, and floats that never stop a control loop."""

from __future__ import annotations

import dataclasses
import hashlib
import math
import struct
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from wire_vectors import EXAMPLES

from surefoot.deploy.messages import Arm, Fault, Hello, Message, Mode, Ping, Position, Pwm, Reason, State
from surefoot.deploy.serial.codec import MAX_PAYLOAD, MESSAGES, NUMBERS, Codec, encodings
from surefoot.deploy.serial.fields import MOTORS, FieldEncoding
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

CODEC = Codec(8)
TWO = Codec(2)
STATE = next(example.message for example in EXAMPLES if isinstance(example.message, State))


def same(one: Message, other: Message) -> bool:
    """Whether two messages are equal, arrays and NaN included."""
    if type(one) is not type(other):
        return False
    pairs = [(getattr(one, item.name), getattr(other, item.name)) for item in dataclasses.fields(one)]
    return all(np.array_equal(a, b, equal_nan=isinstance(a, float | np.ndarray)) for a, b in pairs)


# Known bytes.


@pytest.mark.parametrize(
    ("message", "payload"),
    [
        (Arm(1, Mode.PWM, 0.005, 0.002), "01 00  02  88 13 00 00  D0 07 00 00"),
        (Position(0xFFFF, np.array([1.0, -0.5])), "FF FF  00 00 80 3F  00 00 00 BF"),
        (Fault(6, Reason.BUSY, "no"), "06 00  08  6E 6F" + " 00" * 78),
        (
            State(
                session=0x0102,
                mode=Mode.FAULT,
                reason=Reason.TILT,
                command=0x01020304,
                command_age=0.5,
                dropped=3,
                motor_angle=np.array([1.0, 2.0]),
                motor_velocity=np.array([-1.0, -2.0]),
                motor_torque=np.array([3.5, -0.005]),
                roll_pitch_yaw=np.array([0.5, 0.25, 0.125]),
                angular_velocity_base=np.array([4.0, 8.0, 16.0]),
                energy=32.0,
                voltage=15.5,
                temperature=np.array([25.4, 90.6]),
            ),
            "02 01  03  05  04 03 02 01  50 C3  03 00  00 00 80 3F  00 00 00 40  00 00 80 BF  00 00 00 C0"
            "BC 02  FF FF  00 00 00 3F  00 00 80 3E  00 00 00 3E  00 00 80 40  00 00 00 41  00 00 80 41"
            "00 00 00 42  8C 3C  19  5B",
        ),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, Message) else "",
)
def test_a_message_has_the_bytes_worked_out_by_hand(message: Message, payload: str):
    assert TWO.pack(message) == bytes.fromhex(payload)
    assert TWO.pack(TWO.unpack(NUMBERS[type(message)], bytes.fromhex(payload))) == bytes.fromhex(payload)


# Encoding and decoding.


def values_of(spec: FieldEncoding) -> st.SearchStrategy[Any]:
    """Return the values that a field's numbers represent exactly."""
    if spec.kind == "text":
        letters = st.characters(exclude_characters="\0", exclude_categories=("Cs",))
        return st.text(letters).map(lambda text: text.encode()[: spec.length].decode(errors="ignore"))
    if spec.kind == "f32":
        return st.floats(width=32)
    signed, bits = spec.kind[0] == "i", int(spec.kind[1:])
    numbers = st.integers(-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else st.integers(0, 2**bits - 1)
    per = round(1 / spec.scale) if spec.scale else 0
    return numbers.map(lambda number: number / per) if per else numbers


def messages(motors: int, accelerometer: bool = False) -> st.SearchStrategy[Message]:
    """Return random messages of every type, with values that fields represent exactly."""

    def field(spec: FieldEncoding) -> st.SearchStrategy[Any]:
        one = values_of(spec)
        if spec.count == 1:
            return one
        many = st.lists(one, min_size=spec.entries(motors), max_size=spec.entries(motors))
        return many.map(tuple if spec.kind == "text" else lambda values: np.array(values, np.float64))

    return st.one_of(
        *(
            st.builds(kind, **{name: field(spec) for name, spec in encodings(kind, accelerometer).items()})
            for kind in MESSAGES
        )
    )


@pytest.mark.parametrize("accelerometer", [False, True])
@given(st.data())
def test_pack_and_unpack_are_the_identity(accelerometer: bool, data: st.DataObject):
    codec, message = Codec(2, accelerometer), data.draw(messages(2, accelerometer))
    assert same(codec.unpack(NUMBERS[type(message)], codec.pack(message)), message)


@given(st.data())
def test_unpack_and_pack_are_the_identity_on_every_payload_without_texts(data: st.DataObject):
    kind = data.draw(
        st.sampled_from([kind for kind in MESSAGES if all(s.kind != "text" for s in encodings(kind).values())])
    )
    payload = data.draw(st.binary(min_size=TWO.size(kind), max_size=TWO.size(kind)))
    message = TWO.unpack(NUMBERS[kind], payload)
    again = TWO.pack(message)
    assert same(TWO.unpack(NUMBERS[kind], again), message)
    if not any(
        np.isnan(value).any() for value in vars(message).values() if value is not None
    ):  # the bits of a NaN may differ
        assert again == payload


@given(st.sampled_from((Position, Pwm)), st.lists(st.floats(), min_size=8, max_size=8))
def test_values_that_are_not_finite_are_sent_and_stay_invalid(kind: type[Message], values: list[float]):
    arrived = CODEC.unpack(NUMBERS[kind], CODEC.pack(kind(9, np.array(values))))
    for value, arrives in zip(values, arrived.target if kind is Position else arrived.duty, strict=True):
        if math.isfinite(value) and abs(value) < 3e38:
            assert arrives == np.float32(value)
        else:
            assert math.isnan(arrives) == math.isnan(value)
            assert not abs(arrives) < 3e38


def test_the_temperature_of_an_overheated_motor_saturates():
    message = dataclasses.replace(STATE, temperature=np.array([300.0, -40.0, 89.5, 90.5, 0, 255, 255.4, math.inf]))
    arrived = CODEC.unpack(NUMBERS[State], CODEC.pack(message))
    assert arrived.temperature.tolist() == [255, 0, 90, 90, 0, 255, 255, 255]  # halves are rounded to the even number


def test_the_text_of_a_fault_is_truncated():
    arrived = CODEC.unpack(NUMBERS[Fault], CODEC.pack(Fault(1, Reason.TILT, "ü" * 100)))
    assert arrived.text == "ü" * 40


@pytest.mark.parametrize(
    ("message", "what"),
    [
        (Hello(65536, 0.01), "Hello"),
        (Hello(-1, 0.01), "Hello"),
        (Ping(2**32), "Ping"),
        (Position(1, np.zeros(7)), "target has 7 entries; it must have 8"),
        (Position(1, np.zeros(9)), "target has 9 entries; it must have 8"),
        (Pwm(1, np.zeros((8, 1))), "Pwm"),
        (dataclasses.replace(STATE, dropped=65536), "State"),
        (dataclasses.replace(EXAMPLES[8].message, robot="a" * 25), "robot is 'a+'; it may have at most 24 bytes"),
    ],
)
def test_a_message_with_a_value_out_of_range_is_rejected(message: Message, what: str):
    with pytest.raises(ValueError, match=what):
        CODEC.pack(message)


@pytest.mark.parametrize("kind", MESSAGES)
def test_a_payload_with_a_wrong_length_is_not_a_message(kind: type[Message]):
    payload = CODEC.pack(next(example.message for example in EXAMPLES if type(example.message) is kind))
    for size in {*range(len(payload)), len(payload) + 1, len(payload) + 100}:
        assert CODEC.unpack(NUMBERS[kind], (payload + bytes(100))[:size]) is None


# The schema.


def test_every_field_has_a_meaning_and_a_whole_number_of_steps_in_its_unit():
    for kind in MESSAGES:
        for name, spec in encodings(kind).items():
            assert spec.meaning, f"{kind.__name__}.{name}"
            if spec.scale:
                assert round(1 / spec.scale) * spec.scale == pytest.approx(1.0, abs=1e-12)


def test_the_schema_is_the_hash_of_the_canonical_text():
    # Firmware that was built for this schema stops understanding the host when this number changes.
    assert CODEC.schema == 0x160C5D1C
    assert CODEC.schema == struct.unpack("<I", hashlib.sha256(CODEC.describe().encode()).digest()[:4])[0]


def test_a_board_with_an_accelerometer_has_a_schema_of_its_own():
    # The known hashes: boards of both kinds are in use.
    assert [Codec(motors).schema for motors in (8, 12)] == [0x160C5D1C, 0x3BD1475C]
    assert [Codec(motors, accelerometer=True).schema for motors in (8, 12)] == [0xB3AAEA90, 0x480BF87F]
    plain, line = CODEC.describe(), "accelerometer f32 3 0 0 m/s^2\n"
    assert Codec(8, accelerometer=True).describe() == plain.replace("68 Fault\n", f"{line}68 Fault\n")
    assert len({Codec(motors, one).schema for motors in range(1, 22) for one in (False, True)}) == 42


def test_only_a_board_with_an_accelerometer_sends_its_reading():
    state = dataclasses.replace(STATE, accelerometer=np.array([0.5, math.nan, 9.8125]))
    codec = Codec(8, accelerometer=True)
    payload = codec.pack(state)
    assert payload[:-12] == CODEC.pack(state) == CODEC.pack(STATE)
    assert struct.unpack("<3f", payload[-12:])[::2] == (0.5, 9.8125)
    assert np.isnan(codec.unpack(NUMBERS[State], payload).accelerometer[1])
    assert CODEC.unpack(NUMBERS[State], CODEC.pack(state)).accelerometer is None
    with pytest.raises(ValueError, match="State"):
        codec.pack(STATE)


def test_the_canonical_text_is_as_documented():
    lines = CODEC.describe().split("\n")
    assert lines[:4] == ["surefoot 1 motors 8", "1 Hello", "session u16 1 0 0 1", "state_period u32 1 0 1e-06 s"]
    assert "motor_names text 8 24 0 -" in lines
    assert "motor_torque i16 8 0 0.005 N m" in lines
    assert lines[-1] == ""
    assert len(lines) == 1 + len(MESSAGES) + sum(len(encodings(kind)) for kind in MESSAGES) + 1


def test_each_number_of_motors_has_its_schema_up_to_the_largest_robot():
    assert len({Codec(motors).schema for motors in range(1, 22)}) == 21
    # 98 bytes, and 41 per motor.
    assert Codec(21).size(MESSAGES[8]) == 959 <= MAX_PAYLOAD < 959 + 41
    assert sum(spec.count == MOTORS for spec in encodings(MESSAGES[8]).values()) == 6
    with pytest.raises(SurefootError, match="motors is 22"):
        Codec(22)


# Numbers with a meaning.


def test_modes_and_reasons_have_their_numbers_and_meanings():
    assert [int(mode) for mode in Mode] == [0, 1, 2, 3]
    assert [int(reason) for reason in Reason] == list(range(23))
    assert Reason(5) is Reason.TILT
    assert Reason.TILT == 5
    assert all(one.meaning.endswith(".") for one in [*Mode, *Reason])
    with pytest.raises(ValueError, match="23 is not a valid Reason"):
        Reason(23)


@pytest.mark.parametrize("name", RobotDescription.available())
def test_a_state_can_hold_the_maximum_torque_of_each_robot(name: str):
    robot = RobotDescription.load(name)
    actuator, motors = robot.actuator, robot.num_motors
    limit = actuator.torque_limit if actuator.kind == "joint" else max(actuator.torque_table_torque)
    torque = np.broadcast_to(limit, motors) * np.where(np.arange(motors) % 2, -1.0, 1.0)
    codec, zero = Codec(motors), np.zeros(motors)
    state = State(1, 1, 0, 1, 0.0, 0, zero, zero, torque, np.zeros(3), np.zeros(3), 0.0, 20.0, zero)
    returned = codec.unpack(NUMBERS[State], codec.pack(state))
    assert isinstance(returned, State)
    np.testing.assert_allclose(returned.motor_torque, torque, atol=0.0025 + 1e-9)
