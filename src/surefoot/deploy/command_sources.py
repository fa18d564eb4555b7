"""Sources of commands to a steered robot: a file, the keyboard, a gamepad, or a channel that a program feeds.

The channel is UDP on this computer's loopback address. A datagram is one JSON object with numbers `forward`, `sideways`
[m/s] and `yaw_rate` [rad/s]; what is left out is 0. The newest one holds for `FRESH` seconds; then the robot stands.
Other datagrams are counted and ignored. The robot also stands when its gamepad or terminal is gone.
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

FRESH = 0.3
"""Age [s] up to which a command of the channel holds."""
_MAX_BYTES = 1024
"""Length of the longest datagram."""
_STEP = 0.1
"""Change of a command by one key, as a share of the greatest command."""
_KEYS = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1)}
_ESCAPE = re.compile(r"\x1b(?:\[[0-9;]*[ -~]|O?.)?")
"""Sequences of arrows and other keys without a letter; they end in letters that have another meaning."""
_AXES = {1: (0, -1), 0: (1, -1), 3: (2, -1)}
"""Axes of a gamepad: command and sign; sticks are positive to the right and backward."""
_DEAD_ZONE = 0.1
_EVENT = struct.Struct("<IhBB")
"""Linux's joystick interface: time [ms], value, type, number (kernel documentation, input/joydev)."""


class CommandSource(Protocol):
    """A source of commands; `read` returns at once and raises nothing."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) at a moment [s] of the run."""

    def close(self) -> None:
        """Release what the source holds."""


class FileCommands:
    """Commands over time, of a file; whoever runs the robot clamps them."""

    def __init__(self, path: Path) -> None:
        rows = read_schedule(path)
        self._schedule = CommandSchedule([rows], None, 1)
        self.duration = schedule_duration(rows)
        """How long a run takes that follows the file to its end [s]."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) at a moment [s] of the run."""
        return self._schedule.at(moment)

    def close(self) -> None:
        """Do nothing."""


class ChannelCommands(Channel[Array]):
    """Commands of another program, by UDP on the loopback address.

    Args:
        port: to listen on; 0 lets the system choose.
        clock: gives the time [s] by which commands age.

    Raises:
        SurefootError: the port is taken.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__("commands", port, parse_command, _MAX_BYTES, clock)

    def read(self, moment: float) -> Array:
        """Return the newest command (3,), or stand if none is fresh."""
        age = self.receive()
        return self.newest if self.newest is not None and age < FRESH else np.array(STAND_COMMAND)


def parse_command(values: Any) -> Array | None:
    """Return the command (3,) of a datagram's JSON; None if it is none."""
    if not isinstance(values, dict) or not set(values) <= set(COMMANDS) or not all(map(is_number, values.values())):
        return None
    return np.array([float(values.get(name, 0.0)) for name in COMMANDS])


def send_command(port: int, forward: float = 0.0, sideways: float = 0.0, yaw_rate: float = 0.0) -> None:
    """Send a command to the channel on this computer; within `FRESH` seconds another one must follow."""
    send(port, {"forward": forward, "sideways": sideways, "yaw_rate": yaw_rate})


class KeyboardCommands:
    """Commands of a terminal's keys: each press changes a command by a tenth of its range, space means stand.

    Raises:
        SurefootError: the standard input is no terminal.
    """

    def __init__(self, limits: CommandLimits, input_file: int | None = None) -> None:
        import termios
        import tty

        self._limits, self._command = limits, np.array(STAND_COMMAND)
        self._file = sys.stdin.fileno() if input_file is None else input_file
        if not os.isatty(self._file):
            raise SurefootError("commands: keyboard needs a terminal as standard input; choices: a file, gamepad, PORT")
        self._termios, self._before = termios, termios.tcgetattr(self._file)
        # Keys arrive at once and are not shown; Ctrl-C keeps its meaning.
        tty.setcbreak(self._file)

    def read(self, moment: float) -> Array:
        """Return the command (3,) that the keys have set."""
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
            changed = self._command[axis] + sign * _STEP * (high if sign > 0 else -low)
            # Steps add up with rounding; a command near zero is zero.
            near = abs(changed) < 0.5 * _STEP * max(abs(low), high)
            self._command = self._command.copy()
            self._command[axis] = 0.0 if near else np.clip(changed, low, high)

    def close(self) -> None:
        """Restore the terminal."""
        with contextlib.suppress(OSError, self._termios.error):
            self._termios.tcsetattr(self._file, self._termios.TCSADRAIN, self._before)


class GamepadCommands:
    """Commands of a gamepad's sticks: the left one forward and sideways, the right one turns.

    Raises:
        SurefootError: no gamepad.
    """

    def __init__(self, limits: CommandLimits, device: Path = Path("/dev/input/js0")) -> None:
        self._limits, self._axes, self._rest = limits, np.zeros(3), b""
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SurefootError(f"commands: gamepad {device}: {error.strerror}; is one connected?") from error

    def read(self, moment: float) -> Array:
        """Return the command (3,) of the sticks."""
        try:
            events = os.read(self._file, 64 * _EVENT.size)
            gone = not events
        except BlockingIOError:
            events, gone = b"", False
        except OSError:
            events, gone = b"", True
        self._rest += events
        whole = len(self._rest) // _EVENT.size * _EVENT.size
        for _, value, kind, number in _EVENT.iter_unpack(self._rest[:whole]):
            # Events with initial values have 0x80 in their kind.
            if kind & 0x7F == 2 and number in _AXES:
                axis, sign = _AXES[number]
                share = sign * value / 32767
                self._axes[axis] = 0.0 if abs(share) < _DEAD_ZONE else share
        self._rest = self._rest[whole:]
        if gone:
            self._axes[:] = 0.0
        return np.where(self._axes > 0, self._axes * self._limits.high, -self._axes * self._limits.low)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def open_commands(source: str, limits: CommandLimits) -> CommandSource:
    """Return the source that `--commands` names: `keyboard`, `gamepad`, a port's number, or a file's path.

    Raises:
        SurefootError: none of them, or one that can't be opened.
    """
    if source == "keyboard":
        return KeyboardCommands(limits)
    if source == "gamepad":
        return GamepadCommands(limits)
    if source.isdecimal():
        port = int(source)
        if not 1024 <= port <= 65535:
            raise SurefootError(f"commands: port is {port}; it must be 1024 to 65535")
        return ChannelCommands(port)
    return FileCommands(Path(source))
