"""Processes that answer requests for a `ProcessWorld` and end with it."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
import weakref
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from surefoot.errors import SurefootError

_WAIT = 2.0
"""Time [s] that a process has to end by itself."""


def _start() -> subprocess.Popen[bytes]:
    """Start a process that waits for requests; it imports this package, and nothing of the user's script."""
    package = str(Path(__file__).resolve().parents[2])
    known = [package, *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    environment = {
        **os.environ,
        "PYTHONPATH": os.pathsep.join(filter(None, known)),
        # One core each: what they compute is too small to be shared between threads.
        **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"), "1"),
    }
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "surefoot.world.process_worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env=environment,
        # Ctrl-C on the terminal is for the process that was started by hand; it ends these.
        process_group=0,
    )


def _end(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        for pipe in (process.stdin, process.stdout):
            if pipe is not None:
                with contextlib.suppress(OSError):
                    pipe.close()
    for process in processes:
        try:
            process.wait(_WAIT)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


class ProcessPool:
    """Processes with a world each; they end with this object, when it is closed, or with the process that owns it.

    Args:
        count: number of processes.
    """

    def __init__(self, count: int) -> None:
        self._processes: list[subprocess.Popen[bytes]] = []
        self._finalizer = weakref.finalize(self, _end, self._processes)
        self._processes.extend(_start() for _ in range(count))

    @property
    def process_ids(self) -> list[int]:
        """Process ids, in order."""
        return [process.pid for process in self._processes]

    def close(self) -> None:
        """End the processes; no further request is possible."""
        self._finalizer()

    def ask(self, method: str, arguments: Sequence[Any]) -> list[Any]:
        """Send each process its own arguments; return their answers in order.

        Raises:
            SurefootError: a process is gone. An error that a process reports is raised here as it was there, after
                all have answered.
        """
        if not self._finalizer.alive:
            raise SurefootError("this world is closed, or one of its processes is gone")
        replies = []
        try:
            for process, own in zip(self._processes, arguments, strict=True):
                assert process.stdin is not None
                pickle.dump((method, own), process.stdin, protocol=pickle.HIGHEST_PROTOCOL)
                process.stdin.flush()
            for process in self._processes:
                assert process.stdout is not None
                replies.append(pickle.load(process.stdout))
        except (BrokenPipeError, EOFError, pickle.UnpicklingError) as error:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(_WAIT)
            self.close()
            raise SurefootError(
                f"a process of the simulated world ended on its own (exit code {process.returncode}); "
                "it may have run out of memory"
            ) from error
        except BaseException:
            self.close()  # answers that were not read would be taken for those to the next question
            raise
        for sound, answer in replies:
            if not sound:
                raise answer
        return [answer for _, answer in replies]
