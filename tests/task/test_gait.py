"""Hybrid gait: motor angles from reference and feedback."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from references import read_reference

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import load_task
from surefoot.task.gait import HybridGait

PHASE = {"front_left": 0.0, "back_left": np.pi, "front_right": np.pi, "back_right": 0.0}


def trot(robot: RobotDescription, amplitude: float = 0.35):
    wave = {"amplitude": amplitude, "frequency": 2.0, "phase": PHASE}
    data = {"kind": "sine", "swing": wave | {"amplitude": 0.3}, "extension": wave | {"offset": 2.0}}
    return read_reference(data, robot)


def scratch(robot: RobotDescription) -> HybridGait:
    """Return a gait without a reference: swing +-0.5, extension from 1 to 2."""
    return HybridGait(robot, read_reference({}, robot), (-0.5, 0.5), (1.0, 2.0))


# Actions -1, 0 and 1 are the lower bound, the middle and the upper bound; actions beyond are clipped.
@pytest.mark.parametrize(
    ("action", "swing", "extension"),
    [(-1, -0.5, 1.0), (0, 0.0, 1.5), (1, 0.5, 2.0), (0.5, 0.25, 1.75), (7, 0.5, 2.0), (-7, -0.5, 1.0)],
)
def test_actions_span_the_bounds(robot, action: float, swing: float, extension: float):
    feedback = scratch(robot).feedback(np.full((2, 8), action))
    np.testing.assert_allclose(feedback, np.tile([swing] * 4 + [extension] * 4, (2, 1)))


def test_each_action_moves_its_leg(robot):
    gait = scratch(robot)
    for k, name in enumerate(gait.action_names):
        action = np.zeros((1, 8))
        action[0, k] = 1.0
        targets = gait.motor_targets([0.0], gait.feedback(action))
        moved = targets - gait.motor_targets([0.0], gait.feedback(np.zeros((1, 8))))
        leg = name.split(".")[1]
        sign = -1 if name.startswith("swing") else 1  # theta_1 = e + s, theta_2 = e - s
        expected = dict.fromkeys(robot.motor_names, 0.0) | {
            f"{leg}_1_motor": 0.5,
            f"{leg}_2_motor": sign * 0.5,
        }
        np.testing.assert_allclose(moved[0], list(expected.values()), atol=1e-12)


def test_reference_and_feedback_add(robot):
    gait = HybridGait(robot, trot(robot), (-0.25, 0.25), (-0.25, 0.25))
    # At 0.125 s the front left leg has swing 0.3 and extension 2.35; feedback adds 0.25 to each:
    # theta_1 = 2.6 + 0.55, theta_2 = 2.6 - 0.55.
    targets = gait.motor_targets([0.125], gait.feedback(np.ones((1, 8))))[0]
    assert targets[robot.motor_names.index("front_left_1_motor")] == pytest.approx(3.15)
    assert targets[robot.motor_names.index("front_left_2_motor")] == pytest.approx(2.05)


def test_rest_is_the_middle_of_the_range_of_commands(robot):
    assert scratch(robot).rest == pytest.approx((0.0, 1.5))
    assert HybridGait(robot, trot(robot), (-0.25, 0.25), (-0.25, 0.25)).rest == pytest.approx((0.0, 2.0))


@pytest.mark.parametrize(
    ("amplitude", "swing", "extension", "pieces"),
    [
        (
            0.5,
            (0.0, 0.0),
            (-0.3, 0.3),
            ["1.200 to 2.800", "reference 1.500 to 2.500", "feedback -0.3 to 0.3"],
        ),
        (0.35, (-0.8, 0.8), (0.0, 0.0), ["swing can be -1.100 to 1.100", "minitaur allows -1 to 1"]),
        (1.5, (0.0, 0.0), (0.0, 0.0), ["extension can be 0.500 to 3.500"]),
    ],
)
def test_commands_beyond_the_legs_range_are_rejected(robot, amplitude, swing, extension, pieces):
    with pytest.raises(SurefootError) as caught:
        HybridGait(robot, trot(robot, amplitude), swing, extension)
    message = str(caught.value)
    assert "\n" not in message
    for piece in pieces:
        assert piece in message


def of_joints(robot: RobotDescription, bounds: tuple[float, float] = (-0.1, 0.3)) -> HybridGait:
    return HybridGait(robot, trot(robot), bounds, action="joint")


def test_feedback_may_be_on_each_motor(robot):
    gait = of_joints(robot)
    assert gait.action_names == [f"joint.{motor}" for motor in robot.motor_names]
    np.testing.assert_array_equal((gait.low, gait.high), [[-0.1] * 8, [0.3] * 8])
    unit, time = np.random.default_rng(1).uniform(-1, 1, (11, 8)), np.linspace(0, 1, 11)
    feedback = gait.feedback(unit)
    np.testing.assert_allclose(feedback, 0.1 + 0.2 * unit, atol=1e-15)
    np.testing.assert_allclose(gait.action(feedback), unit, atol=1e-14)
    targets = gait.motor_targets(time, feedback)
    np.testing.assert_allclose(targets, robot.to_motors(gait.reference.pose(time)) + feedback, atol=1e-15)


def test_rest_and_angles_with_feedback_on_motors(robot):
    gait = of_joints(robot)
    assert gait.rest == pytest.approx((0.0, 2.0))
    # The reference has swing -0.3 to 0.3 and extension 1.65 to 2.35, so motors go from 1.35 to 2.65; then -0.1 to 0.3.
    np.testing.assert_allclose(gait.angle_extent(), [[1.25] * 8, [2.95] * 8])
    with pytest.raises(SurefootError, match=r"extension can be 0\.500 to 3\.500 rad"):
        HybridGait(robot, trot(robot, 1.5), (0.0, 0.0), action="joint")


def test_angles_of_all_commands_in_leg_space(robot):
    # From scratch: swing +-0.5, extension 1 to 2.
    np.testing.assert_allclose(scratch(robot).angle_extent(), [[0.5] * 8, [2.5] * 8])
    rng = np.random.default_rng(1)
    gait = HybridGait(robot, trot(robot), (-0.1, 0.3), (-0.2, 0.25))
    low, high = gait.angle_extent()
    targets = gait.motor_targets(rng.uniform(0, 1, 1000), gait.feedback(rng.uniform(-1.2, 1.2, (1000, 8))))
    assert np.all((targets >= low) & (targets <= high))


def test_the_edge_of_the_legs_range_is_allowed(robot):
    reference = read_reference({}, robot)
    gait = HybridGait(robot, reference, robot.leg_space["swing"], robot.leg_space["extension"])
    assert gait.low[0] == -1.0
    assert gait.high[-1] == 2.7


@pytest.mark.parametrize("task", ["trot", "steer"])
def test_velocity_feedforward_compensates_the_lag_of_damping(task: str):
    """An actuator without inertia and load moves at (command - angle) k_p / k_d, so it lags by T = k_d / k_p."""
    go2, lag, step = RobotDescription.load("go2"), 0.0286, 1e-3
    time = np.arange(0.0, 2.0, step)
    command, worst = np.tile([0.5, 0.0, 0.0], (len(time), 1)), {}
    for lead in (0.0, 1.0):  # in k_d / k_p
        config = load_task(task, "go2")[0]
        leads = {"velocity_feedforward": lead} | ({"weight_feedforward": 0.0} if task == "steer" else {})
        gait = replace(config, reference=replace(config.reference, **leads)).gait(go2)
        frequency = gait.reference.frequency(command) if task == "steer" else 0.0
        state = CommandState(command, np.ones(len(time)), frequency * time)
        targets = gait.motor_targets(time, np.zeros((len(time), 12)), state)
        wanted = go2.to_motors(gait.reference.pose(time, state))
        angle, off = wanted[0], []
        for target, pose in zip(targets, wanted, strict=True):
            off.append(np.abs(angle - pose).max())
            angle = angle + (target - angle) * step / lag
        worst[lead] = max(off[500:])
    assert worst[0.0] > 0.1
    assert worst[1.0] < 0.25 * worst[0.0], worst


def test_velocity_feedforward_stays_within_leg_space(robot: RobotDescription):
    foot = {"frequency": 3.0, "stroke": 0.1, "clearance": 0.05, "duty_factor": 0.5, "phase": 0.0, "height": 0.2}
    data = {"kind": "foot", "foot": {**foot, "offset": 0.0, "depth": 0.0}, "velocity_feedforward": 1.0}
    gait = HybridGait(robot, read_reference(data, robot), (-0.1, 0.1), (-0.1, 0.1))
    targets = gait.motor_targets(np.linspace(0, 1, 200), np.zeros((200, 8)))
    pose = robot.to_pose(targets)
    for part, (low, high) in enumerate(robot.leg_space.values()):
        assert pose[:, part].min() == pytest.approx(low)
        assert pose[:, part].max() == pytest.approx(high)
    least, greatest = gait.angle_extent()
    assert (targets >= least - 1e-9).all()
    assert (targets <= greatest + 1e-9).all()
    assert read_reference(gait.reference.to_dict(), robot).to_dict() == gait.reference.to_dict()
