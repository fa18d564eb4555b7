"""The page of `surefoot deploy --browser`: the robot's own state in a browser, and commands from there.

The page runs in a process of its own, so that it never makes the control loop wait. It receives the robot's state by
the pipe of the live display and sends commands by the command channel (`deploy.command_sources`). So the robot stands
when the page is closed, hangs or ends.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.deploy.command_sources import send_command
from surefoot.deploy.display import LiveDisplay, PlainLines, read_messages, run_in_background
from surefoot.deploy.loop import Snapshot
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS, STAND, CommandLimits
from surefoot.rotations import rpy_quat
from surefoot.world.ground import FLAT

if TYPE_CHECKING:
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView

_COMMAND_PERIOD, _REPORT_PERIOD = 0.05, 1 / 15
"""Time between two commands on the channel, and between two reports to the browser [s]."""
_SILENCE = 1.0
"""Time after which a command that the browser does not repeat ends [s]."""
_PATIENCE = 30.0
"""Time that the page's process may take to start [s]."""


class DeployPage(PlainLines, LiveDisplay):
    """Display that prints lines, starts the page's process, and sends it the robot's state.

    Without `limits` of commands the page has no controls. `port` is its TCP port, `channel` the UDP port of commands.

    Raises:
        SurefootError: the page can't be served.
    """

    period = 1 / 25

    def __init__(
        self, title: str, robot: str, policy: str, limits: CommandLimits | None, port: int, channel: int
    ) -> None:
        super().__init__(title, __name__, stdout=subprocess.PIPE)
        ranges = None if limits is None else [[*getattr(limits, name)] for name in COMMANDS]
        self._send(robot=robot, policy=policy, limits=ranges, port=port, channel=channel)
        answer = self._first_line()
        if "address" not in answer:
            self.close()
            raise SurefootError(str(answer.get("error", "the page's process has ended")))
        self.address = str(answer["address"])

    def _first_line(self) -> dict[str, Any]:
        stdout, lines = self._process.stdout, queue.Queue[str]()
        assert stdout is not None
        threading.Thread(target=lambda: lines.put(stdout.readline().decode()), daemon=True).start()
        try:
            return dict(json.loads(lines.get(timeout=_PATIENCE) or "{}"))
        except queue.Empty:
            return {"error": f"the page did not start within {_PATIENCE:g} s"}

    def _message(self, snapshot: Snapshot) -> dict[str, Any]:
        state = snapshot.state
        return super()._message(snapshot) | {
            "attitude": state.roll_pitch_yaw.round(4).tolist(),
            "angles": state.motor_angle.round(4).tolist(),
            "torque": round(float(np.abs(state.motor_torque).max()), 3),
        }


class Page:
    """The page in its process; `setup` is the first message, with robot, policy, limits, and the channel's port."""

    def __init__(self, setup: dict[str, Any], server: PageServer, view: RobotView) -> None:
        self._setup, self._server, self._view = setup, server, view
        robot = RobotDescription.load(setup["robot"])
        self._height = -float(robot.foot_positions(robot.resting_angles)[:, 2].min())
        self._start, self._reported, self._sent, self._received = time.monotonic(), 0.0, 0.0, -math.inf
        self._command = list(STAND)
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
            knobs=[],
            speeds=[1],
            node=f"/world/{robot.base}",
        )

    def update(self, message: dict[str, Any]) -> None:
        """Take a message of the control loop's process."""
        if "warning" in message:
            self._server.send(error=str(message["warning"])[:300])
        self._values.update(message)
        if "angles" in message:
            self._place(message["attitude"], message["angles"])

    def _place(self, attitude: Any, angles: Any) -> None:
        # The robot's position is not measured: it is drawn in one place, at the height at which it stands.
        quat = np.array(rpy_quat(*map(float, attitude)))
        self._view.move(([0.0, 0.0, self._height], quat, angles))

    def step(self) -> None:
        """Pass commands on, and report the robot's state to the browser."""
        now, channel = time.monotonic(), self._setup["channel"]
        with contextlib.suppress(queue.Empty):
            while True:
                self._receive(self._server.inbox.get_nowait(), now)
        drives = self._server.tabs > 0 and now - self._received < _SILENCE
        if drives and channel and now - self._sent >= _COMMAND_PERIOD:
            self._sent = now
            with contextlib.suppress(OSError):
                send_command(channel, *self._command)
        if now - self._reported >= _REPORT_PERIOD:
            self._reported = now
            self._server.send(report=self._report(drives))

    def _receive(self, message: dict[str, Any], now: float) -> None:
        from surefoot.api.drive_page import finite_numbers

        try:
            if "command" in message and self._setup["limits"]:
                self._command = finite_numbers(message["command"][:3], 3)
                self._received = now
            elif "left" in message:
                self._received = -math.inf
            elif "stop" in message:
                # As Ctrl-C in the terminal: the robot sits and is disarmed.
                os.kill(os.getppid(), signal.SIGINT)
        except (TypeError, ValueError):
            self._server.send(error="message refused")

    def _report(self, drives: bool) -> dict[str, Any]:
        values = self._values
        report = {"paused": False, "speed": 1, "text": values.get("phase", "")}
        if "angles" not in values:
            return report
        left = f", {values['left']:.0f} s left" if values.get("left") else ""
        link = f"{values['state_age']:.0f} ms old, {values['missed']} steps missed, {values['dropped']} frames lost"
        return report | {
            "text": f"{values['phase']}{left}; battery {values['voltage']:.1f} V; {link}",
            "time": round(time.monotonic() - self._start, 3),
            "command": self._command if drives else list(STAND),
            "torque": values["torque"],
            "heat": values["temperature"],
            "attitude": values["attitude"][:2],
        }


def main() -> None:
    """Run the page's process."""
    run_in_background()
    from surefoot.report.pages.server import robot_page

    messages, inbox = read_messages(sys.stdin), queue.Queue[dict[str, Any] | None]()
    setup = next(message for message in messages if "robot" in message)
    with contextlib.ExitStack() as stack:
        try:
            server, view = stack.enter_context(robot_page(None, setup["port"]))
        except SurefootError as error:
            print(json.dumps({"error": str(error)}), flush=True)
            return
        print(json.dumps({"address": server.address}), flush=True)
        page = Page(setup, server, view)

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
