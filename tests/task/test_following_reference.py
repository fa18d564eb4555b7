"""Foot trajectories that follow commands: strides, turning, standing, reach."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from references import read_reference

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.gait import HybridGait
from surefoot.task.reference import RATE_STEP, FollowingReference

ROBOTS = ("minitaur", "solo8", "go2", "pupper_v2")


def reference_of(name: str) -> FollowingReference:
    """Return the gait of the task `steer` for a robot."""
    reference = load_task("steer", name)[0].gait(RobotDescription.load(name)).reference
    assert isinstance(reference, FollowingReference)
    return reference


def state(command: tuple[float, float, float], activity: float = 1.0, phases: int = 200) -> CommandState:
    """Return the states of one cycle with a command."""
    return CommandState(np.tile(command, (phases, 1)), np.full(phases, activity), np.arange(phases) / phases)


def feet(reference: FollowingReference, command_state: CommandState) -> np.ndarray:
    """Return foot positions relative to the legs' mounts (phases, L, 3) [m]."""
    robot = reference.robot
    angles = robot.leg_geometry.to_motors(reference.pose(0.0, command_state))
    return robot.leg_geometry.foot_position(angles)


@pytest.mark.parametrize("name", ROBOTS)
def test_feet_go_backward_at_the_commanded_speed_times_the_gain(name: str) -> None:
    reference = reference_of(name)
    speed = 0.3
    place = feet(reference, state((speed, 0.0, 0.0)))[:, :, 0]
    step = 1.0 / reference.frequency(np.array([[speed, 0.0, 0.0]]))[0] / 200
    # A foot is on the ground for the first part of its own cycle.
    share = (np.arange(200)[:, None] / 200 - reference.feet.phase) % 1.0
    moving = np.diff(place, axis=0)[((share > 0.02) & (share < reference.feet.duty_factor - 0.02))[:-1]] / step
    assert moving == pytest.approx(np.full_like(moving, -reference.choice.stride_gain * speed), rel=1e-6)


def test_feet_go_sideways_by_abduction() -> None:
    reference = reference_of("go2")
    place = feet(reference, state((0.0, 0.2, 0.0)))
    span = np.ptp(place, axis=0)
    stride = reference.choice.stride_gain * 0.2 * 0.6 / reference.frequency(np.array([[0.0, 0.2, 0.0]]))[0]
    assert span[:, 1].min() >= stride  # the swing overshoots both ends a little
    assert span[:, 1].max() < 1.3 * stride
    assert span[:, 0].max() < 1e-9


def test_turning_moves_left_and_right_feet_in_opposite_directions() -> None:
    reference = reference_of("minitaur")
    x, y = reference.robot.leg_mounts[:, 0], reference.robot.leg_mounts[:, 1] + reference.neutral_feet[:, 1]
    command = np.array([[0.0, 0.0, 0.1]])
    stride = reference.strides(command)[0]
    stance = reference.feet.duty_factor / reference.frequency(command)[0]
    # The forward component of w x r is -w y; legs without abduction can't follow the lateral component.
    assert stride[:, 0] == pytest.approx(-0.1 * reference.choice.turn_gain * y * reference.choice.stride_gain * stance)
    assert not stride[:, 1].any()
    assert (stride[y > 0, 0] < 0).all()
    aside = reference_of("go2")
    x = aside.robot.leg_mounts[:, 0]
    command = np.array([[0.0, 0.0, 0.5]])
    stride = aside.strides(command)[0]
    assert stride[:, 1] == pytest.approx(
        0.5 * x * aside.choice.stride_gain * aside.feet.duty_factor / aside.frequency(command)[0]
    )


@pytest.mark.parametrize("name", ROBOTS)
def test_a_standing_robot_keeps_its_feet_in_place(name: str) -> None:
    reference = reference_of(name)
    still = feet(reference, state((0.0, 0.0, 0.0), activity=0.0))
    assert np.ptp(still, axis=0) == pytest.approx(0.0, abs=1e-12)
    assert still[0] == pytest.approx(reference.neutral_feet, abs=1e-9)


def changed(name: str, params: dict[str, float] | None = None, **reference: float) -> HybridGait:
    """Return the gait of the task `steer` for a robot, with changes to its reference."""
    data = {"reference": reference, "params": params or {}}
    return from_mapping(TaskConfig, data, base=load_task("steer", name)[0]).gait(RobotDescription.load(name))


def test_clearance_and_height_follow_the_command() -> None:
    reference = changed("go2", clearance_rise=0.5, height_rise=-0.1).reference
    for speed, share in ((0.0, 0.0), (5.0, 1.0)):
        heights = feet(reference, state((speed, 0.0, 0.0), phases=2000))[:, :, 2]
        sunk = 0.1 * share * reference.feet.height
        assert heights.max(axis=0) == pytest.approx(
            reference.neutral_feet[:, 2] + reference.feet.clearance * (1 + 0.5 * share) + sunk, abs=1e-4
        )
        assert heights.min(axis=0) == pytest.approx(
            reference.neutral_feet[:, 2] - reference.feet.depth + sunk, abs=1e-4
        )


