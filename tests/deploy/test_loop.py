"""Runs on a robot of the true protocol, in lockstep: what goes well, and what follows when something does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from fault_bench import QUICK
from fault_bench import QUICK_UP as UP

from surefoot.deploy.controller import Controller
from surefoot.deploy.deployment import Deployment
from surefoot.deploy.messages import Arm, Damp, Mode, Pong, Position, Reason
from surefoot.deploy.motion_runner import REST
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.poses import sitting_pose
from surefoot.deploy.run_saver import RunSaver
from surefoot.deploy.serial.frames import Decoder
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

TROT = Path(__file__).resolve().parents[2] / "policies" / "trot.onnx"
STEP = 0.006
STEPS = 60
SEATED = QUICK["FLAT"] + QUICK["FOLD"] + QUICK["PAUSE"]


@pytest.fixture(autouse=True)
def quick():
    with mock.patch.multiple("surefoot.deploy.motion_runner", **QUICK):
        yield


class Stop:
    """An operator who asks to stop at a time of the robot's."""

    def __init__(self):
        self.toy, self.at, self.again = None, np.inf, np.inf

    @property
    def stops(self):
        return int(self.toy._now / 1e6 >= self.at) + int(self.toy._now / 1e6 >= self.again)


class Spoiled:
    """A policy that does something else from its n-th question on."""

    def __init__(self, policy, at, what):
        self.contract, self._policy, self._at, self._what, self._asked = policy.contract, policy, at, what, 0

    def feedback(self, observation):
        self._asked += 1
        # Twenty questions are asked before the robot is armed.
        return self._what() if self._asked > 20 + self._at else self._policy.feedback(observation)


def raises():
    raise ZeroDivisionError("division by zero")


@pytest.fixture(scope="session")
def policy():
    return PolicyRuntime.load(TROT)


@pytest.fixture
def stop(toy):
    stop = Stop()
    stop.toy = toy
    return stop


@pytest.fixture
def deploy(toy, link, robot, policy, stop, monitor, tmp_path):
    """Connect a deployment and run it; return outcome, saved run and timing."""

    def make(policy=policy, steps=STEPS, dry_run=False, prepare=None):
        deployment = Deployment(link, Controller(policy, robot), stop, monitor, dry_run)
        deployment.connect(lambda handshake: None)
        keeper, timing = RunSaver(deployment, tmp_path / "run_000.npz", steps), LoopTiming(5000)
        keeper.begin()
        if prepare is not None:
            prepare()
        outcome = deployment.run(keeper.recorder, timing)
        kept = keeper.finish(outcome, timing, None)
        make.deployment = deployment
        return outcome, kept, timing

    return make


def sent(toy, kind):
    return [(time, message) for time, message in toy.heard if isinstance(message, kind)]


def test_a_whole_run(deploy, toy, monitor):
    outcome, kept, timing = deploy()
    assert (outcome.ended, outcome.safe) == ("time", False)
    assert monitor.phases == [
        *("connect", "arm", "lay legs flat", "draw legs in", "sit", "stand up", "stand"),
        *("run", "drop", "sit", "disarm"),
    ]
    assert toy.kinds() == ["Hello", "Arm", "Position", "Disarm"]
    assert toy.firmware.mode == Mode.DISARMED
    assert toy.firmware.reason == Reason.NONE
    trace = kept.trace
    assert trace.num_steps == STEPS
    assert trace.time == pytest.approx(STEP * np.arange(1, STEPS + 1))
    assert trace.meta["ended"] == "time"
    assert trace.meta["missed_steps"] == []
    assert trace.meta["firmware"] == "toy"
    assert trace.meta["config_hash"] == deploy.deployment.contract.config_hash
    assert timing.missed == 0
    assert timing.stale == 0
    assert not (kept.path.parent / "run_000.npz.partial").exists()
    deploy.deployment.close()
    assert toy.firmware.owner == 0


