"""Checks of the doctor against inputs with known results, and its motions."""

from __future__ import annotations

import functools
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("numba")  # the toy robot runs the emulator's firmware

from surefoot.api.policies import find_policy
from surefoot.check_result import CheckResult
from surefoot.deploy.doctor import rack_check, tilt_check
from surefoot.deploy.doctor.doctor_motion import DoctorMotion, MotionStoppedError
from surefoot.deploy.doctor.examination import check_computer, examine, time_inference
from surefoot.deploy.doctor.link_check import LinkMetrics, check_link, clock_rate, measure_bursts, measure_link
from surefoot.deploy.doctor.rack_check import MotorStep, check_motors, check_response
from surefoot.deploy.doctor.rest_check import TimedState, check_rest
from surefoot.deploy.doctor.step_response import fit_response
from surefoot.deploy.doctor.tilt_check import TiltReading, check_tilts, read_tilt
from surefoot.deploy.messages import Mode, Packet, Pong, State
from surefoot.deploy.poses import sitting_pose
from surefoot.deploy.robot_link import ReceivedPacket, RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription

NAMES = RobotDescription.load("minitaur").motor_names
QUICK = {"pings": 20, "steps": 20}


@pytest.fixture(scope="module")
def policy() -> PolicyRuntime:
    return PolicyRuntime.load(find_policy("trot"))


class NoOperator:
    """An operator who never stops anything."""

    stops = 0


@pytest.fixture
def ready(link: RobotLink) -> RobotLink:
    """Return the link after its handshake, with a state."""
    link.connect()
    assert link.wait_for(lambda: link.state is not None, 1.0)
    return link


def failures(results: list[CheckResult], *names: str) -> dict[str, CheckResult]:
    """Return the failed checks by name, after asserting the names of all results."""
    assert [result.name for result in results] == list(names)
    failed = {result.name: result for result in results if result.passed is False}
    assert all(result.remedy for result in failed.values())
    return failed


# Link.


def test_frames_that_arrive_together_are_one_burst():
    assert measure_bursts(np.array([0.0, 0.005, 0.010, 0.015])) == (1.0, pytest.approx(0.005))
    # Three frames together, every 16 ms.
    assert measure_bursts(np.repeat([0.0, 0.016, 0.032], 3)) == (3.0, pytest.approx(0.016))
    assert measure_bursts(np.array([])) == (0.0, 0.0)
    assert measure_bursts(np.array([1.0])) == (1.0, 0.0)


def test_the_clock_rate_is_independent_of_delays(rng: np.random.Generator):
    here = np.linspace(0, 1, 200)
    for true in (0.5, 1.0, 1.02):
        delays = np.where(np.arange(200) % 7 == 0, 0.0, rng.uniform(0, 0.005, 200))
        assert clock_rate(7.0 + true * here, here + delays) == pytest.approx(true, abs=1e-3)
    assert clock_rate(np.zeros(2), np.zeros(2)) == 1.0


def link_metrics(trips: Any = 0.001, **changed: Any) -> LinkMetrics:
    defaults = {"lost": 0, "damaged": 0, "missing": 0, "unsent": 0, "burst": 1.0, "gap": 0.005, "clock_rate": 1.0}
    return LinkMetrics(np.broadcast_to(trips, 200).astype(float), **(defaults | changed))


def link_failures(measured: LinkMetrics) -> dict[str, CheckResult]:
    results = check_link(measured, lead=0.003, control_step=0.006, lockstep=False)
    return failures(results, "link, losses", "link, bursts", "link, round trip", "robot's clock")


def test_a_good_link_passes():
    assert link_failures(link_metrics()) == {}


