"""Where commands to a steered robot come from: a file, the keyboard, a gamepad, or a channel that a program feeds.

The channel is UDP on this computer's loopback address. A datagram is one JSON object with numbers `forward`, `sideways`
[m/s] and `yaw_rate` [rad/s]; what is left out is 0. The newest one counts for `FRESH` seconds; then the robot is told
to stand. What is not such a datagram is counted and ignored. A gamepad that is gone means stand, too.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import select
import socket
import struct
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import numpy as np

from surefoot.arrays import Array
from surefoot.configuration import is_number
from surefoot.errors import SurefootError
from surefoot.robot.commands import COMMANDS, STAND, CommandLimits
from surefoot.task.commands import CommandSchedule, read_schedule

FRESH = 0.3
"""Age [s] from which a command of the channel means stand."""
_LONGEST = 1024
"""Bytes of a datagram that is looked at."""
_MOST_AT_ONCE = 64
"""Datagrams that are taken in one control step; older ones wait, or are dropped by the system."""
_STEP = 0.1
"""What a key changes, in greatest commands."""
_KEYS = {"w": (0, 1), "s": (0, -1), "a": (1, 1), "d": (1, -1), "q": (2, 1), "e": (2, -1)}
KEYS = "w/s forward, a/d sideways, q/e turn, space stand"
_ESCAPE = re.compile(r"\x1b(?:\[[0-9;]*[ -~]|O?.)?")
"""What arrows and other keys without a letter send; they end in letters that mean something else."""
_AXES = {1: (0, -1), 0: (1, -1), 3: (2, -1)}
"""Axes of a gamepad: command and sign; sticks are positive to the right and backward."""
_DEAD_ZONE = 0.1
_EVENT = struct.Struct("<IhBB")
"""Linux's joystick interface: time [ms], value, type, number (kernel documentation, input/joydev)."""


class CommandSource(Protocol):
    """Where commands come from; reading takes no time and raises nothing."""

    def read(self, moment: float) -> Array:
        """Return the command (3,) that holds at a moment [s] of the run."""
        ...

    def close(self) -> None:
        """Give back what is held."""
        ...


class FileCommands:
    """Commands over time, of a file; who runs the robot clamps them, and says so."""

    def __init__(self, path: Path) -> None:
        self._schedule = CommandSchedule([read_schedule(path)], None, 1)

    def read(self, moment: float) -> Array:
        """Return the command (3,) that holds at a moment [s] of the run."""
        return self._schedule.at(moment)

    def close(self) -> None:
        """Give back nothing."""


