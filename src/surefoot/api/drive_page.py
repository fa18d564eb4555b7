"""Drive page: a robot simulated in real time, which is steered from a page in the browser."""

from __future__ import annotations

import contextlib
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from surefoot.api.policies import find_policy, load_gait
from surefoot.api.policy_list import list_policies
from surefoot.errors import SurefootError, choices
from surefoot.robot.commands import COMMANDS, STAND_COMMAND
from surefoot.world.registry import WORLDS
from surefoot.world.terrain import KINDS, check_size, is_map

if TYPE_CHECKING:
    from surefoot.deploy.command_sources import CommandSource
    from surefoot.evaluation.command_runs import DrivenRobot
    from surefoot.report.pages.messages import DriveMessage
    from surefoot.report.pages.server import PageServer
    from surefoot.report.pages.view import RobotView
    from surefoot.task.config import TaskConfig

SPEEDS = (1.0, 0.5, 0.25, 0.1)
"""Simulation speeds that the page offers, relative to real time."""
_FRAME_PERIOD = 1 / 30
"""Time between two frames of the 3D view [s]."""
_REPORT_PERIOD = 1 / 15
"""Time between two points of the plots [s]."""
_COMMAND_TIMEOUT = 3.0
"""Time after which a command ends unless it is repeated [s]."""
_PUSH_DURATIONS = (0.1, 0.3, 1.0)
"""Durations of pushes that the page offers [s]."""
_DEFAULT_SIZES = {
    **{"stairs": 0.08, "stairs_down": 0.10, "slope": 15.0, "slope_down": 15.0},
    **{"rough": 0.08, "blocks": 0.06, "gaps": 0.15, "stones": 0.40},
}
"""Initial size of each kind of terrain, in its unit."""
_SIZE_STEPS = {"m": 0.005, "deg": 0.5}
"""Step of the slider for the terrain's size, by unit."""
RECORDINGS = Path("recordings")
"""Default folder of recordings."""
_LIST_PERIOD = 10.0
"""Time between two searches for policies of new runs [s]."""
_MEAN_SPEED_TIME = 0.25
"""Time over which plotted speeds are averaged [s]."""


def serve(drive: DrivePage, host: str | None, port: int, commands: str | None = None) -> None:
    """Serve the page and run its simulation until Ctrl-C; `commands` is another source of commands than the page.

    Raises:
        SurefootError: the port is in use, or the source of commands can't be opened.
    """
    from surefoot.deploy.command_sources import open_commands
    from surefoot.report.pages.server import robot_page

    with contextlib.ExitStack() as stack:
        if commands is not None:
            if drive.robot.limits is None:
                raise SurefootError(f"--commands is given; policy '{drive.policy}' follows no commands")
            drive.source, drive.source_name = open_commands(commands, drive.robot.limits), commands
            stack.callback(drive.source.close)
        page, view = stack.enter_context(robot_page(host, port))
        page.print_addresses()
        drive.run(page, view, threading.Event())


