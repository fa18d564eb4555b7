"""Checks before a robot is armed, on a simulated computer that stalls."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from surefoot.deploy.clock import LockstepClock
from surefoot.deploy.controller import Controller
from surefoot.deploy.deployment import TIMING_ATTEMPTS, TIMING_STEPS, Deployment
from surefoot.deploy.messages import Arm, Ping, Position
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.run_saver import RunSaver
from surefoot.deploy.serial.serial_link import LEAD
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription

STEP = 0.006


class Computer:
    """Clock of a computer that may wake up late; the robot does not wait for it."""

    def __init__(self, lockstep: LockstepClock) -> None:
        self._clock = lockstep
        self.late: Callable[[float], float] = lambda time: 0.0

    def now(self) -> float:
        return self._clock.now()

    def wait_until(self, moment: float) -> None:
        self._clock.wait_until(moment + self.late(moment))


class Operator:
    """An operator who may ask to stop."""

    stops = 0


@pytest.fixture(scope="module")
def controller(repository: Path) -> Controller:
    return Controller(
        PolicyRuntime.load(repository / "policies" / "trot-robust.onnx"), RobotDescription.load("minitaur")
    )


@pytest.fixture
def computer(link: RobotLink) -> Computer:
    clock = link.clock
    assert isinstance(clock, LockstepClock)
    computer = Computer(clock)
    link.clock, link.lockstep, link.lead = computer, False, LEAD
    return computer


@pytest.fixture
def deployment(link, computer, controller, monitor) -> Deployment:
    return Deployment(link, controller, Operator(), monitor)


def connect(deployment: Deployment) -> None:
    deployment.connect(lambda handshake: None)


def test_a_fast_computer_checks_its_timing_once_without_commands(deployment, toy, monitor):
    connect(deployment)
    assert monitor.phases == ["connect", "check timing"]
    kinds = {type(message) for _, message in toy.received}
    assert Ping in kinds
    assert not kinds & {Arm, Position}
    spent = toy.received[-1][0]
    assert TIMING_STEPS * STEP < spent < (TIMING_STEPS + 40) * STEP


def test_a_computer_that_is_slow_only_at_first_passes(deployment, computer, monitor):
    begun: list[float] = []

    def late(moment: float) -> float:
        # Three stalls of five control steps, each after the start of the loop, and then none.
        if "check timing" in monitor.phases and len(begun) < 3 and (not begun or moment > begun[-1] + 0.1):
            begun.append(moment)
            return 5 * STEP
        return 0.0

    computer.late = late
    connect(deployment)
    assert len(begun) == 3
    assert monitor.phases.count("check timing") == 4


def test_a_computer_that_keeps_stalling_cannot_arm_the_robot(deployment, computer, toy, monitor):
    last = [0.0]

    def late(moment: float) -> float:
        if moment > last[0] + 0.3:
            last[0] = moment
            return 4 * STEP
        return 0.0

    computer.late = late
    with pytest.raises(SurefootError, match=r"not armed: \d+ consecutive control steps were missed; at most 2"):
        connect(deployment)
    assert monitor.phases.count("check timing") == TIMING_ATTEMPTS
    assert Arm not in {type(message) for _, message in toy.received}


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("voltage", 13.5, "the battery voltage is 13.5 V, below 14 V"),
        ("temperature", 85.0, "a motor is at 85 degC; at most 80"),
    ],
)
def test_a_low_battery_or_a_hot_motor_prevents_arming(deployment, toy, name, value, text):
    reading = np.full(8, value) if name == "temperature" else value
    toy.sensors = lambda time, readings: replace(readings, **{name: reading})
    with pytest.raises(SurefootError, match=f"the robot is not armed: {text}"):
        connect(deployment)


def test_a_stop_during_the_timing_check_is_not_an_error(deployment, toy):
    deployment.operator.stops = 1
    connect(deployment)
    assert Arm not in {type(message) for _, message in toy.received}


def test_a_run_whose_first_step_is_missed_has_its_start_and_its_own_energy(
    deployment, computer, toy, monitor, tmp_path
):
    stalls: list[float] = []

    def late(moment: float) -> float:
        if monitor.phases[-1] == "run" and not stalls:
            stalls.append(moment)
            return 1.5 * STEP
        return 0.0

    connect(deployment)
    computer.late = late
    toy.sensors = lambda time, readings: replace(readings, energy=1000.0 * time)
    saver, timing = RunSaver(deployment, tmp_path / "run.npz", 50), LoopTiming(5000)
    saver.begin()
    trace = saver.finish(deployment.run(saver.recorder, timing), timing, None).trace
    assert stalls
    assert trace.meta["robot_time_start"] == pytest.approx(stalls[0], abs=STEP)
    # The power is 1 kW; before it ran, the robot has stood up for seconds.
    assert trace.energy[:10].sum() == pytest.approx(1000.0 * 10 * STEP, rel=0.3)