@pytest.mark.parametrize(
    ("measured", "check", "why"),
    [
        (link_metrics(lost=2), "link, losses", "2 of 202 pings lost"),
        (link_metrics(damaged=3), "link, losses", "3 frames damaged"),
        (link_metrics(missing=5), "link, losses", "5 missing"),
        (link_metrics(trips=0.0031), "link, round trip", "median 3.10 ms"),
        (
            link_metrics(trips=np.r_[np.full(195, 0.001), np.full(5, 0.02)]),
            "link, round trip",
            "99th percentile 20.00 ms",
        ),
        (link_metrics(burst=3.2, gap=0.016), "link, bursts", "3.2 answers together on average, every 16.0 ms"),
        (link_metrics(clock_rate=0.8), "robot's clock", "runs 20.00% too slow"),
        (link_metrics(clock_rate=1.02), "robot's clock", "runs 2.00% too fast"),
    ],
)
def test_a_bad_link_fails(measured: LinkMetrics, check: str, why: str):
    failed = link_failures(measured)
    assert list(failed) == [check]
    assert why in failed[check].message


def test_a_link_without_answers_fails_once():
    results = check_link(replace(link_metrics(lost=200), round_trips=np.zeros(0)), 0.003, 0.006, False)
    assert [result.passed for result in results] == [False, None, None, None]


def test_lost_pings_are_counted(link: RobotLink, toy: Any):
    link.connect()
    toy.silent = True
    # In lockstep the clock waits for answers; here it runs without them.
    link.clock.wait_until = lambda moment: setattr(link.clock, "_now", moment)  # type: ignore[method-assign]
    assert measure_link(link, 20).lost == 20


class BufferedLink:
    """A real-time link with its own clock, whose adapter delivers buffered answers every 16 ms."""

    lockstep, every = False, 0.016

    def __init__(self) -> None:
        self.clock, self.time = self, 0.0
        self.statistics = SimpleNamespace(damaged=0, missing=0, unsent=0)
        self.pongs: dict[int, ReceivedPacket] = {}
        self._sent: dict[int, ReceivedPacket] = {}

    def now(self) -> float:
        return self.time

    def ping(self) -> int:
        token = len(self._sent) + 1
        delivered = self.every * np.ceil(self.time / self.every + 1e-9)
        self._sent[token] = ReceivedPacket(Packet(Pong(token), token, self.time), delivered)
        return token

    def wait(self, seconds: float) -> None:
        due = [arrival.time for arrival in self._sent.values() if arrival.time > self.time]
        self.time = min([self.time + seconds, *due])

    def update(self) -> None:
        self.pongs |= {token: arrival for token, arrival in self._sent.items() if arrival.time <= self.time}


def test_an_adapter_that_buffers_bytes_fails() -> None:
    measured = measure_link(BufferedLink(), 160)  # type: ignore[arg-type]
    assert (measured.lost, measured.burst, measured.gap) == (0, pytest.approx(16 / 5), pytest.approx(0.016))
    assert measured.round_trips.max() == pytest.approx(0.016)
    failed = link_failures(measured)
    assert "latency_timer" in failed["link, bursts"].remedy


# At rest.


def samples_of(state: State, rng: np.random.Generator, count: int = 100, **changed: Any) -> list[TimedState]:
    """Return states of a robot at rest with a noisy gyro."""
    states = []
    for index in range(count):
        values = {name: value(index) if callable(value) else value for name, value in changed.items()}
        values.setdefault("angular_velocity_base", 0.004 + 0.003 * rng.standard_normal(3))
        states.append(TimedState(0.01 * index, replace(state, **values)))
    return states


def rest_failures(samples: list[TimedState], robot: RobotDescription, link: RobotLink) -> dict[str, CheckResult]:
    results = check_rest(samples, robot, link.connect(), SafetyLimits.from_robot(robot))
    return failures(results, "battery", "temperature", "encoders", "IMU")


def pose_of(robot: RobotDescription, swing: Any, extension: Any) -> np.ndarray:
    return robot.pose_angles(np.broadcast_to(swing, 4), np.broadcast_to(extension, 4))


@pytest.mark.parametrize(("swing", "extension"), [(0.0, 0.9), (-1.3, 1.0), (0.12, 2.98), (0.0, 2.0)])
def test_a_robot_at_rest_passes_if_all_legs_are_in_the_same_pose(
    swing: float, extension: float, a_state: State, robot: RobotDescription, link: RobotLink, rng: Any
):
    state = replace(a_state, motor_angle=pose_of(robot, swing, extension))
    assert rest_failures(samples_of(state, rng), robot, link) == {}


