"""Page of `surefoot deploy --browser`: shows the robot's state in a browser, and sends velocity commands.

The page runs in a separate process, so that it never blocks the control loop. It receives the robot's state through
the pipe of the live display, and sends commands through the command channel (`deploy.command_sources`), whose timeout
sets the command to zero when the page is closed or hangs. Its buttons write lines to its standard output, a pipe that
the loop reads in each control step without waiting. When the process ends, the pipe is closed and the robot sits down,
as when a terminal is closed.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import select
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.deploy.command_sources import send_command
from surefoot.deploy.display import LiveDisplay, PlainLines, read_messages, run_in_background
from surefoot.deploy.loop import Snapshot
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS, STAND_COMMAND, CommandLimits
from surefoot.rotations import rpy_quat
from surefoot.stop_signals import DAMP, SIT
from surefoot.world.ground import FLAT

if TYPE_CHECKING:
    from surefoot.report.pages.messages import DeployMessage
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView

_COMMAND_PERIOD, _REPORT_PERIOD = 0.05, 1 / 15
"""Periods of commands on the channel, and of reports to the browser [s]."""
_COMMAND_TIMEOUT = 1.0
"""Time after which a command ends unless the browser repeats it [s]."""
_START_TIMEOUT = 30.0
"""Time within which the page's process must start [s]."""
_MAX_BYTES = 4096
"""Maximum number of bytes that are read from the page's process at a time."""


class DeployPage(PlainLines, LiveDisplay):
    """Display that prints lines, and sends the robot's state to the page's process, which it starts.

    Without `limits` of commands the page has no controls. `port` is its TCP port, `channel` the UDP port for commands.

    Raises:
        SurefootError: the page can't be served.
    """

    period = 1 / 25

    def __init__(
        self, title: str, robot: str, policy: str, limits: CommandLimits | None, port: int, channel: int
    ) -> None:
        self._rest, self._answer, self._stops, self._ended = b"", dict[str, Any](), 0, False
        super().__init__(title, __name__, stdout=subprocess.PIPE)
        assert self._process.stdout is not None
        self._output = self._process.stdout.fileno()
        os.set_blocking(self._output, False)
        ranges = None if limits is None else [[*getattr(limits, name)] for name in COMMANDS]
        self._send(robot=robot, policy=policy, limits=ranges, port=port, channel=channel)
        self._await_answer()
        if "address" not in self._answer:
            self.close()
            raise SurefootError(str(self._answer.get("error", "the page's process has ended")))
        self.address = str(self._answer["address"])

    def _await_answer(self) -> None:
        """Wait until the page's process reports the page's address or an error."""
        end = time.monotonic() + _START_TIMEOUT
        while not self._answer and not self._ended:
            if not select.select([self._output], [], [], max(end - time.monotonic(), 0.0))[0]:
                self._answer = {"error": f"the page did not start within {_START_TIMEOUT:g} s"}
            self._receive()

    def _receive(self) -> None:
        """Read the messages that the page's process has written, without waiting."""
        try:
            data = os.read(self._output, _MAX_BYTES)
        except BlockingIOError:
            return
        self._ended = not data
        *lines, self._rest = (self._rest + data).split(b"\n")
        for message in read_messages(line.decode() for line in lines):
            self._stops = max(self._stops, message.pop("stop", 0))
            self._answer |= message

    def stops(self) -> int:
        """Return the stop request of the page's buttons, see `StopSignals.stops`; SIT if the process has ended."""
        if not self._ended:
            self._receive()
            if self._ended:
                self._stops = max(self._stops, SIT)
                self.warn("the page's process has ended; the robot sits down and is disarmed")
        return self._stops

    def _message(self, snapshot: Snapshot) -> dict[str, Any]:
        state = snapshot.state
        return super()._message(snapshot) | {
            "attitude": state.roll_pitch_yaw.round(4).tolist(),
            "angles": state.motor_angle.round(4).tolist(),
            "torque": round(float(np.abs(state.motor_torque).max()), 3),
        }


