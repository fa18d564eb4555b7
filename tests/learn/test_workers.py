"""Jobs in processes of their own: order, figures, deaths and stops, with small scripts in place of trainings."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from surefoot.errors import SurefootError
from surefoot.learn.workers import PARENT, Job, Outcome, run_jobs

WORKER = """
import json, os, signal, sys, time
from surefoot.learn.workers import orphaned
stop = []
signal.signal(signal.SIGTERM, lambda *_: stop.append(1))
request = json.loads(sys.stdin.readline())
print(json.dumps({"n": request["n"], "pid": os.getpid(), "at": time.time()}), flush=True)
print("not a line of figures", flush=True)
if request["do"] == "raise":
    raise RuntimeError("the leg broke")
if request["do"] == "die":
    os.kill(os.getpid(), signal.SIGKILL)
end = time.time() + (60 if request["do"] == "wait" else 0.1)
while time.time() < end and not stop and not orphaned():
    time.sleep(0.02)
sys.exit(130 if stop or orphaned() else 0)
"""


class Pool:
    """Runs jobs and keeps what was told."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.told, self.changes = folder, [], []
        self.stop_when, self.stops = lambda: False, 0

    def run(self, todo: list[str], workers: int = 2) -> Outcome:
        jobs = [
            Job(f"job {n}", {"n": n, "do": what}, self.folder / f"{n}" / "worker.log") for n, what in enumerate(todo)
        ]
        return run_jobs(
            [sys.executable, "-c", WORKER],
            jobs,
            workers,
            lambda job, event: self.told.append((job.name, event)),
            lambda job, what: self.changes.append((job.name, what)),
            self._count,
        )

    def _count(self) -> int:
        if not self.stops and self.stop_when():
            self.stops = 1
        return self.stops


def test_all_jobs_are_done_and_no_more_at_a_time_than_wanted(tmp_path: Path) -> None:
    pool = Pool(tmp_path)
    outcome = pool.run(["sleep"] * 5, workers=2)
    assert sorted(outcome.done) == [f"job {n}" for n in range(5)]
    assert not outcome.failed
    assert not outcome.stopped
    assert [event["n"] for _, event in sorted(pool.told, key=lambda told: told[0])] == list(range(5))
    assert len({event["pid"] for _, event in pool.told}) == 5
    going = most = 0
    for _, what in pool.changes:
        going += 1 if what == "started" else -1
        most = max(most, going)
    assert most == 2


def test_one_that_dies_is_told_with_its_last_line_and_the_others_go_on(tmp_path: Path) -> None:
    outcome = Pool(tmp_path).run(["raise", "sleep", "die", "sleep"])
    assert sorted(outcome.done) == ["job 1", "job 3"]
    assert outcome.failed == {
        "job 0": "RuntimeError: the leg broke (exit code 1)",
        "job 2": "killed by signal 9 (SIGKILL)",
    }
    assert not outcome.stopped


def test_a_stop_lets_the_running_end_and_starts_no_more(tmp_path: Path) -> None:
    pool = Pool(tmp_path)
    pool.stop_when = lambda: len(pool.told) == 2
    start = time.monotonic()
    outcome = pool.run(["wait"] * 4)
    assert time.monotonic() - start < 20
    assert outcome.stopped
    assert not outcome.failed
    assert sorted(pool.changes) == sorted((f"job {n}", what) for n in range(2) for what in ("started", "stopped"))


def test_a_second_stop_ends_at_once(tmp_path: Path) -> None:
    pool = Pool(tmp_path)
    ignoring = WORKER.replace("lambda *_: stop.append(1)", "signal.SIG_IGN")
    job = Job("stubborn", {"n": 0, "do": "wait"}, tmp_path / "log")

    def count() -> int:
        if pool.told:
            pool.stops += 1
        return min(pool.stops, 2)

    start = time.monotonic()
    outcome = run_jobs(
        [sys.executable, "-c", ignoring], [job], 1, lambda j, event: pool.told.append(event), lambda *_: None, count
    )
    assert time.monotonic() - start < 20
    assert outcome.stopped


def test_workers_end_when_their_parent_is_killed(tmp_path: Path) -> None:
    script = f"""
import sys; sys.path.insert(0, {str(Path(__file__).parent)!r})
from pathlib import Path
from test_workers import Pool
class Loud(Pool):
    def _count(self):
        for name, event in self.told: print(event["pid"], flush=True)
        self.told.clear()
        return 0
Loud(Path({str(tmp_path)!r})).run(["wait", "wait"])
"""
    parent = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    pids = [int(parent.stdout.readline()) for _ in range(2)]
    assert all(Path(f"/proc/{pid}").exists() for pid in pids)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 20
    while time.monotonic() < deadline and any(alive(pid) for pid in pids):
        time.sleep(0.05)
    assert not any(alive(pid) for pid in pids)


def alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and that nobody asks about does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False


def test_a_process_without_a_parent_to_watch_is_no_orphan() -> None:
    assert PARENT not in os.environ
    script = "import sys; from surefoot.learn.workers import orphaned; sys.exit(orphaned())"
    assert subprocess.run([sys.executable, "-c", script], timeout=60, check=False).returncode == 0


@pytest.mark.parametrize("workers", [0, -1])
def test_no_workers_are_refused(tmp_path: Path, workers: int) -> None:
    with pytest.raises(SurefootError, match=f"workers is {workers}; it must be 1 or more"):
        Pool(tmp_path).run(["sleep"], workers)


def test_a_log_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    (tmp_path / "0").write_text("a file where a folder must be")
    with pytest.raises(SurefootError, match=r"worker\.log: can't be written"):
        Pool(tmp_path).run(["sleep"])
