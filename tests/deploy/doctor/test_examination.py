"""The doctor's judgements, each with known answers, and how it moves a robot: gently, and no further than is safe."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba")  # the toy robot runs the emulator's firmware

from surefoot.check_result import CheckResult
from surefoot.cli.helpers.policies import find_policy
from surefoot.deploy.doctor import rack_check
from surefoot.deploy.doctor.doctor_motion import DoctorMotion, MotionStoppedError
from surefoot.deploy.doctor.examination import check_computer, examine, time_inference
from surefoot.deploy.doctor.link_check import LinkFigures, check_link, clock_rate, measure_bursts, measure_link
from surefoot.deploy.doctor.rack_check import MotorStep, check_motors, check_response, fit_response
from surefoot.deploy.doctor.rest_check import TimedState, check_rest
from surefoot.deploy.doctor.tilt_check import TiltReading, check_tilts, read_tilt
from surefoot.deploy.messages import Mode, State
from surefoot.deploy.poses import sitting_pose
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription

NAMES = RobotDescription.load("minitaur").motor_names
QUICK = {"pings": 20, "steps": 20}


@pytest.fixture(scope="module")
def policy() -> PolicyRuntime:
    return PolicyRuntime.load(find_policy("trot"))


class Never:
    """An operator who asks for nothing."""

    stops = 0


# Link.


def test_frames_that_come_together_are_one_burst():
    assert measure_bursts(np.array([0.0, 0.005, 0.010, 0.015])) == (1.0, pytest.approx(0.005))
    # An adapter that gathers: three frames at once, every 16 ms.
    assert measure_bursts(np.repeat([0.0, 0.016, 0.032], 3)) == (3.0, pytest.approx(0.016))
    assert measure_bursts(np.array([])) == (0.0, 0.0)
    assert measure_bursts(np.array([1.0])) == (1.0, 0.0)


def test_the_rate_of_a_clock_is_found_beneath_delays(rng: np.random.Generator):
    here = np.linspace(0, 1, 200)
    for true in (0.5, 1.0, 1.02):
        delays = np.where(np.arange(200) % 7 == 0, 0.0, rng.uniform(0, 0.005, 200))
        assert clock_rate(7.0 + true * here, here + delays) == pytest.approx(true, abs=1e-3)
    assert clock_rate(np.zeros(2), np.zeros(2)) == 1.0


def figures(trips: Any = 0.001, **changed: Any) -> LinkFigures:
    plain = {"lost": 0, "damaged": 0, "missing": 0, "unsent": 0, "burst": 1.0, "gap": 0.005, "clock_rate": 1.0}
    return LinkFigures(np.broadcast_to(trips, 200).astype(float), **(plain | changed))


def link_failures(measured: LinkFigures) -> dict[str, CheckResult]:
    found = check_link(measured, lead=0.003, control_step=0.006, lockstep=False)
    assert [one.name for one in found] == ["link, losses", "link, bursts", "link, round trip", "robot's clock"]
    return {one.name: one for one in found if one.passed is False}


def test_a_good_link_passes():
    assert link_failures(figures()) == {}


@pytest.mark.parametrize(
    ("measured", "check", "why"),
    [
        (figures(lost=2), "link, losses", "2 of 202 pings lost"),
        (figures(damaged=3), "link, losses", "3 frames damaged"),
        (figures(missing=5), "link, losses", "5 missing"),
        (figures(trips=0.0031), "link, round trip", "median 3.10 ms"),
        (figures(trips=np.r_[np.full(195, 0.001), np.full(5, 0.02)]), "link, round trip", "99th percentile 20.00 ms"),
        (figures(burst=3.2, gap=0.016), "link, bursts", "3.2 answers together on average, every 16.0 ms"),
        (figures(clock_rate=0.8), "robot's clock", "runs 20.00% too slow"),
        (figures(clock_rate=1.02), "robot's clock", "runs 2.00% too fast"),
    ],
)
def test_a_bad_link_is_found(measured: LinkFigures, check: str, why: str):
    failed = link_failures(measured)
    assert list(failed) == [check]
    assert why in failed[check].message
    assert failed[check].remedy


def test_a_line_that_answers_nothing_fails_once():
    found = check_link(replace(figures(lost=200), round_trips=np.zeros(0)), 0.003, 0.006, False)
    assert [one.passed for one in found] == [False, None, None, None]


def test_pings_that_are_lost_are_counted(link: RobotLink, toy: Any):
    link.connect()
    toy.silent = True
    # Time in lockstep needs answers; what is lost is lost for the doctor's own pings.
    link.clock.wait_until = lambda moment: setattr(link.clock, "_now", moment)  # type: ignore[method-assign]
    assert measure_link(link, 20).lost == 20


# At rest.


def samples_of(state: State, rng: np.random.Generator, count: int = 100, **changed: Any) -> list[TimedState]:
    """States of a robot at rest whose gyro is noisy."""
    made = []
    for index in range(count):
        values = {name: value(index) if callable(value) else value for name, value in changed.items()}
        values.setdefault("angular_velocity_base", 0.004 + 0.003 * rng.standard_normal(3))
        made.append(TimedState(0.01 * index, replace(state, **values)))
    return made


def rest_failures(samples: list[TimedState], robot: RobotDescription, link: RobotLink) -> dict[str, CheckResult]:
    handshake = link.connect()
    found = check_rest(samples, robot, handshake, SafetyLimits.of(robot))
    assert [one.name for one in found] == ["battery", "temperature", "encoders", "IMU"]
    return {one.name: one for one in found if not one.passed}


def pose_of(robot: RobotDescription, swing: Any, extension: Any) -> np.ndarray:
    return robot.pose_angles(np.broadcast_to(swing, 4), np.broadcast_to(extension, 4))


@pytest.mark.parametrize(("swing", "extension"), [(0.0, 0.9), (-1.3, 1.0), (0.12, 2.98), (0.0, 2.0)])
def test_a_robot_at_rest_passes_in_any_pose_that_is_alike(
    swing: float, extension: float, a_state: State, robot: RobotDescription, link: RobotLink, rng: Any
):
    state = replace(a_state, motor_angle=pose_of(robot, swing, extension))
    assert rest_failures(samples_of(state, rng), robot, link) == {}


@pytest.mark.parametrize(
    ("changed", "check", "why"),
    [
        ({"voltage": 14.1}, "battery", "14.10 V; it must be 14.4 V"),
        ({"temperature": np.r_[np.full(7, 30.0), 75.0]}, "temperature", "back_right_2_motor, 75 degC; at most 70"),
        ({"roll_pitch_yaw": np.array([0.0, -1.6, 0.0])}, "IMU", "pitch is 1.600 rad at rest; at most 0.3"),
        ({"angular_velocity_base": np.array([0.0, 0.0, 0.2])}, "IMU", "gyro's mean is 0.200 rad/s"),
        (
            {"angular_velocity_base": lambda k: np.array([0.2 * (-1) ** k, 0.0, 0.0])},
            "IMU",
            "gyro's noise is 0.200 rad/s",
        ),
        (
            {"roll_pitch_yaw": lambda k: np.array([0.1 * (-1) ** k, 0.0, 0.0])},
            "IMU",
            "noise of roll and pitch is 0.100 rad",
        ),
        # Pitch grows by .1 rad/s and the gyro says that nothing turns.
        (
            {"roll_pitch_yaw": lambda k: np.array([0.0, 0.001 * k, 0.0]), "angular_velocity_base": np.zeros(3)},
            "IMU",
            "drift of roll and pitch against the gyro is 0.100 rad/s",
        ),
        ({"roll_pitch_yaw": np.array([np.nan, 0.0, 0.0])}, "IMU", "is not finite"),
        ({"motor_angle": np.r_[np.full(7, 2.0), np.nan]}, "encoders", "the angle of back_right_2_motor is not finite"),
    ],
)
def test_what_is_wrong_at_rest_is_found(
    changed: dict[str, Any],
    check: str,
    why: str,
    a_state: State,
    robot: RobotDescription,
    link: RobotLink,
    rng: Any,
):
    failed = rest_failures(samples_of(a_state, rng, **changed), robot, link)
    assert list(failed) == [check]
    assert why in failed[check].message
    assert failed[check].remedy


@pytest.mark.parametrize("motor", range(8))
def test_a_mirrored_encoder_is_found_at_rest(
    motor: int, a_state: State, robot: RobotDescription, link: RobotLink, rng: Any
):
    angles = pose_of(robot, 0.0, 0.9)
    angles[motor] *= -1
    failed = rest_failures(samples_of(replace(a_state, motor_angle=angles), rng), robot, link)
    leg = next(leg for leg in robot.legs if NAMES[motor] in leg.motors)
    assert failed["encoders"].message.startswith(leg.name)
    assert NAMES[motor] in failed["encoders"].message


def test_a_robot_that_sends_no_states_fails(robot: RobotDescription, link: RobotLink):
    assert len(rest_failures([], robot, link)) == 4


# On the rack.


@functools.cache
def response(frequency: float, damping: float) -> tuple[np.ndarray, np.ndarray]:
    """Of J x'' = K (1 - x) - D x' from rest, integrated by hand in steps of 10 microseconds."""
    x = v = 0.0
    dt, out = 1e-5, []
    grid = np.arange(0.0, 0.2, dt)
    for _ in grid:
        out.append(x)
        v += dt * (frequency**2 * (1 - x) - 2 * damping * frequency * v)
        x += dt * v
    return grid, np.array(out)