def test_motors_move_smoothly_from_where_they_are_until_the_robot_sits(deploy, toy, robot, policy):
    start = toy.angle.copy()
    deploy()
    times, targets = map(np.array, zip(*((time, message.target) for time, message in sent(toy, Position)), strict=True))
    assert np.diff(times) == pytest.approx(STEP, abs=1e-6)
    assert targets[0] == pytest.approx(start, abs=1e-3)
    assert targets[-1] == pytest.approx(sitting_pose(robot), abs=1e-6)
    speed = np.abs(np.diff(targets, axis=0)) / STEP
    up = round(UP / STEP)
    assert targets[up - 10] == pytest.approx(robot.pose_angles(*policy.contract.rest), abs=1e-6)
    assert speed[: up - 1].max() < 4.0
    assert speed[-round(REST / STEP) :].max() < 1e-6


def test_rows_are_those_of_the_commands_and_of_the_states_at_their_end(deploy, toy, policy):
    toy.sensors = lambda time, readings: replace(
        readings, roll_pitch_yaw=np.array([0.1 * np.sin(9 * time), 0.05 * np.cos(7 * time), 0.0]), energy=2.0 * time
    )
    _, kept, _ = deploy()
    trace, start = kept.trace, kept.trace.meta["robot_time_start"]
    positions = {round(time * 1e6): message.target for time, message in sent(toy, Position)}
    for k in range(STEPS):
        assert trace.target[k] == pytest.approx(positions[round((start + k * STEP) * 1e6)], abs=1e-6)
    ends = start + STEP * np.arange(1, STEPS + 1)
    assert trace.roll_pitch_yaw[:, 0] == pytest.approx(0.1 * np.sin(9 * ends), abs=1e-6)
    assert trace.observation[1:, :2] == pytest.approx(trace.roll_pitch_yaw[:-1, :2], abs=1e-7)
    assert trace.energy == pytest.approx(2.0 * STEP, abs=1e-5)
    assert trace.feedback == pytest.approx(policy.feedback(trace.observation), abs=1e-6)


def at_step(k: int, change, toy):
    """Change readings from about the policy's control step k on; each phase takes a step more than its time."""

    def spoil():
        toy.sensors = lambda time, readings: replace(readings, **change)

    once(toy, spoil, UP + k * STEP)


def once(toy, act, seconds=UP + 0.2):
    """Do something once, when the robot has been armed for so long."""
    when = []

    def sensors(time, readings):
        if not when and toy.firmware.armed:
            when.append(time + seconds)
        if when and time > when[0]:
            toy.sensors = lambda time, readings: readings
            act()
            return toy.sensors(time, readings)
        return readings

    toy.sensors = sensors


@pytest.mark.parametrize(
    ("change", "ended", "reason"),
    [
        ({"motor_angle": np.full(8, np.nan)}, "fault", "not finite"),
        ({"roll_pitch_yaw": np.array([0.6, 0.0, 0.0])}, "fall", "tilt"),
        ({"temperature": np.full(8, 85.0)}, "stopped", "temperature"),
        ({"voltage": 13.5}, "stopped", "battery"),
    ],
)
def test_readings_end_a_run(change, ended, reason, deploy, toy):
    at_step(20, change, toy)
    outcome, kept, _ = deploy(steps=300)
    assert (outcome.ended, outcome.reason, outcome.safe) == (ended, reason, True)
    assert kept.trace.meta["ended"] == ended
    assert kept.trace.meta["reason"] == reason
    assert 12 <= kept.trace.num_steps <= 24 + (170 if reason == "battery" else 0)
    assert not toy.firmware.armed
    damped = bool(sent(toy, Damp))
    assert damped == (ended in ("fault", "fall"))


def test_a_fall_is_damped_at_once_and_the_robot_sits_when_it_is_still(deploy, toy, monitor):
    at_step(20, {"roll_pitch_yaw": np.array([0.6, 0.0, 0.0])}, toy)
    outcome, kept, _ = deploy(steps=300)
    assert outcome.text.endswith("it has sat down")
    damped, armed = sent(toy, Damp)[0][0], sent(toy, Arm)[-1][0]
    assert armed - damped >= toy.firmware.limits.rearm_after
    assert kept.trace.fell
    assert abs(kept.trace.roll_pitch_yaw[-1, 0]) > 0.5
    assert monitor.phases[-4:] == ["lie still", "arm", "sit down", "disarm"]
    assert toy.firmware.mode == Mode.DISARMED
    # Nothing was commanded between the tilt and the damping.
    assert not [time for time, _ in sent(toy, Position) if damped <= time < armed]


