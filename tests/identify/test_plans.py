"""Commands of every experiment from first to last: within the robot's limits, and without unintended jumps."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.messages import Mode
from surefoot.deploy.poses import sitting_pose
from surefoot.identify.ground.plans import DRAG, extension_chirp, fore_aft_signs, lateral_signs, stand_up_phases
from surefoot.identify.plan import FADE, Phase, Plan, chirps, go_to, hold, steps, sweep
from surefoot.identify.rack.plans import PULSE_TIME, SPIKE_PERIOD, latency_plan, motor_plan
from surefoot.identify.registry import EXPERIMENTS
from surefoot.robot import RobotDescription

PERIOD = 0.002
JUMPS = ("steps", "drop", "hop")
"""Phases with intended jumps of the target."""
MAX_JUMP = 0.4
"""Maximum jump of a target in all other phases [rad]."""


FIVE_BAR = [name for name, experiment in EXPERIMENTS.items() if not experiment.for_joint_actuators]


@pytest.fixture(scope="module")
def plans(robot: RobotDescription) -> dict[str, Plan]:
    return {name: EXPERIMENTS[name].plan(robot) for name in FIVE_BAR}


COMMANDS: dict[tuple[int, bytes], NDArray[np.float64]] = {}
"""Cache of commands by phase and start: most phases start from the same pose, independent of the robot's first pose."""


