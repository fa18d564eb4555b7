"""Sources of velocity commands: a file, the keyboard, a gamepad, or a UDP channel for other programs.

The channel listens on this computer's loopback address. A datagram is one JSON object with the numbers `forward`,
`sideways` [m/s] and `yaw_rate` [rad/s]; missing ones are 0. The newest command is valid for `MAX_COMMAND_AGE`; then the
robot stands. Other datagrams are counted and ignored. The robot also stands if its gamepad or terminal is disconnected.
"""

from __future__ import annotations

import contextlib
import os
import re
import select
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.deploy.channel import Channel, send
from surefoot.errors import SurefootError
from surefoot.robot.commands import COMMANDS, STAND_COMMAND, CommandLimits
from surefoot.task.commands import CommandSchedule, read_schedule, schedule_duration

MAX_COMMAND_AGE = 0.3
"""Time for which a command from the channel is valid [s]."""
_MAX_BYTES = 1024
"""Maximum size of a datagram [bytes]."""
_KEY_STEP = 0.1
"""Change of a command per key press, relative to its limit."""
_KEYS = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1)}
_ESCAPE = re.compile(r"\x1b(?:\[[0-9;]*[ -~]|O?.)?")
"""Escape sequences of arrow and other special keys; their final letters would be taken for commands."""
_AXES = {1: (0, -1), 0: (1, -1), 3: (2, -1)}
"""Index and sign of the command for each axis of a gamepad; sticks are positive to the right and backward."""
_DEAD_ZONE = 0.1
_EVENT = struct.Struct("<IhBB")
"""Linux's joystick interface: time [ms], value, type, number (kernel documentation, input/joydev)."""


class CommandSource(Protocol):
    """Source of velocity commands; `start` and `read` return immediately and raise nothing."""

    def start(self) -> None:
        """Begin a run: the robot stands until a command arrives. Those from before it are forgotten."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) at a moment [s] of the run."""

    def close(self) -> None:
        """Release the resources of the source."""


class FileCommands:
    """Velocity commands over time from a file; they are not clamped here."""

    def __init__(self, path: Path) -> None:
        rows = read_schedule(path)
        self._schedule = CommandSchedule([rows], None, 1)
        self.duration = schedule_duration(rows)
        """Duration of the schedule [s]."""

    def start(self) -> None:
        """Do nothing: a file's times count from the beginning of each run."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) at a moment [s] of the run."""
        return self._schedule.at(moment)

    def close(self) -> None:
        """Do nothing."""