def test_a_robot_on_its_side_stays_damped(deploy, toy):
    at_step(20, {"roll_pitch_yaw": np.array([1.4, 0.0, 0.0])}, toy)
    outcome, _, _ = deploy(steps=300)
    assert outcome.text.endswith("it lies on its side and stays damped")
    assert toy.firmware.mode == Mode.FAULT


def test_a_robot_that_does_not_come_to_rest_stays_damped(deploy, toy):
    at_step(20, {"roll_pitch_yaw": np.array([0.6, 0.0, 0.0]), "motor_velocity": np.full(8, 3.0)}, toy)
    outcome, _, _ = deploy(steps=300)
    assert outcome.text.endswith("it does not come to rest and stays damped")


@pytest.mark.parametrize(
    ("what", "reason", "text"),
    [
        (raises, "exception", "ZeroDivisionError: division by zero"),
        (lambda: np.full((1, 8), np.nan), "not finite", "feedback 'swing.front_left' is nan"),
        (lambda: np.full((1, 3), 0.1), "exception", "Error"),
    ],
)
def test_a_policy_that_breaks_is_damped_in_the_same_step(what, reason, text, deploy, toy, policy):
    outcome, kept, _ = deploy(Spoiled(policy, 25, what))
    assert (outcome.ended, outcome.reason, outcome.safe) == ("fault", reason, True)
    assert text in outcome.text
    assert toy.firmware.reason == Reason.HOST
    assert kept.trace.num_steps == 25
    # The step that failed is the 26th; its time is that of the damping.
    assert sent(toy, Damp)[0][0] == pytest.approx(kept.trace.meta["robot_time_start"] + 25 * STEP, abs=1e-6)


def test_what_goes_wrong_after_an_episode_does_not_change_how_it_ended(deploy, toy):
    at_step(STEPS + 20, {"motor_velocity": np.full(8, np.nan)}, toy)
    outcome, kept, _ = deploy()
    assert (outcome.ended, outcome.safe) == ("time", True)
    assert outcome.text == "done; then a reading of the robot is not finite"
    assert kept.trace.num_steps == STEPS
    assert kept.trace.meta["ended"] == "time"
    assert toy.firmware.reason == Reason.HOST


def test_a_nod_while_the_robot_drops_is_no_fall(deploy, toy):
    at_step(STEPS + 20, {"roll_pitch_yaw": np.array([0.0, 0.6, 0.0])}, toy)
    outcome, _, _ = deploy()
    assert (outcome.ended, outcome.safe) == ("time", False)
    assert toy.firmware.mode == Mode.DISARMED


def test_the_operator_lets_the_robot_sit(deploy, toy, stop):
    stop.at = UP + 20 * STEP + 0.1
    outcome, kept, _ = deploy(steps=300)
    assert (outcome.ended, outcome.reason, outcome.safe) == ("stopped", "operator", False)
    assert toy.firmware.mode == Mode.DISARMED
    assert toy.firmware.reason == Reason.NONE
    assert not sent(toy, Damp)
    assert 10 <= kept.trace.num_steps <= 40


@pytest.mark.parametrize("when", [SEATED + 0.2, UP + 0.5])
def test_the_operator_asks_twice_and_motors_are_damped(when, deploy, toy, stop):
    stop.at, stop.again = when, when + 0.2
    outcome, _, _ = deploy(steps=300)
    assert (outcome.ended, outcome.reason, outcome.safe) == ("stopped", "operator", True)
    assert toy.firmware.reason == Reason.HOST