@pytest.mark.parametrize(
    ("changed", "check", "why"),
    [
        ({"voltage": 14.1}, "battery", "14.10 V; at least 14.4 V"),
        ({"temperature": np.r_[np.full(7, 30.0), 75.0]}, "temperature", "back_right_2_motor, 75 degC; at most 70"),
        ({"roll_pitch_yaw": np.array([0.0, -1.6, 0.0])}, "IMU", "pitch is 1.600 rad at rest; at most 0.3"),
        ({"angular_velocity_base": np.array([0.0, 0.0, 0.2])}, "IMU", "gyro bias is 0.200 rad/s"),
        (
            {"angular_velocity_base": lambda k: np.array([0.2 * (-1) ** k, 0.0, 0.0])},
            "IMU",
            "gyro noise is 0.200 rad/s",
        ),
        (
            {"roll_pitch_yaw": lambda k: np.array([0.1 * (-1) ** k, 0.0, 0.0])},
            "IMU",
            "noise of roll and pitch is 0.100 rad",
        ),
        # Pitch grows by 0.1 rad/s and the gyro reads zero.
        (
            {"roll_pitch_yaw": lambda k: np.array([0.0, 0.001 * k, 0.0]), "angular_velocity_base": np.zeros(3)},
            "IMU",
            "drift of roll and pitch relative to the gyro is 0.100 rad/s",
        ),
        ({"roll_pitch_yaw": np.array([np.nan, 0.0, 0.0])}, "IMU", "is not finite"),
        ({"motor_angle": np.r_[np.full(7, 2.0), np.nan]}, "encoders", "the angle of back_right_2_motor is not finite"),
    ],
)
def test_a_fault_at_rest_fails_its_check(
    changed: dict[str, Any], check: str, why: str, a_state: State, robot: RobotDescription, link: RobotLink, rng: Any
):
    failed = rest_failures(samples_of(a_state, rng, **changed), robot, link)
    assert list(failed) == [check]
    assert why in failed[check].message


