"""Faults of emulated robots by name, as in `--fault NAME[=VALUE][@TIME]`: their effects and start times.

The table is shared by all links to a robot. Each fault has a target, such as the handshake; `LINKS` lists the targets
of each link, and faults with other targets are rejected there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from surefoot.errors import SurefootError, suggest

LINE_FAULTS = ("garbage", "drop", "cut-frames", "corrupt", "reorder", "duplicate")
"""Faults of single frames on a serial line, in the order of their random numbers; `FAULTS` describes each."""
_MOTOR = "number of the motor"
_KIND = "kind"
_AFTER_ARMING = "s after arming"
"""Start times are relative to the first arming; over DDS, to the first command of a host."""
_RATE = (0.05, 0.0, 1.0, "probability per frame")


class Target(StrEnum):
    """Target of a fault."""

    MESSAGES = "messages in transit"
    BYTES = "bytes between messages"
    HANDSHAKE = "the handshake"
    STATES = "states"
    MOTOR_MESSAGES = "messages of single motors"
    TOPICS = "DDS topics"
    SERVICES = "the services of the robot's own controller"
    REMOTE = "the remote control"
    WIRING = "the wiring of motors"
    SENSORS = "encoders and IMU"
    BODY = "battery, motors and body"
    BOARD = "the microcontroller"


_ALWAYS = {Target.MESSAGES, Target.STATES, Target.WIRING, Target.SENSORS, Target.BODY, Target.BOARD}
LINKS: dict[str, frozenset[Target]] = {
    "serial": frozenset(_ALWAYS | {Target.BYTES, Target.HANDSHAKE}),
    "dds": frozenset(_ALWAYS | {Target.MOTOR_MESSAGES, Target.TOPICS, Target.SERVICES, Target.REMOTE}),
}
"""Targets of faults that exist behind each kind of link."""


@dataclass(frozen=True)
class FaultKind:
    """Definition of a fault."""

    target: Target
    meaning: str
    value: float = math.nan
    """Default value; NaN: the fault has no value."""
    low: float = 0.0
    high: float = math.inf
    unit: str = ""
    start: float = math.nan
    """Default start time, in s after the robot was first armed; NaN: always active."""
    real_time: bool = False
    """Whether it concerns real time, so that it has no meaning in lockstep."""

    @property
    def links(self) -> tuple[str, ...]:
        """Kinds of links that have its target."""
        return tuple(link for link, targets in LINKS.items() if self.target in targets)


def _at_time(target: Target, meaning: str) -> FaultKind:
    return FaultKind(target, meaning, 1.0, unit=_AFTER_ARMING)


def _motor(target: Target, meaning: str, start: float = math.nan) -> FaultKind:
    return FaultKind(target, meaning, 0.0, unit=_MOTOR, start=start)


FAULTS: dict[str, FaultKind] = {
    "corrupt": FaultKind(Target.MESSAGES, "one to three bits of a frame are flipped", *_RATE),
    "drop": FaultKind(Target.MESSAGES, "frames are lost", *_RATE),
    "duplicate": FaultKind(Target.MESSAGES, "frames arrive twice", *_RATE),
    "reorder": FaultKind(Target.MESSAGES, "frames arrive after the next one", *_RATE),
    "garbage": FaultKind(Target.BYTES, "random bytes arrive between frames", *_RATE),
    "cut-frames": FaultKind(Target.BYTES, "only the beginning or the end of a frame arrives", *_RATE),
    "batching": FaultKind(
        Target.BYTES,
        "bytes to the host arrive in batches, as with some USB adapters",
        *(0.016, 0.0, 1.0, "s between batches"),
        real_time=True,
    ),
    "unplug": _at_time(Target.MESSAGES, "the cable is pulled"),
    "swap-motors": _motor(Target.WIRING, "commands of a motor and the next one are exchanged"),
    "flip-sign": _motor(Target.WIRING, "a motor turns in the wrong direction from its rest"),
    "flip-encoder": _motor(Target.SENSORS, "a motor's encoder counts in the wrong direction from its rest"),
    "imu-flip": FaultKind(
        Target.SENSORS,
        "the IMU is mounted wrongly: 0 exchanges roll and pitch, 1 negates roll, 2 pitch, 3 both",
        *(0.0, 0.0, 3.0, _KIND),
    ),
    "other-robot": FaultKind(Target.HANDSHAKE, "the handshake has the name of another robot"),
    "other-order": FaultKind(Target.HANDSHAKE, "the handshake has the motors in another order"),
    "other-gains": FaultKind(
        Target.HANDSHAKE, "the handshake has other servo gains", 1.5, 0.0, 100.0, "times the nominal ones"
    ),
    "other-schema": FaultKind(Target.HANDSHAKE, "the robot has another schema of the protocol"),
    "slow-servo": FaultKind(
        Target.HANDSHAKE, "the servo runs slower, as the handshake states", 0.002, 0.001, 0.1, "s per step"
    ),
    "stale-state": _at_time(Target.STATES, "states repeat the readings of one state"),
    "repeat-sequence": _at_time(Target.STATES, "all states have the same sequence number"),
    "backward-sequence": _at_time(Target.STATES, "sequence numbers of states decrease"),
    "late-states": FaultKind(Target.STATES, "readings are older than they should be", 0.02, 0.0, 0.06, "s more"),
    "battery-low": FaultKind(
        Target.BODY, "the open-circuit voltage of the battery falls by 2 V per second", 12.0, 1.0, 30.0, "V", start=1.0
    ),
    "motor-hot": FaultKind(
        Target.BODY, "the first motor heats up by 40 degC per second", 95.0, 0.0, 250.0, "degC", start=1.0
    ),
    "tilt": _at_time(Target.BODY, "a hard push from the side topples the robot"),
    "reboot": _at_time(Target.BOARD, "the microcontroller restarts and forgets its operator"),
    "hang": FaultKind(Target.BOARD, "the microcontroller's program hangs", 0.2, 0.0, 60.0, "s", start=1.0),
    "overload": FaultKind(
        Target.BODY, "the physics is slower than real time", 1.5, 0.0, 1000.0, "times real time", real_time=True
    ),
    "not-finite": _at_time(Target.MOTOR_MESSAGES, "the angle of the first motor is not a number"),
    "tick-restart": _at_time(Target.TOPICS, "ticks of states restart at 0"),
    "slow-states": FaultKind(Target.TOPICS, "states are sent less often", 50.0, 1.0, 500.0, "Hz"),
    "other-layout": FaultKind(Target.TOPICS, "states have another layout"),
    "motor-off": _motor(Target.MOTOR_MESSAGES, "a motor switches itself off", start=1.0),
    "motor-lost": _motor(Target.MOTOR_MESSAGES, "the messages of a motor are lost", start=1.0),
    "second-writer": _at_time(Target.TOPICS, "another program commands the motors"),
    "service-back": _at_time(Target.SERVICES, "the robot's own controller becomes active again"),
    "no-service": FaultKind(Target.SERVICES, "neither the motion switcher nor the sport service answers"),
    "remote-stop": _at_time(Target.REMOTE, "L2 and B of the remote control are pressed"),
    "remote-stick": _at_time(Target.REMOTE, "a stick of the remote control is pushed forwards"),
}
"""Every fault, by name."""


@dataclass(frozen=True)
class InjectedFault:
    """Requested fault: its value (NaN: none) and its start time after arming [s] (0: always active)."""

    value: float
    start: float


def parse_faults(
    words: Sequence[str], lockstep: bool = False, motors: int = 8, link: str = "serial"
) -> dict[str, InjectedFault]:
    """Parse faults `NAME[=VALUE][@TIME]`; return them by name.

    Args:
        words: options of the command line.
        lockstep: whether the emulator runs in lockstep.
        motors: number of motors of the robot.
        link: kind of link, a key of `LINKS`.

    Raises:
        SurefootError: unknown fault, a fault given twice, or a value out of range.
    """
    faults: dict[str, InjectedFault] = {}
    for word in words:
        rest, at, time = word.partition("@")
        name, equals, text = rest.partition("=")
        kind = FAULTS.get(name)
        if kind is None:
            raise SurefootError(f"'{name}' is not a fault; {suggest(name, FAULTS)}")
        if name in faults:
            raise SurefootError(f"fault {name} is given twice; give it once")
        if link not in kind.links:
            raise SurefootError(
                f"fault {name} acts on {kind.target}, which --link {link} does not have; give --link {kind.links[0]}"
            )
        if kind.real_time and lockstep:
            raise SurefootError(f"fault {name} concerns real time; it cannot be used with --lockstep")
        if equals and math.isnan(kind.value):
            raise SurefootError(f"fault {name} has no value; '{word}' gives one")
        if at and kind.unit == _AFTER_ARMING:
            raise SurefootError(f"fault {name} has its time as value, {name}=TIME; '{word}' gives another")
        value = _number(word, text) if equals else kind.value
        high = motors - (2 if name == "swap-motors" else 1) if kind.unit == _MOTOR else kind.high
        if equals and not kind.low <= value <= high:
            allowed = f"{kind.low:g} to {high:g}" if high < math.inf else f"{kind.low:g} or more"
            raise SurefootError(f"fault {name} is {value:g}; it must be {allowed} (unit: {kind.unit})")
        if kind.unit in (_MOTOR, _KIND) and value != round(value):
            raise SurefootError(f"fault {name} is {value:g}; it must be a whole number")
        start = _number(word, time) if at else 0.0 if math.isnan(kind.start) else kind.start
        if not 0 <= start < math.inf:
            raise SurefootError(f"fault {name} begins at {start:g} s; it must be 0 or more")
        faults[name] = InjectedFault(value, value if kind.unit == _AFTER_ARMING else start)
    return faults


def _number(word: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise SurefootError(f"fault '{word}' has no valid number; write NAME, NAME=VALUE or NAME=VALUE@TIME")
    return value


def describe() -> list[str]:
    """Return a list of all faults, one line each."""
    lines = []
    for name, kind in FAULTS.items():
        number = "" if math.isnan(kind.value) else f"={kind.value:g} ({kind.unit})"
        start = "" if math.isnan(kind.start) else f"@{kind.start:g} (s after arming)"
        only = f" [--link {kind.links[0]}]" if len(kind.links) == 1 else ""
        lines.append(f"{name}{number}{start}: {kind.meaning}{only}")
    return lines
