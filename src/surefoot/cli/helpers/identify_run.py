"""An experiment on a robot: handshake, plan, confirmation, run, recording."""

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
from surefoot.cli.helpers.options import Json, Settings, Yes, ask_to_move, check_terminal
from surefoot.cli.helpers.output import make_console
from surefoot.deploy.checks import check_handshake
from surefoot.deploy.display import PlainLines, open_display
from surefoot.deploy.loop import RunMonitor, Snapshot
from surefoot.deploy.messages import Handshake
from surefoot.deploy.pacer import real_time_priority
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.errors import SurefootError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.plan import Plan
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription
from surefoot.robot.params import parse_settings

PLACES = {True: "hang free, its legs in the air", False: "sit on flat ground with a metre of room"}
"""Where the robot must be, by whether it is an experiment for the rack."""


@dataclass(frozen=True, kw_only=True)
class ExperimentCommand(LinkOptions):
    """Run an experiment on a robot, or take a recording of one, and identify physical parameters.

    The plan is shown, and must be confirmed, before a motor moves. The recording is kept however the experiment ends;
    --record-only leaves the fit to another computer, such as one with MuJoCo. Exit codes: 0 done, 2 refused before
    anything moved or data that identify nothing, 3 stopped.
    """

    recording: Path | None = None
    """Take this recording instead of a robot: the folder of an experiment, or its file."""
    params: Path | None = None
    """File of the robot's parameters (.toml), to which the estimates are written. robot.toml in --out, if not given."""
    out: Path | None = None
    """Folder for recording and report; runs/identify/EXPERIMENT-TIME or the recording's, if not given."""
    plan: bool = False
    """Connect to nothing: show the plan of air, and what it would tell."""
    record_only: bool = False
    """Record and do not fit; needs the bare install only."""
    yes: Yes = False
    robot: str | None = None
    """Name or folder of the robot's description; the recording's, or else minitaur, if not given."""
    settings: Settings = ()
    """Gains of a robot over DDS, such as servo_kp=20 servo_kd=1.5; the data sheet's, if not given."""
    json: Json = False

    def open_robot(self, robot: RobotDescription) -> RobotLink:
        """Open the link to a robot; one over DDS gets the gains of --set."""
        gains = {"servo_kp": robot.actuator.kp, "servo_kd": robot.actuator.kd, **self.gains()}
        return self.open_with_gains(robot, (gains["servo_kp"], gains["servo_kd"]), 0.0, not self.yes)

    def gains(self) -> dict[str, float]:
        """Return the gains of --set.

        Raises:
            SurefootError: another parameter, or a robot on a serial port, whose own board has its gains.
        """
        stated = parse_settings([word for group in self.settings for word in group])
        for name in stated:
            if name not in ("servo_kp", "servo_kd"):
                raise SurefootError(f"--set names {name}; an experiment sets servo_kp and servo_kd")
        if stated and self.link == "serial":
            raise SurefootError("--set goes with --link dds; the gains of a robot on a serial port are on its board")
        return stated


def run_experiment(command: ExperimentCommand, plan: Plan, robot: RobotDescription, path: Path) -> Recording:
    """Run a plan on the robot that the command names, and keep the recording at a path, however it ended.

    Raises:
        SurefootError: no robot or another one, no confirmation, or a robot that does not arm: nothing has moved.
    """
    if not command.yes:
        check_terminal(PLACES[plan.rack])
    with _connect(command, robot) as (link, handshake):
        # What a robot does not take is not sent to it.
        show_plan(plan, handshake.robot, (handshake.angle_low, handshake.angle_high), make_console(stderr=command.json))
        if command.yes:
            return _run(command, link, plan, robot, path)
    # A robot does not wait for slow answers: it is connected anew.
    ask_to_move(PLACES[plan.rack])
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
        with contextlib.suppress(LinkLostError, OSError):
            link.close()


def check_robot(handshake: Handshake, robot: RobotDescription) -> None:
    """Refuse a robot that is not the one of the data sheet."""
    error = first_failure(check_handshake(handshake, robot))
    if error is not None:
        raise SurefootError(f"the robot is not as on its data sheet: {error}")


def show_plan(plan: Plan, name: str, taken: tuple[Array | float, Array | float], console: Console) -> None:
    """Print the plan for a robot by its name, which takes commands in a range."""
    limits = plan.limits
    low, high = np.maximum(plan.angle_low, taken[0]), np.minimum(plan.angle_high, taken[1])
    place = "on its rack, legs in the air" if plan.rack else "on flat ground"
    head = f"{plan.experiment} experiment with {name} {place}, {plan.duration:.0f} s and a second at rest"
    table = Table(title=head, title_justify="left", title_style="bold")
    table.add_column("phase")
    table.add_column("time", justify="right")
    table.add_column("what the robot does")
    # Each kind of phase with its count, in the order in which they first come.
    kinds: dict[tuple[str, str], list[float]] = {}
    for phase in plan.phases:
        kinds.setdefault((phase.name, phase.what), []).append(phase.duration)
    for (phase_name, what), times in kinds.items():
        counted = phase_name if len(times) == 1 else f"{phase_name} x {len(times)}"
        table.add_row(Text(counted), Text(f"{sum(times):.1f} s"), Text(what))
    console.print(table)
    pwm = f"; duty without servo at most {plan.largest_duty:g}" if plan.largest_duty else ""
    console.print(f"motor angles from {low.min():.2f} to {high.max():.2f} rad{pwm}")
    console.print(
        f"ends with damped motors when a motor leaves {plan.angle_low.min() - limits.angle_room:.2f} to "
        f"{plan.angle_high.max() + limits.angle_room:.2f} rad, gives more than "
        f"{limits.torque:g} N m for {limits.torque_time:g} s or is hotter than {limits.temperature:g} degC, after "
        f"{limits.duration:g} s, or with Ctrl-C",
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
    """Number of the phase and time left of a whole experiment, on the display of a robot."""

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
        """Return the duration of the phases that follow [s]."""
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