def commands(phase: Phase, start: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return all commands of a phase (T, M), one per period; the last one holds at its end."""
    key = (id(phase), start.tobytes())
    if key not in COMMANDS:
        assert np.isfinite(phase.signal(phase.duration, start)).all()
        COMMANDS[key] = np.array([phase.signal(k * PERIOD, start) for k in range(round(phase.duration / PERIOD))])
    return COMMANDS[key]


@pytest.mark.parametrize(
    ("swing", "extension"),
    [(0.0, 0.9), ([1.3, -1.2, 1.1, 1.4], 0.8), (0.0, 0.2), (0.0, 2.6)],
    ids=["sits", "lies", "folded", "hangs"],
)
@pytest.mark.parametrize("name", FIVE_BAR)
def test_plans_have_no_jumps_from_any_start(
    name: str, swing: float | list[float], extension: float, plans: dict[str, Plan], robot: RobotDescription
):
    """A robot may lie or hang in any pose when it is armed."""
    plan, message = plans[name], make_handshake(robot, Limits.from_robot(robot), "", robot.timing.servo_step)
    before = robot.pose_angles(swing, extension)
    for phase in plan.phases:
        if phase.mode == Mode.PWM:
            duties = commands(phase, np.zeros(robot.num_motors))
            assert np.isfinite(duties).all()
            assert np.abs(duties).max() <= plan.largest_duty + 1e-12
            # The last command holds until the robot is disarmed.
            np.testing.assert_array_equal(duties[-1], 0.0)
            continue
        angles = np.clip(commands(phase, before), message.angle_low, message.angle_high)
        assert np.isfinite(angles).all(), phase.name
        if phase.name not in JUMPS:
            # This also holds after a PWM phase, which ends near its start.
            jumps = np.abs(np.diff(np.vstack([before, angles]), axis=0))
            assert jumps.max() < MAX_JUMP, phase.name
            assert jumps[1:].max(initial=0.0) < 0.1, phase.name
        before = angles[-1]


def test_plans_stay_within_the_robots_angles(plans: dict[str, Plan], robot: RobotDescription):
    message = make_handshake(robot, Limits.from_robot(robot), "", robot.timing.servo_step)
    for name, plan in plans.items():
        assert (plan.experiment, plan.rack) == (name, EXPERIMENTS[name].rack)
        assert plan.duration < plan.limits.duration
        before = sitting_pose(robot)
        for phase in plan.phases:
            if phase.mode == Mode.POSITION:
                angles = commands(phase, before)
                assert np.all(angles >= message.angle_low), phase.name
                assert np.all(angles <= message.angle_high), phase.name
                before = angles[-1]
                if phase.use != "transition":
                    assert np.all(angles >= plan.angle_low - 1e-9), phase.name
                    assert np.all(angles <= plan.angle_high + 1e-9), phase.name


@pytest.mark.parametrize("name", FIVE_BAR)
def test_plans_are_deterministic(name: str, plans: dict[str, Plan], robot: RobotDescription):
    start = np.zeros(robot.num_motors)
    for first, second in zip(plans[name].phases, EXPERIMENTS[name].plan(robot).phases, strict=True):
        assert (first.name, first.duration, first.use) == (second.name, second.duration, second.use)
        np.testing.assert_array_equal(first.signal(0.05, start), second.signal(0.05, start))


def test_pulses_return_a_motor_to_its_start(robot: RobotDescription):
    phase = next(p for p in motor_plan(robot).phases if p.name == "PWM pulses")
    start = np.zeros(robot.num_motors)
    values = [phase.signal((k + 0.5) * PULSE_TIME, start) for k in range(6)]
    assert np.all(np.abs(values[0]) > 0)
    # One pulse forward, two back, one forward: a free motor ends at rest at its start. Then the duty is zero.
    for value, factor in zip(values, (1, -1, -1, 1, 0, 0), strict=True):
        np.testing.assert_array_equal(value, factor * values[0])


def test_a_spike_is_one_command(robot: RobotDescription):
    phase = next(p for p in latency_plan(robot).phases if p.name == "spikes")
    duties = commands(phase, np.zeros(robot.num_motors))
    driven = np.flatnonzero(np.abs(duties).max(axis=1))
    np.testing.assert_array_equal(driven, [0, round(SPIKE_PERIOD / PERIOD)])
    np.testing.assert_allclose(np.abs(duties[driven]), robot.experiments.spike)
    np.testing.assert_array_equal(duties[driven[0]], -duties[driven[1]])


def test_legs_have_signs_by_position(robot: RobotDescription):
    # Order: front left, back left, front right, back right.
    assert fore_aft_signs(robot).tolist() == [1, -1, 1, -1]
    assert lateral_signs(robot).tolist() == [1, 1, -1, -1]


def test_an_extension_chirp_is_around_standing(robot: RobotDescription):
    signal = extension_chirp(robot, fore_aft_signs(robot), 0.12, 1.0, 4.0, 2.0)
    start, stand = np.zeros(8), robot.pose_angles(0.0, robot.experiments.stance)
    np.testing.assert_allclose(signal(0.0, start), stand)
    np.testing.assert_allclose(signal(2.0, start), stand, atol=1e-12)
    for t in np.arange(0.0, 2.0, 0.05):
        swing, extension = robot.to_pose(signal(t, start))
        np.testing.assert_allclose(swing, 0.0, atol=1e-12)
        # Front legs lengthen as much as back legs shorten.
        np.testing.assert_allclose(
            extension - robot.experiments.stance,
            (extension[0] - robot.experiments.stance) * fore_aft_signs(robot),
            atol=1e-12,
        )
        assert abs(extension[0] - robot.experiments.stance) <= 0.12 + 1e-12


def test_a_sweep_of_one_frequency_is_a_sine():
    angle, fade = sweep(1.0, 2.0, 2.0, 3.0)
    assert angle == pytest.approx(4 * np.pi)
    assert fade == 1.0
    assert sweep(FADE / 2, 2.0, 2.0, 3.0)[1] == pytest.approx(0.5)
    assert sweep(3.0, 2.0, 2.0, 3.0)[1] == 0.0
    # From 1 to 4 Hz in 2 s the frequency grows as 4^(t / 2), whose integral is 3 / ln 2.
    assert sweep(2.0, 1.0, 4.0, 2.0)[0] == pytest.approx(2 * np.pi * 3 / np.log(2))
    middle, amplitude, phase, start = np.array([0.5, 1.0]), np.array([0.1, 0.2]), np.array([0.0, 0.4]), np.zeros(2)
    expected = middle + 0.5 * amplitude * np.sin(sweep(FADE / 2, 1.0, 4.0, 2.0)[0] + phase)
    np.testing.assert_allclose(chirps(middle, amplitude, 1.0, 4.0, 2.0, phase)(FADE / 2, start), expected)


def test_legs_that_slid_out_are_pulled_in_from_their_side(robot: RobotDescription):
    out, unfold, draw_in = stand_up_phases(robot)[:3]
    start = robot.pose_angles([1.0, -0.9, 0.1, 0.0], 0.4)
    swing, extension = robot.to_pose(out.signal(1.0, start))
    np.testing.assert_allclose(swing, [1.2, -1.2, 0.1, 0.0], atol=1e-12)
    np.testing.assert_allclose(extension, 0.4)
    flat = unfold.signal(1.0, out.signal(1.0, start))
    np.testing.assert_allclose(robot.to_pose(flat)[0], swing, atol=1e-12)
    np.testing.assert_allclose(robot.to_pose(flat)[1], 0.9)
    np.testing.assert_allclose(draw_in.signal(1.0, flat), sitting_pose(robot), atol=1e-12)


def test_a_diagonal_is_dragged_while_the_other_stands(robot: RobotDescription):
    drags = [phase for phase in EXPERIMENTS["contact"].plan(robot).phases if phase.name == "drag"]
    stand = robot.pose_angles(0.0, robot.experiments.stance)
    moved = []
    for phase in drags:
        angles = commands(phase, stand)
        np.testing.assert_allclose(angles[0], stand, atol=1e-12)
        np.testing.assert_allclose(angles[-1], stand, atol=1e-3)
        swing, extension = np.moveaxis(robot.to_pose(angles), -2, 0)
        moving = np.ptp(swing, axis=0) > 1e-9
        moved.append(moving.tolist())
        np.testing.assert_allclose(np.abs(swing).max(axis=0)[moving], DRAG, rtol=0.01)
        np.testing.assert_allclose(
            robot.experiments.stance - extension.min(axis=0), np.where(moving, robot.experiments.lift, 0.0), atol=1e-9
        )
    assert moved == [[True, False, False, True], [False, True, True, False]]


def test_signals():
    start, target = np.array([1.0, 2.0]), np.array([3.0, 0.0])
    motion = go_to(target, 2.0)
    np.testing.assert_allclose(motion(0.0, start), start)
    np.testing.assert_allclose(motion(1.0, start), (start + target) / 2)
    np.testing.assert_allclose(motion(2.0, start), target)
    np.testing.assert_allclose(motion(9.0, start), target)
    np.testing.assert_allclose(hold(target)(1.0, start), target)
    rows = np.array([[1.0], [2.0], [3.0]])
    jump = steps(rows, 0.25)
    assert [jump(t, start)[0] for t in (0.0, 0.249, 0.25, 0.5, 5.0)] == [1.0, 1.0, 2.0, 3.0, 3.0]