def step_response(age: np.ndarray, delay: float, frequency: float, damping: float) -> np.ndarray:
    return np.interp(age - delay, *response(frequency, damping), left=0.0)


@pytest.mark.parametrize(
    ("delay", "frequency", "damping"),
    [(0.0, 60.0, 0.5), (0.0053, 100.0, 0.8), (0.017, 150.0, 2.2), (0.04, 60.0, 0.5), (0.04, 150.0, 2.2)],
)
def test_the_delay_of_a_step_response_is_found(delay: float, frequency: float, damping: float, rng: Any):
    age = np.r_[np.arange(0.003, 0.15, 0.006), np.arange(0.003, 0.15, 0.006)]
    moved = 0.97 * step_response(age, delay, frequency, damping) + 0.004 * rng.standard_normal(len(age))
    fit = fit_response(age, moved)
    assert fit.delay == pytest.approx(delay, abs=1.5e-3)
    assert fit.error < 0.03
    fine = np.arange(0, 0.15, 1e-4)
    there = fine[np.argmax(step_response(fine, 0.0, frequency, damping) > 0.632)]
    assert fit.rise == pytest.approx(there, abs=3e-3)


def wiggles(moved: np.ndarray, delay: float = 0.017, frequency: float = 90.0) -> list[MotorStep]:
    """What was seen when each motor was asked for .05 rad: row i is how far all went when motor i was asked."""
    age = np.arange(0.002, 0.15, 0.003)
    share = step_response(age, delay, frequency, 0.9)
    return [MotorStep(motor, 0.05, row, age, share) for motor, row in enumerate(moved)]