class Page:
    """The page in its own process.

    Args:
        setup: the first message from the control loop: robot, policy, limits, and the channel's port.
        server: server of the page.
        view: 3D view of the robot.
        send: function that sends a message to the control loop's process.
    """

    def __init__(self, setup: dict[str, Any], server: PageServer, view: RobotView, send: Callable[..., None]) -> None:
        self._setup, self._server, self._view, self._send = setup, server, view, send
        robot = RobotDescription.load(setup["robot"])
        self._height = -float(robot.foot_positions(robot.resting_angles)[:, 2].min())
        self._start, self._reported, self._sent, self._received = time.monotonic(), 0.0, 0.0, -math.inf
        self._command = list(STAND_COMMAND)
        self._values: dict[str, Any] = {}
        view.show(FLAT, robot)
        self._place([0.0, 0.0, 0.0], robot.resting_angles)
        server.set_options(
            deployed=True,
            policies=[[setup["policy"], setup["policy"], ""]],
            worlds=["robot"],
            policy=setup["policy"],
            world="robot",
            robot=robot.name,
            legs=robot.leg_names,
            limits=setup["limits"],
            live_parameters=[],
            speeds=[1],
            node=f"/world/{robot.base}",
        )

    def update(self, message: dict[str, Any]) -> None:
        """Handle a message from the control loop's process."""
        if "warning" in message:
            self._server.send(error=str(message["warning"])[:300])
        self._values.update(message)
        if "angles" in message:
            self._place(message["attitude"], message["angles"])

    def _place(self, attitude: Any, angles: Any) -> None:
        # The robot's position is not measured, so it is drawn at a fixed position, at standing height.
        quat = np.array(rpy_quat(*map(float, attitude)))
        self._view.move(([0.0, 0.0, self._height], quat, angles))

    def step(self) -> None:
        """Forward commands to the control loop, and report the robot's state to the browser."""
        now, channel = time.monotonic(), self._setup["channel"]
        with contextlib.suppress(queue.Empty):
            while True:
                self._handle(self._server.inbox.get_nowait(), now)
        steers = self._server.tabs > 0 and now - self._received < _COMMAND_TIMEOUT
        if steers and channel and now - self._sent >= _COMMAND_PERIOD:
            self._sent = now
            with contextlib.suppress(OSError):
                send_command(channel, *self._command)
        if now - self._reported >= _REPORT_PERIOD:
            self._reported = now
            self._server.send(report=self._report(steers))

    def _handle(self, message: DeployMessage | None, now: float) -> None:
        """Handle a message from a tab; None means that the controlling tab was closed."""
        if message is None:
            self._received = -math.inf
            return
        if message.command is not None and self._setup["limits"]:
            self._command, self._received = list(message.command), now
        if message.damp or message.stop:
            self._send(stop=DAMP if message.damp else SIT)

    def _report(self, steers: bool) -> dict[str, Any]:
        values = self._values
        report = {"paused": False, "speed": 1, "text": values.get("phase", "")}
        if "angles" not in values:
            return report
        left = f", {values['left']:.0f} s left" if values.get("left") else ""
        link = f"{values['state_age']:.0f} ms old, {values['missed']} steps missed, {values['dropped']} frames lost"
        return report | {
            "text": f"{values['phase']}{left}; battery {values['voltage']:.1f} V; {link}",
            "time": round(time.monotonic() - self._start, 3),
            "command": self._command if steers else list(STAND_COMMAND),
            "torque": values["torque"],
            "heat": values["temperature"],
            "attitude": values["attitude"][:2],
        }


def main() -> None:
    """Run the page's process."""
    run_in_background()
    # Output of libraries must not be mistaken for a button.
    output = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    from surefoot.report.pages.messages import DeployMessage
    from surefoot.report.pages.server import robot_page

    def send(**message: Any) -> None:
        with contextlib.suppress(OSError):  # the control loop has ended, and then so does this process's input
            print(json.dumps(message), file=output, flush=True)

    messages, inbox = read_messages(sys.stdin), queue.Queue[dict[str, Any] | None]()
    setup = next(message for message in messages if "robot" in message)
    with contextlib.ExitStack() as stack:
        try:
            server, view = stack.enter_context(robot_page(None, setup["port"], messages=DeployMessage))
        except SurefootError as error:
            send(error=str(error))
            return
        send(address=server.address)
        page = Page(setup, server, view, send)

        def read() -> None:
            for message in messages:
                inbox.put(message)
            inbox.put(None)

        threading.Thread(target=read, daemon=True).start()
        message: dict[str, Any] | None = {}
        while message is not None:
            page.update(message)
            page.step()
            try:
                message = inbox.get(timeout=0.02)
            except queue.Empty:
                message = {}


if __name__ == "__main__":
    main()
