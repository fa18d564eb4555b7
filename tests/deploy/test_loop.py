"""Runs of a policy on a toy robot in lockstep: a complete run, and all causes that end a run early."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from fault_bench import QUICK
from fault_bench import QUICK_UP as STARTUP_TIME

from surefoot.deploy.controller import Controller
from surefoot.deploy.deployment import Deployment
from surefoot.deploy.messages import Arm, Damp, Mode, Pong, Position, Reason
from surefoot.deploy.motion_runner import SITTING_TIME
from surefoot.deploy.pacer import LoopTiming
from surefoot.deploy.poses import sitting_pose
from surefoot.deploy.run_saver import RunSaver
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.trace import EpisodeTrace

TROT = Path(__file__).resolve().parents[2] / "policies" / "trot.onnx"
STEP = 0.006
STEPS = 60
SEATED = QUICK["LAY_FLAT_TIME"] + QUICK["FOLD_TIME"] + QUICK["PAUSE_TIME"]


@pytest.fixture(autouse=True)
def quick():
    with mock.patch.multiple("surefoot.deploy.motion_runner", **QUICK):
        yield


class Stop:
    """An operator who asks to stop at two times of the robot's clock."""

    def __init__(self, toy):
        self.toy, self.at, self.again = toy, np.inf, np.inf

    @property
    def stops(self):
        return int(self.toy._now / 1e6 >= self.at) + int(self.toy._now / 1e6 >= self.again)


class Spoiled:
    """A policy that calls another function from its n-th inference on; 20 inferences precede arming."""

    def __init__(self, policy, at, call):
        self.contract, self._policy, self._at, self._call, self._count = policy.contract, policy, at, call, 0

    def feedback(self, observation):
        self._count += 1
        return self._call() if self._count > 20 + self._at else self._policy.feedback(observation)


def raises():
    raise ZeroDivisionError("division by zero")


@pytest.fixture(scope="session")
def policy():
    return PolicyRuntime.load(TROT)


@pytest.fixture
def stop(toy):
    return Stop(toy)


@pytest.fixture
def deploy(toy, link, robot, policy, stop, monitor, tmp_path):
    """Connect a deployment and run it; return outcome, saved run and timing."""

    def make(policy=policy, steps=STEPS, dry_run=False, prepare=None):
        deployment = make.deployment = Deployment(link, Controller(policy, robot), stop, monitor, dry_run)
        deployment.connect(lambda handshake: None)
        saver, timing = RunSaver(deployment, tmp_path / "run_000.npz", steps), LoopTiming(5000)
        saver.begin()
        if prepare is not None:
            prepare()
        outcome = deployment.run(saver.recorder, timing)
        return outcome, saver.finish(outcome, timing, None), timing

    return make


def sent(toy, kind):
    return [(time, message) for time, message in toy.received if isinstance(message, kind)]


def end_of(outcome):
    return outcome.ended, outcome.reason, outcome.safe


def once(toy, act, seconds=STARTUP_TIME + 0.2):
    """Call a function once, at a time after arming."""
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


def at_step(k, change, toy):
    """Change readings from about control step k of the policy on; each phase has one additional step."""
    when = STARTUP_TIME + k * STEP
    once(toy, lambda: setattr(toy, "sensors", lambda time, readings: replace(readings, **change)), when)


def tilt(roll=0.0, pitch=0.0):
    return {"roll_pitch_yaw": np.array([roll, pitch, 0.0])}


def test_a_whole_run_goes_through_all_phases_and_leaves_a_trace(deploy, toy, monitor):
    outcome, saved, timing = deploy()
    assert (outcome.ended, outcome.safe) == ("time", False)
    up = ("connect", "arm", "lay legs flat", "draw legs in", "sit", "stand up", "stand")
    assert monitor.phases == [*up, "run", "drop", "sit", "disarm"]
    assert toy.kinds() == ["Hello", "Arm", "Position", "Disarm"]
    assert (toy.firmware.mode, toy.firmware.reason) == (Mode.DISARMED, Reason.NONE)
    trace = saved.trace
    assert trace.time == pytest.approx(STEP * np.arange(1, STEPS + 1))
    facts = {"ended": "time", "missed_steps": [], "firmware": "toy", "lead": 0.0}
    assert facts.items() <= trace.meta.items()
    assert trace.meta["config_hash"] == deploy.deployment.contract.config_hash
    assert (timing.missed, timing.stale) == (0, 0)
    assert not (saved.path.parent / "run_000.npz.partial").exists()
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
    up = round(STARTUP_TIME / STEP)
    assert targets[up - 10] == pytest.approx(robot.pose_angles(*policy.contract.rest), abs=1e-6)
    assert speed[: up - 1].max() < 4.0
    assert speed[-round(SITTING_TIME / STEP) :].max() < 1e-6