def test_weight_feedforward_compensates_deflection() -> None:
    gait, plain = (changed("go2", {"servo_kp": 30.0}, weight_feedforward=gain) for gain in (1.0, 0.0))
    robot, kp = gait.robot, 30.0
    index, feedback = robot.leg_motor_index, np.zeros((1, 12))
    for activity, phase, carrying in ((0.0, 0.0, (0.25,) * 4), (1.0, 0.3, (0.0, 0.5, 0.5, 0.0))):
        one = CommandState(np.zeros((1, 3)), np.array([activity]), np.array([phase]))
        targets, there = (each.motor_targets(np.zeros(1), feedback, one)[0] for each in (gait, plain))
        torque = kp * (targets - there)[index]
        # Virtual work: torques that carry F do the work F dz as motors turn.
        turn = 1e-6 * np.array([[0.3, -1.0, 0.7]])
        move = robot.leg_geometry.foot_position(there[index] + turn) - robot.leg_geometry.foot_position(there[index])
        work = np.array(carrying) * robot.weight * -move[:, 2]
        assert (torque * turn).sum(axis=1) == pytest.approx(work, rel=1e-4, abs=1e-9)


def test_velocity_feedforward_is_the_tasks_gain() -> None:
    lead = changed("go2", {"servo_kp": 30.0, "servo_kd": 0.6}).reference.feedforward.velocity
    assert lead == pytest.approx(0.8 * 0.6 / 30.0)  # 0.8 in the task, times k_d / k_p
    assert reference_of("go2").feedforward.velocity == pytest.approx(0.8 * 1.0 / 40.0)


@pytest.mark.parametrize("name", ROBOTS)
def test_all_commands_are_within_extent_and_reach(name: str) -> None:
    reference, random = reference_of(name), np.random.default_rng(1)
    low, high = reference.limits.low, reference.limits.high
    command = low + random.uniform(size=(500, 3)) * (high - low)
    poses = reference.pose(0.0, CommandState(command, random.uniform(size=500), random.uniform(size=500)))
    assert np.isfinite(poses).all()
    for (least, most), values in zip(reference.extent(), np.moveaxis(poses, 1, 0), strict=True):
        assert values.min() >= least - 2e-3
        assert values.max() <= most + 2e-3


def test_the_maximum_stride_applies_with_its_frequency() -> None:
    reference = reference_of("go2")
    reference = replace(reference, choice=replace(reference.choice, frequency_rise=0.5))
    fast = np.array([[50.0, 0.0, 0.0]])
    assert np.linalg.norm(reference.strides(fast)[0], axis=-1) == pytest.approx(reference.feet.stroke)
    assert reference.frequency(fast)[0] == pytest.approx(1.5 / reference.period)
    assert reference.frequency(np.zeros((1, 3)))[0] == pytest.approx(1.0 / reference.period)


def test_reference_of_a_contract_is_the_same_gait() -> None:
    reference = reference_of("go2")
    again = read_reference(reference.to_dict(), reference.robot, reference.limits)
    command_state = state((0.5, 0.1, 0.3))
    assert again.pose(0.0, command_state) == pytest.approx(reference.pose(0.0, command_state), abs=1e-12)


def test_a_stride_out_of_reach_is_rejected() -> None:
    reference = reference_of("go2")
    data = reference.to_dict()
    data["foot"]["stroke"] = dict.fromkeys(reference.feet.legs, 0.8)
    with pytest.raises(SurefootError, match="out of the leg's reach"):
        read_reference(data | {"stride_gain": 3.0}, reference.robot, reference.limits)


@pytest.mark.parametrize("robots", [1, 5])
@pytest.mark.parametrize(
    ("task", "robot"),
    [("steer", "minitaur"), ("steer", "go2"), ("terrain", "pupper_v2"), ("terrain-seeing", "go2")],
)
def test_pose_and_rate_are_those_of_single_phases(task: str, robot: str, robots: int) -> None:
    reference = load_task(task, robot)[0].gait(RobotDescription.load(robot)).reference
    assert isinstance(reference, FollowingReference)
    draws, limits, legs = np.random.default_rng(0), reference.limits, len(reference.feet.legs)
    radius, lift = reference.foothold_radius, reference.touch_clearance
    walking = CommandState(
        draws.uniform(limits.low, limits.high, (robots, 3)),
        draws.uniform(0.2, 1.0, robots),
        draws.uniform(0.0, 1.0, robots),
        lift_off=draws.uniform(-0.5, 0.5, (robots, legs, 2)) * radius if radius else None,
        landing=draws.uniform(-0.5, 0.5, (robots, legs, 2)) * radius if radius else None,
        lift=draws.uniform(0.0, 1.0, (robots, legs)) * lift if lift else None,
        over_holes=draws.uniform(0.0, 1.0, robots) if reference.over_holes else None,
    )
    assert (reference.over_holes is not None) is (task == "terrain-seeing")
    pose, rate = reference.pose_and_rate(0.0, walking)
    change = RATE_STEP * reference.choice.frequency(walking.command)
    before, after = (reference.pose(0.0, replace(walking, phase=walking.phase + s * change)) for s in (-1, 1))
    np.testing.assert_allclose(pose, reference.pose(0.0, walking), rtol=0, atol=1e-14)
    np.testing.assert_allclose(rate, (after - before) / (2 * RATE_STEP), rtol=0, atol=1e-10)
    assert np.abs(rate).max() > 0.1