@pytest.mark.parametrize("motor", range(8))
def test_a_mirrored_encoder_fails_at_rest(
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
    """Return the step response of J x'' = K (1 - x) - D x', integrated in steps of 10 microseconds."""
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
def test_the_fit_of_a_step_response_has_its_delay_and_rise_time(
    delay: float, frequency: float, damping: float, rng: Any
):
    age = np.r_[np.arange(0.003, 0.15, 0.006), np.arange(0.003, 0.15, 0.006)]
    moved = 0.97 * step_response(age, delay, frequency, damping) + 0.004 * rng.standard_normal(len(age))
    fit = fit_response(age, moved)
    assert fit.delay == pytest.approx(delay, abs=1.5e-3)
    assert fit.error < 0.03
    fine = np.arange(0, 0.15, 1e-4)
    rise = fine[np.argmax(step_response(fine, 0.0, frequency, damping) > 0.632)]
    assert fit.rise == pytest.approx(rise, abs=3e-3)


def steps(moved: np.ndarray, delay: float = 0.017, frequency: float = 90.0) -> list[MotorStep]:
    """Return the readings of steps of 0.05 rad; row i of `moved` is the motion of all motors in the step of motor i."""
    age = np.arange(0.002, 0.15, 0.003)
    progress = step_response(age, delay, frequency, 0.9)
    return [MotorStep(motor, 0.05, row, age, progress) for motor, row in enumerate(moved)]


def test_steps_against_friction_are_longer(robot: RobotDescription):
    go2 = RobotDescription.load("go2")
    friction = np.array(go2.actuator.friction)
    assert friction[2] == pytest.approx(0.91, abs=0.01)  # of a knee [N m]
    at_70, at_35 = (rack_check.step_sizes(go2, np.full(12, kp)) for kp in (70.0, 35.0))
    assert at_70[:3] == pytest.approx([0.05, 0.05, 5 * friction[2] / 70])
    assert at_35[2] == pytest.approx(5 * friction[2] / 35)
    assert np.all(rack_check.step_sizes(go2, np.full(12, 10.0))[2::3] == rack_check.MAX_STEP)
    assert np.all(
        rack_check.step_sizes(robot, np.ones(8)) == rack_check.STEP
    )  # kp is a duty per angle: no joint actuator


RIGHT = 0.048 * np.eye(8)


def test_motors_that_follow_their_steps_pass(robot: RobotDescription):
    result = check_motors(steps(RIGHT), robot)
    assert result.passed
    assert "by 96 to 96 % of its step of 0.05 rad" in result.message


def moved(motor: tuple[int, int], motion: float) -> np.ndarray:
    """Return the motions of all motors with one of them changed."""
    motions = RIGHT.copy()
    motions[motor] = motion
    return motions


@pytest.mark.parametrize(
    ("motions", "message", "remedy"),
    [
        (
            RIGHT[[0, 1, 5, 3, 4, 2, 6, 7]],
            f"{NAMES[2]}, commanded to move by +0.050 rad, did not move, but {NAMES[5]} moved by +0.048",
            f"swapped: {NAMES[2]} and {NAMES[5]};",
        ),
        (moved((4, 4), -0.048), f"{NAMES[4]}, commanded to move by +0.050 rad, moved by -0.048", "invert the sign"),
        (moved((6, 6), 0.0), f"{NAMES[6]}, commanded to move by +0.050 rad, moved by +0.000", "check cables"),
        (moved((1, 0), 0.03), f"moved by +0.048, together with {NAMES[0]}", "check cables"),
    ],
    ids=["swapped", "inverted", "still", "coupled"],
)
def test_a_motor_that_does_not_follow_its_step_is_named(
    robot: RobotDescription, motions: np.ndarray, message: str, remedy: str
):
    result = check_motors(steps(motions), robot)
    assert result.passed is False
    assert message in result.message
    assert remedy in result.remedy


def test_many_faults_are_reported_in_one_line(robot: RobotDescription):
    result = check_motors(steps(-RIGHT), robot)
    assert result.message.endswith("(and 6 more)")


@pytest.mark.parametrize(
    ("delay", "passed"), [(0.0175, True), (0.0125, True), (0.022, True), (0.025, False), (0.0095, False)]
)
def test_the_control_latency_includes_the_age_of_readings_and_the_lead(delay: float, passed: bool):
    # The command waits for half a servo period, 0.5 ms, on average, and the state is used 3 ms after it is sent.
    latency, servo = check_response(steps(RIGHT[:3], delay), (0.02, 0.02), 0.001, 0.003)
    assert latency.value == pytest.approx(delay - 0.0005 + 0.003, abs=3e-4)
    assert latency.passed is passed
    assert servo.passed
    if not passed:
        assert "the policy was trained with 20 ms" in latency.message
        assert "or train with control_latency 0.0" in latency.remedy


def test_latency_within_the_range_of_training_passes():
    latency, _ = check_response(steps(RIGHT[:3], 0.037), (0.0, 0.04), 0.001, 0.003)
    assert latency.passed
    assert "trained with 0 to 40 ms" in latency.message


def test_a_slow_servo_fails():
    _, servo = check_response(steps(RIGHT[:3], frequency=20.0), (0.02, 0.02), 0.001, 0.003)
    assert servo.passed is False


def test_latency_is_skipped_if_motors_do_not_respond():
    results = check_response(steps(0 * RIGHT), (0.02, 0.02), 0.001, 0.003)
    assert [result.passed for result in results] == [None, None]


# On the ground.


def test_an_imu_with_the_right_frame_passes():
    front = TiltReading(np.array([0.001, 0.07]), np.array([0.0, 0.075]))
    left = TiltReading(np.array([-0.17, 0.01]), np.array([-0.16, 0.0]))
    assert [result.passed for result in check_tilts(front, left)] == [True, True, True]


@pytest.mark.parametrize(
    ("mounted", "failed", "remedy"),
    [
        (np.array([[0, 1], [1, 0]]), [0, 1], "x and y of the IMU are swapped"),
        (np.diag([-1, 1]), [1], "roll of the IMU has the wrong sign"),
        (np.diag([1, -1]), [0], "pitch of the IMU has the wrong sign"),
        (-np.eye(2), [0, 1], "of the IMU has the wrong sign"),
        (0 * np.eye(2), [0, 1], "did not tilt the robot"),
    ],
)
def test_an_imu_with_a_wrong_frame_fails(mounted: np.ndarray, failed: list[int], remedy: str):
    front, left = mounted @ [0.001, 0.07], mounted @ [-0.17, 0.01]
    results = check_tilts(TiltReading(front, front), TiltReading(left, left))
    assert [index for index, result in enumerate(results) if result.passed is False] == failed
    assert all(remedy in results[index].remedy for index in failed)


def test_rates_in_degrees_or_with_a_wrong_sign_fail():
    front, left = np.array([0.0, 0.07]), np.array([-0.17, 0.0])
    for factor in (57.3, -1.0, 0.0):
        results = check_tilts(TiltReading(front, factor * front), TiltReading(left, factor * left))
        assert [result.passed for result in results] == [True, True, False]


def test_a_tilt_is_corrected_for_gyro_bias(a_state: State):
    """A robot that pitches by 0.08 rad between 0.5 and 1.5 s; its gyro has a bias of 0.01 rad/s."""
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
    tilt = read_tilt(samples, bias)
    assert tilt.angles == pytest.approx([0.0, 0.08], abs=1e-9)
    assert tilt.integrated == pytest.approx([0.0, 0.08], abs=1e-3)


# This computer.


def test_a_fast_computer_passes_and_a_slow_one_fails():
    quick, slow = np.full(1000, 1e-4), np.r_[np.full(990, 1e-4), np.full(10, 0.004)]
    assert [result.passed for result in check_computer(quick, quick, 0, 0.006)] == [True, True]
    assert [result.passed for result in check_computer(slow, quick, 0, 0.006)] == [False, True]
    assert [result.passed for result in check_computer(quick, slow, 0, 0.006)] == [True, False]
    assert [result.passed for result in check_computer(quick, quick, 2, 0.006)] == [True, False]
    # The same times pass for a policy of half the rate.
    assert [result.passed for result in check_computer(slow, slow, 1, 0.012)] == [True, True]


def test_every_inference_is_timed(policy: PolicyRuntime):
    times = time_inference(policy, 30)
    assert times.shape == (30,)
    assert (times > 0).all()


# Motion.


def motion_of(link: RobotLink, robot: RobotDescription, operator: Any = NoOperator, **options: Any) -> DoctorMotion:
    return DoctorMotion(link, robot, 0.006, operator, **({"max_error": 0.15} | options))


def test_a_motion_is_smooth_and_ends_disarmed(ready: RobotLink, robot: RobotDescription, toy: Any):
    end = toy.angle + 0.3
    with motion_of(ready, robot, max_error=1.0) as motion:
        motion.go(end, 0.6)
    assert np.allclose(toy.angle, end, atol=1e-6)
    targets = np.array([message.target[0] for _, message in toy.received if type(message).__name__ == "Position"])
    assert np.abs(np.diff(targets, prepend=0.9)).max() < 0.3 * 1.9 * 0.006 / 0.6  # minimum jerk: 15/8 of the mean speed
    assert len(motion.states) >= 100
    assert toy.kinds() == ["Hello", "Arm", "Position", "Disarm"]
    assert toy.firmware.mode == Mode.DISARMED
    assert ready.on_state is None


def test_a_robot_on_the_ground_sits_before_it_is_disarmed(ready: RobotLink, robot: RobotDescription, toy: Any):
    with motion_of(ready, robot) as motion:
        motion.rise(pose_of(robot, 0.0, 1.5))
    assert np.allclose(toy.angle, sitting_pose(robot), atol=1e-6)
    assert toy.firmware.mode == Mode.DISARMED


def test_a_motor_far_from_its_target_damps_all_motors(ready: RobotLink, robot: RobotDescription, toy: Any):
    def offset(time: float, readings: Any) -> Any:
        angle = readings.motor_angle.copy()
        angle[3] += 0.4 if toy.firmware.armed else 0.0
        return replace(readings, motor_angle=angle)

    toy.sensors = offset
    motion = motion_of(ready, robot)
    with pytest.raises(MotionStoppedError, match=r"back_left_1_motor is .0.40 rad from its target"), motion:
        motion.hold(toy.angle.copy(), 0.5)
    assert motion.tracking_error == (3, pytest.approx(0.4))
    assert toy.kinds()[-1] == "Damp"
    assert toy.firmware.mode == Mode.FAULT


@pytest.mark.parametrize(("stops", "last", "mode"), [(1, "Disarm", Mode.DISARMED), (2, "Damp", Mode.FAULT)])
def test_ctrl_c_lets_the_robot_sit_and_a_second_one_damps_it(
    stops: int, last: str, mode: Mode, ready: RobotLink, robot: RobotDescription, toy: Any
):
    class Impatient:
        @property
        def stops(self) -> int:
            return stops if ready.clock.now() > 3.2 else 0  # while it stands up

    motion = motion_of(ready, robot, Impatient())
    with pytest.raises(MotionStoppedError) as stopped, motion:
        motion.rise(pose_of(robot, 0.0, 1.5))
    assert stopped.value.verdict.reason == "operator"
    assert toy.kinds()[-1] == last
    assert toy.firmware.mode == mode
    assert np.allclose(toy.angle, sitting_pose(robot), atol=1e-6) == (stops == 1)


def test_an_exception_in_the_middle_damps(ready: RobotLink, robot: RobotDescription, toy: Any):
    with pytest.raises(ZeroDivisionError), motion_of(ready, robot) as motion:  # noqa: PT012
        motion.hold(toy.angle.copy(), 0.1)
        raise ZeroDivisionError
    assert toy.kinds()[-1] == "Damp"
    assert toy.firmware.mode == Mode.FAULT


# The examination.


def delayed(seconds: float) -> Callable[[float, Any], Any]:
    """Return sensors with motor angles that are delayed by some seconds."""
    past: deque[tuple[float, np.ndarray]] = deque(maxlen=2000)

    def sensors(time: float, readings: Any) -> Any:
        past.append((time, readings.motor_angle))
        old = [angle for at, angle in past if at <= time - seconds]
        return replace(readings, motor_angle=old[-1] if old else readings.motor_angle)

    return sensors


def test_a_robot_with_the_latency_of_training_passes_all_checks(
    link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    toy.sensors = delayed(0.018)
    results = list(examine(link, policy, robot, on_rack=True, **QUICK))
    assert [result.name for result in results if result.passed is False] == []
    by_name = {result.name: result for result in results}
    assert all(by_name[name].passed for name in rack_check.NAMES)
    assert by_name["control latency"].value == pytest.approx(0.018, abs=0.004)
    assert toy.firmware.mode == Mode.DISARMED


@pytest.mark.parametrize(("factor", "moves"), [(0.1, True), (2.0, False)])
def test_weaker_servos_than_the_policys_may_move_on_the_rack_only(
    factor: float, moves: bool, link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    handshake = toy.firmware.handshake
    gains = {name: factor * getattr(handshake, name) for name in ("servo_kp", "servo_kd")}
    toy.firmware.handshake = replace(handshake, **gains)
    toy.sensors = delayed(0.018)
    results = {one.name: one for one in examine(link, policy, robot, on_rack=True, on_ground=True, **QUICK)}
    assert results["servo gains"].passed is False
    assert (results[rack_check.NAMES[0]].passed is not None) is moves
    assert results[tilt_check.NAMES[0]].passed is None


def test_a_lost_link_ends_the_checks_with_a_failure(
    link: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    results = []
    for result in examine(link, policy, robot, **QUICK):
        results.append(result)
        toy.cut = result.name == "angle limits"
    assert results[-2].name == "angle limits"
    assert (results[-1].name, results[-1].passed) == ("link", False)


def test_a_step_that_is_stopped_names_the_motor(
    ready: RobotLink, robot: RobotDescription, policy: PolicyRuntime, toy: Any
):
    def runaway(time: float, readings: Any) -> Any:
        angle = readings.motor_angle.copy()
        angle[2] -= 5 * (angle - sitting_pose(robot))[2]
        return replace(readings, motor_angle=angle)

    toy.sensors = runaway
    results = rack_check.step_motors(ready, policy.contract, robot, NoOperator())  # type: ignore[arg-type]
    assert results[0].passed is False
    assert (
        "back_left_2_motor moved -0.25 rad away from its target while back_left_2_motor was commanded"
        in results[0].message
    )
    assert [result.passed for result in results[1:]] == [None, None]