def test_rows_without_a_valid_trace_are_lost_with_a_note(deploy, monkeypatch):
    monkeypatch.setattr(
        "surefoot.task.partial_trace.TraceHeader.trace", mock.Mock(side_effect=SurefootError("time repeats"))
    )
    _, saved, _ = deploy()
    assert (saved.trace, saved.lost, saved.notes) == (None, True, ["no trace can be made of the rows: time repeats"])


def test_rows_have_the_commands_and_the_states_at_their_end(deploy, toy, policy):
    toy.sensors = lambda time, readings: replace(
        readings, **tilt(0.1 * np.sin(9 * time), 0.05 * np.cos(7 * time)), energy=2.0 * time
    )
    trace = deploy()[1].trace
    start = trace.meta["robot_time_start"]
    positions = {round(time * 1e6): message.target for time, message in sent(toy, Position)}
    for k in range(STEPS):
        assert trace.target[k] == pytest.approx(positions[round((start + k * STEP) * 1e6)], abs=1e-6)
    ends = start + STEP * np.arange(1, STEPS + 1)
    assert trace.roll_pitch_yaw[:, 0] == pytest.approx(0.1 * np.sin(9 * ends), abs=1e-6)
    assert trace.observation[1:, :2] == pytest.approx(trace.roll_pitch_yaw[:-1, :2], abs=1e-7)
    assert trace.energy == pytest.approx(2.0 * STEP, abs=1e-5)
    assert trace.feedback == pytest.approx(policy.feedback(trace.observation), abs=1e-6)


@pytest.mark.parametrize(
    ("change", "ended", "reason"),
    [
        ({"motor_angle": np.full(8, np.nan)}, "fault", "not finite"),
        (tilt(0.6), "fall", "tilt"),
        ({"temperature": np.full(8, 85.0)}, "stopped", "temperature"),
        ({"voltage": 13.5}, "stopped", "battery"),
    ],
)
def test_readings_beyond_a_limit_end_a_run(change, ended, reason, deploy, toy):
    at_step(20, change, toy)
    outcome, saved, _ = deploy(steps=300)
    assert end_of(outcome) == (ended, reason, True)
    assert (saved.trace.meta["ended"], saved.trace.meta["reason"]) == (ended, reason)
    assert 12 <= saved.trace.num_steps <= 24 + (170 if reason == "battery" else 0)
    assert not toy.firmware.armed
    assert bool(sent(toy, Damp)) == (ended in ("fault", "fall"))


def test_a_fall_damps_at_once_and_the_robot_sits_once_it_lies_still(deploy, toy, monitor):
    at_step(20, tilt(0.6), toy)
    outcome, saved, _ = deploy(steps=300)
    assert outcome.text.endswith("it has sat down")
    damped, armed = sent(toy, Damp)[0][0], sent(toy, Arm)[-1][0]
    assert armed - damped >= toy.firmware.limits.rearm_after
    assert saved.trace.fell
    assert abs(saved.trace.roll_pitch_yaw[-1, 0]) > 0.5
    assert monitor.phases[-4:] == ["lie still", "arm", "sit down", "disarm"]
    assert toy.firmware.mode == Mode.DISARMED
    # Nothing was commanded between the tilt and the damping.
    assert not [time for time, _ in sent(toy, Position) if damped <= time < armed]


