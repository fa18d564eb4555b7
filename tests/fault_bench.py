"""Robot, host and a recording cable between them, in lockstep, for tests of the safety table."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from processes import SUREFOOT, EmulatorHere

from surefoot.cli.main import main
from surefoot.deploy.links import open_link
from surefoot.deploy.messages import (
    Arm,
    Bye,
    Damp,
    Disarm,
    Fault,
    Handshake,
    Hello,
    Message,
    Mode,
    Packet,
    Ping,
    Pong,
    Position,
    Reason,
    State,
)
from surefoot.deploy.motion_runner import STARTUP_TIME
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.trace import EpisodeTrace

STEP = 0.006
CODEC = Codec(8)
OTHER_SESSION = 8
"""Session id of another operator."""
PATIENCE = 120.0
LONG = 60.0
"""Duration of a run that is ended by an event [s]."""
QUICK = {"LAY_FLAT_TIME": 0.1, "FOLD_TIME": 0.1, "PAUSE_TIME": 0.1, "RISE_TIME": 0.6, "STAND_TIME": 0.2}
"""Times of the phases in which a robot that still sits after power-on can stand up reliably [s]."""
QUICK_UP = sum(QUICK.values())
RUNNING = QUICK_UP + 0.3
"""Time after arming at which the policy has run for some dozen steps [s]."""


@dataclass
class Record:
    """Packets on a cable, oldest first."""

    from_host: list[Packet] = field(default_factory=list)
    from_robot: list[Packet] = field(default_factory=list)
    armed: float | None = None
    """Time of the host's first request to arm, on the host's clock [s]."""

    def host_packets(self, kind: type[Message], since: float = -1.0) -> list[Packet]:
        """Return the host's packets of a kind, starting at a time of the host's clock [s]."""
        return [frame for frame in self.from_host if isinstance(frame.message, kind) and frame.time >= since]

    def robot_packets(self, kind: type[Message], since: float = -1.0) -> list[Packet]:
        """Return the robot's packets of a kind, starting at a time of the robot's clock [s]."""
        return [frame for frame in self.from_robot if isinstance(frame.message, kind) and frame.time >= since]

    @property
    def reasons(self) -> list[Reason]:
        """Reasons of the robot's faults."""
        return reasons(self.from_robot)

    @property
    def final_mode(self) -> tuple[Mode, Reason]:
        """Last mode of the robot, and its reason."""
        state = self.robot_packets(State)[-1].message
        return Mode(state.mode), Reason(state.reason)

    @property
    def clock_offset(self) -> float:
        """Offset of the robot's clock from the host's clock in lockstep [s]."""
        return self.robot_packets(Handshake)[0].time - self.host_packets(Hello)[0].time


def reasons(frames: list[Packet]) -> list[Reason]:
    """Return the reasons of fault packets."""
    return [Reason(frame.message.reason) for frame in frames if isinstance(frame.message, Fault)]


