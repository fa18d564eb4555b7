"""Balance: legs turn the base back and answer its speed, by gains."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from resuming import assert_resumes_exactly

from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.balance import Balance
from surefoot.task.commands import CommandState
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.foot_references import FollowingReference
from surefoot.world.interface import Readings
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")
NATURAL, SPEED = (0.426 / 9.81) ** 0.5, (0.426 * 9.81) ** 0.5
STEP = np.array([0.016])
SLOW = 0.016 / NATURAL / 2.4
"""Share of a change that the slow means take over in a control step."""
FRONT_LEFT, FRONT_RIGHT, BACK_LEFT = (GO2.leg_names.index(leg) for leg in ("front_left", "front_right", "back_left"))
ABDUCTION, SWING, EXTENSION = range(3)


def balanced_task(robot: str = "go2", **gains: Any) -> TaskConfig:
    """Return the task `terrain` of a robot with a gait over holes, the same but for gains of its balance."""
    task = load_task("terrain", robot)[0]
    over = {"foot": to_mapping(task.reference.foot), "stride_gain": task.reference.stride_gain, "balance": gains}
    reference = {"foothold_radius": 0.5, "over_holes": over}
    return from_mapping(TaskConfig, {"reference": reference}, base=task)


def balance(robot: RobotDescription = GO2, **gains: Any) -> Balance:
    reference = balanced_task(robot.name, **gains).gait(robot).reference
    made = Balance.of(reference, 1)
    assert made is not None
    return made


def readings(
    made: Balance, angles: tuple[float, ...] = (0.0, 0.0), rates: tuple[float, ...] = (0.0, 0.0), **motors: Any
):
    """Return what robots measure with roll and pitch, and their rates; motors at the reference's places, at rest."""
    robot, places = made.robot, made.reference.places
    angle = robot.to_motors(robot.leg_geometry.foot_pose(places)[None])
    return Readings(
        np.zeros(1),
        np.array([[*angles, 0.0]]),
        np.array([[*rates, 0.0]]),
        motors.get("angle", angle),
        motors.get("velocity", np.zeros_like(angle)),
    )


def walking(phase: float = 0.3, forward: float = 0.0) -> CommandState:
    """Return a robot that walks; at .3 its front left leg stands and its front right one swings."""
    return CommandState(np.array([[forward, 0.0, 0.0]]), np.ones(1), np.array([phase]))


def moving(made: Balance, velocity: tuple[float, float]) -> Readings:
    """Return what robots measure whose base moves level with a velocity [m/s] over feet that stand still."""
    still = readings(made)
    jacobian = GO2.leg_geometry.jacobian(still.motor_angle[:, GO2.leg_motor_index])
    rate = np.linalg.solve(jacobian, np.broadcast_to([*(-np.array(velocity)), 0.0], (1, 4, 3))[..., None])[..., 0]
    motors = np.zeros_like(still.motor_angle)
    motors[:, GO2.leg_motor_index] = rate
    return readings(made, velocity=motors)


def test_legs_in_stance_turn_the_base_back():
    # Nose down by .1 rad, of which the slow mean takes SLOW: front legs are longer by .5 of the rest.
    made = balance(stance={"pitch_extension": 0.5}, swing={"pitch_extension": 0.25})
    made.update(readings(made, (0.0, 0.1)), walking(), STEP)
    rest = 0.1 * (1.0 - SLOW)
    assert made.pose[0, EXTENSION, FRONT_LEFT] == pytest.approx(0.5 * rest)
    assert made.pose[0, EXTENSION, BACK_LEFT] == pytest.approx(-0.25 * rest)  # it swings: the other gain
    assert not made.pose[0, :EXTENSION].any()


def test_a_base_that_rolls_to_the_right_is_held_by_its_right_legs():
    made = balance(stance={"roll_extension": 0.5, "roll_rate_extension": 1.0, "roll_abduction": 0.2})
    made.update(readings(made, (0.1, 0.0), (0.3, 0.0)), walking(), STEP)
    lower = 0.5 * 0.1 * (1.0 - SLOW) + 0.3 * NATURAL
    assert made.pose[0, EXTENSION, FRONT_LEFT] == pytest.approx(-lower)
    back_right = GO2.leg_names.index("back_right")
    assert made.pose[0, EXTENSION, back_right] == pytest.approx(lower)
    assert made.pose[0, ABDUCTION, FRONT_LEFT] == pytest.approx(0.2 * 0.1 * (1.0 - SLOW))


def test_on_a_slope_legs_lean_by_its_mean_pitch():
    made = balance(slope_swing=-0.7)
    for _ in range(400):
        made.update(readings(made, (0.0, -0.3)), walking(), STEP)
    np.testing.assert_allclose(made.pose[0, SWING], 0.21, atol=1e-4)


def test_speed_is_that_of_the_base_over_feet_that_stand():
    made = balance(stance={"speed_swing": 1.0})
    for _ in range(200):
        made.update(moving(made, (0.4, -0.1)), walking(forward=0.5), STEP)
    np.testing.assert_allclose(made.speed[0] * SPEED, (0.4, -0.1), atol=1e-9)
    # Slower than its command by .1 m/s: legs in stance swing backward, by the gain.
    assert made.pose[0, SWING, FRONT_LEFT] == pytest.approx(0.1 / SPEED)
    assert made.pose[0, SWING, FRONT_RIGHT] == 0.0


def test_a_robot_that_is_too_slow_for_long_leans_into_its_way():
    made = balance(slow_speed_swing=2.0)
    for _ in range(400):
        made.update(moving(made, (0.3, 0.0)), walking(forward=0.5), STEP)
    np.testing.assert_allclose(made.pose[0, SWING], 2.0 * 0.2 / SPEED, rtol=1e-3)


