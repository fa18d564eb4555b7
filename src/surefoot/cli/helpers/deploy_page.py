"""The page of `surefoot deploy --drive`: the robot's own state in a browser, and commands from there.

The page runs in a process of its own, so that it can't make the control loop wait. The loop's process tells it how the
robot is by the live display's pipe; commands go back by the command channel (`deploy.command_sources`), so that
the robot stands when the page is closed, hangs or is gone.
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
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, TextIO

import numpy as np

from surefoot.deploy.command_sources import send_command
from surefoot.deploy.display import LiveDisplay
from surefoot.deploy.loop import Snapshot
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS, STAND, CommandLimits
from surefoot.rotations import rpy_quat

if TYPE_CHECKING:
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView

_AGAIN = 0.05
"""Time between two commands on the channel [s]."""
_SILENCE = 1.0
"""Time after which a command that the browser does not repeat ends [s]."""
_NEWS = 1 / 15
_PATIENCE = 30.0
"""Time that the page's process may take to start [s]."""


class DeployPage(LiveDisplay):
    """Starts the page's process, and tells it how the robot is.

    Args:
        title: of the run.
        robot: name or folder.
        policy: its name.
        limits: of the commands; none: the policy follows none, and the page only shows.
        port: TCP port of the page.
        channel: UDP port that takes commands.

    Raises:
        SurefootError: the page can't be served.
    """

    period = 1 / 25

    def __init__(
        self, title: str, robot: str, policy: str, limits: CommandLimits | None, port: int, channel: int
    ) -> None:
        super().__init__(title, __name__, stdout=subprocess.PIPE)
        given = None if limits is None else [[*getattr(limits, name)] for name in COMMANDS]
        self._send(robot=robot, policy=policy, limits=given, port=port, channel=channel)
        answer = self._answer()
        if "address" not in answer:
            self.close()
            raise SurefootError(str(answer.get("error", "the page's process has ended")))
        self.address = str(answer["address"])
        """Where a browser finds the page."""

    def _answer(self) -> dict[str, Any]:
        """Return the first line that the page's process says."""
        stdout, said = self._process.stdout, queue.Queue[str]()
        assert stdout is not None
        threading.Thread(target=lambda: said.put(stdout.readline().decode()), daemon=True).start()
        try:
            return dict(json.loads(said.get(timeout=_PATIENCE) or "{}"))
        except queue.Empty:
            return {"error": f"the page did not start within {_PATIENCE:g} s"}

    def _about(self, snapshot: Snapshot) -> dict[str, Any]:
        state = snapshot.state
        return super()._about(snapshot) | {
            "attitude": state.roll_pitch_yaw.round(4).tolist(),
            "angles": state.motor_angle.round(4).tolist(),
            "torque": round(float(np.abs(state.motor_torque).max()), 3),
        }


class Page:
    """What the page's process does.

    Args:
        about: the first message: robot, policy, limits, and the command channel's port.
        server: serves the page.
        view: draws the robot.
    """

    def __init__(self, about: dict[str, Any], server: PageServer, view: RobotView) -> None:
        self._about, self._server, self._view = about, server, view
        self._robot = RobotDescription.load(about["robot"])
        feet = self._robot.leg_mounts + self._robot.leg_geometry.foot_position(
            self._robot.resting_angles[self._robot.leg_motor_index]
        )
        self._height = -float(feet[:, 2].min())
        self._begin, self._told, self._sent, self._heard = time.monotonic(), 0.0, 0.0, -math.inf
        self._command = list(STAND)
        self._now: dict[str, Any] = {}
        view.show(self._robot)
        self._place([0.0, 0.0, 0.0], self._robot.resting_angles)
        server.set_options(
            deployed=True,
            policies=[about["policy"]],
            worlds=["robot"],
            policy=about["policy"],
            world="robot",
            robot=self._robot.name,
            legs=self._robot.leg_names,
            limits=about["limits"],
            knobs=[],
            speeds=[1],
        )

    def take(self, message: dict[str, Any]) -> None:
        """Take what the control loop's process tells."""
        if "warning" in message:
            self._server.send(error=str(message["warning"])[:300])
        self._now.update(message)
        if "angles" in message:
            self._place(message["attitude"], message["angles"])

    def _place(self, attitude: Any, angles: Any) -> None:
        # Where the robot is it does not know: it is drawn in one place, at the height at which it stands.
        quat = np.array(rpy_quat(*map(float, attitude)))
        self._view.move([0.0, 0.0, self._height], quat, angles)

    def step(self) -> None:
        """Pass commands on, and tell the page how the robot is."""
        now = time.monotonic()
        with contextlib.suppress(queue.Empty):
            while True:
                self._hear(self._server.inbox.get_nowait(), now)
        drives = self._server.tabs > 0 and now - self._heard < _SILENCE
        if drives and self._about["channel"] and now - self._sent >= _AGAIN:
            self._sent = now
            with contextlib.suppress(OSError):
                send_command(self._about["channel"], *self._command)
        if now - self._told >= _NEWS:
            self._told = now
            self._server.send(report=self._news(drives))

    def _hear(self, given: dict[str, Any], now: float) -> None:
        from surefoot.cli.helpers.drive_page import finite_numbers

        try:
            if "command" in given and self._about["limits"]:
                self._command = finite_numbers(given["command"][:3], 3)
                self._heard = now
            elif "left" in given:
                self._heard = -math.inf
            elif "stop" in given:
                # As Ctrl-C in the terminal: the robot sits and is disarmed.
                os.kill(os.getppid(), signal.SIGINT)
        except (TypeError, ValueError):
            self._server.send(error="message refused")

    def _news(self, drives: bool) -> dict[str, Any]:
        now = self._now
        news = {"paused": False, "speed": 1, "text": now.get("phase", "")}
        if "angles" not in now:
            return news
        left = f", {now['left']:.0f} s left" if now.get("left") else ""
        link = f"{now['state_age']:.0f} ms old, {now['missed']} steps missed, {now['dropped']} frames lost"
        return news | {
            "text": f"{now['phase']}{left}; battery {now['voltage']:.1f} V; {link}",
            "time": round(time.monotonic() - self._begin, 3),
            "command": self._command if drives else list(STAND),
            "torque": now["torque"],
            "heat": now["temperature"],
            "attitude": now["attitude"][:2],
        }


def _messages(lines: TextIO) -> Iterator[dict[str, Any]]:
    for line in lines:
        with contextlib.suppress(ValueError):
            message = json.loads(line)
            if isinstance(message, dict):
                yield message


def main() -> None:
    """Run the page's process: it ends with its input, whatever signals its terminal sends."""
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    with contextlib.suppress(OSError):
        os.nice(10)
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView

    messages, about, told = _messages(sys.stdin), {}, queue.Queue[dict[str, Any] | None]()
    while "robot" not in about:
        about = next(messages)
    view = RobotView()
    try:
        server = PageServer(None, about["port"], view.port)
    except SurefootError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        view.stop()
        return
    print(json.dumps({"address": server.address}), flush=True)
    page = Page(about, server, view)

    def read() -> None:
        for message in messages:
            told.put(message)
        told.put(None)

    threading.Thread(target=read, daemon=True).start()
    while True:
        try:
            message = told.get(timeout=0.02)
        except queue.Empty:
            message = {}
        if message is None:
            break
        page.take(message)
        page.step()
    server.stop()
    view.stop()


if __name__ == "__main__":
    main()
