"""Emulated robots as processes, and an experiment that one of them went through."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from surefoot.deploy.display import PlainLines
from surefoot.deploy.poses import pose
from surefoot.deploy.wire.messages import Mode
from surefoot.identify.experiments.signals import chirps, go_to, steps
from surefoot.identify.plan import ExperimentLimits, Phase, Plan
from surefoot.identify.recording import Recording
from surefoot.robot import RobotDescription

MIDDLE, REACH, DUTY = 1.7, 0.3, 0.2


class Emulator:
    """A `surefoot emulate --lockstep --rack` process; `port` is its pseudo-terminal."""

    def __init__(self, folder: Path, *words: str) -> None:
        self.port = folder / f"port_{len(list(folder.iterdir()))}"
        self.log = (folder / f"{self.port.name}.log").open("w")
        command = [sys.executable, "-m", "surefoot", "emulate", "--lockstep", "--rack", "--link", str(self.port)]
        self.process = subprocess.Popen([*command, *words], stdout=self.log, stderr=self.log)
        end = time.monotonic() + 60
        while not self.port.exists():
            assert self.process.poll() is None, Path(self.log.name).read_text()
            assert time.monotonic() < end, "the emulator does not start"
            time.sleep(0.05)

    def stop(self) -> None:
        self.process.terminate()
        self.process.wait(30)
        self.log.close()


@pytest.fixture(scope="session")
def robot() -> RobotDescription:
    return RobotDescription.load("minitaur")


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Callable[..., Emulator]]:
    """Start emulators that end with the test."""
    pytest.importorskip("mujoco")
    started: list[Emulator] = []

    def start(*words: str) -> Emulator:
        started.append(Emulator(tmp_path, *words))
        return started[-1]

    yield start
    for emulator in started:
        emulator.stop()


@pytest.fixture(scope="session")
def healthy(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Emulator]:
    """A robot that several tests use, one after another."""
    pytest.importorskip("mujoco")
    emulator = Emulator(tmp_path_factory.mktemp("healthy"))
    yield emulator
    emulator.stop()


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
