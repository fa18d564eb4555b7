"""Processes for tests: `surefoot` commands, emulated robots, and a measure of how busy the computer is."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

from surefoot import progress
from surefoot.cli.main import main

SUREFOOT = (sys.executable, "-m", "surefoot")
BUSY = 0.003
"""Lateness of a bare loop above which the computer is too busy for real-time tests [s]: half a control step of 6 ms."""


def surefoot(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """Run a command in this process, without a display; return its result."""
    out, err = io.StringIO(), io.StringIO()
    environment = {"COLUMNS": "100", "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    with contextlib.ExitStack() as stack:
        for context in (contextlib.redirect_stdout(out), contextlib.redirect_stderr(err), contextlib.chdir(cwd or ".")):
            stack.enter_context(context)
        stack.enter_context(mock.patch.dict(os.environ, environment))
        # Even on a slow computer, no lines of a progress bar are printed to standard error.
        stack.enter_context(mock.patch.object(progress, "_LINE_PERIOD", math.inf))
        try:
            code = main(list(map(str, words)))
        except SystemExit as end:  # such as by --help
            code = int(end.code or 0)
    return subprocess.CompletedProcess(words, code, out.getvalue(), err.getvalue())


def printed_commands(text: str) -> dict[str, list[str]]:
    """Return the arguments of all commands suggested in an output as `to PURPOSE: COMMAND`, by purpose."""
    return {purpose: shlex.split(command) for purpose, command in re.findall(r"^to ([^:\n]+): (.+)$", text, re.M)}


def assert_rejected(done: subprocess.CompletedProcess[str], *parts: str) -> None:
    """Check that a command was rejected: exit code 2, no stdout, and one line on stderr with all parts."""
    assert done.returncode == 2, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("surefoot: error: ")
    assert done.stderr.count("\n") == 1
    for part in parts:
        assert part in done.stderr


def wait_until(condition: Callable[[], bool], seconds: float = 400.0) -> None:
    """Wait until a condition holds, or fail after some time."""
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, "it did not come in time"
        time.sleep(0.05)


def run_surefoot(*words: object, timeout: float = 200, **how: Any) -> subprocess.CompletedProcess[str]:
    """Run a command in a separate process; return its result."""
    return subprocess.run([*SUREFOOT, *map(str, words)], capture_output=True, text=True, timeout=timeout, **how)


@contextmanager
def serve_page(*words: object, cwd: Path | None = None) -> Iterator[str]:
    """Context manager that runs a command that serves a page on a free port; yield the page's address."""
    command = [*SUREFOOT, *map(str, words), "--page-port", "0"]
    process = subprocess.Popen(command, cwd=cwd, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        yield process.stdout.readline().split()[0]
    finally:
        process.kill()
        process.communicate()


class Emulator:
    """Running `surefoot emulate` process; `port` is its pseudo-terminal, or its DDS domain."""

    def __init__(self, *words: object) -> None:
        command = [*SUREFOOT, "emulate", *map(str, words)]
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line.startswith("robot on "):
            raise AssertionError(f"printed {line!r}, {self.process.communicate()}")
        self.port = line.split()[-1]
        self._stderr: str | None = None

    def stop(self) -> tuple[int, str]:
        """Terminate the process; return its exit code and its standard error."""
        if self._stderr is None:
            if self.process.poll() is None:
                self.process.terminate()
            _, self._stderr = self.process.communicate(timeout=30)
        return self.process.returncode, self._stderr


class EmulatorHere:
    """`surefoot emulate` in a thread of this process: in lockstep, or in real time with `--baud 0`."""

    def __init__(self, *words: object) -> None:
        from surefoot.cli.emulate import EmulateCommand, make_loop
        from surefoot.cli.helpers.parsing import parse
        from surefoot.emulator.fault_table import parse_faults
        from surefoot.emulator.real_time import Summary
        from surefoot.emulator.serial.pty_port import PtyPort
        from surefoot.robot import RobotDescription

        command = parse(EmulateCommand, list(map(str, words)), "surefoot emulate")
        robot = RobotDescription.load(command.robot)
        faults = parse_faults([word for group in command.faults for word in group], command.lockstep, robot.num_motors)
        self._pty, self._summary = PtyPort(held=not command.lockstep), Summary()
        self.port = self._pty.path
        loop = make_loop(command, robot, faults, self._pty, self._summary)
        self.board = loop.board
        self._thread = threading.Thread(target=loop.run, daemon=True)
        self._thread.start()

    @property
    def unread(self) -> int:
        return self._pty.unread

    def hear_out(self, patience: float) -> None:
        """Wait, at most `patience` [s], until it has received all frames of hosts in lockstep that have left."""
        heard, has_no_host = threading.Event(), self._pty.has_no_host

        def look() -> bool:
            if left := has_no_host():
                heard.set()
            return left

        with mock.patch.object(self._pty, "has_no_host", look):
            assert heard.wait(patience)

    def wait_until_free(self, patience: float) -> None:
        """Wait, at most `patience` [s], until another operator may control the robot after its hosts have left."""
        wait_until(lambda: not self.board.firmware.has_operator(self.board.now), patience)

    def stop(self) -> str:
        """Stop the emulator; return its summary line."""
        self._summary.stop = True
        self._thread.join()
        self._pty.close()
        return self._summary.text(self.board)


@contextmanager
def emulators(kind: type[Any] = Emulator) -> Iterator[Callable[..., Any]]:
    """Context manager that yields a function to start emulators, which are stopped at the end."""
    started: list[Any] = []

    def start(*words: object) -> Emulator:
        started.append(kind(*words))
        return started[-1]

    try:
        yield start
    finally:
        for emulator in started:
            emulator.stop()


class BareLoop:
    """Processes that only wake up every millisecond, one on each core; `worst` is their maximum delay [s].

    A virtual machine may lose one of its cores for tens of milliseconds while the others run.

    Args:
        priority: real-time priority, if allowed, so that only the computer itself delays them; with 0, other programs
            delay them as well.
    """

    CODE = """
import contextlib, os, select, sys, time
core, priority, worst = int(sys.argv[1]), int(sys.argv[2]), 0.0
with contextlib.suppress(AttributeError, OSError):
    os.sched_setaffinity(0, {core})
with contextlib.suppress(AttributeError, OSError):
    os.sched_setscheduler(0, os.SCHED_FIFO if priority else os.SCHED_OTHER, os.sched_param(priority))
while True:
    before = time.monotonic()
    if select.select([sys.stdin], [], [], 0.001)[0]:
        break
    worst = max(worst, time.monotonic() - before - 0.001)
print(worst)
"""

    def __init__(self, priority: int) -> None:
        self._processes = [
            subprocess.Popen(
                [sys.executable, "-S", "-E", "-c", self.CODE, str(core), str(priority)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
            for core in range(os.cpu_count() or 1)
        ]
        self.worst = 0.0

    def __enter__(self) -> BareLoop:
        return self

    def __exit__(self, *_: object) -> None:
        self.worst = max(float(process.communicate()[0]) for process in self._processes)
