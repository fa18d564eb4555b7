"""Experiments on emulated robots: what is recorded, and what stops them early."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from processes import EmulatorHere, emulators

from surefoot.deploy.display import PlainLines
from surefoot.deploy.links import open_link
from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.experiment_runner import run_plan
from surefoot.identify.plan import ExperimentLimits, Plan
from surefoot.identify.recording import COMPLETE, Recording, load_recording
from surefoot.robot import RobotDescription

MakePlan = Callable[..., Plan]
RunOn = Callable[..., Recording]


class ActionOnPhase(PlainLines):
    """Monitor that calls a function when a phase begins for the first time."""

    def __init__(self, phase: str, action: Callable[[], Any]) -> None:
        super().__init__()
        self.trigger, self.action, self.phases = phase, action, []

    def phase(self, name: str, duration: float) -> None:
        self.phases.append(name)
        if self.phases.count(self.trigger) == 1 and name == self.trigger:
            self.action()


def test_recording_holds_every_command_and_state_of_an_experiment(
    recorded: Recording, make_plan: MakePlan, robot: RobotDescription
):
    plan, meta = make_plan(), recorded.meta
    assert (meta["ended"], meta["experiment"], meta["rack"]) == (COMPLETE, "motor", True)
    assert meta["frames"] == {"received": len(recorded.time), "missing": 0, "damaged": 0}
    assert meta["resting_states"] == pytest.approx(100, abs=3)
    # Armed for servos, for duties, and for servos again, and disarmed after each.
    position, pwm, off = int(Mode.POSITION), int(Mode.PWM), int(Mode.DISARMED)
    assert [mode for _, mode in meta["mode_changes"]] == [position, off, pwm, off, position, off]
    moments = [moment for moment, _ in meta["mode_changes"]]
    assert moments == sorted(moments)
    assert [phase["name"] for phase in meta["phases"]] == [phase.name for phase in plan.phases]
    # One command per period, and one more per phase, which holds its last target.
    expected = [round(phase.duration / meta["period"]) + 1 for phase in plan.phases]
    np.testing.assert_array_equal(np.bincount(recorded.sent_phase.astype(int)), expected)
    assert np.all(np.diff(recorded.sent_number) > 0)
    for k, phase in enumerate(plan.phases):
        assert set(recorded.mode[recorded.phase_states(k)][2:-2]) == {int(phase.mode)}
    # The motors follow the sweep.
    sweep = recorded.phase_states(1)
    assert np.ptp(recorded.motor_angle[sweep], axis=0).min() > 0.2
    assert recorded.motor_angle.shape == (len(recorded.time), robot.num_motors)


def test_recordings_in_lockstep_are_identical(emulate: Callable[..., Any], make_plan: MakePlan, run_on: RunOn):
    """They do not depend on how long the robot takes to answer: one emulator is suspended for a while."""
    plan = make_plan()
    plan = replace(plan, phases=tuple(phase for phase in plan.phases if "sweep" not in phase.name))
    slow = emulate("--lockstep", "--rack")

    def hold_up() -> None:
        slow.process.send_signal(signal.SIGSTOP)
        threading.Timer(0.3, slow.process.send_signal, [signal.SIGCONT]).start()

    with emulators(EmulatorHere) as start:
        recordings = [
            run_on(start("--lockstep", "--rack").port, plan),
            run_on(slow.port, plan, ActionOnPhase("push", hold_up)),
        ]
    assert len({len(one.time) for one in recordings}) == 1
    assert len({one.meta["digest"] for one in recordings}) == 1
    assert all(one.meta["mode_changes"] == recordings[0].meta["mode_changes"] for one in recordings)


@pytest.fixture
def ended(healthy: Any, robot: RobotDescription, tmp_path: Path) -> Callable[..., str]:
    """Function that runs a plan which stops early, checks recording and robot, and returns the reason."""

    def run(plan: Plan, watch: PlainLines | None = None) -> str:
        link = open_link(healthy.port, robot.num_motors, lockstep=True)
        link.connect()
        recording = run_plan(link, plan, robot, watch or PlainLines())
        assert len(recording.time) > 50
        link.wait_for(lambda: link.last_state().mode != Mode.POSITION, 0.1)
        assert link.last_state().mode in (Mode.FAULT, Mode.DISARMED)
        link.close()
        with pytest.raises(SurefootError, match="stopped early"):
            load_recording(recording.save(tmp_path / "recording.npz"), robot)
        assert "\n" not in recording.meta["ended"]
        return str(recording.meta["ended"])

    return run


@pytest.mark.parametrize(
    ("limits", "reason"),
    [
        (ExperimentLimits(torque=2.8, angle_margin=-0.28), "beyond the plan's angles; at most -0.28"),
        (ExperimentLimits(torque=0.1, angle_margin=2.0, torque_time=0.02), "exceeded 0.1 N m for 0.02 s"),
        (ExperimentLimits(torque=2.8, angle_margin=2.0, temperature=15.0), "degC; at most 15"),
        (ExperimentLimits(torque=2.8, angle_margin=2.0, duration=1.7), "it took more than 1.7 s"),
    ],
    ids=["angle", "torque", "temperature", "time"],
)
def test_exceeding_a_limit_of_the_plan_stops_the_experiment(
    ended: Callable[..., str], make_plan: MakePlan, limits: ExperimentLimits, reason: str
):
    assert reason in ended(make_plan(limits))


def test_a_signal_of_the_operator_stops_the_experiment(ended: Callable[..., str], make_plan: MakePlan):
    watch = ActionOnPhase("steps", lambda: os.kill(os.getpid(), signal.SIGINT))
    assert ended(make_plan(), watch) == "stopped by the operator (in phase 'steps')"
    assert watch.phases == ["unfold", "sweep", "steps"]


def test_a_damped_robot_stops_the_experiment(healthy: Any, robot: RobotDescription, make_plan: MakePlan):
    link = open_link(healthy.port, robot.num_motors, lockstep=True)
    link.connect()
    recording = run_plan(link, make_plan(), robot, ActionOnPhase("sweep", link.damp))
    link.close()
    assert (
        recording.meta["ended"]
        == "the robot has damped its motors (host): the operator requested it (in phase 'sweep')"
    )


def test_a_closed_port_stops_the_experiment(emulate: Callable[..., Any], make_plan: MakePlan, run_on: RunOn):
    emulator = emulate("--lockstep", "--rack")
    recording = run_on(emulator.port, make_plan(), ActionOnPhase("sweep", emulator.process.kill))
    assert recording.meta["ended"] != COMPLETE
    assert len(recording.time) > 400
    assert recording.sent_phase.max() == 0


def test_experiment_needs_a_handshake(healthy: Any, robot: RobotDescription, make_plan: MakePlan):
    link = open_link(healthy.port, 8, lockstep=True)
    try:
        with pytest.raises(SurefootError, match="the robot is not connected"):
            run_plan(link, make_plan(), robot, PlainLines())
    finally:
        link.close()
