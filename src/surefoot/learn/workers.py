"""Jobs in separate processes, a few at a time, which end with their parent and when a stop is requested."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import subprocess
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from surefoot.errors import accessible, at_least

PARENT = "SUREFOOT_PARENT"
"""Environment variable with the number of the process that started a worker, which ends when that one is gone."""
_ONE_THREAD = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}


@dataclass(frozen=True)
class Job:
    """A job of a worker."""

    name: str
    """How the user calls it."""
    request: dict[str, Any]
    """Given to the worker's standard input as one line of JSON."""
    log: Path
    """What the worker writes to standard error is added to this file."""


@dataclass
class Outcome:
    """Results of the jobs."""

    done: list[str] = field(default_factory=list)
    """Names of the jobs that ended well."""
    failed: dict[str, str] = field(default_factory=dict)
    """Names of those that did not, each with the last line it left."""
    stopped: bool = False
    """Whether it was ended by a wish to stop, with jobs left."""


def run_jobs(
    command: Sequence[str],
    jobs: Sequence[Job],
    workers: int,
    on_event: Callable[[Job, dict[str, Any]], None],
    on_change: Callable[[Job, str], None],
    stops: Callable[[], int] = lambda: 0,
) -> Outcome:
    """Run jobs, each in its own process, which writes its progress as lines of JSON.

    Args:
        command: the words that start a worker.
        jobs: what is to be done, in order.
        workers: how many run at a time.
        on_event: called with each line that a worker writes.
        on_change: called when a job is "started", "done", "stopped" or "failed".
        stops: number of stops requested: one lets the workers save and end, two end them at once.

    Raises:
        SurefootError: no workers, or a log that can't be written.
    """
    at_least("workers", workers, 1)
    outcome, waiting, running = Outcome(), list(jobs), dict[int, _Worker]()
    told: queue.Queue[tuple[_Worker, dict[str, Any] | None]] = queue.Queue()
    asked = 0
    try:
        while waiting or running:
            before, asked = asked, stops()
            for worker in running.values() if asked > before else ():
                worker.process.send_signal(signal.SIGTERM if asked == 1 else signal.SIGKILL)
            while waiting and len(running) < workers and not asked:
                worker = _Worker(command, waiting.pop(0), told)
                running[worker.process.pid] = worker
                on_change(worker.job, "started")
            if not running:
                break
            try:
                worker, event = told.get(timeout=0.2)
            except queue.Empty:
                continue
            if event is not None:
                on_event(worker.job, event)
                continue
            del running[worker.process.pid]
            ended = "stopped" if asked else "failed"
            if worker.process.returncode == 0:
                outcome.done.append(worker.job.name)
                ended = "done"
            elif not asked:
                outcome.failed[worker.job.name] = worker.last_line()
            on_change(worker.job, ended)
    finally:
        for worker in running.values():
            worker.process.terminate()
    outcome.stopped = bool(asked)
    return outcome


class _Worker:
    """A process that does one job, and a thread that reads its events."""

    def __init__(self, command: Sequence[str], job: Job, told: queue.Queue[Any]) -> None:
        self.job, self._told = job, told
        with accessible(job.log, "written"):
            job.log.parent.mkdir(parents=True, exist_ok=True)
            log = job.log.open("ab")
        self._logged = job.log.stat().st_size
        with log:
            # In a session of its own: Ctrl-C reaches this process alone, which then asks the workers to stop.
            self.process = subprocess.Popen(
                list(command), stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, start_new_session=True,
                env={**os.environ, **_ONE_THREAD, PARENT: str(os.getpid())},
            )  # fmt: skip
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        # One that has died already is reported by its end.
        with contextlib.suppress(OSError), self.process.stdin as pipe:
            pipe.write(json.dumps(self.job.request).encode() + b"\n")
        for line in self.process.stdout:
            with contextlib.suppress(ValueError):
                self._told.put((self, json.loads(line)))
        self.process.wait()
        self._told.put((self, None))

    def last_line(self) -> str:
        """Return the last line of the worker's log, and how it ended."""
        code = self.process.returncode
        end = f"killed by signal {-code} ({signal.Signals(-code).name})" if code < 0 else f"exit code {code}"
        with self.job.log.open("rb") as log:
            log.seek(self._logged)
            lines = log.read().decode(errors="replace").strip().splitlines()
        return f"{lines[-1].strip()} ({end})" if lines else end


def orphaned() -> bool:
    """Return whether the process that started this worker is gone."""
    return os.environ.get(PARENT, str(os.getppid())) != str(os.getppid())