RIGHT = 0.048 * np.eye(8)


def test_motors_that_go_where_they_are_sent_pass(robot: RobotDescription):
    result = check_motors(wiggles(RIGHT), robot)
    assert result.passed
    assert "96 to 96 % of the 0.05 rad" in result.message


def moved(**changes: Any) -> np.ndarray:
    """How far motors went, with some of it changed: entries by `at`, to `to`."""
    found = RIGHT.copy()
    found[changes["at"]] = changes["to"]
    return found


@pytest.mark.parametrize(
    ("went", "why", "todo"),
    [
        (
            RIGHT[[0, 1, 5, 3, 4, 2, 6, 7]],
            f"{NAMES[2]}, asked to go +0.050 rad, stayed, and {NAMES[5]} went +0.048",
            f"exchanged: {NAMES[2]} with {NAMES[5]};",
        ),
        (moved(at=(4, 4), to=-0.048), f"{NAMES[4]}, asked to go +0.050 rad, went -0.048", "turn the sign"),
        (moved(at=(6, 6), to=0.0), f"{NAMES[6]}, asked to go +0.050 rad, went +0.000", "check cables"),
        (moved(at=(1, 0), to=0.03), f"went +0.048 and took along {NAMES[0]}", "check cables"),
    ],
    ids=["exchanged", "mirrored", "still", "coupled"],
)
def test_a_motor_that_goes_wrong_is_named(robot: RobotDescription, went: np.ndarray, why: str, todo: str):
    result = check_motors(wiggles(went), robot)
    assert result.passed is False
    assert why in result.message
    assert todo in result.remedy


