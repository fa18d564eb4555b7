"""Low-level messages of a Go2, rt/lowstate and rt/lowcmd, as numpy records in the layout of the vendor's C structs.

On the wire (CDR, little-endian, after a header of 4 bytes) they have the layout of the C struct with one exception: the
first motor's `mode` directly follows the field before it, while C aligns it to 4 bytes. Units: SI, degC, mA, mV;
`docs/go2.md` lists the sources. The checksum covers all words of the C struct except the last, with zero padding.
"""

from __future__ import annotations

import zlib
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError

SLOTS = 20
"""Number of motors in a message; the Go2 has the first 12: hip, thigh and calf of FR, FL, RR, RL."""
MOTOR_NAMES = tuple(f"{leg}_{part}_joint" for leg in ("FR", "FL", "RR", "RL") for part in ("hip", "thigh", "calf"))
POS_STOP, VEL_STOP = 2.146e9, 16000.0
"""Special values of angle and speed in a command that mean that none is commanded."""
SERVO = 1
"""`mode` of a motor that is switched on."""
HEAD, COMMAND_LEVEL = (0xFE, 0xEF), 0xFF
STATE_PERIOD = 0.002
"""Period of a Go2's states [s]."""

_FRAME = [("head", "u1", 2), ("level_flag", "u1"), ("frame_reserve", "u1"), ("sn", "<u4", 2)]
_FRAME += [("version", "<u4", 2), ("bandwidth", "<u2")]


def _record(*fields: Any) -> np.dtype[Any]:
    return np.dtype(list(fields), align=True)


IMU = _record(
    ("quaternion", "<f4", 4),  # w x y z
    ("gyroscope", "<f4", 3),  # rad/s, base frame
    ("accelerometer", "<f4", 3),  # m/s2, base frame
    ("rpy", "<f4", 3),
    ("temperature", "u1"),
)
MOTOR_STATE = _record(
    ("mode", "u1"),
    *((name, "<f4") for name in ("q", "dq", "ddq", "tau_est", "q_raw", "dq_raw", "ddq_raw")),
    ("temperature", "u1"),
    ("lost", "<u4"),
    ("reserve", "<u4", 2),
)
BMS_STATE = _record(
    *((name, "u1") for name in ("version_high", "version_low", "status", "soc")),
    ("current", "<i4"),
    ("cycle", "<u2"),
    ("bq_ntc", "u1", 2),
    ("mcu_ntc", "u1", 2),
    ("cell_vol", "<u2", 15),
)
LOW_STATE = _record(
    *_FRAME,
    ("imu_state", IMU),
    ("motor_state", MOTOR_STATE, SLOTS),
    ("bms_state", BMS_STATE),
    ("foot_force", "<i2", 4),
    ("foot_force_est", "<i2", 4),
    ("tick", "<u4"),  # ms
    ("wireless_remote", "u1", 40),
    ("bit_flag", "u1"),
    ("adc_reel", "<f4"),
    ("temperature_ntc1", "u1"),
    ("temperature_ntc2", "u1"),
    ("power_v", "<f4"),
    ("power_a", "<f4"),
    ("fan_frequency", "<u2", 4),
    ("reserve", "<u4"),
    ("crc", "<u4"),
)
MOTOR_COMMAND = _record(
    ("mode", "u1"), *((name, "<f4") for name in ("q", "dq", "tau", "kp", "kd")), ("reserve", "<u4", 3)
)
BMS_COMMAND = _record(("off", "u1"), ("reserve", "u1", 3))
LOW_COMMAND = _record(
    *_FRAME,
    ("motor_cmd", MOTOR_COMMAND, SLOTS),
    ("bms_cmd", BMS_COMMAND),
    ("wireless_remote", "u1", 40),
    ("led", "u1", 12),
    ("fan", "u1", 2),
    ("gpio", "u1"),
    ("reserve", "<u4"),
    ("crc", "<u4"),
)
_CDR_HEADER = bytes((0, 1, 0, 0))
_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
Record = NDArray[np.void]
"""A message: an array of shape () with dtype LOW_STATE or LOW_COMMAND."""


class BadMessageError(SurefootError):
    """The message has another layout, or a wrong checksum."""


def _used(kind: np.dtype[Any]) -> NDArray[np.uint8]:
    """Return a mask of a record: 255 for each byte of a field, 0 for padding."""
    used = np.zeros(kind.itemsize, np.uint8)
    for part, offset, *_ in (kind.fields or {}).values():
        base, count = part.base, int(np.prod(part.shape, dtype=int))
        inner = _used(base) if base.fields else np.full(base.itemsize, 255, np.uint8)
        used[offset : offset + count * base.itemsize] = np.tile(inner, count)
    return used


@dataclass(frozen=True)
class _Layout:
    """Offsets of the first motor's `mode` in CDR and in the C struct, and the mask of used bytes of the C struct."""

    cdr_mode: int
    c_mode: int
    used: NDArray[np.uint8]


