"""`surefoot drive`: a page in the browser to steer, disturb and change a simulated robot while it runs."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from surefoot.cli.helpers.options import PAGE_PORT, PagePort, PolicyName, World
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError, choices
from surefoot.robot.commands import COMMANDS, STAND
from surefoot.world.registry import WORLDS, find_world

if TYPE_CHECKING:
    from surefoot.deploy.command_sources import CommandSource
    from surefoot.evaluate.driven import DrivenRobot
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView
    from surefoot.robot import RobotDescription
    from surefoot.task.config import TaskConfig

    Adjust = Callable[[TaskConfig, RobotDescription], TaskConfig]

SPEEDS = (1.0, 0.5, 0.25, 0.1)
"""Simulated over real time that a page may choose."""
_FRAME = 1 / 30
"""Time between pictures [s]."""
_NEWS = 1 / 15
"""Time between the plots' points [s]."""
_SILENCE = 3.0
"""Time after which a command that is not sent again ends [s]."""
_PUSH = 0.1
"""How long a push lasts [s]."""
_SMOOTH = 0.25
"""Time over which plotted speeds are means [s]."""


@dataclass(frozen=True)
class DriveCommand:
    """Drive a simulated robot from a page in the browser."""

    policy: PolicyName
    world: World = "mujoco"
    robot: str | None = None
    """Name or folder of the robot; the one of the policy's task, if not given."""
    port: PagePort = PAGE_PORT
    commands: str | None = None
    """What steers in place of the page: a file (CSV: time, forward, sideways, yaw_rate), keyboard or gamepad at this
    terminal, or the number of a UDP port on this computer."""
    host: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address to listen at for other machines, such as 0.0.0.0; the page's address then holds a token. Without it only
    this machine can open the page."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; return the exit code."""
    command = parse(DriveCommand, argv, "surefoot drive")
    serve(Drive(command.policy, command.world, command.robot), command.host, command.port, command.commands)
    return 0