class Cable:
    """Pseudo-terminal that forwards bytes to and from the robot's, and records each packet.

    Args:
        robot: path of the robot's port.
        chatter: when the host connects, the robot is in the middle of a packet of another session.
    """

    def __init__(self, robot: str, chatter: bool = False) -> None:
        self._robot = os.open(robot, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self._host, self._far = os.openpty()
        tty.setraw(self._far)
        os.set_blocking(self._host, False)
        self.path = os.ttyname(self._far)
        self.record = Record()
        self._actions: list[tuple[float, Callable[[], object]]] = []
        self._chatter = b"".join(_states_of_another_session(30))[70:-70] if chatter else b""
        self._others = bytearray()
        self._over = self._pulled = False
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def after_arming(self, seconds: float, action: Callable[[], object]) -> None:
        """Call a function just before the host's first frame after a given time since its first Arm [s]."""
        self._actions.append((seconds, action))

    def moment(self, seconds: float) -> threading.Event:
        """Return an event that is set at a given time after arming [s]."""
        event = threading.Event()
        self.after_arming(seconds, event.set)
        return event

    def send(self, messages: Sequence[Message]) -> None:
        """Send additional messages to the robot."""
        now = self.record.from_host[-1].time
        for number, message in enumerate(messages, 1):
            self._others += encode_frame(CODEC, message, number, now)

    def pull(self) -> None:
        """Drop all further bytes in both directions; they are still recorded."""
        self._pulled = True

    def close(self) -> None:
        self._over = True
        self._thread.join()
        for file in (self._robot, self._host, self._far):
            os.close(file)

    def _carry(self) -> None:
        with contextlib.suppress(OSError, AttributeError):
            # A cable has no scheduling delay.
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(30))
        of_host, of_robot = Decoder(CODEC), Decoder(CODEC)
        while not self._over:
            ready = select.select([self._robot, self._host], [], [], 0.005)[0]
            if self._host in ready:
                data = _read(self._host)
                self._hear(of_host.feed(data))
                _write(self._robot, b"" if self._pulled else bytes(self._others) + data)
                self._others.clear()
            if self._robot in ready:
                data = _read(self._robot)
                self.record.from_robot += of_robot.feed(data)
                _write(self._host, b"" if self._pulled else data)

    def _hear(self, frames: list[Packet]) -> None:
        record = self.record
        if frames and not record.from_host:
            _write(self._host, self._chatter)
        record.from_host += frames
        for frame in frames:
            if isinstance(frame.message, Arm) and record.armed is None:
                record.armed = frame.time
            while self._actions and record.armed is not None and frame.time >= record.armed + self._actions[0][0]:
                self._actions.pop(0)[1]()


def _read(file: int) -> bytes:
    with contextlib.suppress(OSError):  # no data, or the other end is closed
        return os.read(file, 65_536)
    return b""


def _write(file: int, data: bytes) -> None:
    """Write as many bytes as fit; the rest is lost, as on a serial line without a reader."""
    with contextlib.suppress(OSError):
        while data:
            data = data[os.write(file, data) :]


def _states_of_another_session(count: int) -> Iterator[bytes]:
    zeros = np.zeros(8)
    for number in range(5000, 5000 + count):
        state = State(99, 1, 0, 1, 0.0, 0, zeros, zeros, zeros, zeros[:3], zeros[:3], 0.0, 16.0, zeros)
        yield encode_frame(CODEC, state, number, number / 1000)


def deploy_words(port: str, folder: Path, *options: str, policy: str = "trot", lockstep: bool = True) -> list[str]:
    """Return the arguments of a `surefoot deploy` command."""
    out = ("--out", str(folder / "traces"), "--json", *(["--lockstep"] if lockstep else []))
    return ["deploy", policy, "--port", port, *out, *options]


_HOST = f"""
import sys
from unittest import mock
from surefoot.cli.main import main
times = {QUICK!r} if sys.argv[1] else {{"STARTUP_TIME": {STARTUP_TIME!r}}}
with mock.patch.multiple("surefoot.deploy.motion_runner", **times):
    sys.exit(main(sys.argv[2:]))
"""


class Host:
    """`surefoot deploy` in a separate process, in real time.

    Args:
        port: its port.
        folder: for its output and traces.
        quick: whether the robot stands up in `QUICK` times.
    """

    def __init__(self, port: str, folder: Path, quick: bool = True) -> None:
        self.folder = folder
        words = deploy_words(port, folder, "--duration", str(LONG), lockstep=False)
        with (folder / "stdout").open("w") as out, (folder / "stderr").open("w") as err:
            command = [sys.executable, "-c", _HOST, "quick" if quick else "", *words]
            self.popen = subprocess.Popen(command, stdout=out, stderr=err)

    def end(self) -> DeployResult:
        """Wait until the process ends."""
        try:
            code = self.popen.wait(PATIENCE)
        finally:
            if self.popen.poll() is None:
                self.popen.kill()
        return DeployResult.read(code, self.folder)


