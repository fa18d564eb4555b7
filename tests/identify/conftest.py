"""Emulated robots, and the recording of an experiment with one of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress

import numpy as np
import pytest
from processes import EmulatorHere, emulators

from surefoot.deploy.display import PlainLines
from surefoot.deploy.links import open_link
from surefoot.deploy.messages import Mode
from surefoot.deploy.robot_link import LinkLostError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.plan import ExperimentLimits, Phase, Plan, chirps, go_to, steps
from surefoot.identify.recording import COMPLETE, Recording
from surefoot.robot import PhysicalParams, RobotDescription

MIDDLE, REACH, DUTY = 1.7, 0.3, 0.2


@pytest.fixture(scope="session")
def pupper() -> RobotDescription:
    return RobotDescription.load("pupper_v2")


@pytest.fixture(scope="session")
def nominal(robot: RobotDescription) -> PhysicalParams:
    return PhysicalParams.nominal(robot)


@pytest.fixture(scope="session")
def healthy() -> Iterator[EmulatorHere]:
    """Emulated robot on its rack, which several tests share."""
    pytest.importorskip("mujoco")
    with emulators(EmulatorHere) as start:
        yield start("--lockstep", "--rack")


@pytest.fixture(scope="session")
def make_plan(robot: RobotDescription) -> Callable[..., Plan]:
    """Plan of 3.5 s: unfold, a sweep, steps, a pulse of duty, and a held-out sweep."""

    def make(limits: ExperimentLimits | None = None) -> Plan:
        middle, ones = robot.pose_angles(0.0, MIDDLE), np.ones(robot.num_motors)
        jumps = middle + np.random.default_rng(1).uniform(-REACH, REACH, (3, robot.num_motors))
        sweep = chirps(middle, REACH * ones, 1.0, 3.0, 1.0, np.arange(robot.num_motors))
        push = DUTY * ones
        phases = (
            Phase("unfold", "all legs to the middle of their range", 1.0, go_to(middle, 1.0), use="transition"),
            Phase("sweep", "every motor to both sides", 1.0, sweep),
            Phase("steps", "every motor jumps three times", 0.6, steps(jumps, 0.2)),
            Phase("centre", "all legs to the middle", 0.3, go_to(middle, 0.2), use="transition"),
            Phase("push", "motors without servo", 0.04, lambda t, start: push, Mode.PWM),
            Phase("centre", "all legs to the middle", 0.3, go_to(middle, 0.2), use="transition"),
            Phase("sweep again", "every motor to both sides", 0.3, sweep, use="check"),
        )
        # The legs of a robot on its rack hang down, outside the angles of the plan.
        limits = limits or ExperimentLimits(torque=2.8, angle_margin=2.0)
        return Plan("motor", True, phases, middle - REACH, middle + REACH, DUTY, limits)

    return make


@pytest.fixture(scope="session")
def run_on(robot: RobotDescription) -> Callable[..., Recording]:
    """Return a function that runs a plan on the robot at a port."""

    def run(port: str, plan: Plan, watch: PlainLines | None = None) -> Recording:
        link = open_link(port, robot.num_motors, lockstep=True)
        try:
            link.connect()
            return run_plan(link, plan, robot, watch or PlainLines())
        finally:
            with suppress(LinkLostError, OSError):
                link.close()

    return run


@pytest.fixture(scope="session")
def record(run_on: Callable[..., Recording]) -> Callable[..., list[Recording]]:
    """Return a function that runs plans to their end on an emulated robot with ideal sensors and given parameters."""

    def recordings(params: dict[str, float], *plans: Plan) -> list[Recording]:
        words = ["--lockstep", "--ideal-sensors", *(["--rack"] if plans[0].rack else [])]
        with emulators(EmulatorHere) as start:
            port = start(*words, "--set", *(f"{name}={value}" for name, value in params.items())).port
            runs = [run_on(port, plan) for plan in plans]
        assert all(recording.meta["ended"] == COMPLETE for recording in runs)
        return runs

    return recordings


@pytest.fixture(scope="session")
def recorded(healthy: EmulatorHere, make_plan: Callable[..., Plan], run_on: Callable[..., Recording]) -> Recording:
    """Recording of a complete experiment with a robot without faults."""
    return run_on(healthy.port, make_plan())