class ChannelCommands:
    """Commands of another program, by UDP on the loopback address.

    Args:
        port: to listen on; 0 lets the system choose.
        clock: gives the time [s] by which commands age.

    Raises:
        SurefootError: the port is taken.
    """

    def __init__(self, port: int, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._command, self._at = clock, np.array(STAND), -math.inf
        self.refused = 0
        """Datagrams that were no commands."""
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind(("127.0.0.1", port))
        except OSError as error:
            self._socket.close()
            raise SurefootError(f"commands: port {port} can't be listened on: {error.strerror}") from error
        self._socket.setblocking(False)
        self.port = int(self._socket.getsockname()[1])

    def read(self, moment: float) -> Array:
        """Return the newest command (3,), or stand if there is none that is fresh."""
        for _ in range(_MOST_AT_ONCE):
            try:
                data = self._socket.recv(_LONGEST + 1)
            except OSError:
                break
            command = parse_command(data)
            if command is None:
                self.refused += 1
            else:
                self._command, self._at = command, self._clock()
        return self._command if self._clock() - self._at < FRESH else np.array(STAND)

    def close(self) -> None:
        """Stop listening."""
        self._socket.close()


def parse_command(data: bytes) -> Array | None:
    """Return the command (3,) of a datagram; None if it is none."""
    if len(data) > _LONGEST:
        return None
    try:
        given = json.loads(data)
    except (ValueError, RecursionError):
        return None
    if not isinstance(given, dict) or not set(given) <= set(COMMANDS) or not all(map(is_number, given.values())):
        return None
    return np.array([float(given.get(name, 0.0)) for name in COMMANDS])


def send_command(port: int, forward: float = 0.0, sideways: float = 0.0, yaw_rate: float = 0.0) -> None:
    """Send a command to the channel on this computer; within `FRESH` seconds another one must follow."""
    data = json.dumps({"forward": forward, "sideways": sideways, "yaw_rate": yaw_rate}).encode()
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        sender.sendto(data, ("127.0.0.1", port))


class KeyboardCommands:
    """Commands of a terminal's keys: each press changes a command by a tenth of its range, space means stand.

    Raises:
        SurefootError: the standard input is no terminal.
    """

    def __init__(self, limits: CommandLimits, input_file: int | None = None) -> None:
        import termios
        import tty

        self._limits, self._command = limits, np.array(STAND)
        self._file = sys.stdin.fileno() if input_file is None else input_file
        if not os.isatty(self._file):
            raise SurefootError("commands: keyboard needs a terminal as standard input; choices: a file, gamepad, PORT")
        self._termios, self._before = termios, termios.tcgetattr(self._file)
        # Keys come at once and are not shown; Ctrl-C stays what it is.
        tty.setcbreak(self._file)

    def read(self, moment: float) -> Array:
        """Return the command (3,) that the keys have set."""
        with contextlib.suppress(OSError):
            while select.select([self._file], [], [], 0)[0]:
                keys = os.read(self._file, 64).decode("ascii", "ignore")
                if not keys:
                    self._command = np.array(STAND)
                    break
                for key in _ESCAPE.sub("", keys).lower():
                    self._press(key)
        return self._command

    def _press(self, key: str) -> None:
        if key == " ":
            self._command = np.array(STAND)
        elif key in _KEYS:
            which, sign = _KEYS[key]
            most = self._limits.high if sign > 0 else -self._limits.low
            changed = self._command[which] + sign * _STEP * most[which]
            self._command = self._command.copy()
            # Small steps add up with rounding; a command near zero is zero.
            near = abs(changed) < 0.5 * _STEP * max(abs(self._limits.low[which]), self._limits.high[which])
            self._command[which] = 0.0 if near else np.clip(changed, self._limits.low[which], self._limits.high[which])

    def close(self) -> None:
        """Give the terminal back as it was."""
        with contextlib.suppress(OSError, self._termios.error):
            self._termios.tcsetattr(self._file, self._termios.TCSADRAIN, self._before)


class GamepadCommands:
    """Commands of a gamepad's sticks: left one forward and sideways, right one turns; stand when it is gone.

    Raises:
        SurefootError: no gamepad.
    """

    def __init__(self, limits: CommandLimits, device: Path = Path("/dev/input/js0")) -> None:
        self._limits, self._axes = limits, np.zeros(3)
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise SurefootError(f"commands: gamepad {device}: {error.strerror}; is one connected?") from error
        self._rest = b""

    def read(self, moment: float) -> Array:
        """Return the command (3,) of the sticks."""
        try:
            events = os.read(self._file, 64 * _EVENT.size)
            self._rest += events
            gone = not events
        except BlockingIOError:
            gone = False
        except OSError:
            gone = True
        whole = len(self._rest) // _EVENT.size * _EVENT.size
        for _, value, kind, number in _EVENT.iter_unpack(self._rest[:whole]):
            # The first events tell where axes are (0x80).
            if kind & 0x7F == 2 and number in _AXES:
                which, sign = _AXES[number]
                share = sign * value / 32767
                self._axes[which] = 0.0 if abs(share) < _DEAD_ZONE else share
        self._rest = self._rest[whole:]
        if gone:
            self._axes[:] = 0.0
        return np.where(self._axes > 0, self._axes * self._limits.high, -self._axes * self._limits.low)

    def close(self) -> None:
        """Close the device."""
        os.close(self._file)


def open_commands(given: str, limits: CommandLimits) -> CommandSource:
    """Return the source that `--commands` names: `keyboard`, `gamepad`, a port's number, or a file's path.

    Raises:
        SurefootError: none of them, or one that can't be opened.
    """
    if given == "keyboard":
        return KeyboardCommands(limits)
    if given == "gamepad":
        return GamepadCommands(limits)
    if given.isdecimal():
        port = int(given)
        if not 1024 <= port <= 65535:
            raise SurefootError(f"commands: port is {port}; it must be 1024 to 65535")
        return ChannelCommands(port)
    return FileCommands(Path(given))
