"""Robot's end of a pseudo-terminal, whose other end hosts open as a serial port."""

from __future__ import annotations

import os
import select
import tty
from pathlib import Path

from surefoot.deploy.serial.terminal_input import TerminalInput
from surefoot.errors import SurefootError


class PtyPort:
    """Pseudo-terminal in raw mode. It blocks only with a timeout.

    Args:
        link: symbolic link to create; it is removed when the port is closed.
        held: whether to keep the hosts' end open as well, so that nothing happens when the last host closes it.

    Raises:
        SurefootError: the link exists.
    """

    def __init__(self, link: Path | None = None, held: bool = True) -> None:
        self._master, slave = os.openpty()
        tty.setraw(slave)
        os.set_blocking(self._master, False)
        self.path = os.ttyname(slave)
        self._slave = slave if held else None
        if not held:
            os.close(slave)
        self._input = TerminalInput(self._master)
        self._hangup = select.poll()
        self._hangup.register(self._master, select.POLLIN)
        self.unread = 0
        """Number of frames dropped because no host read the earlier ones."""
        self._link = link
        if link is not None:
            if link.is_symlink() and not link.exists():
                link.unlink()  # left by an emulator that was killed
            try:
                link.symlink_to(self.path)
            except FileExistsError:
                raise SurefootError(f"link {link} exists; give another name") from None

    def read(self) -> bytes:
        """Return the bytes that hosts have written."""
        try:
            return self._input.read()
        except OSError:  # no host
            return b""

    def has_no_host(self) -> bool:
        """Return whether no host has the port open and all data were read; False for a held port."""
        events = sum(event for _, event in self._hangup.poll(0))
        return bool(events & select.POLLHUP) and not events & select.POLLIN

    def wait(self, timeout: float) -> bool:
        """Wait until data can be read, at most `timeout` [s]; return whether they can."""
        return self._input.wait(timeout)

    def write(self, data: bytes, patience: float = 0.0) -> None:
        """Write to the hosts; drop data that they do not read within `patience` [s]."""
        while data:
            try:
                data = data[os.write(self._master, data) :]
            except BlockingIOError:
                if patience <= 0 or not select.select([], [self._master], [], patience)[1]:
                    self.unread += 1
                    return
            except OSError:  # a host has just closed a port that is not held
                return

    def close(self) -> None:
        """Close the port, and remove the link."""
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        self._input.close()
        os.close(self._master)
        if self._slave is not None:
            os.close(self._slave)
