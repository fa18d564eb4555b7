"""An experiment on a robot: greet it, say what is going to happen, ask, run it, keep what was recorded."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TextIO

import numpy as np
from rich.console import Console
from rich.table import Table
from rich.text import Text

from surefoot.deploy.connection import RobotConnection, open_connection
from surefoot.deploy.display import LiveDisplay, PlainLines
from surefoot.deploy.link import LinkLostError
from surefoot.deploy.loop import Snapshot, Watch
from surefoot.deploy.realtime import undisturbed
from surefoot.deploy.wire.messages import Handshake
from surefoot.errors import SurefootError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.plan import Plan
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription

PLACES = {True: "hang free, its legs in the air", False: "sit on flat ground with a metre of room"}
"""Where the robot must be, by whether it is an experiment for the rack."""
_PERIOD = 0.05
"""How far the robot's servo period may be from the data sheet's, as a share."""


@dataclass(frozen=True)
class Session:
    """How to reach a robot, and who is asked."""

    port: str
    """Serial port or pseudo-terminal."""
    lockstep: bool
    """The robot is an emulator that follows this computer's clock."""
    baud: int
    """Bits a second."""
    yes: bool
    """Do not ask before motors move."""
    quiet: bool = False
    """Leave stdout alone: what is said goes to stderr."""


def run_experiment(session: Session, plan: Plan, robot: RobotDescription, path: Path) -> Recording:
    """Run a plan and keep the recording, however it ended.

    Args:
        session: to whom, and how.
        plan: what to do.
        robot: data sheet of the robot that must be there.
        path: file for the recording.

    Raises:
        SurefootError: no robot or another one, nobody who says yes, or a robot that does not arm: nothing has moved.
    """
    asks = not session.yes
    if asks and not sys.stdin.isatty():
        raise SurefootError(
            f"motors will move and the robot must {PLACES[plan.rack]}; without a terminal, say so with --yes"
        )
    with _greeted(session, robot) as connection:
        _show_plan(session, plan, connection.handshake)
        if not asks:
            recording = _run(session, connection, plan, robot)
            recording.save(path)
            return recording
    # A robot does not wait for slow answers: it is greeted anew.
    _ask(plan)
    with _greeted(session, robot) as connection:
        recording = _run(session, connection, plan, robot)
        recording.save(path)
    return recording


@contextlib.contextmanager
def _greeted(session: Session, robot: RobotDescription) -> Iterator[RobotConnection]:
    connection = open_connection(session.port, robot.num_motors, session.lockstep, session.baud)
    try:
        check_robot(connection.connect(), robot)
        yield connection
    finally:
        with contextlib.suppress(LinkLostError, OSError):
            connection.close()


def check_robot(handshake: Handshake, robot: RobotDescription) -> None:
    """Refuse a robot that is not the one of the data sheet.

    Raises:
        SurefootError: says what differs.
    """
    if handshake.robot != robot.name:
        raise SurefootError(f"the robot says that it is '{handshake.robot}', and the data sheet is of '{robot.name}'")
    motors = zip(robot.motor_names, robot.motor_sign, handshake.motor_names, handshake.motor_signs, strict=True)
    for index, (name, sign, their_name, their_sign) in enumerate(motors):
        if name != their_name:
            raise SurefootError(
                f"motor {index} is '{their_name}' (robot), '{name}' (data sheet); names and order must be the same"
            )
        if float(sign) != float(their_sign):
            raise SurefootError(
                f"{name} has sign {their_sign:+g} (robot), {sign:+g} (data sheet); they must be the same"
            )
    period = robot.timing.servo_step
    if abs(handshake.servo_period - period) > _PERIOD * period:
        raise SurefootError(
            f"the robot's servos step every {1e3 * handshake.servo_period:g} ms; the data sheet says {1e3 * period:g} "
            f"ms, and it must be within {_PERIOD:.0%}"
        )