@dataclass
class DeployResult:
    """Result of a `surefoot deploy`."""

    code: int
    output: dict[str, Any]
    """Printed JSON object, or an empty dict."""
    messages: list[str]
    """Lines on standard error."""
    traces: Path
    """Folder of traces."""
    trace: EpisodeTrace | None = None
    record: Record = field(default_factory=Record)
    summary: str = ""
    """Last line of the emulator."""
    refusal: str = ""
    """Error message of a second program."""

    @classmethod
    def read(cls, code: int, folder: Path) -> DeployResult:
        out, err = ((folder / name).read_text() for name in ("stdout", "stderr"))
        result = cls(code, json.loads(out) if out else {}, err.splitlines(), folder / "traces")
        if (path := result.traces / "run_000.npz").exists():
            result.trace = EpisodeTrace.load(path)
        return result

    @property
    def run(self) -> dict[str, Any]:
        """Entry of the run in the JSON object."""
        assert self.output, f"it was refused: {self.messages}"
        (run,) = self.output["runs"]
        return run

    @property
    def outcome(self) -> tuple[int, str, str]:
        """Exit code, end of the run, and reason."""
        return self.code, self.run["ended"], self.run["reason"]

    @property
    def saved_trace(self) -> EpisodeTrace:
        """Trace of the run."""
        assert self.trace is not None, "no trace was saved"
        return self.trace


class Client:
    """Operator in lockstep, for messages that `surefoot deploy` never sends; times are on the operator's clock [s]."""

    def __init__(self, path: str, session: int) -> None:
        self.path, self.file = path, os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        self.session, self.now, self.number = session, 0.0, 0
        self.last = 0
        """Sequence number of the last message, not counting pings."""
        self.packets: list[Packet] = []
        self._decoder = Decoder(CODEC)

    def send(self, message: Message, number: int | None = None, at: float | None = None) -> None:
        """Send a message, by default with the next sequence number and the present time."""
        if number is None:
            self.number = number = self.number + 1
            if not isinstance(message, Ping):
                self.last = number
        os.write(self.file, encode_frame(CODEC, message, number, self.now if at is None else at))

    def pass_time(self, seconds: float) -> list[Packet]:
        """Advance time without sending; return the robot's packets."""
        self.now += seconds
        before, token = len(self.packets), 1 + len(self.packets)
        self.send(Ping(token))
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            select.select([self.file], [], [], 1.0)
            self.packets += self._decoder.feed(_read(self.file))
            if any(isinstance(f.message, Pong) and f.message.token == token for f in self.packets[before:]):
                return self.packets[before:]
        raise AssertionError("the robot does not answer")

    def talk(self, seconds: float) -> list[Packet]:
        """Advance time with pings, as on a clean link; return the robot's packets."""
        return [frame for _ in range(round(seconds / 0.02)) for frame in self.pass_time(0.02)]

    def arm(self) -> list[Reason]:
        """Request to arm; return the reasons of the robot's faults."""
        self.send(Arm(self.session, int(Mode.POSITION), STEP, STEP))
        return reasons(self.pass_time(0.0))

    def command(self, target: np.ndarray, steps: int = 1) -> None:
        """Send the same command in every control step."""
        for _ in range(steps):
            self.send(Position(self.session, target))
            self.pass_time(STEP)

    @property
    def state(self) -> Any:
        """Newest state."""
        return next(frame.message for frame in reversed(self.packets) if isinstance(frame.message, State))


# Runs in lockstep.


@dataclass(frozen=True)
class Scenario:
    """Faults and events in a run of `surefoot deploy` in lockstep."""

    faults: tuple[str, ...] = ()
    """Faults of the emulator."""
    policy: str = "trot"
    """Name of a policy, or of a file in the folder of policies."""
    duration: float = 0.3
    """Duration of the policy's run [s]."""
    signals: tuple[tuple[float, int], ...] = ()
    """Signals sent to the host: time after arming [s], and signal."""
    raises: bool = False
    """Whether the policy's runtime raises an exception when the body pitches faster than 0.5 rad/s."""
    disk: int = 0
    """Maximum file size [bytes]; 0: unlimited."""
    terminal: bool = False
    """Whether it runs as a process in a terminal that is closed while the policy runs."""
    second: bool = False
    """Whether a second program opens the port at `RUNNING`; then the first one receives Ctrl-C."""
    stranger: bool = False
    """Whether another operator sends messages to the robot at `RUNNING`."""
    chatter: bool = False
    """Whether the robot is in the middle of a frame when the host connects."""
    sunk: float = 0.0
    """Time for which the robot has been sinking onto its belly [s]; after 1 s its legs are folded next to it."""
    quick: bool = True
    """Whether the robot stands up in `QUICK` times."""