def serve(drive: Drive, host: str | None, port: int, commands: str | None) -> None:
    """Serve the page and run the simulation behind it until Ctrl-C.

    Args:
        drive: the simulation.
        host: address to listen at; none: this machine only.
        port: TCP port; 0 for a free one.
        commands: what steers in place of the page, as `open_commands` takes it.

    Raises:
        SurefootError: a port that is taken, or commands that can't be had.
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


class Drive:
    """The simulation behind a page: steps in real time, and does what the page says.

    Args:
        policy: path, or name of one that ships.
        world: name of the world.
        robot: name or folder of the robot; the one of the policy's task, if None.
        adjust: changes that policy's task, which is for the robot that is given too; other policies' stay as they are.
    """

    source: CommandSource | None = None
    """What steers in place of the page."""
    source_name = ""

    def __init__(self, policy: str, world: str, robot: str | None = None, adjust: Adjust | None = None) -> None:
        from surefoot.cli.helpers.policies import SHELVES

        shipped = sorted({path.stem for shelf in SHELVES for path in shelf.glob("*.onnx")})
        self.policies = list(dict.fromkeys([policy, *shipped]))
        self.worlds = [name for name, entry in WORLDS.items() if find_spec(entry.package) is not None]
        self._robot_given, self._adjust = robot, adjust
        self.paused, self.speed = False, 1.0
        self.delays: deque[float] = deque(maxlen=10_000)
        """Time from a hand's movement in the browser to its command in the simulation [s], on one machine."""
        self.kept = 1.0
        """Share of real time that was kept in the last second or so."""
        self._heard = 0.0
        self.robot = self._load(policy, world)

    def _load(self, policy: str, world: str) -> DrivenRobot:
        from surefoot.cli.helpers.policies import find_policy, load_gait
        from surefoot.evaluate.driven import DrivenRobot

        make = find_world(world)
        given = self._robot_given if policy == self.policies[0] else None
        runtime, described, task, _ = load_gait(find_policy(policy), given)
        if self._adjust is not None and policy == self.policies[0]:
            task = self._adjust(task, described)
        robot = DrivenRobot(runtime, task, make)
        self.policy, self.world = policy, world
        return robot

    def run(self, page: PageServer, view: RobotView, stop: threading.Event) -> None:
        """Run until `stop` is set; while no tab is open, time stands still."""
        self._page, self._view = page, view
        self._show()
        begin, frame, news, steps, speed = time.perf_counter(), 0.0, 0.0, 0, self.speed
        while not stop.is_set():
            self._take()
            now = time.perf_counter()
            if speed != self.speed:
                begin, steps, speed = now, 0, self.speed
            if self.paused or not page.tabs:
                if now >= news:
                    news = now + 0.25
                    self._tell()
                time.sleep(0.01)
                begin, steps = time.perf_counter(), 0
                continue
            if self.source is not None and self.robot.limits is not None:
                self.robot.command(self.source.read(self.robot.time))
            elif self._heard and now - self._heard > _SILENCE:
                self._command(STAND)
            self.robot.step()
            steps += 1
            now, due = time.perf_counter(), begin + steps * self.robot.step_time / self.speed
            if now >= frame:
                frame = now + _FRAME
                truth = self.robot.env.truth
                view.move(truth.base_position_world[0], truth.base_quat_world[0], truth.motor_angle[0])
            if now >= news:
                news = now + _NEWS
                self._tell()
            wait = due - time.perf_counter()
            if wait > 0:
                time.sleep(wait)
            if (passed := time.perf_counter() - begin) > 1.0:
                self.kept = min(steps * self.robot.step_time / self.speed / passed, 1.0)
                # What was late stays late: a robot that hurries to catch up would be no robot.
                begin, steps = time.perf_counter(), 0

    def _show(self) -> None:
        """Tell the page about a new robot."""
        self._view.show(self.robot.robot)
        truth = self.robot.env.truth
        self._view.move(truth.base_position_world[0], truth.base_quat_world[0], truth.motor_angle[0])
        self._greet()

    def _greet(self) -> None:
        limits = self.robot.limits
        self._page.greet(
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

    def _tell(self) -> None:
        """Tell the page how the robot is."""
        news: dict[str, Any] = {"paused": self.paused, "speed": self.speed, "kept": round(self.kept, 3)}
        if rows := self.robot.rows:
            count = min(len(rows), max(round(_SMOOTH / self.robot.step_time), 1))
            recent = [rows[-k] for k in range(1, count + 1)]
            last = rows[-1]
            news |= {
                "time": round(last.time, 4),
                "velocity": np.mean([row.velocity for row in recent], axis=0).round(4).tolist(),
                "command": None if np.isnan(last.command).any() else last.command.round(4).tolist(),
                "torque": round(float(np.abs(last.torque).max()), 3),
                "heat": round(float(np.mean([row.heat for row in recent])), 2),
                "contact": (last.contact > 0.5).tolist(),
                "falls": self.robot.falls,
            }
        self._page.tell(news=news)

    def _take(self) -> None:
        """Do what the page said since the last control step."""
        # No more than a second's worth of one tab, so that a flood can't hold up the robot.
        for _ in range(50):
            try:
                given = self._page.inbox.get_nowait()
            except queue.Empty:
                return
            for word, value in given.items():
                try:
                    self._do(word, value)
                except SurefootError as error:
                    self._page.tell(error=str(error))
                    if word == "set":
                        self._greet()
                except (TypeError, ValueError, OverflowError):
                    self._page.tell(error=f"message refused: {word}"[:100])

    def _do(self, word: str, value: Any) -> None:
        if word == "command":
            self._command(finite_numbers(value[:3], 3))
            if len(value) == 4:
                self.delays.append(time.time() - finite_numbers(value[3:], 1)[0] / 1e3)
        elif word == "left":
            self._command(STAND)
        elif word == "set":
            self.robot.set(str(value[0]), *finite_numbers(value[1:], 1))
            self._page.tell(done=[str(value[0]), float(value[1])])
        elif word == "push":
            force, degrees = finite_numbers(value, 2)
            turn = np.radians(degrees)
            self.robot.push([force * np.cos(turn), force * np.sin(turn), 0.0], _PUSH)
        elif word == "pause":
            self.paused = bool(value)
        elif word == "speed":
            if value not in SPEEDS:
                raise SurefootError(f"speed must be {choices(map(str, SPEEDS))}")
            self.speed = float(value)
        elif word == "restart":
            self.robot.restart()
        elif word in ("policy", "world"):
            known = self.policies if word == "policy" else self.worlds
            if value not in known:
                raise SurefootError(f"{word} must be one of {choices(known)}")
            asked = {"policy": self.policy, "world": self.world, word: value}
            try:
                self.robot = self._load(asked["policy"], asked["world"])
            finally:
                self._heard = 0.0
                self._show()

    def _command(self, command: Any) -> None:
        if self.robot.limits is not None and self.source is None:
            self.robot.command(command)
            self._heard = time.perf_counter() if any(command) else 0.0


def finite_numbers(given: Any, count: int) -> list[float]:
    """Return finite numbers from a browser's message."""
    if not isinstance(given, list) or len(given) != count or not all(type(x) in (int, float) for x in given):
        raise ValueError("not numbers")
    values = [float(x) for x in given]
    if not np.isfinite(values).all():
        raise ValueError("not finite")
    return values
