"""Faults of an emulated robot, by name, as in `--fault NAME[=VALUE][@TIME]`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from surefoot.errors import SurefootError, choices

_MOTOR = "number of the motor"
_AFTER_ARMING = "s after arming"


@dataclass(frozen=True)
class FaultKind:
    """A fault that can be requested."""

    meaning: str
    value: float = math.nan
    """Default of its number; NaN: it takes none."""
    low: float = 0.0
    high: float = math.inf
    unit: str = ""
    start: float = math.nan
    """Default of its start, in s after the robot was first armed; NaN: it is always active."""
    real_time: bool = False
    """It concerns real time, and has no meaning in lockstep."""


def _rate(meaning: str) -> FaultKind:
    return FaultKind(meaning, 0.05, high=1.0, unit="chance a frame")


def _moment(meaning: str) -> FaultKind:
    return FaultKind(meaning, 1.0, unit=_AFTER_ARMING)


def _motor(meaning: str) -> FaultKind:
    return FaultKind(meaning, 0.0, unit=_MOTOR)


FAULTS: dict[str, FaultKind] = {
    "corrupt": _rate("one to three bits of a frame are turned over"),
    "drop": _rate("frames are lost"),
    "duplicate": _rate("frames come twice"),
    "reorder": _rate("frames come after the next one"),
    "garbage": _rate("bytes that nobody sent come between frames"),
    "cut-frames": _rate("only the beginning or the end of a frame comes"),
    "batching": FaultKind(
        "bytes to the host arrive in batches, as some USB adapters hand them over",
        *(0.016, 0.0, 1.0, "s between batches"),
        real_time=True,
    ),
    "unplug": _moment("the cable is pulled"),
    "swap-motors": _motor("commands of a motor and of the one after it go to each other's"),
    "flip-sign": _motor("a motor turns the other way round its rest than it is told"),
    "flip-encoder": _motor("a motor's encoder reads the other way round its rest"),
    "imu-flip": FaultKind(
        "the IMU is mounted otherwise than it says: 0 exchanges roll and pitch, 1 negates roll, 2 pitch, 3 both",
        *(0.0, 0.0, 3.0, "way"),
    ),
    "other-robot": FaultKind("the robot says that it is another one"),
    "other-order": FaultKind("the robot names its motors in another order"),
    "other-gains": FaultKind("the robot states other servo gains", 1.5, 0.0, 100.0, "times the nominal ones"),
    "other-schema": FaultKind("the robot speaks another schema of the protocol"),
    "slow-servo": FaultKind("the servo runs slower, and says so", 0.002, 0.001, 0.1, "s between two steps"),
    "stale-state": _moment("states tell again and again what one told"),
    "repeat-sequence": _moment("all states have the same number"),
    "backward-sequence": _moment("numbers of states go backward"),
    "late-states": FaultKind("readings are older than they should be", 0.02, 0.0, 0.06, "s more"),
    "battery-low": FaultKind("the battery's voltage without load falls, 2 V a second", 12.0, 1.0, 30.0, "V", start=1.0),
    "motor-hot": FaultKind("the first motor grows hot, 40 degC a second", 95.0, 0.0, 250.0, "degC", start=1.0),
    "tilt": _moment("a hard push from the side topples the robot"),
    "reboot": _moment("the microcontroller starts anew, and knows nobody"),
    "hang": FaultKind("the microcontroller's program stands still", 0.2, 0.0, 60.0, "s", start=1.0),
    "overload": FaultKind("physics needs more than real time", 1.5, 0.0, 1000.0, "times real time", real_time=True),
}
"""Every fault, by name."""


@dataclass(frozen=True)
class Fault:
    """One fault as requested."""

    value: float
    """Its number, in the fault's unit; NaN where it takes none."""
    start: float
    """When it begins [s], after the robot was first armed; 0: it is always active."""


def parse_faults(words: Sequence[str], lockstep: bool = False, motors: int = 8) -> dict[str, Fault]:
    """Return faults by name, from words `NAME[=VALUE][@TIME]`.

    Args:
        words: as given on a command line.
        lockstep: whether robot time follows the times in the host's frames.
        motors: number of motors.

    Raises:
        SurefootError: no such fault, a fault given twice, or a number that it does not take.
    """
    found: dict[str, Fault] = {}
    for word in words:
        rest, at, time = word.partition("@")
        name, equals, text = rest.partition("=")
        kind = FAULTS.get(name)
        if kind is None:
            raise SurefootError(f"'{name}' is no fault; choices: {choices(FAULTS)}")
        if name in found:
            raise SurefootError(f"fault {name} is given twice; give it once")
        if kind.real_time and lockstep:
            raise SurefootError(f"fault {name} is about real time; it does not go with --lockstep")
        value = _number(word, text) if equals else kind.value
        if equals and math.isnan(kind.value):
            raise SurefootError(f"fault {name} takes no number; '{word}' gives one")
        high = kind.high
        if kind.unit == _MOTOR:
            high = motors - 2 if name == "swap-motors" else motors - 1
        if equals and not kind.low <= value <= high:
            allowed = f"{kind.low:g} to {high:g}" if high < math.inf else f"{kind.low:g} or more"
            raise SurefootError(f"fault {name} is {value:g}; it must be {allowed} (unit: {kind.unit})")
        if kind.unit in (_MOTOR, "way") and value != round(value):
            raise SurefootError(f"fault {name} is {value:g}; it must be a whole number")
        if at and kind.unit == _AFTER_ARMING:
            raise SurefootError(f"fault {name} takes its time as {name}=TIME; '{word}' gives another")
        start = _number(word, time) if at else 0.0 if math.isnan(kind.start) else kind.start
        if not 0 <= start < math.inf:
            raise SurefootError(f"fault {name} begins at {start:g} s; it must be 0 or more")
        found[name] = Fault(value, value if kind.unit == _AFTER_ARMING else start)
    return found


def _number(word: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise SurefootError(f"fault '{word}' gives no number; write NAME, NAME=VALUE or NAME=VALUE@TIME")
    return value


def describe() -> list[str]:
    """Return one line per fault, for a list."""
    lines = []
    for name, kind in FAULTS.items():
        number = "" if math.isnan(kind.value) else f"={kind.value:g} ({kind.unit})"
        start = "" if math.isnan(kind.start) else f"@{kind.start:g} (s after arming)"
        lines.append(f"{name}{number}{start}: {kind.meaning}")
    return lines