SCENARIOS = {
    "whole": Scenario(),
    **{
        name: Scenario((f"{name}={RUNNING}",), duration=LONG)
        for name in ("stale-state", "repeat-sequence", "backward-sequence", "unplug", "reboot", "tilt")
    },
    **{name: Scenario(policy=name, duration=LONG) for name in ("nan", "infinite")},
    "exception": Scenario(raises=True, duration=LONG),
    "leaning": Scenario(policy="leaning", duration=LONG, quick=False),
    **{name: Scenario((name,)) for name in ("other-robot", "other-order", "other-gains", "other-schema")},
    "battery-low": Scenario((f"battery-low=13.8@{QUICK_UP - 0.5}",), duration=LONG),
    "motor-hot": Scenario((f"motor-hot=84@{QUICK_UP - 0.5}",), duration=LONG),
    "second": Scenario(duration=LONG, second=True),
    "stranger": Scenario(stranger=True),
    **{name: Scenario((f"{name}=0.02",)) for name in ("corrupt", "cut-frames", "drop", "reorder")},
    **{name: Scenario((f"{name}=0.05",)) for name in ("duplicate", "garbage")},
    "in the middle": Scenario(chatter=True),
    "SIGINT": Scenario(duration=LONG, signals=((RUNNING, signal.SIGINT),)),
    "SIGTERM": Scenario(duration=LONG, signals=((RUNNING, signal.SIGTERM),)),
    "SIGINT twice": Scenario(duration=LONG, signals=((RUNNING, signal.SIGINT), (RUNNING + 0.1, signal.SIGINT))),
    **{
        name: Scenario(duration=LONG, signals=((when, number),), sunk=1.0, quick=False)
        for name, when, number in (
            ("SIGINT while it arms", 0.0, signal.SIGINT),
            ("SIGTERM while it lies", 0.05, signal.SIGTERM),
            ("SIGHUP while it lies", 0.5, signal.SIGHUP),
        )
    },
    "terminal": Scenario(duration=LONG, terminal=True),
    "disk full": Scenario(disk=8_000, duration=0.6),
}
OTHER_MESSAGES = (
    Hello(OTHER_SESSION, 0.001),
    Arm(OTHER_SESSION, int(Mode.POSITION), STEP, STEP),
    Position(OTHER_SESSION, np.zeros(8)),
    Damp(OTHER_SESSION),
    Disarm(OTHER_SESSION),
    Bye(OTHER_SESSION),
)
_TERMINAL = """
import os, subprocess, sys
terminal = os.open(sys.argv[1], os.O_RDWR)  # it leads a session, so this terminal is now the session's
words = ["sh", "-c", 'trap "" HUP; "$@"; echo $? > "$0"', *sys.argv[2:]]
subprocess.Popen(words, stdin=terminal, stdout=terminal, stderr=terminal)
sys.stdin.read()
"""
"""Shell in a terminal that runs a program, and ends when its window is closed. A program that survives this writes the
exit code."""


