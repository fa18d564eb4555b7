"""Run of an experiment on a robot: handshake, plan, confirmation, motion, recording."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from surefoot.arrays import Array
from surefoot.check_result import first_failure
from surefoot.cli.helpers.link_options import LinkOptions
from surefoot.cli.helpers.options import PLACES, Json, Settings, Yes, ask_to_move, check_terminal
from surefoot.cli.helpers.output import make_console, print_warning
from surefoot.deploy.checks import check_handshake
from surefoot.deploy.display import PlainLines, open_display
from surefoot.deploy.loop import RunMonitor, Snapshot
from surefoot.deploy.messages import Handshake
from surefoot.deploy.pacer import real_time_priority
from surefoot.deploy.robot_link import LinkLostError, RobotLink, close_link
from surefoot.errors import SurefootError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.plan import Plan
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription
from surefoot.robot.params import GAINS, parse_settings


@dataclass(frozen=True, kw_only=True)
class ExperimentCommand(LinkOptions):
    """Run an experiment on a robot, or load its recording, and identify physical parameters.

    The plan is printed and must be confirmed before a motor moves. The recording is saved however the experiment ends;
    with --record-only the fit is left to another computer, such as one with MuJoCo. Exit codes: 0: completed;
    2: rejected before anything moved, or no parameter is identifiable from the data; 3: stopped.
    """

    recording: Path | None = None
    """Fit this recording instead of running the experiment: the folder of an experiment, or its recording file."""
    params: Path | None = None
    """File of the robot's parameters (.toml) to which the estimates are written. Defaults to robot.toml in --out."""
    out: Path | None = None
    """Folder for recording and report. Defaults to runs/identify/EXPERIMENT-TIME, or the folder of --recording."""
    plan: bool = False
    """Print the plan of the experiment air and the accuracy that it would achieve; no robot is connected."""
    record_only: bool = False
    """Record without fitting; requires only the bare install."""
    yes: Yes = False
    robot: str | None = None
    """Name or folder of the robot. Defaults to the recording's robot, or else minitaur."""
    settings: Settings = ()
    """Gains of a robot over DDS, such as servo_kp=20 servo_kd=1.5. Defaults to the data sheet."""
    json: Json = False

    def open_robot(self, robot: RobotDescription) -> RobotLink:
        """Open the link to a robot; a robot over DDS receives the gains of --set."""
        gains = {"servo_kp": robot.actuator.kp, "servo_kd": robot.actuator.kd, **self.gains()}
        return self.open_with_gains(robot, (gains["servo_kp"], gains["servo_kd"]), 0.0, not self.yes)

    def gains(self) -> dict[str, float]:
        """Return the gains of --set.

        Raises:
            SurefootError: another parameter, or a robot on a serial port, whose gains are stored on its board.
        """
        stated = parse_settings([word for group in self.settings for word in group])
        for name in stated:
            if name not in GAINS:
                raise SurefootError(f"--set names {name}; it must be servo_kp or servo_kd")
        if stated and self.link == "serial":
            raise SurefootError("--set requires --link dds; a robot on a serial port stores its gains on its board")
        return stated


def run_experiment(command: ExperimentCommand, plan: Plan, robot: RobotDescription, path: Path) -> Recording:
    """Run a plan on the command's robot, and save the recording to a path, however the run ends.

    Raises:
        SurefootError: nothing has moved: the robot does not answer, differs or does not arm, or was not confirmed.
    """
    if not command.yes:
        check_terminal(PLACES[plan.rack])
    # A Go2's own controller must not take the robot back while the operator reads the plan.
    first = command if command.yes else replace(command, hand_back=False)
    try:
        with _connect(first, robot) as (link, handshake):
            # Angles outside the robot's limits are not sent to it.
            show_plan(
                plan, handshake.robot, (handshake.angle_low, handshake.angle_high), make_console(stderr=command.json)
            )
            if command.yes:
                return _run(command, link, plan, robot, path)
        # The robot's connection times out while the operator answers, so it is connected again.
        ask_to_move(PLACES[plan.rack])
    except BaseException:
        if command.hand_back and not command.yes:
            again = replace(command, release=False, yes=True)  # it neither moves nor asks
            with contextlib.suppress(SurefootError, LinkLostError, OSError), _connect(again, robot):
                pass
        raise
    with _connect(command, robot) as (link, _):
        return _run(command, link, plan, robot, path)