def test_many_faults_are_told_in_one_line(robot: RobotDescription):
    result = check_motors(wiggles(-RIGHT), robot)
    assert result.message.endswith("(and 6 more)")


@pytest.mark.parametrize(
    ("delay", "passed"), [(0.0175, True), (0.0125, True), (0.022, True), (0.025, False), (0.0095, False)]
)
def test_latency_is_the_readings_age_and_the_lead(delay: float, passed: bool):
    # The command waits half a servo period, .5 ms, on average, and the state is used 3 ms after it is sent.
    latency, servo = check_response(wiggles(RIGHT[:3], delay), (0.02, 0.02), 0.001, 0.003)
    assert latency.value == pytest.approx(delay - 0.0005 + 0.003, abs=3e-4)
    assert latency.passed is passed
    assert servo.passed
    if not passed:
        assert "the policy was trained with 20 ms" in latency.message
        assert "or train with control_latency 0.0" in latency.remedy


def test_latency_within_the_range_of_training_passes():
    latency, _ = check_response(wiggles(RIGHT[:3], 0.037), (0.0, 0.04), 0.001, 0.003)
    assert latency.passed
    assert "trained with 0 to 40 ms" in latency.message


def test_a_slow_servo_fails():
    _, servo = check_response(wiggles(RIGHT[:3], frequency=20.0), (0.02, 0.02), 0.001, 0.003)
    assert servo.passed is False


def test_latency_is_skipped_when_motors_do_not_answer():
    results = check_response(wiggles(0 * RIGHT), (0.02, 0.02), 0.001, 0.003)
    assert [result.passed for result in results] == [None, None]


# On the ground.


def test_the_frame_of_an_imu_that_is_mounted_right_passes():
    found = check_tilts(
        TiltReading(np.array([0.001, 0.07]), np.array([0.0, 0.075])),
        TiltReading(np.array([-0.17, 0.01]), np.array([-0.16, 0.0])),
    )
    assert [one.passed for one in found] == [True, True, True]


@pytest.mark.parametrize(
    ("mounted", "failed", "todo"),
    [
        (np.array([[0, 1], [1, 0]]), [0, 1], "x and y are exchanged"),
        (np.diag([-1, 1]), [1], "roll is mirrored"),
        (np.diag([1, -1]), [0], "pitch is mirrored"),
        (-np.eye(2), [0, 1], "is mirrored"),
        (0 * np.eye(2), [0, 1], "did not tilt the robot"),
    ],
)
def test_an_imu_that_is_mounted_wrong_is_found(mounted: np.ndarray, failed: list[int], todo: str):
    front, left = mounted @ [0.001, 0.07], mounted @ [-0.17, 0.01]
    found = check_tilts(TiltReading(front, front), TiltReading(left, left))
    assert [index for index, one in enumerate(found) if one.passed is False] == failed
    assert all(todo in found[index].remedy for index in failed)