class ChannelCommands(Channel[Array]):
    """Velocity commands from another program, by UDP on the loopback address.

    Args:
        port: port to listen on; 0 lets the system choose one.
        clock: returns the time that determines the age of commands [s].

    Raises:
        SurefootError: the port is in use.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__("commands", port, parse_command, _MAX_BYTES, clock)

    def start(self) -> None:
        """Forget the commands that other programs have sent."""
        self.discard()

    def read(self, moment: float) -> Array:
        """Return the newest command (3,), or zero if it is too old."""
        age = self.receive()
        return self.newest if self.newest is not None and age < MAX_COMMAND_AGE else np.array(STAND_COMMAND)


def parse_command(values: Any) -> Array | None:
    """Return the command (3,) in the JSON value of a datagram, or None if it is not a command."""
    if not isinstance(values, dict) or not set(values) <= set(COMMANDS) or not all(map(is_number, values.values())):
        return None
    return np.array([float(values.get(name, 0.0)) for name in COMMANDS])


def send_command(port: int, forward: float = 0.0, sideways: float = 0.0, yaw_rate: float = 0.0) -> None:
    """Send a command [m/s, m/s, rad/s] to the channel on this computer; repeat it within `MAX_COMMAND_AGE`."""
    send(port, {"forward": forward, "sideways": sideways, "yaw_rate": yaw_rate})


def keyboard_file(input_file: int | None = None) -> int:
    """Return the descriptor of the terminal from which keys are read; defaults to the standard input.

    Raises:
        SurefootError: it is not a terminal.
    """
    if input_file is None and sys.stdin is not None and not sys.stdin.closed:
        with contextlib.suppress(OSError):  # of a standard input without a descriptor
            input_file = sys.stdin.fileno()
    if input_file is None or not os.isatty(input_file):
        raise SurefootError("commands: keyboard needs a terminal as standard input; choices: a file, gamepad, PORT")
    return input_file


class KeyboardCommands:
    """Velocity commands from the keyboard: each key press changes a command by a tenth of its limit; space stops.

    Raises:
        SurefootError: the standard input is not a terminal.
    """

    def __init__(self, limits: CommandLimits, input_file: int | None = None) -> None:
        import termios
        import tty

        self._limits, self._command = limits, np.array(STAND_COMMAND)
        self._file = keyboard_file(input_file)
        self._termios, self._before = termios, termios.tcgetattr(self._file)
        # Keys arrive immediately and are not echoed; Ctrl-C still sends a signal.
        tty.setcbreak(self._file)

    def start(self) -> None:
        """Forget the keys that were pressed."""
        self.read(0.0)
        self._command = np.array(STAND_COMMAND)

    def read(self, moment: float) -> Array:
        """Return the command (3,) set by the keys."""
        with contextlib.suppress(OSError):
            while select.select([self._file], [], [], 0)[0]:
                keys = os.read(self._file, 64).decode("ascii", "ignore")
                for key in _ESCAPE.sub("", keys).lower():
                    self._press(key)
                if not keys:
                    self._press(" ")
                    break
        return self._command

    def _press(self, key: str) -> None:
        if key == " ":
            self._command = np.array(STAND_COMMAND)
        elif key in _KEYS:
            axis, sign = _KEYS[key]
            low, high = self._limits.low[axis], self._limits.high[axis]
            changed = self._command[axis] + sign * _KEY_STEP * (high if sign > 0 else -low)
            # Rounding errors of the steps add up: values close to zero become zero.
            is_zero = abs(changed) < 0.5 * _KEY_STEP * max(abs(low), high)
            self._command = self._command.copy()
            self._command[axis] = 0.0 if is_zero else np.clip(changed, low, high)

    def close(self) -> None:
        """Restore the terminal."""
        with contextlib.suppress(OSError, self._termios.error):
            self._termios.tcsetattr(self._file, self._termios.TCSADRAIN, self._before)


class GamepadCommands:
    """Velocity commands from a gamepad: the left stick sets forward and sideways speed, the right one the yaw rate.

    Raises:
        SurefootError: no gamepad is connected.
    """

    def __init__(self, limits: CommandLimits, device: Path = Path("/dev/input/js0")) -> None:
        self._limits, self._axes, self._rest = limits, np.zeros(3), b""
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SurefootError(f"commands: gamepad {device}: {error.strerror}; is one connected?") from error

    def start(self) -> None:
        """Do nothing: sticks have a position, which counts."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) set by the sticks."""
        try:
            events = os.read(self._file, 64 * _EVENT.size)
            disconnected = not events
        except BlockingIOError:
            events, disconnected = b"", False
        except OSError:
            events, disconnected = b"", True
        self._rest += events
        whole = len(self._rest) // _EVENT.size * _EVENT.size
        for _, value, kind, number in _EVENT.iter_unpack(self._rest[:whole]):
            # Bit 0x80 of the type marks initial values.
            if kind & 0x7F == 2 and number in _AXES:
                axis, sign = _AXES[number]
                deflection = sign * value / 32767
                self._axes[axis] = 0.0 if abs(deflection) < _DEAD_ZONE else deflection
        self._rest = self._rest[whole:]
        if disconnected:
            self._axes[:] = 0.0
        return np.where(self._axes > 0, self._axes * self._limits.high, -self._axes * self._limits.low)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


KEYBOARD = "keyboard"
"""Source that takes the terminal's keys."""


def open_commands(source: str, limits: CommandLimits) -> CommandSource:
    """Open the source named by `--commands`: `keyboard`, `gamepad`, a port number, or the path of a file.

    Raises:
        SurefootError: the source cannot be opened.
    """
    if source == KEYBOARD:
        return KeyboardCommands(limits)
    if source == "gamepad":
        return GamepadCommands(limits)
    if source.isdecimal():
        port = int(source)
        if not 1024 <= port <= 65535:
            raise SurefootError(f"commands: port is {port}; it must be 1024 to 65535")
        return ChannelCommands(port)
    return FileCommands(Path(source))