def play(
    scenario: Scenario,
    folder: Path,
    policies: Path,
    options: Sequence[str] = (),
    observe: Callable[[Any], object] | None = None,
) -> DeployResult:
    """Run a policy on a robot that was just switched on, in this process unless the scenario requires another one.

    Args:
        scenario: faults and events.
        folder: folder for output and traces.
        policies: folder of policies.
        options: options of the emulator.
        observe: function called with the emulated board before the run; the board then runs until another operator may
            connect.
    """
    folder.mkdir(parents=True)
    robot = EmulatorHere("--lockstep", *options, *(word for fault in scenario.faults for word in ("--fault", fault)))
    if observe is not None:
        observe(robot.board)
    if scenario.sunk:
        _settle(robot, scenario.sunk)
    cable = Cable(robot.port, scenario.chatter)
    refusals = [""]

    def open_port_twice() -> None:
        try:
            open_link(cable.path, 8, lockstep=True)
        except SurefootError as error:
            refusals.append(str(error))
        _signal(signal.SIGINT)

    try:
        for when, number in scenario.signals:
            cable.after_arming(when, partial(_signal, number))
        if scenario.stranger:
            cable.after_arming(RUNNING, lambda: cable.send(OTHER_MESSAGES))
        if scenario.second:
            cable.after_arming(RUNNING, open_port_twice)
        if scenario.disk:
            # In lockstep a run may end before the first access to the disk.
            cable.after_arming(RUNNING, lambda: time.sleep(0.3))
        options = ("--duration", str(scenario.duration))
        if scenario.terminal:
            ended = _in_a_terminal(cable, folder, *options)
        else:
            file = policies / f"{scenario.policy}.onnx"
            words = deploy_words(cable.path, folder, *options, policy=str(file) if file.exists() else scenario.policy)
            ended = in_this_process(words, folder, scenario)
    finally:
        cable.close()
        robot.hear_out(PATIENCE)
        if observe is not None:
            robot.wait_until_free(PATIENCE)
        summary = robot.stop()
    ended.record, ended.refusal, ended.summary = cable.record, refusals[-1], summary
    return ended


def _signal(number: int) -> None:
    """Send a signal to the host in this process, and wait for its delivery."""
    signal.pthread_kill(threading.main_thread().ident or 0, number)
    time.sleep(0.02)


def in_this_process(words: list[str], folder: Path, scenario: Scenario | None = None) -> DeployResult:
    """Run a command with the scenario's faults of the host."""
    scenario = scenario or Scenario()
    feedback, limits = PolicyRuntime.feedback, resource.getrlimit(resource.RLIMIT_FSIZE)

    def breaking(self: PolicyRuntime, observation: np.ndarray) -> np.ndarray:
        if scenario.raises and observation[0, 3] > 0.5:
            raise RuntimeError("index out of data bounds")
        return feedback(self, observation)

    times = QUICK if scenario.quick else {"STARTUP_TIME": STARTUP_TIME}
    with (
        (folder / "stdout").open("w") as out,
        (folder / "stderr").open("w") as err,
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
        mock.patch.object(PolicyRuntime, "feedback", breaking),
        mock.patch.multiple("surefoot.deploy.motion_runner", **times),
    ):
        resource.setrlimit(resource.RLIMIT_FSIZE, (scenario.disk or limits[0], limits[1]))
        try:
            code = main(words)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    return DeployResult.read(code, folder)


def _in_a_terminal(cable: Cable, folder: Path, *options: str) -> DeployResult:
    window, terminal = os.openpty()
    code = folder / "code"
    words = [sys.executable, "-c", _TERMINAL, os.ttyname(terminal), str(code), *SUREFOOT]
    words += deploy_words(cable.path, folder, *options)
    shell = subprocess.Popen(words, stdin=subprocess.PIPE, start_new_session=True)

    def leave() -> None:
        shell.communicate()
        os.close(window)

    # The terminal has no reader, which must not block the run.
    cable.after_arming(STARTUP_TIME + 0.3, leave)
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end and not (code.exists() and code.read_text()):
        time.sleep(0.05)
    shell.kill()
    shell.wait()
    os.close(terminal)
    for name in ("stdout", "stderr"):
        (folder / name).touch()
    return DeployResult.read(int(code.read_text()), folder)


def _settle(robot: EmulatorHere, seconds: float) -> None:
    """Let a robot sink to the ground for a given time [s]."""
    operator = Client(robot.port, OTHER_SESSION)
    operator.send(Hello(OTHER_SESSION, 0.1))
    operator.pass_time(seconds)
    operator.send(Bye(OTHER_SESSION))
    operator.pass_time(0.0)
    os.close(operator.file)