@pytest.mark.parametrize("remote", [False, True])
def test_a_stop_at_once_after_a_fall_keeps_the_motors_damped(remote, deploy, toy, stop, link):
    at_step(20, tilt(0.6), toy)
    when = STARTUP_TIME + 20 * STEP + 0.3
    if remote:
        tick = toy.firmware.tick

        def announce(now, vitals):
            if toy.firmware.mode == Mode.FAULT and not any(fault.reason == Reason.REMOTE for fault in link.faults):
                toy.firmware.announce(now, (Reason.REMOTE, "L2 and B of the remote control are pressed"))
            return tick(now, vitals)

        toy.firmware.tick = announce
    else:
        stop.at = stop.again = when
    outcome, _, _ = deploy(steps=300)
    assert outcome.text.endswith("it stays damped: stopped at once by the operator")
    assert (outcome.ended, outcome.safe, toy.firmware.mode) == ("fall", True, Mode.FAULT)
    damped = sent(toy, Damp)[0][0]
    assert not [time for time, _ in sent(toy, Position) if time > damped]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (tilt(1.4), "it lies on its side and stays damped"),
        ({**tilt(0.6), "motor_velocity": np.full(8, 3.0)}, "it does not come to rest and stays damped"),
    ],
)
def test_a_robot_on_its_side_or_in_motion_stays_damped(change, text, deploy, toy):
    at_step(20, change, toy)
    assert deploy(steps=300)[0].text.endswith(text)
    assert toy.firmware.mode == Mode.FAULT


@pytest.mark.parametrize(
    ("call", "reason", "text"),
    [
        (raises, "exception", "ZeroDivisionError: division by zero"),
        (lambda: np.full((1, 8), np.nan), "not finite", "feedback 'swing.front_left' is nan"),
        (lambda: np.full((1, 3), 0.1), "exception", "Error"),
    ],
)
def test_a_failing_policy_damps_the_robot_in_the_same_step(call, reason, text, deploy, toy, policy):
    outcome, saved, _ = deploy(Spoiled(policy, 25, call))
    assert end_of(outcome) == ("fault", reason, True)
    assert text in outcome.text
    assert toy.firmware.reason == Reason.HOST
    assert saved.trace.num_steps == 25
    # The step that failed is the 26th; the robot was damped at its time.
    assert sent(toy, Damp)[0][0] == pytest.approx(saved.trace.meta["robot_time_start"] + 25 * STEP, abs=1e-6)


def test_a_fault_after_an_episode_does_not_change_how_it_ended(deploy, toy):
    at_step(STEPS + 20, {"motor_velocity": np.full(8, np.nan)}, toy)
    outcome, saved, _ = deploy()
    assert (outcome.ended, outcome.safe) == ("time", True)
    assert outcome.text == "done; then a reading of the robot is not finite"
    assert (saved.trace.num_steps, saved.trace.meta["ended"]) == (STEPS, "time")
    assert toy.firmware.reason == Reason.HOST


def test_a_tilt_while_the_robot_drops_is_not_a_fall(deploy, toy):
    at_step(STEPS + 20, tilt(pitch=0.6), toy)
    outcome, _, _ = deploy()
    assert (outcome.ended, outcome.safe) == ("time", False)
    assert toy.firmware.mode == Mode.DISARMED


def test_a_stop_request_makes_the_robot_sit(deploy, toy, stop):
    stop.at = STARTUP_TIME + 20 * STEP + 0.1
    outcome, saved, _ = deploy(steps=300)
    assert end_of(outcome) == ("stopped", "operator", False)
    assert (toy.firmware.mode, toy.firmware.reason) == (Mode.DISARMED, Reason.NONE)
    assert not sent(toy, Damp)
    assert 10 <= saved.trace.num_steps <= 40


@pytest.mark.parametrize("when", [SEATED + 0.2, STARTUP_TIME + 0.5])
def test_two_stop_requests_damp_the_motors(when, deploy, toy, stop):
    stop.at, stop.again = when, when + 0.2
    assert end_of(deploy(steps=300)[0]) == ("stopped", "operator", True)
    assert toy.firmware.reason == Reason.HOST


@pytest.mark.parametrize(
    ("when", "phases"),
    [
        (0.01, ["arm", "lay legs flat", "disarm"]),
        (0.05, ["lay legs flat", "disarm"]),
        (0.15, ["draw legs in", "disarm"]),
        (0.25, ["sit", "disarm"]),
        (SEATED + 0.2, ["stand up", "sit down", "disarm"]),
        (STARTUP_TIME - 0.1, ["stand", "sit down", "disarm"]),
    ],
)
def test_a_stop_request_before_the_policy_runs(when, phases, deploy, toy, stop, monitor):
    stop.at = when
    outcome, saved, _ = deploy()
    assert end_of(outcome) == ("stopped", "operator", False)
    # Only a robot that has started to stand up sits down; a lying robot is disarmed at once.
    assert monitor.phases[-len(phases) :] == phases
    assert not sent(toy, Damp)
    assert (saved.trace, saved.lost) == (None, False)
    assert toy.firmware.mode == Mode.DISARMED


