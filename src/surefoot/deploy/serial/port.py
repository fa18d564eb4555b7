"""Non-blocking serial port for exclusive use by one program."""

from __future__ import annotations

import contextlib
import errno
import os

import serial

from surefoot.deploy.robot_link import LinkLostError
from surefoot.deploy.serial.terminal_input import TerminalInput
from surefoot.errors import SurefootError

BAUD = 921_600


class SerialPort:
    """Serial port or pseudo-terminal, locked against other programs while it is open.

    Args:
        path: path of the device, such as /dev/ttyUSB0.
        baud: bit rate [1/s]; a byte takes 10 bits.

    Raises:
        SurefootError: no such port, no permission, or another program uses it.
    """

    def __init__(self, path: str, baud: int = BAUD) -> None:
        self.path = path
        try:
            self._serial = serial.Serial(path, baud, timeout=0, write_timeout=0, exclusive=True)
        except (serial.SerialException, OSError, ValueError) as error:
            number = getattr(error, "errno", None)
            if number == errno.EAGAIN or "exclusively lock" in str(error):
                raise SurefootError(f"port {path}: another program uses it; only one operator at a time") from error
            reason = os.strerror(number) if number else str(error)
            raise SurefootError(f"port {path}: can't be opened: {reason}") from error
        self._file = self._serial.fileno()
        os.set_blocking(self._file, False)
        self._input = TerminalInput(self._file)
        # Without it, USB adapters delay bytes by up to 16 ms. Pseudo-terminals and some adapters have no such mode.
        with contextlib.suppress(OSError, ValueError, NotImplementedError):
            self._serial.set_low_latency_mode(True)

    def read(self) -> bytes:
        """Return the bytes that have arrived, possibly none, without waiting."""
        try:
            return self._input.read()
        except OSError as error:
            raise LinkLostError(f"port {self.path} is gone: {error.strerror}") from error

    def write(self, data: bytes) -> int:
        """Write bytes without waiting; return how many were accepted."""
        try:
            return os.write(self._file, data)
        except BlockingIOError:
            return 0
        except OSError as error:
            raise LinkLostError(f"port {self.path} is gone: {error.strerror}") from error

    def wait(self, timeout: float) -> None:
        """Wait until data can be read, at most `timeout` [s]."""
        self._input.wait(timeout)

    def close(self) -> None:
        """Release the port."""
        self._input.close()
        self._serial.close()