def _show_plan(session: Session, plan: Plan, handshake: Handshake | None) -> None:
    """Say what is going to happen."""
    console = Console(stderr=session.quiet, highlight=False, soft_wrap=True, emoji=False)
    limits = plan.limits
    name, low, high = "the robot", plan.angle_low, plan.angle_high
    if handshake is not None:
        # What a robot does not take is not sent to it.
        name = handshake.robot
        low, high = np.maximum(low, handshake.angle_low), np.minimum(high, handshake.angle_high)
    place = "on its rack, legs in the air" if plan.rack else "on flat ground"
    head = f"{plan.experiment} experiment with {name} {place}, {plan.duration:.0f} s and a second at rest"
    table = Table(title=head, title_justify="left", title_style="bold")
    for name, justify in (("phase", "left"), ("time", "right"), ("what the robot does", "left")):
        table.add_column(name, justify="right" if justify == "right" else "left")
    for row in plan_rows(plan):
        table.add_row(*map(Text, row))
    console.print(table)
    pwm = f"; duty without servo at most {plan.largest_duty:g}" if plan.largest_duty else ""
    console.print(f"motor angles from {low.min():.2f} to {high.max():.2f} rad{pwm}", markup=False)
    console.print(
        f"ends with damped motors when a motor leaves {plan.angle_low.min() - limits.angle_room:.2f} to "
        f"{plan.angle_high.max() + limits.angle_room:.2f} rad, gives more than "
        f"{limits.torque:g} N m for {limits.torque_time:g} s or is hotter than {limits.temperature:g} degC, after "
        f"{limits.duration:g} s, or with Ctrl-C",
        markup=False,
    )


def plan_rows(plan: Plan) -> list[tuple[str, str, str]]:
    """Name, duration and motion of each kind of phase, in the order in which they first come.

    Phases that take turns are counted too, which `Plan.rows` does for neighbours only.
    """
    kinds: dict[tuple[str, str], list[float]] = {}
    for phase in plan.phases:
        kinds.setdefault((phase.name, phase.what), []).append(phase.duration)
    return [
        (name if len(times) == 1 else f"{name} x {len(times)}", f"{sum(times):.1f} s", what)
        for (name, what), times in kinds.items()
    ]


def _ask(plan: Plan) -> None:
    """Ask before motors move.

    Raises:
        SurefootError: the answer is not yes.
    """
    print(f"Motors will move. Does the robot {PLACES[plan.rack]}? [y/N] ", end="", file=sys.stderr, flush=True)
    if sys.stdin.readline().strip().lower() not in ("y", "yes"):
        raise SurefootError("not begun; nothing has moved")


def _run(session: Session, connection: RobotConnection, plan: Plan, robot: RobotDescription) -> Recording:
    with contextlib.ExitStack() as stack:
        watch = Progress(plan, f"{plan.experiment} experiment, {robot.name}, {session.port}", sys.stderr)
        stack.callback(watch.close)
        if not session.lockstep:
            stack.enter_context(undisturbed())
        return run_plan(connection, plan, robot, watch)


class Progress(Watch):
    """How an experiment goes, and how long it still takes: a display on a terminal, lines elsewhere.

    Args:
        plan: what is done.
        title: of the display.
        stream: where to.
    """

    def __init__(self, plan: Plan, title: str, stream: TextIO) -> None:
        self._display = LiveDisplay(title) if stream.isatty() else None
        self._lines = PlainLines(stream)
        self._phases, self._number, self._name = plan.phases, 0, ""

    def phase(self, name: str, duration: float) -> None:
        """A phase begins."""
        self._number += 1
        self._name = f"{name}, {self._number} of {len(self._phases)}"
        if self._display is not None:
            self._display.phase(self._name, duration + self._later())
        else:
            self._lines.phase(f"{self._name}, {duration + self._later():.0f} s left", 0.0)

    def _later(self) -> float:
        """Time of the phases that come [s]."""
        return sum(phase.duration for phase in self._phases[self._number :])

    def tick(self, snapshot: Snapshot) -> None:
        """Several times a second."""
        if self._display is not None:
            self._display.tick(replace(snapshot, phase=self._name, left=snapshot.left + self._later()))

    def warn(self, text: str) -> None:
        """Something that the operator should know."""
        (self._display or self._lines).warn(text)

    def recording(self, text: str) -> None:
        """How recording goes."""
        (self._display or self._lines).recording(text)

    def close(self) -> None:
        """End the display."""
        (self._display or self._lines).close()
