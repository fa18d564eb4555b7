"""Processes of a link over DDS, the keeper and its watcher: how they start, what they get, and how they end."""

from __future__ import annotations

import contextlib
import pickle
import select
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from surefoot.deploy.board.limits import Limits
from surefoot.deploy.dds.bus import Bus, RawWriter
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.messages import Handshake
from surefoot.deploy.pacer import BOARD_PRIORITY, real_time_priority
from surefoot.errors import SurefootError
from surefoot.stop_signals import ALL

_READY = "ready"
_START_TIMEOUT, _DISCOVERY_TIMEOUT = 20.0, 2.0
"""Longest time [s] to start, and to find the robot's reader of commands."""


@dataclass(frozen=True)
class LinkConfig:
    """What the processes of a link must know."""

    handshake: Handshake
    limits: Limits
    interface: str
    domain: int


class Child:
    """A process of the link, in a session of its own: no signal of the terminal reaches it.

    Args:
        module: what it runs.
        config: its configuration.
        ends: its ends of sockets to others.
    """

    def __init__(self, module: str, config: LinkConfig, ends: Sequence[socket.socket]) -> None:
        self.name = module.rpartition(".")[2]
        self._errors = tempfile.TemporaryFile()  # noqa: SIM115
        descriptors = [end.fileno() for end in ends]
        self._process = subprocess.Popen(
            [sys.executable, "-m", module, *map(str, descriptors)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._errors,
            pass_fds=descriptors,
            start_new_session=True,
        )
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):
            pickle.dump(config, self._process.stdin)
            self._process.stdin.close()

    @property
    def pid(self) -> int:
        """Its number among the computer's processes."""
        return self._process.pid

    def await_ready(self) -> None:
        """Wait until the process has started.

        Raises:
            SurefootError: it does not start.
        """
        output = self._process.stdout
        assert output is not None
        started = select.select([output], [], [], _START_TIMEOUT)[0]
        line = output.readline().decode().strip() if started else f"it does not start within {_START_TIMEOUT:g} s"
        if line != _READY:
            raise SurefootError(line or self.exit_message())

    def exit_message(self) -> str:
        """Return how the process has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"the {self.name} process has ended{f': {lines[-1]}' if lines else ''}"

    def finish(self, timeout: float) -> None:
        """Wait until the process has ended by itself; kill it after `timeout` [s]."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()


class Runnable(Protocol):
    """What a process does once it has started."""

    def run(self) -> None:
        """Run to the end."""


def serve(prepare: Callable[[LinkConfig, Bus, list[SocketPort]], Runnable]) -> int:
    """Run a process of the link, which `Child` has started; return its exit code.

    Signals of a terminal or a service do not end it: the control loop brings the robot to rest first, and ends this
    process by closing its socket.
    """
    for name in ALL:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    config: LinkConfig = pickle.load(sys.stdin.buffer)
    ports = [SocketPort(socket.socket(fileno=int(word)), "the other process") for word in sys.argv[1:]]
    # Threads of DDS get this priority too: a state that waits for a busy computer is a late one.
    with real_time_priority(BOARD_PRIORITY, threads=True):
        try:
            child = prepare(config, Bus(config.interface, config.domain), ports)
        except SurefootError as error:
            print(error, flush=True)
            return 2
        print(_READY, flush=True)
        child.run()
    return 0


def await_readers(writer: RawWriter) -> None:
    """Wait until DDS has found a reader, so that no message is lost; at most `_DISCOVERY_TIMEOUT`."""
    end = time.monotonic() + _DISCOVERY_TIMEOUT
    while not writer.readers and time.monotonic() < end:
        time.sleep(0.01)
