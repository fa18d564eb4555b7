"""Shared by benchmarks and tests of a Go2 over DDS: a robot, an observer of its commands, and `surefoot deploy`.

All run in separate processes, in real time, on the loopback interface.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.deploy.dds import bus, low_level, types

SUREFOOT = (sys.executable, "-m", "surefoot")
VENDOR_GO2 = Path(__file__).parents[1] / "tests" / "vendor_go2.py"
ROBOTS = ("emulated", "vendor", "fitted")
"""surefoot's emulated Go2, and two variants of an independent simulator."""
_TICK = os.sysconf("SC_CLK_TCK")


class Robot:
    """Robot process on the loopback interface.

    `emulated` takes faults as options; the others accept them at any time.

    Args:
        kind: one of `ROBOTS`.
        domain: DDS domain.
        folder: folder of its record.
        options: additional options of its command.
    """

    def __init__(self, kind: str, domain: int, folder: Path, *options: object) -> None:
        self.kind, self.record_file = kind, folder / f"{kind}_{time.monotonic_ns()}.npz"
        self.capture_file = self.record_file.with_suffix(".csv")
        network = ("--interface", "lo", "--domain", str(domain))
        if kind == "emulated":
            words = [*SUREFOOT, "emulate", "--robot", "go2", "--link", "dds", "--out", str(self.capture_file)]
        else:
            words = [sys.executable, str(VENDOR_GO2), "--variant", kind, "--record", str(self.record_file)]
        with Path(os.devnull).open("w") as quiet:
            self.process = subprocess.Popen(
                [*words, *network, *map(str, options)],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=quiet if kind != "emulated" else subprocess.PIPE,
                text=True,
            )
        assert self.process.stdout is not None
        if not self.process.stdout.readline().startswith("robot "):
            raise SystemExit(f"no robot: {self.process.communicate()[1]}")

    def inject(self, fault: str) -> int:
        """Begin a fault of the `vendor` robot; return the time of the request [ns, monotonic clock]."""
        assert self.process.stdin is not None
        now = time.monotonic_ns()
        self.process.stdin.write(fault + "\n")
        self.process.stdin.flush()
        return now

    def end(self) -> tuple[dict[str, Any], NDArray[np.void], NDArray[np.void]]:
        """End the robot; return its summary, the commands that it received, and its faults."""
        nothing = np.zeros(0, [("time", "u8")])
        if self.kind == "emulated":
            self.process.send_signal(signal.SIGINT)
            return {"text": self.process.communicate(timeout=20)[1].strip()}, nothing, nothing
        output = self.process.communicate(timeout=20)[0]
        with np.load(self.record_file) as record:
            return json.loads(output), record["commands"], record["faults"]

    def kill(self) -> None:
        """Kill the robot's process."""
        self.process.kill()
        self.process.communicate()


def take_stamped(reader: bus.RawReader[Any]) -> list[tuple[int, bytes]]:
    """Return the received messages, oldest first, each with the time when it was written [ns]."""
    from cyclonedds._clayer import ddspy_take

    taken = ddspy_take(reader._reader._ref, 2048)
    # Messages without data announce that a writer is gone.
    return [] if isinstance(taken, int) else [(info.source_timestamp, data) for data, info in taken if info.valid_data]


class Witness:
    """Observer of the commands on a domain: time of writing [ns], maximum kp and minimum kd of each."""

    def __init__(self, domain: int) -> None:
        self._bus = bus.Bus("lo", domain)
        self._reader = self._bus.reader(bus.LOW_COMMAND_TOPIC, types.LowCmd, 2048)
        self.rows: list[tuple[int, float, float]] = []
        self.armed: float | None = None
        """Time of the first command with a gain [s, monotonic clock]."""
        self._last: tuple[bytes, float, float] = b"", 0.0, 0.0

    def take(self) -> None:
        """Take what has come."""
        for written, data in take_stamped(self._reader):
            if data != self._last[0]:
                motors = low_level.decode(low_level.LOW_COMMAND, data)["motor_cmd"][:12]
                self._last = data, float(motors["kp"].max()), float(motors["kd"].min())
            self.rows.append((written, *self._last[1:]))
            if self.armed is None and self._last[1] > 0:
                self.armed = time.monotonic()

    def close(self) -> None:
        """Leave the domain."""
        self._bus.close()

    def commands(self) -> NDArray[np.void]:
        """Return all commands."""
        return np.array(self.rows, [("written", "u8"), ("kp", "f4"), ("kd", "f4")])