def test_rates_in_degrees_or_mirrored_are_found():
    front, left = np.array([0.0, 0.07]), np.array([-0.17, 0.0])
    for factor in (57.3, -1.0, 0.0):
        found = check_tilts(TiltReading(front, factor * front), TiltReading(left, factor * left))
        assert [one.passed for one in found] == [True, True, False]


def test_a_tilt_is_read_from_states_with_the_bias_taken_off(a_state: State):
    """A robot that pitches by .08 rad between .5 and 1.5 s, with a gyro that says .01 rad/s too much."""
    times = np.arange(0, 2, 0.006)
    bias = np.array([0.01, 0.01, 0.0])
    samples = [
        TimedState(
            t,
            replace(
                a_state,
                roll_pitch_yaw=np.array([0.02, 0.08 * np.clip(t - 0.5, 0, 1), 0.0]),
                angular_velocity_base=np.array([0.0, 0.08 if 0.5 < t < 1.5 else 0.0, 0.0]) + bias,
            ),
        )
        for t in times
    ]
    seen = read_tilt(samples, bias)
    assert seen.angles == pytest.approx([0.0, 0.08], abs=1e-9)
    assert seen.turned == pytest.approx([0.0, 0.08], abs=1e-3)


# This computer.


def test_times_of_a_quick_computer_pass_and_of_a_slow_one_fail():
    quick, slow = np.full(1000, 1e-4), np.r_[np.full(990, 1e-4), np.full(10, 0.004)]
    assert [one.passed for one in check_computer(quick, quick, 0, 0.006)] == [True, True]
    assert [one.passed for one in check_computer(slow, quick, 0, 0.006)] == [False, True]
    assert [one.passed for one in check_computer(quick, slow, 0, 0.006)] == [True, False]
    assert [one.passed for one in check_computer(quick, quick, 2, 0.006)] == [True, False]
    # The same times are good enough for a policy of half the rate.
    assert [one.passed for one in check_computer(slow, slow, 1, 0.012)] == [True, True]


def test_every_inference_is_timed(policy: PolicyRuntime):
    taken = time_inference(policy, 30)
    assert taken.shape == (30,)
    assert (taken > 0).all()


# Motion.


def move(link: RobotLink, robot: RobotDescription, operator: Any = Never, **options: Any) -> DoctorMotion:
    if link.handshake is None:
        link.connect()
        assert link.wait_for(lambda: link.state is not None, 1.0)
    return DoctorMotion(link, robot, 0.006, operator, options.pop("max_error", 0.15), **options)


def test_a_motion_is_smooth_and_ends_disarmed(link: RobotLink, robot: RobotDescription, toy: Any):
    end = toy.angle + 0.3
    with move(link, robot, max_error=1.0) as motion:
        motion.go(end, 0.6)
    assert np.allclose(toy.angle, end, atol=1e-6)
    targets = np.array([message.target[0] for _, message in toy.heard if type(message).__name__ == "Position"])
    assert np.abs(np.diff(targets, prepend=0.9)).max() < 0.3 * 1.9 * 0.006 / 0.6  # least jerk: 15/8 of the mean speed
    assert len(motion.states) >= 100
    assert toy.kinds() == ["Hello", "Arm", "Position", "Disarm"]
    assert toy.firmware.mode == Mode.DISARMED
    assert link.on_state is None


def test_a_robot_on_the_ground_sits_before_it_is_disarmed(link: RobotLink, robot: RobotDescription, toy: Any):
    with move(link, robot, sits=True) as motion:
        motion.go(pose_of(robot, 0.0, 1.5), 0.5)
    assert np.allclose(toy.angle, sitting_pose(robot), atol=1e-6)
    assert toy.firmware.mode == Mode.DISARMED


