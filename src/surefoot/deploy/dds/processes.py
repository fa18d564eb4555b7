"""Start and end of the processes behind a DDS link: the supervisor and its watchdog."""

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
from surefoot.stop_signals import STOP_SIGNALS

_READY = "ready"
_START_TIMEOUT, _DISCOVERY_TIMEOUT = 20.0, 2.0
"""Maximum times to start a process, and to discover the robot's reader of motor commands [s]."""


@dataclass(frozen=True)
class LinkConfig:
    """Configuration of supervisor and watchdog: handshake and limits of the robot, network interface, DDS domain."""

    handshake: Handshake
    limits: Limits
    interface: str
    domain: int


class Child:
    """Child process of a link, in a session of its own, so that signals of the terminal do not reach it.

    Args:
        module: Python module to run.
        config: its configuration, sent through standard input.
        ends: sockets that the process inherits.
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
        """Process number."""
        return self._process.pid

    def await_ready(self) -> None:
        """Wait until the process reports that it is ready.

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
        """Return a message with the last error of a process that has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(1.0)
        self._errors.seek(0)
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"the {self.name} process has ended{f': {lines[-1]}' if lines else ''}"

    def finish(self, timeout: float) -> None:
        """Wait until the process exits; kill it after `timeout` [s]."""
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._process.stdout is not None:
            self._process.stdout.close()
        self._errors.close()


class Runnable(Protocol):
    """Main loop of a child process."""

    def run(self) -> None:
        """Run until the process should exit."""


def serve(prepare: Callable[[LinkConfig, Bus, list[SocketPort]], Runnable]) -> int:
    """Run a process that `Child` has started, from configuration to end; return its exit code.

    Signals of a terminal or a service manager are ignored: the control loop first brings the robot to rest, then ends
    this process by closing its socket.
    """
    for name in STOP_SIGNALS:
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    config: LinkConfig = pickle.load(sys.stdin.buffer)
    ports = [SocketPort(socket.socket(fileno=int(word)), "the other process") for word in sys.argv[1:]]
    # The threads of DDS also get this priority; otherwise states are late on a busy computer.
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
    """Wait until DDS has discovered a reader, at most `_DISCOVERY_TIMEOUT`; earlier messages would be lost."""
    end = time.monotonic() + _DISCOVERY_TIMEOUT
    while not writer.readers and time.monotonic() < end:
        time.sleep(0.01)
