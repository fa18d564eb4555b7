"""Emulated robots as processes, and an experiment that one of them went through."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np
import pytest
from processes import Emulator, emulators

from surefoot.deploy.display import PlainLines
from surefoot.deploy.poses import pose
from surefoot.deploy.wire.messages import Mode
from surefoot.identify.experiments.signals import chirps, go_to, steps
from surefoot.identify.plan import ExperimentLimits, Phase, Plan
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription

MIDDLE, REACH, DUTY = 1.7, 0.3, 0.2


@pytest.fixture(scope="session")
def healthy() -> Iterator[Emulator]:
    """A robot on its rack that several tests use, one after another."""
    pytest.importorskip("mujoco")
    with emulators() as start:
        yield start("--lockstep", "--rack")


@pytest.fixture(scope="session")
def make_plan(robot: RobotDescription) -> Callable[..., Plan]:
    """A plan of 3.5 s: unfold, a sweep, steps, a pulse of duty, and a part that is not fitted."""

    def make(limits: ExperimentLimits | None = None) -> Plan:
        middle, each = pose(robot, 0.0, MIDDLE), np.ones(robot.num_motors)
        jumps = middle + np.random.default_rng(1).uniform(-REACH, REACH, (3, robot.num_motors))
        sweep = chirps(middle, REACH * each, 1.0, 3.0, 1.0, np.arange(robot.num_motors))
        push = DUTY * each
        phases = (
            Phase("unfold", "all legs to the middle of their reach", 1.0, go_to(middle, 1.0), use="way"),
            Phase("sweep", "every motor to both sides", 1.0, sweep),
            Phase("steps", "every motor jumps three times", 0.6, steps(jumps, 0.2)),
            Phase("centre", "all legs to the middle", 0.3, go_to(middle, 0.2), use="way"),
            Phase("push", "motors without servo", 0.04, lambda t, start: push, Mode.PWM),
            Phase("centre", "all legs to the middle", 0.3, go_to(middle, 0.2), use="way"),
            Phase("sweep again", "every motor to both sides", 0.3, sweep, use="check"),
        )
        # Legs of a robot on its rack hang down: their motors have further to go than the plan's angles.
        limits = limits or ExperimentLimits(angle_room=2.0)
        return Plan("motor", True, phases, middle - REACH, middle + REACH, DUTY, limits)

    return make


@pytest.fixture(scope="session")
def recorded(healthy: Emulator, robot: RobotDescription, make_plan: Callable[..., Plan]) -> Recording:
    """What a healthy robot told in a whole experiment."""
    from surefoot.deploy.connection import open_connection
    from surefoot.identify.experiment_runner import run_plan

    connection = open_connection(str(healthy.port), robot.num_motors, lockstep=True)
    try:
        connection.connect()
        return run_plan(connection, make_plan(), robot, PlainLines())
    finally:
        connection.close()