class Deploy:
    """Running `surefoot deploy --link dds`; `program` is the command before its words."""

    def __init__(
        self,
        domain: int,
        folder: Path,
        *options: object,
        policy: str = "go2-steer",
        program: Sequence[str] = SUREFOOT,
    ) -> None:
        self.folder = folder / f"deploy_{time.monotonic_ns()}"
        words = ["deploy", policy, "--link", "dds", "--interface", "lo", "--domain", str(domain), "--json"]
        words += ["--out", str(self.folder), *map(str, options)]
        self._output, self._errors = self.folder.with_suffix(".out"), self.folder.with_suffix(".err")
        with self._output.open("w") as out, self._errors.open("w") as err:
            self.process = subprocess.Popen([*program, *words], stdin=subprocess.DEVNULL, stdout=out, stderr=err)

    @property
    def ended(self) -> bool:
        """Whether it has ended."""
        return self.process.poll() is not None

    def result(self) -> tuple[int, dict[str, Any], str]:
        """Return the exit code, the report and the errors of a command that has ended."""
        output = self._output.read_text()
        return self.process.wait(60), json.loads(output) if output else {}, self._errors.read_text()

    def helpers(self) -> dict[str, int]:
        """Return the process ids of keeper and watcher."""
        return {
            name: pid
            for pid, words in descendants(self.process.pid).items()
            for name, module in (("keeper", "supervisor"), ("watcher", "watchdog"))
            if f"surefoot.deploy.dds.{module}" in words
        }

    def kill(self) -> None:
        """Kill the command and its helper processes."""
        for pid in (*descendants(self.process.pid), self.process.pid):
            with contextlib.suppress(OSError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()


def descendants(pid: int) -> dict[int, str]:
    """Return the command lines of all descendants of a process, by process id."""
    found: dict[int, str] = {}
    with contextlib.suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text().split():
                words = Path(f"/proc/{child}/cmdline").read_bytes().replace(b"\0", b" ").decode()
                found |= {int(child): words, **descendants(int(child))}
    return found


def cpu_time(pid: int) -> float:
    """Return the processor time of a process [s]; NaN if it does not exist."""
    try:
        words = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except OSError:
        return float("nan")
    return (int(words[11]) + int(words[12])) / _TICK


def watch(
    deploy: Deploy, witness: Witness, actions: Sequence[tuple[float, Callable[[], object]]], patience: float
) -> None:
    """Wait for the end of a deployment, and call actions at their times after arming [s].

    Raises:
        SystemExit: the deployment has not ended after `patience` [s].
    """
    end = time.monotonic() + patience
    done = 0
    while not deploy.ended:
        witness.take()
        while (
            done < len(actions) and witness.armed is not None and time.monotonic() >= witness.armed + actions[done][0]
        ):
            actions[done][1]()
            done += 1
        if time.monotonic() > end:
            raise SystemExit(f"surefoot deploy has not ended after {patience:g} s")
        time.sleep(0.002)
    for _ in range(100):
        witness.take()
        time.sleep(0.01)


@contextlib.contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Run programs that keep processors busy."""
    # They exit after 120 s, even if this script is killed.
    busy = "import time; end = time.monotonic() + 120\nwhile time.monotonic() < end: pass"
    programs = [subprocess.Popen([sys.executable, "-c", busy]) for _ in range(count)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def measure_capture(path: Path, settled: float) -> float:
    """Return the mean forward speed [m/s] in a motion capture, from `settled` [s] after the first step to the stop."""
    time_, x, y, _, w, qx, qy, qz = np.loadtxt(path, delimiter=",", skiprows=1, usecols=range(8)).T
    yaw = np.arctan2(2 * (w * qz + qx * qy), 1 - 2 * (qy**2 + qz**2))
    window = max(round(0.5 / float(np.median(np.diff(time_)))), 1)
    along = (x[window:] - x[:-window]) * np.cos(yaw[:-window]) + (y[window:] - y[:-window]) * np.sin(yaw[:-window])
    speed = along / (time_[window:] - time_[:-window])
    walking = np.flatnonzero(speed > 0.1)
    if not len(walking):
        return 0.0
    began, ended = time_[walking[0]], time_[walking[-1]]
    return float(speed[(time_[:-window] > began + settled) & (time_[:-window] < ended - 0.5)].mean())


def steer_forward(folder: Path, speed: float) -> Path:
    """Write a file of commands: forward [m/s] from 0.5 s on."""
    path = folder / f"forward_{speed:g}.csv"
    path.write_text(f"time,forward,sideways,yaw_rate\n0,0,0,0\n0.5,{speed},0,0\n")
    return path