def test_a_stop_request_before_anything_moves(deploy, toy, stop):
    stop.at = 0.0
    assert deploy()[0].text == "stopped before anything moved"
    assert not sent(toy, Arm)


def test_a_robot_that_damps_itself_ends_the_run(deploy, toy):
    once(toy, lambda: toy.firmware._fail(toy._now, Reason.TEMPERATURE, "hot"))
    outcome, saved, _ = deploy(steps=300)
    assert end_of(outcome) == ("fault", "robot temperature", True)
    assert saved.trace.num_steps > 20
    assert not sent(toy, Damp)


def test_a_robot_that_sends_no_states_is_damped_after_three_steps(deploy, toy):
    silent, send = [], toy._send

    def pongs_only():
        frames = toy.firmware.take()
        toy.firmware._out = [frame for frame in frames if isinstance(frame.message, Pong)] if silent else frames
        send()

    toy._send = pongs_only
    once(toy, lambda: silent.append(True))
    outcome, saved, timing = deploy(steps=300)
    assert end_of(outcome) == ("fault", "stale state", True)
    assert timing.stale in (3, 4)
    assert sent(toy, Damp)
    assert saved.trace.num_steps > 20


def test_a_pulled_cable_ends_the_run_and_the_trace_is_saved(deploy, toy):
    once(toy, lambda: setattr(toy, "cut", True))
    outcome, saved, _ = deploy(steps=300)
    assert end_of(outcome) == ("fault", "link", True)
    assert "port toy is gone" in outcome.text
    assert saved.trace.num_steps > 20
    assert saved.path.exists()
    deploy.deployment.close()


def late_by(link, steps, at):
    """Make the clock late once: the program sleeps through a number of steps."""
    clock = link.clock
    wait, done = clock.wait_until, []

    def wait_until(moment):
        wait(moment)
        if moment > at and not done:
            done.append(True)
            wait(moment + steps * STEP)

    clock.wait_until = wait_until


@pytest.mark.parametrize("steps", [1, 2])
def test_missed_steps_hold_the_target_and_are_counted(steps, deploy, toy, link):
    late_by(link, steps, STARTUP_TIME + 0.2)
    outcome, saved, timing = deploy()
    assert (outcome.ended, timing.missed) == ("time", steps)
    trace = saved.trace
    missed = trace.meta["missed_steps"]
    assert len(missed) == steps
    assert trace.num_steps == STEPS
    assert np.diff(trace.time) == pytest.approx(STEP)
    for k in missed:
        assert trace.target[k].tolist() == trace.target[missed[0] - 1].tolist()
    # The phase of the gait stays correct: the next target belongs to its own time.
    after, gait = missed[-1] + 1, deploy.deployment.controller.gait
    expected = gait.motor_targets(np.array([after * STEP]), trace.feedback[after][None])[0]
    assert trace.target[after] == pytest.approx(expected, abs=1e-12)


def test_more_than_two_consecutive_missed_steps_damp(deploy, toy, link):
    late_by(link, 3, STARTUP_TIME + 0.2)
    outcome, saved, timing = deploy()
    assert end_of(outcome) == ("fault", "late", True)
    assert toy.firmware.reason == Reason.HOST
    assert timing.missed == 3
    assert saved.trace.num_steps > 20


def test_a_dry_run_arms_and_commands_nothing(deploy, toy):
    outcome, saved, timing = deploy(dry_run=True)
    assert outcome.ended == "time"
    assert set(toy.kinds()) == {"Hello"}
    assert (toy.firmware.mode, toy.firmware.owner) == (Mode.DISARMED, 77)
    assert saved.trace.num_steps == STEPS
    assert saved.trace.meta["dry_run"]
    assert timing.steps > STEPS


@pytest.mark.parametrize(
    ("call", "match"),
    [
        (raises, "policy 'trot' fails in the robot's present state: ZeroDivisionError: division by zero"),
        (lambda: np.full((1, 8), np.nan), "present state: NotFiniteError: feedback 'swing.front_left'"),
    ],
)
def test_a_policy_that_fails_from_the_start_prevents_arming(call, match, deploy, toy, policy):
    with pytest.raises(SurefootError, match=match):
        deploy(Spoiled(policy, -20, call))
    assert not sent(toy, Arm)