@contextlib.contextmanager
def _connect(command: ExperimentCommand, robot: RobotDescription) -> Iterator[tuple[RobotLink, Handshake]]:
    link = command.open_robot(robot)
    try:
        handshake = link.connect()
        check_robot(handshake, robot)
        yield link, handshake
    finally:
        close_link(link, print_warning)


def check_robot(handshake: Handshake, robot: RobotDescription) -> None:
    """Check that the connected robot matches its data sheet."""
    error = first_failure(check_handshake(handshake, robot))
    if error is not None:
        raise SurefootError(f"the robot does not match its data sheet: {error}")


def show_plan(plan: Plan, name: str, angle_limits: tuple[Array | float, Array | float], console: Console) -> None:
    """Print the plan for a robot by name, which accepts motor angles between its limits (low, high) [rad]."""
    limits = plan.limits
    low, high = np.maximum(plan.angle_low, angle_limits[0]), np.minimum(plan.angle_high, angle_limits[1])
    place = "on its rack, legs in the air" if plan.rack else "on flat ground"
    head = f"{plan.experiment} experiment with {name} {place}, {plan.duration:.0f} s and a second at rest"
    table = Table(title=head, title_justify="left", title_style="bold")
    table.add_column("phase")
    table.add_column("time", justify="right")
    table.add_column("motion")
    # Each kind of phase with its number of repetitions, in the order of first occurrence.
    kinds: dict[tuple[str, str], list[float]] = {}
    for phase in plan.phases:
        kinds.setdefault((phase.name, phase.description), []).append(phase.duration)
    for (phase_name, what), times in kinds.items():
        counted = phase_name if len(times) == 1 else f"{phase_name} x {len(times)}"
        table.add_row(Text(counted), Text(f"{sum(times):.1f} s"), Text(what))
    console.print(table)
    pwm = f"; duty without the servo up to {plan.largest_duty:g}" if plan.largest_duty else ""
    console.print(f"motor angles from {low.min():.2f} to {high.max():.2f} rad{pwm}")
    torque = " or ".join(f"{one:g}" for one in np.unique(limits.torque).tolist())  # of different motors
    console.print(
        f"motors are damped if an angle leaves {plan.angle_low.min() - limits.angle_margin:.2f} to "
        f"{plan.angle_high.max() + limits.angle_margin:.2f} rad, a torque exceeds "
        f"{torque} N m for {limits.torque_time:g} s or a temperature {limits.temperature:g} degC, after "
        f"{limits.duration:g} s, or by Ctrl-C",
    )


def _run(command: ExperimentCommand, link: RobotLink, plan: Plan, robot: RobotDescription, path: Path) -> Recording:
    with contextlib.ExitStack() as stack:
        watch = ExperimentProgress(plan, f"{plan.experiment} experiment, {robot.name}, {command.address}")
        stack.callback(watch.close)
        if not command.lockstep:
            stack.enter_context(real_time_priority())
        recording = run_plan(link, plan, robot, watch)
    recording.save(path)
    return recording


class ExperimentProgress(RunMonitor):
    """Monitor that adds the phase number and the remaining time of an experiment to a robot's display."""

    def __init__(self, plan: Plan, title: str) -> None:
        self._display = open_display(title)
        self._phases, self._number, self._name = plan.phases, 0, ""

    def phase(self, name: str, duration: float) -> None:
        """Show the start of a phase."""
        self._number += 1
        self._name = f"{name}, {self._number} of {len(self._phases)}"
        left = duration + self._remaining()
        if isinstance(self._display, PlainLines):
            self._display.phase(f"{self._name}, {left:.0f} s left", 0.0)
        else:
            self._display.phase(self._name, left)

    def tick(self, snapshot: Snapshot) -> None:
        """Show the state of the robot."""
        self._display.tick(replace(snapshot, phase=self._name, left=snapshot.left + self._remaining()))

    def _remaining(self) -> float:
        """Return the total duration of the remaining phases [s]."""
        return sum(phase.duration for phase in self._phases[self._number :])

    def warn(self, text: str) -> None:
        """Show a warning."""
        self._display.warn(text)

    def recording(self, text: str) -> None:
        """Show the state of the recording."""
        self._display.recording(text)

    def close(self) -> None:
        """End the display."""
        self._display.close()