def test_a_motor_that_strays_damps_all(link: RobotLink, robot: RobotDescription, toy: Any):
    def stray(time: float, readings: Any) -> Any:
        angle = readings.motor_angle.copy()
        angle[3] += 0.4 if toy.firmware.armed else 0.0
        return replace(readings, motor_angle=angle)

    toy.sensors = stray
    start = toy.angle.copy()
    motion = move(link, robot)
    with pytest.raises(MotionStoppedError, match=r"back_left_1_motor is .0.40 rad from where it was sent"), motion:
        motion.hold(start, 0.5)
    assert motion.tracking_error == (3, pytest.approx(0.4))
    assert toy.kinds()[-1] == "Damp"
    assert toy.firmware.mode == Mode.FAULT


@pytest.mark.parametrize(("stops", "last", "mode"), [(1, "Disarm", Mode.DISARMED), (2, "Damp", Mode.FAULT)])
def test_ctrl_c_sits_and_once_more_damps(
    stops: int, last: str, mode: Mode, link: RobotLink, robot: RobotDescription, toy: Any
):
    class Impatient:
        @property
        def stops(self) -> int:
            return stops if link.clock.now() > 0.3 else 0

    stand = pose_of(robot, 0.0, 1.5)
    motion = move(link, robot, Impatient(), sits=True)
    with pytest.raises(MotionStoppedError) as stopped, motion:
        motion.go(stand, 5.0)
    assert stopped.value.verdict.reason == "operator"
    assert toy.kinds()[-1] == last
    assert toy.firmware.mode == mode
    assert np.allclose(toy.angle, sitting_pose(robot), atol=1e-6) == (stops == 1)


def test_an_exception_in_the_middle_damps(link: RobotLink, robot: RobotDescription, toy: Any):
    def fail(motion: DoctorMotion) -> None:
        with motion:
            motion.hold(toy.angle.copy(), 0.1)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail(move(link, robot))
    assert toy.kinds()[-1] == "Damp"
    assert toy.firmware.mode == Mode.FAULT


# All together.


def delayed(seconds: float) -> Callable[[float, Any], Any]:
    """Readings of motor angles from so long ago; time on the toy goes on in steps of its states."""
    past: deque[tuple[float, np.ndarray]] = deque(maxlen=2000)

    def sensors(time: float, readings: Any) -> Any:
        past.append((time, readings.motor_angle))
        old = [angle for at, angle in past if at <= time - seconds]
        return replace(readings, motor_angle=old[-1] if old else readings.motor_angle)

    return sensors


def test_a_toy_that_is_as_old_as_the_policy_expects_passes_all(
    link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    toy.sensors = delayed(0.018)
    found = list(examine(link, policy, robot, on_rack=True, **QUICK))
    assert [one.name for one in found if one.passed is False] == []
    by_name = {one.name: one for one in found}
    assert all(by_name[name].passed for name in rack_check.NAMES)
    assert by_name["control latency"].value == pytest.approx(0.018, abs=0.004)
    assert toy.firmware.mode == Mode.DISARMED


def test_a_cable_that_is_pulled_ends_the_checks_with_a_finding(
    link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    found = []
    for result in examine(link, policy, robot, **QUICK):
        found.append(result)
        toy.cut = result.name == "angle limits"
    assert found[-2].name == "angle limits"
    assert (found[-1].name, found[-1].passed) == ("link", False)


def test_a_wiggle_that_is_stopped_says_which_motor(
    link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    def runaway(time: float, readings: Any) -> Any:
        moved = readings.motor_angle - sitting_pose(robot)
        angle = readings.motor_angle.copy()
        angle[2] -= 5 * moved[2]
        return replace(readings, motor_angle=angle)

    toy.sensors = runaway
    link.connect()
    assert link.wait_for(lambda: link.state is not None, 1.0)
    found = rack_check.step_motors(link, policy.contract, robot, Never())  # type: ignore[arg-type]
    assert found[0].passed is False
    assert (
        "back_left_2_motor went -0.25 rad from where it was sent while back_left_2_motor was asked" in found[0].message
    )
    assert [one.passed for one in found[1:]] == [None, None]