def test_a_cable_pulled_before_arming_is_an_error(deploy, toy):
    toy.cut = True
    with pytest.raises(SurefootError, match="connection lost before the robot was armed: port toy is gone"):
        deploy()


def wear(toy):
    """Make a motor too hot from now on."""
    toy.firmware._vitals = replace(toy.firmware._vitals, temperature=95.0)
    toy.firmware.tick = lambda now, vitals: None


@pytest.mark.parametrize("accelerometer", [False, True])
def test_the_trace_has_the_accelerometer_of_a_board_that_sends_it(deploy, toy, link, accelerometer):
    toy.codec = link.codec = link.decoder.codec = toy._decoder.codec = Codec(8, accelerometer)
    toy.sensors = lambda time, readings: replace(readings, accelerometer=np.array([time, 0.0, 9.75]))
    _, saved, _ = deploy()
    assert ("accelerometer" in np.load(saved.path)) == accelerometer
    force = EpisodeTrace.load(saved.path).accelerometer
    if accelerometer:
        np.testing.assert_allclose(np.diff(force, axis=0), np.tile([STEP, 0.0, 0.0], (STEPS - 1, 1)), atol=1e-5)
        assert (force[:, 2] == 9.75).all()
    else:
        assert np.isnan(force).all()


def test_a_robot_that_cannot_be_armed_is_an_error(deploy, toy):
    with pytest.raises(SurefootError, match="the robot does not arm: a motor is at 95 degC"):
        deploy(prepare=lambda: wear(toy))
    assert not sent(toy, Position)


def test_a_robot_that_cannot_be_armed_again_ends_its_second_run(deploy, toy):
    deploy()
    wear(toy)
    saver = RunSaver(deploy.deployment, None, STEPS)
    outcome = deploy.deployment.run(saver.recorder, LoopTiming(100))
    assert end_of(outcome) == ("fault", "arm", True)
    assert "a motor is at 95 degC" in outcome.text


def test_a_lost_request_to_arm_is_repeated(deploy, toy):
    write, lost = toy.write, []

    def drop_two(data: bytes) -> int:
        frames = Decoder(toy.codec).feed(data)
        if len(lost) < 2 and any(isinstance(frame.message, Arm) for frame in frames):
            lost.append(data)
            return len(data)
        return write(data)

    toy.write = drop_two
    assert deploy()[0].ended == "time"
    assert len(lost) == 2


def test_a_damped_robot_can_be_armed_after_a_clean_link(deploy, toy):
    outcome, _, _ = deploy(prepare=lambda: toy.firmware._fail(toy._now, Reason.TIMEOUT, "before"))
    assert outcome.ended == "time"
    assert sent(toy, Arm)[-1][0] >= toy.firmware.limits.rearm_after


def test_a_robot_beyond_its_angle_limits_is_moved_back_within_them(deploy, toy):
    toy.angle = np.full(8, -1.0)
    assert deploy()[0].ended == "time"
    targets = np.array([message.target for _, message in sent(toy, Position)])
    assert targets.min() >= toy.firmware.handshake.angle_low.min() - 1e-6


@pytest.mark.parametrize("shown", [True, False])
def test_the_speed_is_estimated_for_monitors_that_show_it(deploy, monitor, shown):
    monitor.shows_speed = shown
    deploy()
    speeds = [snapshot.speed for snapshot in monitor.snapshots if snapshot.phase == "run"]
    assert len(speeds) > 2
    assert all((speed is not None) == shown for speed in speeds)


def test_monitors_get_ten_snapshots_a_second_and_warnings(deploy, monitor, toy):
    at_step(5, {"voltage": 14.2}, toy)
    deploy(steps=500)
    run = [snapshot for snapshot in monitor.snapshots if snapshot.phase == "run"]
    assert 28 <= len(run) <= 32
    assert run[5].rate == pytest.approx(1 / STEP, rel=0.01)
    assert len(run[5].lateness) in (16, 17)
    assert run[5].inference > 0.0
    assert monitor.warnings == ["battery below 14.4 V; charge it soon"]
