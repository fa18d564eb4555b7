"""Message faults of an emulated Go2: in the fields of states, in their bytes, and in commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.dds.low_level import STATE_PERIOD, Record, RemoteControl, new_command
from surefoot.emulator.dds.low_state import StateMessage
from surefoot.emulator.faults import FaultInjector, flip_bits
from surefoot.emulator.plant import JointCommand
from surefoot.seeding import generator

_OMITTED_BYTES = 12
"""Bytes that the other layout omits at the end: `fan_frequency` and `reserve`."""
_HEADER_BITS = 32
"""Size of the CDR header, which is never damaged [bits]."""
_STOP = RemoteControl(frozenset({"L2", "B"}), 0.0, 0.0, 0.0, 0.0)
_STICK = RemoteControl(frozenset(), 0.0, 0.8, 0.0, 0.0)
_OTHER_GAINS = 5.0, 1.0
"""Gains of the other program, from the vendor's low-level example."""


class MessageFaults:
    """Applies faults to a robot's messages. Times are whole microseconds.

    In the descriptions of faults, the sequence number of a state is its tick.

    Args:
        injector: requested faults and their start times.
        seed: seed of random faults.
    """

    def __init__(self, injector: FaultInjector, seed: int) -> None:
        self._injector = injector
        self.enabled = bool(injector.faults)
        self._random = generator(seed, "faults of messages")
        self._tick = 0
        self._tick_zero: int | None = None
        self._old: bytes | None = None
        self._late: bytes | None = None
        self._lost: tuple[float, ...] | None = None
        self._kept: JointCommand | None = None
        self._other: Record | None = None

    def _motor(self, name: str) -> int | None:
        fault = self._injector.active_fault(name)
        return None if fault is None else int(fault.value)

    def _occurs(self, name: str) -> bool:
        fault = self._injector.active_fault(name)
        return fault is not None and bool(self._random.random() < fault.value)

    @property
    def period(self) -> int:
        """Period of states."""
        fault = self._injector.active_fault("slow-states")
        return round(1e6 * STATE_PERIOD) if fault is None else round(1e6 / fault.value)

    @property
    def delay(self) -> int:
        """Transmission time of a state."""
        fault = self._injector.active_fault("late-states")
        return 0 if fault is None else round(1e6 * fault.value)

    def joint_command(self, command: JointCommand) -> JointCommand:
        """Return the command that reaches the motors."""
        servo, sign = self._injector.wiring()
        columns = {name: values[servo] for name, values in vars(command).items()}
        angle = columns["angle"]
        columns["angle"] = np.where(sign < 0, 2 * self._injector.rest - angle, angle)
        for name in ("speed", "feedforward"):
            columns[name] *= sign
        if (motor := self._motor("motor-lost")) is not None:
            self._kept = self._kept or replace(command)
            for name, values in columns.items():
                values[motor] = getattr(self._kept, name)[motor]
        if (motor := self._motor("motor-off")) is not None:
            for name in ("feedforward", "kp", "kd"):
                columns[name][motor] = 0.0
        return JointCommand(**columns)

    def drops_command(self) -> bool:
        """Return whether a command is lost, or damaged and therefore ignored."""
        return self._occurs("drop") or self._occurs("corrupt")

    def change(self, message: StateMessage, now: int) -> None:
        """Apply faults to the fields of a state message."""
        injector, record, motors = self._injector, message.record, message.motors
        if (motor := self._motor("motor-off")) is not None:
            motors["mode"][motor] = 0
            motors["lost"][motor] += 1
        if (motor := self._motor("motor-lost")) is not None:
            fields = ("q", "dq", "tau_est")
            self._lost = self._lost or tuple(float(motors[name][motor]) for name in fields)
            for name, value in zip(fields, self._lost, strict=True):
                motors[name][motor] = value
            motors["lost"][motor] += 1
        if injector.active_fault("not-finite"):
            motors["q"][0] = np.nan
        for name, remote in (("remote-stop", _STOP), ("remote-stick", _STICK)):
            if injector.active_fault(name):
                record["wireless_remote"] = remote.encode()
        if injector.active_fault("tick-restart"):
            self._tick_zero = now if self._tick_zero is None else self._tick_zero
            record["tick"] = (now - self._tick_zero) // 1000
        if injector.active_fault("repeat-sequence"):
            record["tick"] = self._tick
        elif injector.active_fault("backward-sequence"):
            record["tick"] = max(self._tick - 2, 0)
        self._tick = int(record["tick"])

    def packets(self, data: bytes) -> list[bytes]:
        """Return the messages to send instead of an encoded state."""
        injector = self._injector
        if injector.active_fault("stale-state"):
            data = self._old = self._old or data
        if injector.active_fault("other-layout"):
            data = data[:-_OMITTED_BYTES]
        if self._occurs("drop"):
            return []
        if self._occurs("corrupt"):
            data = flip_bits(data, self._random, first=_HEADER_BITS)
        late, self._late = self._late, None
        if late is None and self._occurs("reorder"):
            self._late = data
            return []
        packets = [data, data] if self._occurs("duplicate") else [data]
        return packets if late is None else [*packets, late]

    def other_command(self, angles: Array) -> Record | None:
        """Return the command of another program, or None; it holds the angles (12,) at its start [rad]."""
        if not self._injector.active_fault("second-writer"):
            return None
        if self._other is None:
            self._other = new_command()
            motors = self._other["motor_cmd"][: len(angles)]
            motors["q"], motors["dq"] = angles, 0.0
            motors["kp"], motors["kd"] = _OTHER_GAINS
        return self._other
