"""Faults of an emulated robot, by name, as in `--fault NAME[=VALUE][@TIME]`: what each changes, and when."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from surefoot.arrays import Array
from surefoot.deploy.board.signals import MotorOrder, Sensors
from surefoot.deploy.messages import Handshake, Mode, Packet, State
from surefoot.errors import SurefootError, suggest

if TYPE_CHECKING:
    from surefoot.emulator.plant import Plant  # and with it the simulator, which a list of the faults does not need

HARMS = ("garbage", "drop", "cut-frames", "corrupt", "reorder", "duplicate")
"""What can happen to a packet on the line, in the order in which it is drawn; `FAULTS` describes each."""
_MOTOR = "number of the motor"
_AFTER_ARMING = "s after arming"
"""Over DDS nothing is armed: there these times count from the first command of a host."""
TILT_FORCE, TILT_TIME = 1.1, 0.4
"""Force of the push that topples a robot, over its weight, and its duration [s]."""
FALL_OF_VOLTAGE, RISE_OF_TEMPERATURE = 2.0, 40.0
"""Rates at which a battery becomes low [V/s] and a motor hot [degC/s]."""
_IMU_SIGNS = {1: (-1, 1), 2: (1, -1), 3: (-1, -1)}


_SERIAL, _DDS = ("serial",), ("dds",)
_ANY = (*_SERIAL, *_DDS)


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
    links: tuple[str, ...] = _ANY
    """Links that have it."""


def _rate(meaning: str, links: tuple[str, ...] = _ANY) -> FaultKind:
    return FaultKind(meaning, 0.05, high=1.0, unit="chance a frame", links=links)


def _at_time(meaning: str, links: tuple[str, ...] = _ANY) -> FaultKind:
    return FaultKind(meaning, 1.0, unit=_AFTER_ARMING, links=links)


def _motor(meaning: str, links: tuple[str, ...] = _ANY) -> FaultKind:
    return FaultKind(meaning, 0.0, unit=_MOTOR, links=links)


FAULTS: dict[str, FaultKind] = {
    "corrupt": _rate("one to three bits of a frame are flipped"),
    "drop": _rate("frames are lost"),
    "duplicate": _rate("frames come twice"),
    "reorder": _rate("frames come after the next one"),
    "garbage": _rate("bytes that nobody sent come between frames", links=_SERIAL),
    "cut-frames": _rate("only the beginning or the end of a frame comes", links=_SERIAL),
    "batching": FaultKind(
        "bytes to the host arrive in batches, as with some USB adapters",
        *(0.016, 0.0, 1.0, "s between batches"),
        real_time=True,
        links=_SERIAL,
    ),
    "unplug": _at_time("the cable is pulled"),
    "swap-motors": _motor("commands of a motor and of the one after it are exchanged"),
    "flip-sign": _motor("a motor turns the wrong way from its rest"),
    "flip-encoder": _motor("a motor's encoder reads the wrong way from its rest"),
    "imu-flip": FaultKind(
        "the IMU is mounted wrongly: 0 exchanges roll and pitch, 1 negates roll, 2 pitch, 3 both",
        *(0.0, 0.0, 3.0, "way"),
    ),
    "other-robot": FaultKind("the handshake names another robot", links=_SERIAL),
    "other-order": FaultKind("the handshake names the motors in another order", links=_SERIAL),
    "other-gains": FaultKind(
        "the handshake states other servo gains", 1.5, 0.0, 100.0, "times the nominal ones", links=_SERIAL
    ),
    "other-schema": FaultKind("the robot has another schema of the protocol", links=_SERIAL),
    "slow-servo": FaultKind(
        "the servo runs slower, and the handshake states it", 0.002, 0.001, 0.1, "s between two steps", links=_SERIAL
    ),
    "stale-state": _at_time("states repeat the readings of one"),
    "repeat-sequence": _at_time("all states have the same number"),
    "backward-sequence": _at_time("numbers of states decrease"),
    "late-states": FaultKind("readings are older than they should be", 0.02, 0.0, 0.06, "s more"),
    "battery-low": FaultKind("the battery's voltage without load falls, 2 V a second", 12.0, 1.0, 30.0, "V", start=1.0),
    "motor-hot": FaultKind("the first motor grows hot, 40 degC a second", 95.0, 0.0, 250.0, "degC", start=1.0),
    "tilt": _at_time("a hard push from the side topples the robot"),
    "reboot": _at_time("the microcontroller restarts and forgets its operator"),
    "hang": FaultKind("the microcontroller's program stands still", 0.2, 0.0, 60.0, "s", start=1.0),
    "overload": FaultKind("physics needs more than real time", 1.5, 0.0, 1000.0, "times real time", real_time=True),
    "not-finite": _at_time("the angle of the first motor is not a number", links=_DDS),
    "tick-restart": _at_time("ticks of states begin at 0 again", links=_DDS),
    "slow-states": FaultKind("states come less often", 50.0, 1.0, 500.0, "Hz", links=_DDS),
    "other-layout": FaultKind("states have another layout", links=_DDS),
    "motor-off": FaultKind("a motor switches itself off", 0.0, unit=_MOTOR, start=1.0, links=_DDS),
    "motor-lost": FaultKind("the messages of a motor are lost", 0.0, unit=_MOTOR, start=1.0, links=_DDS),
    "second-writer": _at_time("another program commands the motors", links=_DDS),
    "service-back": _at_time("the robot's own controller becomes active again", links=_DDS),
    "no-service": FaultKind("neither the motion switcher nor the sport service answers", links=_DDS),
    "remote-stop": _at_time("L2 and B of the remote control are pressed", links=_DDS),
    "remote-stick": _at_time("a stick of the remote control is pushed forwards", links=_DDS),
}
"""Every fault, by name."""


@dataclass(frozen=True)
class InjectedFault:
    """One fault as requested: its number, NaN where it takes none, and its start [s] after arming; 0: always active."""

    value: float
    start: float


def parse_faults(
    words: Sequence[str], lockstep: bool = False, motors: int = 8, link: str = "serial"
) -> dict[str, InjectedFault]:
    """Return faults by name, from words `NAME[=VALUE][@TIME]`, for a robot with so many motors and a kind of link.

    Raises:
        SurefootError: no such fault, a fault given twice, or a number that it does not take.
    """
    faults: dict[str, InjectedFault] = {}
    for word in words:
        rest, at, time = word.partition("@")
        name, equals, text = rest.partition("=")
        kind = FAULTS.get(name)
        if kind is None:
            raise SurefootError(f"'{name}' is no fault; {suggest(name, FAULTS)}")
        if name in faults:
            raise SurefootError(f"fault {name} is given twice; give it once")
        if link not in kind.links:
            raise SurefootError(f"fault {name} is one of --link {kind.links[0]}; it does not go with --link {link}")
        if kind.real_time and lockstep:
            raise SurefootError(f"fault {name} is about real time; it does not go with --lockstep")
        if equals and math.isnan(kind.value):
            raise SurefootError(f"fault {name} takes no number; '{word}' gives one")
        if at and kind.unit == _AFTER_ARMING:
            raise SurefootError(f"fault {name} takes its time as {name}=TIME; '{word}' gives another")
        value = _number(word, text) if equals else kind.value
        high = motors - (2 if name == "swap-motors" else 1) if kind.unit == _MOTOR else kind.high
        if equals and not kind.low <= value <= high:
            allowed = f"{kind.low:g} to {high:g}" if high < math.inf else f"{kind.low:g} or more"
            raise SurefootError(f"fault {name} is {value:g}; it must be {allowed} (unit: {kind.unit})")
        if kind.unit in (_MOTOR, "way") and value != round(value):
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
        raise SurefootError(f"fault '{word}' gives no number; write NAME, NAME=VALUE or NAME=VALUE@TIME")
    return value


def describe() -> list[str]:
    """Return one line per fault, for a list."""
    lines = []
    for name, kind in FAULTS.items():
        number = "" if math.isnan(kind.value) else f"={kind.value:g} ({kind.unit})"
        start = "" if math.isnan(kind.start) else f"@{kind.start:g} (s after arming)"
        only = f" [--link {kind.links[0]}]" if len(kind.links) == 1 else ""
        lines.append(f"{name}{number}{start}: {kind.meaning}{only}")
    return lines


class FaultInjector:
    """The faults of one robot; without any it changes nothing. Times are whole microseconds."""

    def __init__(self, faults: Mapping[str, InjectedFault], plant: Plant) -> None:
        self.faults, self._plant = faults, plant
        self.rest = plant.robot.resting_angles
        self.armed_at: int | None = None
        self.hangs_until = 0
        """When the microcontroller's program goes on."""
        self._now = 0
        self._order: MotorOrder | None = None
        self._changed_order: MotorOrder | None = None
        self._old: Packet | None = None
        self._number = 0

    def change_handshake(self, handshake: Handshake) -> Handshake:
        """Return what the robot states about itself."""
        faults = self.faults
        if "other-robot" in faults:
            handshake = replace(handshake, robot=f"not-{handshake.robot}"[:24])
        if "other-order" in faults:
            first, second, *others = handshake.motor_names
            handshake = replace(handshake, motor_names=(second, first, *others))
        if fault := faults.get("other-gains"):
            kp, kd = handshake.servo_kp * fault.value, handshake.servo_kd * fault.value
            handshake = replace(handshake, servo_kp=kp, servo_kd=kd)
        if fault := faults.get("slow-servo"):
            handshake = replace(handshake, servo_period=fault.value)
        return handshake

    def _since(self, fault: InjectedFault) -> float:
        return -math.inf if self.armed_at is None else (self._now - self.armed_at) / 1e6 - fault.start

    def active(self, name: str) -> InjectedFault | None:
        """Return a fault that was requested and acts now; one that begins at 0 acts before anything is armed."""
        fault = self.faults.get(name)
        return fault if fault and (fault.start == 0 or self._since(fault) >= 0) else None

    def began(self, name: str) -> bool:
        """Return whether a fault was requested and its time after arming has passed."""
        return name in self.faults and self._since(self.faults[name]) >= 0

    @property
    def chances(self) -> dict[str, float]:
        """Chance per frame of each harm on the line that has begun."""
        return {name: fault.value for name in HARMS if (fault := self.active(name))}

    def tick(self, now: int, armed: bool) -> None:
        """Take the end of a servo step, and whether the robot is armed."""
        self._now = now
        if armed and self.armed_at is None:
            self.armed_at = now
        if self.armed_at is None:
            return
        plant = self._plant
        if fault := self.active("battery-low"):
            fall = max(plant.start_voltage - fault.value, 0.0)
            plant.voltage_drop = min(FALL_OF_VOLTAGE * max(self._since(fault), 0.0), fall)
        if (fault := self.active("motor-hot")) and plant.temperature[0] < fault.value:
            plant.temperature[0] += RISE_OF_TEMPERATURE * plant.robot.timing.servo_step
        if fault := self.faults.get("tilt"):
            force = TILT_FORCE * plant.robot.weight if 0 <= self._since(fault) < TILT_TIME else 0.0
            plant.push(np.array([0.0, force, 0.0]))
        if not self.hangs_until and self.began("hang"):
            self.hangs_until = now + round(self.faults["hang"].value * 1e6)

    def order(self, order: MotorOrder) -> MotorOrder:
        """Return what the motors get instead of an order; the same object for the same order."""
        if order is not self._order:
            self._order, self._changed_order = order, self._change_order(order)
        return self._changed_order or order

    def _change_order(self, order: MotorOrder) -> MotorOrder:
        servo, sign = self._wiring()
        values = order.values[servo]
        # An angle is mirrored at the resting angle, a duty at zero.
        middle = self.rest if order.mode == Mode.POSITION else 0.0
        return replace(order, values=np.where(sign < 0, 2 * middle - values, values))

    def _wiring(self) -> tuple[NDArray[np.int64], Array]:
        """Return, for each motor, the servo that it is wired to, and -1 where it turns the wrong way (M,)."""
        servo, sign = np.arange(len(self.rest)), np.ones(len(self.rest))
        if fault := self.active("swap-motors"):
            motor = int(fault.value)
            servo[[motor, motor + 1]] = motor + 1, motor
        if fault := self.active("flip-sign"):
            sign[int(fault.value)] = -1.0
        return servo, sign

    def servo_readings(self, seen: Sensors) -> Sensors:
        """Return what a microcontroller's own servos read, wired to the wrong motors or the wrong way round."""
        if not self.faults:
            return seen
        servo, sign = self._wiring()
        angle = self.rest + sign * (seen.motor_angle - self.rest)
        velocity, torque = sign * seen.motor_velocity, sign * seen.motor_torque
        return replace(seen, motor_angle=angle[servo], motor_velocity=velocity[servo], motor_torque=torque[servo])

    def efforts(self, effort: Array) -> Array:
        """Return what motors get (M,), of a microcontroller's own servos."""
        if not self.faults:
            return effort
        servo, sign = self._wiring()
        return np.asarray(sign * effort[servo])

    def sensors(self, seen: Sensors) -> Sensors:
        """Return the readings with the faults of the sensors."""
        if fault := self.active("flip-encoder"):
            motor = int(fault.value)
            angle, velocity = seen.motor_angle.copy(), seen.motor_velocity.copy()
            angle[motor], velocity[motor] = 2 * self.rest[motor] - angle[motor], -velocity[motor]
            seen = replace(seen, motor_angle=angle, motor_velocity=velocity)
        if fault := self.active("imu-flip"):
            angles, rates = seen.roll_pitch_yaw.copy(), seen.angular_velocity_base.copy()
            for array in (angles, rates):
                array[:2] = array[[1, 0]] if fault.value == 0 else array[:2] * _IMU_SIGNS[int(fault.value)]
            seen = replace(seen, roll_pitch_yaw=angles, angular_velocity_base=rates)
        return seen

    def packet(self, packet: Packet) -> Packet:
        """Return what is sent instead of a packet."""
        if isinstance(packet.message, Handshake):
            packet = replace(packet, message=self.change_handshake(packet.message))
        elif isinstance(packet.message, State):
            if self.began("stale-state"):
                self._old = self._old or packet
                packet = replace(packet, message=self._old.message, time=self._old.time)
            if self.began("repeat-sequence"):
                packet = replace(packet, sequence=max(self._number, 1))
            elif self.began("backward-sequence"):
                packet = replace(packet, sequence=max(self._number - 1, 1))
        self._number = packet.sequence
        return packet