@pytest.mark.parametrize(
    ("when", "phases"),
    [
        (0.01, ["arm", "lay legs flat", "disarm"]),
        (0.05, ["lay legs flat", "disarm"]),
        (0.15, ["draw legs in", "disarm"]),
        (0.25, ["sit", "disarm"]),
        (SEATED + 0.2, ["stand up", "sit down", "disarm"]),
        (UP - 0.1, ["stand", "sit down", "disarm"]),
    ],
)
def test_the_operator_stops_before_the_policy_runs(when, phases, deploy, toy, stop, monitor):
    stop.at = when
    outcome, kept, _ = deploy()
    assert (outcome.ended, outcome.reason, outcome.safe) == ("stopped", "operator", False)
    # Only a robot that has begun to rise from sitting sits down; one that still lies is let go at once.
    assert monitor.phases[-len(phases) :] == phases
    assert not sent(toy, Damp)
    assert kept.trace is None
    assert not kept.lost
    assert toy.firmware.mode == Mode.DISARMED


def test_the_operator_stops_before_anything_moves(deploy, toy, stop):
    stop.at = 0.0
    outcome, _, _ = deploy()
    assert outcome.text == "stopped before anything moved"
    assert not sent(toy, Arm)


def test_a_robot_that_damps_itself_ends_the_run(deploy, toy):
    once(toy, lambda: toy.firmware._fail(toy._now, Reason.TEMPERATURE, "hot"))
    outcome, kept, _ = deploy(steps=300)
    assert (outcome.ended, outcome.reason, outcome.safe) == ("fault", "robot temperature", True)
    assert kept.trace.num_steps > 20
    assert not sent(toy, Damp)


def test_a_robot_that_falls_silent_is_damped_after_three_steps(deploy, toy):
    silent, say = [], toy._say

    def quiet():
        frames = toy.firmware.take()
        toy.firmware._out = [frame for frame in frames if isinstance(frame.message, Pong)] if silent else frames
        say()

    toy._say = quiet
    once(toy, lambda: silent.append(True))
    outcome, kept, timing = deploy(steps=300)
    assert (outcome.ended, outcome.reason) == ("fault", "stale state")
    assert timing.stale in (3, 4)
    assert sent(toy, Damp)
    assert kept.trace.num_steps > 20


def test_a_cable_that_is_pulled_ends_the_run_and_the_trace_is_kept(deploy, toy):
    once(toy, lambda: setattr(toy, "cut", True))
    outcome, kept, _ = deploy(steps=300)
    assert (outcome.ended, outcome.reason, outcome.safe) == ("fault", "link", True)
    assert "port toy is gone" in outcome.text
    assert kept.trace.num_steps > 20
    assert kept.path.exists()
    deploy.deployment.close()


def late_by(link, steps, at):
    """Let the clock be late once: the program slept through so many steps."""
    clock = link.clock
    wait, done = clock.wait_until, []

    def wait_until(moment):
        wait(moment)
        if moment > at and not done:
            done.append(True)
            wait(moment + steps * STEP)

    clock.wait_until = wait_until


@pytest.mark.parametrize("steps", [1, 2])
def test_missed_steps_are_held_and_counted(steps, deploy, toy, link):
    late_by(link, steps, UP + 0.2)
    outcome, kept, timing = deploy()
    assert outcome.ended == "time"
    assert timing.missed == steps
    trace = kept.trace
    missed = trace.meta["missed_steps"]
    assert len(missed) == steps
    assert trace.num_steps == STEPS
    assert np.diff(trace.time) == pytest.approx(STEP)
    for k in missed:
        assert trace.target[k].tolist() == trace.target[missed[0] - 1].tolist()
    # The gait's time stays right: the next target is that of its own time.
    gait = deploy.deployment.controller.gait
    after = missed[-1] + 1
    assert trace.target[after] == pytest.approx(
        gait.motor_targets(np.array([after * STEP]), trace.feedback[after][None])[0], abs=1e-12
    )


def test_more_than_two_missed_steps_in_a_row_are_damped(deploy, toy, link):
    late_by(link, 3, UP + 0.2)
    outcome, kept, timing = deploy()
    assert (outcome.ended, outcome.reason) == ("fault", "late")
    assert toy.firmware.reason == Reason.HOST
    assert timing.missed == 3
    assert kept.trace.num_steps > 20


