"""The drive page: a simulated robot that runs in real time behind a page in the browser, and obeys it."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.api.policies import find_policy, load_gait, shipped_policies
from surefoot.errors import SurefootError, choices
from surefoot.robot.commands import COMMANDS, STAND
from surefoot.world.registry import WORLDS, find_world

if TYPE_CHECKING:
    from surefoot.deploy.command_sources import CommandSource
    from surefoot.evaluation.driven import DrivenRobot
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig

SPEEDS = (1.0, 0.5, 0.25, 0.1)
"""Simulated over real time that a page may choose."""
_FRAME_PERIOD = 1 / 30
"""Time between two pictures [s]."""
_REPORT_PERIOD = 1 / 15
"""Time between two points of the plots [s]."""
_COMMAND_TIMEOUT = 3.0
"""Time after which a command that is not repeated ends [s]."""
_PUSH_DURATION = 0.1
"""How long a push lasts [s]."""
_MEAN_SPEED_TIME = 0.25
"""Time over which plotted speeds are averaged [s]."""


def serve(drive: DrivePage, host: str | None, port: int, commands: str | None = None) -> None:
    """Serve the page, and run the simulation behind it until Ctrl-C; `commands` name a source in place of the page.

    Raises:
        SurefootError: a port that is taken, or a source that can't be opened.
    """
    from surefoot.deploy.command_sources import open_commands
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView

    with contextlib.ExitStack() as stack:
        if commands is not None:
            if drive.robot.limits is None:
                raise SurefootError(f"--commands is given; policy '{drive.policy}' has no commands to follow")
            drive.source, drive.source_name = open_commands(commands, drive.robot.limits), commands
            stack.callback(drive.source.close)
        view = RobotView()
        stack.callback(view.stop)
        page = PageServer(host, port, view.port)
        stack.callback(page.stop)
        print(f"{page.address}   (Ctrl-C ends)", flush=True)
        drive.run(page, view, threading.Event())


class DrivePage:
    """The simulation behind the page.

    Args:
        policy: path, or name of one that ships.
        world: name of the world.
        robot: name or folder of the robot of that policy; the one of its task, if None.
        adjust: returns that policy's task in another simulator. Tasks of other policies stay as they are.
    """

    source: CommandSource | None = None
    """Source of commands in place of the page."""
    source_name = ""

    def __init__(
        self,
        policy: str,
        world: str,
        robot: str | None = None,
        adjust: Callable[[TaskConfig, RobotDescription], TaskConfig] = lambda task, _: task,
    ) -> None:
        self.policies = list(dict.fromkeys([policy, *sorted(shipped_policies())]))
        self.worlds = [name for name, entry in WORLDS.items() if find_spec(entry.package) is not None]
        self._robot_name, self._adjust = robot, adjust
        self.paused, self.speed = False, 1.0
        self.delays: deque[float] = deque(maxlen=10_000)
        """Time from a hand's movement in the browser to its command in the simulation [s], on one machine."""
        self.real_time_share = 1.0
        """Share of real time that was reached in the last second or so."""
        self._command_time = 0.0
        self.robot = self._load(policy, world)

    def _load(self, policy: str, world: str) -> DrivenRobot:
        from surefoot.evaluation.driven import DrivenRobot

        make_world, is_first = find_world(world), policy == self.policies[0]
        runtime, description, task, _ = load_gait(find_policy(policy), self._robot_name if is_first else None)
        robot = DrivenRobot(runtime, self._adjust(task, description) if is_first else task, make_world)
        self.policy, self.world = policy, world
        return robot

    def run(self, page: PageServer, view: RobotView, stop: threading.Event) -> None:
        """Run until `stop` is set. While no tab is open, time stands still."""
        self._page, self._view = page, view
        self._show_robot()
        begin, steps, speed, next_frame, next_report = time.perf_counter(), 0, self.speed, 0.0, 0.0
        while not stop.is_set():
            self._handle_messages()
            now, idle = time.perf_counter(), self.paused or not page.tabs
            if idle or speed != self.speed:
                begin, steps, speed = now, 0, self.speed
            if now >= next_report:
                next_report = now + _REPORT_PERIOD
                self._send_report()
            if idle:
                time.sleep(0.01)
                continue
            self._step()
            steps += 1
            if time.perf_counter() >= next_frame:
                next_frame = time.perf_counter() + _FRAME_PERIOD
                self._draw()
            simulated = steps * self.robot.step_time / speed
            time.sleep(max(begin + simulated - time.perf_counter(), 0.0))
            if (passed := time.perf_counter() - begin) > 1.0:
                self.real_time_share = min(simulated / passed, 1.0)
                # Lost time is not made up for: no real robot speeds up.
                begin, steps = time.perf_counter(), 0

    def _step(self) -> None:
        """Run a control step with the command of the source, or with the page's newest one."""
        if self.source is not None and self.robot.limits is not None:
            self.robot.command(self.source.read(self.robot.time))
        elif self._command_time and time.perf_counter() - self._command_time > _COMMAND_TIMEOUT:
            self._command(STAND)
        self.robot.step()

    def _draw(self) -> None:
        truth = self.robot.env.truth
        self._view.move(truth.base_position_world[0], truth.base_quat_world[0], truth.motor_angle[0])

    def _show_robot(self) -> None:
        """Show a new robot on the page."""
        self._view.show(self.robot.robot)
        self._draw()
        self._send_options()

    def _send_options(self) -> None:
        limits = self.robot.limits
        self._page.set_options(
            policies=self.policies,
            worlds=self.worlds,
            policy=self.policy,
            world=self.world,
            robot=self.robot.robot.name,
            legs=self.robot.robot.leg_names,
            source=self.source_name,
            limits=None if limits is None else [[*getattr(limits, name)] for name in COMMANDS],
            knobs=[asdict(knob) for knob in self.robot.knobs()],
            speeds=SPEEDS,
        )

    def _send_report(self) -> None:
        """Send the state of the robot."""
        share = round(self.real_time_share, 3)
        report: dict[str, Any] = {"paused": self.paused, "speed": self.speed, "share": share}
        if rows := self.robot.rows:
            last, count = rows[-1], min(len(rows), max(round(_MEAN_SPEED_TIME / self.robot.step_time), 1))
            recent = [rows[-k] for k in range(1, count + 1)]
            report |= {
                "time": round(last.time, 4),
                "velocity": np.mean([row.velocity for row in recent], axis=0).round(4).tolist(),
                "command": None if np.isnan(last.command).any() else last.command.round(4).tolist(),
                "torque": round(float(np.abs(last.torque).max()), 3),
                "heat": round(float(np.mean([row.heat for row in recent])), 2),
                "contact": (last.contact > 0.5).tolist(),
                "falls": self.robot.falls,
            }
        self._page.send(report=report)

    def _handle_messages(self) -> None:
        """Do what the page asked for since the last control step."""
        # No more than a second's worth of one tab, so that a flood can't hold up the robot.
        for _ in range(50):
            try:
                message = self._page.inbox.get_nowait()
            except queue.Empty:
                return
            for name, value in message.items():
                try:
                    self._handle(name, value)
                except SurefootError as error:
                    self._page.send(error=str(error))
                    if name == "set":
                        self._send_options()
                except (TypeError, ValueError, OverflowError):
                    self._page.send(error=f"message refused: {name}"[:100])

    def _handle(self, name: str, value: Any) -> None:
        if name == "command":
            self._command(finite_numbers(value[:3], 3))
            if len(value) == 4:
                self.delays.append(time.time() - finite_numbers(value[3:], 1)[0] / 1e3)
        elif name == "left":
            self._command(STAND)
        elif name == "set":
            self.robot.set(str(value[0]), *finite_numbers(value[1:], 1))
            self._page.send(done=[str(value[0]), float(value[1])])
        elif name == "push":
            force, degrees = finite_numbers(value, 2)
            direction = np.radians(degrees)
            self.robot.push([force * np.cos(direction), force * np.sin(direction), 0.0], _PUSH_DURATION)
        elif name == "pause":
            self.paused = bool(value)
        elif name == "restart":
            self.robot.restart()
        elif name == "speed":
            if value not in SPEEDS:
                raise SurefootError(f"speed must be {choices(map(str, SPEEDS))}")
            self.speed = float(value)
        elif name in ("policy", "world"):
            names = self.policies if name == "policy" else self.worlds
            if value not in names:
                raise SurefootError(f"{name} must be one of {choices(names)}")
            try:
                self.robot = self._load(**{"policy": self.policy, "world": self.world, name: value})
            finally:
                self._command_time = 0.0
                self._show_robot()

    def _command(self, command: Any) -> None:
        if self.robot.limits is not None and self.source is None:
            self.robot.command(command)
            self._command_time = time.perf_counter() if any(command) else 0.0


def finite_numbers(values: Any, count: int) -> list[float]:
    """Return the finite numbers of a browser's message; refuse what is none with `ValueError`."""
    if not isinstance(values, list) or len(values) != count or not all(type(x) in (int, float) for x in values):
        raise ValueError("not numbers")
    numbers = [float(x) for x in values]
    if not np.isfinite(numbers).all():
        raise ValueError("not finite")
    return numbers