def test_mirrored_robots_have_mirrored_poses():
    every = {
        name: 0.3 for name in ("pitch_swing", "roll_extension", "roll_abduction", "speed_abduction", "speed_swing")
    }
    made, other = (balance(stance=every, swing=every, slope_abduction=0.2, slope_extension=0.1) for _ in range(2))
    left, right = (
        np.array([GO2.leg_names.index(f"{end}_{side}") for end in ("front", "back")]) for side in ("left", "right")
    )
    made.update(replace(moving(made, (0.3, 0.1)), roll_pitch_yaw=np.array([[0.1, 0.05, 0.0]])), walking(0.3), STEP)
    other.update(replace(moving(other, (0.3, -0.1)), roll_pitch_yaw=np.array([[-0.1, 0.05, 0.0]])), walking(0.8), STEP)
    np.testing.assert_allclose(made.pose[0, :, left], other.pose[0, :, right], atol=1e-12)
    np.testing.assert_allclose(made.pose[0, :, right], other.pose[0, :, left], atol=1e-12)
    assert np.abs(made.pose).min() > 0.0


def test_a_robot_that_stands_is_left_alone():
    made = balance(stance={"pitch_extension": 1.0}, slope_swing=1.0)
    state = replace(walking(), activity=np.zeros(1))
    made.update(readings(made, (0.2, 0.2), (1.0, 1.0)), state, STEP)
    assert not made.pose.any()


def test_legs_without_abduction_have_none():
    robot = RobotDescription.load("minitaur")
    made = balance(robot, stance={"roll_abduction": 1.0, "pitch_swing": 1.0})
    made.update(readings(made, (0.1, 0.1)), walking(), STEP)
    assert made.pose.shape == (1, 2, 4)
    assert made.pose[:, 0].any()
    assert not made.pose[:, 1].any()


def test_over_holes_poses_are_those_of_the_other_gait_and_its_balance_within_the_leg_space():
    reference = balanced_task(stance={"pitch_extension": 1.0}).gait(GO2).reference
    assert isinstance(reference, FollowingReference)
    assert reference.over_holes is not None
    low, high = np.array(list(GO2.leg_space.values())).T
    for sign, end in ((-10.0, low), (10.0, high)):
        state = replace(walking(), balance=np.full((1, 3, 4), sign), over_holes=np.ones(1))
        np.testing.assert_allclose(reference.pose(0.0, state)[0], np.repeat(end[:, None], 4, axis=1), atol=1e-12)
        # Half way from one gait to the other.
        half = reference.pose(0.0, replace(state, over_holes=np.array([0.5])))[0]
        own = reference.pose(0.0, replace(state, over_holes=np.zeros(1)))[0]
        np.testing.assert_allclose(half, (own + end[:, None]) / 2, atol=1e-12)


def test_over_holes_there_is_no_feedback_of_the_policy():
    gait = balanced_task().gait(GO2)
    feedback = np.full((1, 12), 0.1)
    states = [replace(walking(), over_holes=np.array([share])) for share in (0.0, 0.25, 1.0)]
    free, part, over = (gait.motor_targets(np.zeros(1), feedback, state) for state in states)
    without = gait.motor_targets(np.zeros(1), np.zeros((1, 12)), states[2])
    np.testing.assert_array_equal(over, without)
    # The two gaits are the same here, so that only the feedback differs.
    legs = GO2.to_pose(free) - GO2.to_pose(without)
    np.testing.assert_allclose(GO2.to_pose(part) - GO2.to_pose(without), 0.75 * legs, atol=1e-9)


def test_frequency_goes_from_one_gait_to_the_other():
    task = balanced_task()
    over = task.reference.over_holes
    assert over is not None
    slow = replace(over, foot=replace(over.foot, frequency=0.5 * over.foot.frequency), frequency_rise=0.5)
    reference = replace(task, reference=replace(task.reference, over_holes=slow)).gait(GO2).reference
    assert isinstance(reference, FollowingReference)
    command = np.zeros((3, 3))
    frequency = reference.frequency(command, np.array([0.0, 0.5, 1.0]))
    np.testing.assert_allclose(frequency, reference.feet.frequency * np.array([1.0, 0.75, 0.5]))


def test_a_robot_over_holes_goes_on_exactly_from_a_state():
    task = balanced_task(stance={"pitch_rate_extension": 0.2, "speed_swing": 0.2}, slope_swing=-0.5)
    terrain = replace(task.terrain, sizes={}, shares={}, ground="gaps:0.1")
    commands = replace(task.commands, each=((0.5, 0.0, 0.0),))
    env = LocomotionEnv(replace(task, terrain=terrain, commands=commands), 2, SimWorld, seed=3, threads=1)
    action = np.zeros((2, len(env.gait.action_names)))
    for _ in range(150):  # the first gap is a metre away
        env.step(action)
    assert_resumes_exactly(env, [action] * 30)
    assert env.follower is not None
    assert env.follower.balance is not None
    assert env.follower.footholds is not None
    assert env.follower.balance.pose.any()
    assert env.follower.footholds.over_holes.max() == 1.0


def test_gains_are_refused_that_are_out_of_bounds_and_a_gait_over_holes_without_footholds():
    with pytest.raises(
        SurefootError, match=r"reference.over_holes.balance.stance.pitch_extension is 11; it must be 10 or less"
    ):
        balanced_task(stance={"pitch_extension": 11.0})
    task = balanced_task()
    with pytest.raises(SurefootError, match=r"over_holes is given and foothold_radius is 0; holes are found for"):
        replace(task, reference=replace(task.reference, foothold_radius=0.0))