def test_a_dry_run_arms_and_commands_nothing(deploy, toy):
    outcome, kept, timing = deploy(dry_run=True)
    assert outcome.ended == "time"
    assert set(toy.kinds()) == {"Hello"}
    assert toy.firmware.mode == Mode.DISARMED
    assert kept.trace.num_steps == STEPS
    assert kept.trace.meta["dry_run"]
    assert timing.steps > STEPS
    assert toy.firmware.owner == 77


@pytest.mark.parametrize(
    ("what", "match"),
    [
        (raises, "policy 'trot' fails on the robot's present state: ZeroDivisionError: division by zero"),
        (
            lambda: np.full((1, 8), np.nan),
            "fails on the robot's present state: NotFiniteError: feedback 'swing.front_left'",
        ),
    ],
)
def test_a_policy_that_breaks_from_the_start_is_refused(what, match, deploy, toy, policy):
    with pytest.raises(SurefootError, match=match):
        deploy(Spoiled(policy, -20, what))
    assert not sent(toy, Arm)


def test_a_cable_that_is_pulled_before_arming_is_told_in_one_line(deploy, toy):
    toy.cut = True
    with pytest.raises(SurefootError, match="the robot was lost before it was armed: port toy is gone"):
        deploy()


def test_a_robot_that_does_not_arm_is_refused(deploy, toy):
    def worn():
        toy.firmware._vitals = replace(toy.firmware._vitals, temperature=95.0)
        toy.firmware.tick = lambda now, vitals: None

    with pytest.raises(SurefootError, match="the robot does not arm: a motor has 95 degC"):
        deploy(prepare=worn)
    assert not sent(toy, Position)


def test_a_robot_that_does_not_arm_again_ends_its_second_run(deploy, toy, link, monitor):
    deploy()
    deployment = deploy.deployment
    toy.firmware._vitals = replace(toy.firmware._vitals, temperature=95.0)
    toy.firmware.tick = lambda now, vitals: None
    keeper = RunSaver(deployment, None, STEPS)
    outcome = deployment.run(keeper.recorder, LoopTiming(100))
    assert (outcome.ended, outcome.reason, outcome.safe) == ("fault", "arm", True)
    assert "a motor has 95 degC" in outcome.text


def test_a_request_to_arm_that_is_lost_is_made_again(deploy, toy):
    hear, lost = toy.write, []

    def write(data: bytes) -> int:
        frames = Decoder(toy.codec).feed(data)
        if len(lost) < 2 and any(isinstance(frame.message, Arm) for frame in frames):
            lost.append(data)
            return len(data)
        return hear(data)

    toy.write = write
    outcome, _, _ = deploy()
    assert outcome.ended == "time"
    assert len(lost) == 2


def test_a_robot_that_was_damped_before_is_armed_after_a_clean_while(deploy, toy):
    outcome, _, _ = deploy(prepare=lambda: toy.firmware._fail(toy._now, Reason.TIMEOUT, "before"))
    assert outcome.ended == "time"
    assert sent(toy, Arm)[-1][0] >= toy.firmware.limits.rearm_after


def test_a_robot_in_a_pose_beyond_its_limits_is_brought_back_within(deploy, toy, robot):
    toy.angle = np.full(8, -1.0)
    outcome, _, _ = deploy()
    assert outcome.ended == "time"
    targets = np.array([message.target for _, message in sent(toy, Position)])
    assert targets.min() >= toy.firmware.handshake.angle_low.min() - 1e-6


def test_whoever_watches_is_told_ten_times_a_second(deploy, monitor, toy):
    at_step(5, {"voltage": 14.2}, toy)
    deploy(steps=500)
    run = [snapshot for snapshot in monitor.snapshots if snapshot.phase == "run"]
    assert 28 <= len(run) <= 32
    assert run[5].rate == pytest.approx(1 / STEP, rel=0.01)
    assert len(run[5].lateness) in (16, 17)
    assert run[5].inference > 0.0
    assert monitor.warnings == ["battery below 14.4 V; charge it soon"]