def _layout(kind: np.dtype[Any], motors: str, before: int) -> _Layout:
    return _Layout(before, kind.fields[motors][1], _used(kind))  # type: ignore[index]


_LAYOUTS = {
    LOW_STATE: _layout(LOW_STATE, "motor_state", 77),
    LOW_COMMAND: _layout(LOW_COMMAND, "motor_cmd", 22),
}


def new_record(kind: np.dtype[Any]) -> Record:
    """Return a message in which all bytes are zero, including padding."""
    return np.zeros((), kind)


def new_command() -> Record:
    """Return a command without effect: all motors are on, without angle, speed, torque and gains."""
    command = new_record(LOW_COMMAND)
    command["head"], command["level_flag"] = HEAD, COMMAND_LEVEL
    motors = command["motor_cmd"]
    motors["mode"], motors["q"], motors["dq"] = SERVO, POS_STOP, VEL_STOP
    return command


def _crc(words: bytes) -> int:
    """Return the CRC of zlib over 32-bit words in the bit order of the robot's checksum; `array` swaps bytes fastest.

    The robot uses CRC-32/MPEG-2 over byte-swapped words: polynomial 04C11DB7, initial value FFFFFFFF, no reflection, no
    inversion. The CRC of zlib has the same polynomial, reflected and inverted.
    """
    swapped = array("I", words)
    swapped.byteswap()
    return zlib.crc32(swapped.tobytes().translate(_REVERSED))


def checksum(record: Record) -> int:
    """Return the checksum of a message with zero padding."""
    crc = _crc(record.tobytes()[:-4]) ^ 0xFFFFFFFF
    return int.from_bytes(crc.to_bytes(4, "little").translate(_REVERSED), "big")


def encode(record: Record) -> bytes:
    """Write the checksum into a message, and return its encoded bytes."""
    record["crc"] = checksum(record)
    data, layout = record.tobytes(), _LAYOUTS[record.dtype]
    first = data[: layout.cdr_mode] + data[layout.c_mode : layout.c_mode + 1]
    return _CDR_HEADER + first + bytes(-len(first) % 4) + data[layout.c_mode + 4 :]


def unpack(kind: np.dtype[Any], data: bytes, check: bool = True) -> bytes:
    """Return the bytes of a message's C struct, with zero padding, from its encoded bytes.

    `check` is whether to verify the checksum, which some writers omit.

    Raises:
        BadMessageError: another length or encoding, or a wrong checksum.
    """
    layout = _LAYOUTS[kind]
    length = kind.itemsize  # the header's 4 bytes replace the 4 of the first mode's alignment
    if len(data) != length or data[:4] != _CDR_HEADER:
        raise BadMessageError(f"the message has {len(data)} bytes; it must have {length}, in little-endian CDR")
    mode = 4 + layout.cdr_mode
    gap = bytes(layout.c_mode - layout.cdr_mode)
    raw = b"".join((data[4:mode], gap, data[mode : mode + 1], bytes(3), data[(mode + 4) // 4 * 4 :]))
    raw = (np.frombuffer(raw, np.uint8) & layout.used).tobytes()
    # The CRC of a message followed by its own checksum is constant.
    if check and _crc(raw) != 0xFFFFFFFF:
        record = np.frombuffer(raw, kind).reshape(())
        raise BadMessageError(f"the checksum is {int(record['crc'])}; it must be {checksum(record)}")
    return raw


def decode(kind: np.dtype[Any], data: bytes, check: bool = True) -> Record:
    """Return the message of encoded bytes; see `unpack`.

    Raises:
        BadMessageError: another length or encoding, or a wrong checksum.
    """
    return np.ndarray((), kind, bytearray(unpack(kind, data, check)))


_BUTTONS = ("R1", "L1", "start", "select", "R2", "L2", "F1", "F2", "A", "B", "X", "Y", "up", "right", "down", "left")


@dataclass(frozen=True)
class RemoteControl:
    """Remote control: pressed buttons, and deflections of the left and right stick, -1 to 1 (x to the right, y up)."""

    buttons: frozenset[str]
    left_x: float
    left_y: float
    right_x: float
    right_y: float

    @classmethod
    def decode(cls, data: NDArray[np.uint8]) -> RemoteControl:
        """Decode the 40 bytes `wireless_remote` of a state; without a remote control, all are zero."""
        raw = data.tobytes()
        word = int.from_bytes(raw[2:4], "little")
        left_x, right_x, right_y, _, left_y = np.frombuffer(raw, "<f4", 5, 4).tolist()
        pressed = frozenset(name for bit, name in enumerate(_BUTTONS) if word >> bit & 1)
        return cls(pressed, left_x, left_y, right_x, right_y)

    def encode(self) -> NDArray[np.uint8]:
        """Return the encoded 40 bytes."""
        word = sum(1 << _BUTTONS.index(name) for name in self.buttons)
        sticks = np.array([self.left_x, self.right_x, self.right_y, 0.0, self.left_y], "<f4")
        return np.frombuffer(bytes(2) + word.to_bytes(2, "little") + sticks.tobytes() + bytes(16), np.uint8)