class DrivePage:
    """Simulation behind the drive page.

    Args:
        policy: path or name of the first policy.
        world: name of the world.
        robot: name or folder of the robot; defaults to the policy's.
        adjust: function that changes the simulator of the first policy's task; other policies' tasks stay unchanged.
        recordings: folder of recordings.
        terrain: flat, KIND:SIZE, or the path of a height map.
    """

    source: CommandSource | None = None
    """Source of commands instead of the page."""
    source_name = ""

    def __init__(
        self,
        policy: str,
        world: str,
        robot: str | None = None,
        adjust: Callable[[TaskConfig], TaskConfig] = lambda task: task,
        recordings: Path = RECORDINGS,
        terrain: str = "flat",
    ) -> None:
        from surefoot.api.drive_recordings import DriveRecordings

        self.worlds = [name for name, entry in WORLDS.items() if find_spec(entry.package) is not None]
        self._first, self._robot_name, self._adjust = policy, robot, adjust
        self.recordings = DriveRecordings(recordings)
        self.paused, self.speed = False, 1.0
        self.delays: deque[float] = deque(maxlen=10_000)
        """Delays from an input in the browser to its command in the simulation [s], for a browser on this machine."""
        self.real_time_factor = 1.0
        """Ratio of the achieved to the selected simulation speed, over about the last second."""
        self._command_time = 0.0
        self._settings: dict[str, float] = {}
        """Parameters set on the page, which are applied to every robot that is loaded."""
        self.policy, self.world, self.terrain = policy, world, terrain
        self._maps = [terrain] if is_map(terrain) else []
        self.robot, self._name = self._load(policy, world, terrain)
        self._robot_name = self.robot.env.task.robot
        self.ghost: DrivenRobot | None = None
        """Second robot for comparison, with the same commands, pushes and parameters."""
        self.ghost_policy, self._ghost_name, self._ghost_offset = "", "", 0.0
        self._list_policies()

    def _list_policies(self) -> bool:
        """Update the list of policies for the robot; return whether it has changed."""
        before = getattr(self, "policies", None)
        self._listed = time.monotonic()
        # The simulation continues if a policy's folder has been moved or removed.
        with contextlib.suppress(SurefootError) if before else contextlib.nullcontext():
            self.policies = list_policies(self._first, self.robot.robot.name)
        return self.policies != before

    def _load(self, policy: str, world: str, terrain: str) -> tuple[DrivenRobot, str]:
        """Return a simulated robot with a policy in a world on a terrain, and the name in the policy's contract."""
        from surefoot.evaluation.command_runs import DrivenRobot

        runtime, _, task, origin = load_gait(find_policy(policy), self._robot_name)
        task = self._adjust(task) if policy == self._first else task
        robot = DrivenRobot(runtime, task, world, terrain)
        for name, value in self._settings.items():
            with contextlib.suppress(SurefootError):  # this world or robot does not have the parameter
                robot.set(name, value)
        return robot, origin["name"]

    @property
    def _robots(self) -> list[DrivenRobot]:
        return [self.robot] if self.ghost is None else [self.robot, self.ghost]

    def run(self, page: PageServer, view: RobotView, stop: threading.Event) -> None:
        """Run until `stop` is set; the simulation is paused while no tab is open."""
        self._page, self._view = page, view
        try:
            self._run(page, stop)
        finally:
            self.recordings.close()

    def _run(self, page: PageServer, stop: threading.Event) -> None:
        self._show_robot()
        begin, steps, speed, next_frame, next_report = time.perf_counter(), 0, self.speed, 0.0, 0.0
        while not stop.is_set():
            self._handle_messages()
            self._update_recordings()
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
                self.real_time_factor = min(simulated / passed, 1.0)
                # Lost time is not caught up by running faster than real time.
                begin, steps = time.perf_counter(), 0

    def _step(self) -> None:
        """Run a control step with the command of the source or of the page."""
        if self.source is not None and self.robot.limits is not None:
            self._set_command(self.source.read(self.robot.time))
        elif self._command_time and time.perf_counter() - self._command_time > _COMMAND_TIMEOUT:
            self._command(STAND_COMMAND)
        if self.ghost is not None and any(robot.must_stand_up for robot in self._robots):
            self._restart()
        self.robot.step()
        if self.ghost is not None:
            # The ghost may have another control step.
            while self.ghost.time + self._ghost_offset < self.robot.time - 1e-9:
                self.ghost.step()

    def _restart(self) -> None:
        """Restart all robots at the start."""
        for robot in self._robots:
            robot.restart()
        if self.ghost is not None:
            self._ghost_offset = self.robot.time - self.ghost.time

    def _update_recordings(self) -> None:
        """Make recorded files available to the browser, and report errors."""
        self.recordings.update()
        for path in list(self.recordings.files.values()):
            self._page.files[path.name] = path
        if self.recordings.error:
            self._page.send(error=self.recordings.error)
            self.recordings.error = ""

    def _draw(self) -> None:
        truths = [robot.env.state.truth for robot in self._robots]
        self._view.move(*((t.base_position_world[0], t.base_quat_world[0], t.motor_angle[0]) for t in truths))
        self._view.show_push(self.robot.push_force_world)

    def _show_robot(self) -> None:
        """Show new robots on the page."""
        self._view.show(self.robot.env.state.ground, *(robot.robot for robot in self._robots))
        self._draw()
        self._send_options()

    def _send_options(self) -> None:
        limits, robot = self.robot.limits, self.robot.robot
        self._page.set_options(
            policies=self.policies,
            worlds=self.worlds,
            policy=self.policy,
            ghost=self.ghost_policy,
            world=self.world,
            terrain=self.terrain,
            terrains=_terrains() | {path: None for path in self._maps},
            robot=robot.name,
            weight=round(robot.weight, 2),
            node=f"/world/{robot.base}",
            legs=robot.leg_names,
            source=self.source_name,
            limits=None if limits is None else [[*getattr(limits, name)] for name in COMMANDS],
            live_parameters=self._live_parameters(),
            speeds=SPEEDS,
            pushes=_PUSH_DURATIONS,
        )

    def _send_report(self) -> None:
        """Send the state of the robots."""
        if time.monotonic() - self._listed > _LIST_PERIOD and self._page.tabs and self._list_policies():
            self._send_options()
        report: dict[str, Any] = {
            "paused": self.paused,
            "speed": self.speed,
            "share": round(self.real_time_factor, 3),
            "recording": self.recordings.report(),
        }
        if rows := self.robot.rows:
            report |= _plot_values(self.robot) | {
                "time": round(rows[-1].time, 4),
                "contact": (rows[-1].contact > 0.5).tolist(),
            }
            command = self.robot.commanded if self.robot.limits is not None else None
            report |= {"command": None if command is None else command.round(4).tolist()}
        if self.ghost is not None and self.ghost.rows:
            report["ghost"] = _plot_values(self.ghost)
        self._page.send(report=report)

    def _handle_messages(self) -> None:
        """Handle the messages received since the last control step."""
        # A limited number, about one second of messages from a tab, so that a flood can't stall the simulation.
        for _ in range(50):
            try:
                message = self._page.inbox.get_nowait()
            except queue.Empty:
                return
            try:
                self._handle(message)
            except (SurefootError, OSError) as error:
                self._page.send(error=str(error))
                if message is not None and message.set is not None:
                    self._send_options()

    def _handle(self, message: DriveMessage | None) -> None:
        """Handle a message from a tab; None means that the controlling tab was closed."""
        if message is None:
            self._command(STAND_COMMAND)
            return
        if message.command is not None:
            self._command(message.command)
        if message.moved is not None:
            self.delays.append(time.time() - message.moved / 1e3)
        if message.set is not None:
            self._set(*message.set)
        if message.push is not None:
            self._push(*message.push)
        if message.pause is not None:
            self.paused = message.pause
        if message.restart is not None:
            self._restart()
        if message.speed is not None:
            if message.speed not in SPEEDS:
                raise SurefootError(f"speed must be one of {choices(map(str, SPEEDS))}")
            self.speed = message.speed
        if message.record is not None:
            self._record(message.record)
        if message.export is not None:
            self.recordings.export(message.export)
        if message.terrain is not None:
            self._choose_terrain(*message.terrain)
        for what in ("policy", "world", "ghost"):
            if (name := getattr(message, what)) is not None:
                self._choose(what, name)

    def _push(self, force: float, degrees: float, duration: float) -> None:
        if duration not in _PUSH_DURATIONS:
            raise SurefootError(f"the duration of a push must be one of {choices(map(str, _PUSH_DURATIONS))} s")
        direction = np.radians(degrees)
        for robot in self._robots:
            robot.push([force * np.cos(direction), force * np.sin(direction), 0.0], duration)

    def _set(self, name: str, value: float) -> None:
        for robot in reversed(self._robots):  # the ghost first: if it rejects the value, nothing changes
            robot.set(name, value)
        self._settings[name] = value
        self._page.update_options(live_parameters=self._live_parameters())
        self._page.send(done=[name, value])

    def _live_parameters(self) -> list[dict[str, Any]]:
        return [asdict(knob) for knob in self.robot.live_parameters()]

    def _record(self, on: bool) -> None:
        if on and not self.recordings.is_recording:
            names = [self._name] if self.ghost is None else [self._name, f"{self._ghost_name} (ghost)"]
            self.recordings.start(dict(zip(names, self._robots, strict=True)), self.terrain)
        elif not on and self.recordings.is_recording:
            self.recordings.stop()

    def _choose_terrain(self, kind: str, size: float | None = None) -> None:
        names = ["flat", *KINDS, *self._maps]
        if kind not in names:
            raise SurefootError(f"terrain must be one of {choices(names)}")
        if kind not in KINDS:
            self._load_chosen("terrain", kind)
            return
        size = _DEFAULT_SIZES[kind] if size is None else size
        check_size(kind, size)
        self._load_chosen("terrain", f"{kind}:{size:g}")

    def _choose(self, what: str, value: str) -> None:
        names = self.worlds if what == "world" else [entry.name for entry in self.policies]
        if value not in names and (what, value) != ("ghost", ""):
            raise SurefootError(f"{what} must be one of {choices(names)}")
        self._load_chosen(what, value)

    def _load_chosen(self, what: str, value: str) -> None:
        """Load another policy, world, terrain or ghost; the command and parameters set on the page are kept."""
        self._record(False)
        command = self.robot.commanded
        names = {"policy": self.policy, "world": self.world, "terrain": self.terrain, "ghost": self.ghost_policy}
        chosen = names | {what: value}
        place = chosen["world"], chosen["terrain"]
        try:
            robot, ghost = (self.robot, self._name), (self.ghost, self._ghost_name)
            if what != "ghost":
                robot = self._load(chosen["policy"], *place)
            if what != "policy":
                ghost = self._load(chosen["ghost"], *place) if chosen["ghost"] else (None, "")
            (self.robot, self._name), (self.ghost, self._ghost_name) = robot, ghost
            self.policy, self.world, self.terrain, self.ghost_policy = chosen.values()
        finally:
            if self.ghost is not None:
                self._restart()
            self._set_command(command)
            self._show_robot()

    def _command(self, command: Any) -> None:
        if self.robot.limits is not None and self.source is None:
            self._set_command(command)
            self._command_time = time.perf_counter() if any(command) else 0.0

    def _set_command(self, command: Any) -> None:
        for robot in self._robots:
            if robot.limits is not None:
                robot.command(command)


def _terrains() -> dict[str, Any]:
    """Return the kinds of terrain for the page: unit, meaning, minimum, maximum, step and initial value of the size."""
    kinds: dict[str, Any] = {"flat": None}
    for name, kind in KINDS.items():
        step = kind.multiple or _SIZE_STEPS[kind.unit]
        kinds[name] = [kind.unit, kind.meaning, *kind.range, step, _DEFAULT_SIZES[name]]
    return kinds


def _plot_values(robot: DrivenRobot) -> dict[str, Any]:
    """Return the values of a robot for the page's plots."""
    rows = robot.rows
    count = min(len(rows), max(round(_MEAN_SPEED_TIME / robot.step_time), 1))
    recent = [rows[-k] for k in range(1, count + 1)]
    return {
        "velocity": np.mean([row.velocity for row in recent], axis=0).round(4).tolist(),
        "torque": round(float(np.abs(rows[-1].torque).max()), 3),
        "heat": round(float(np.mean([row.heat for row in recent])), 2),
        "falls": robot.falls,
    }
