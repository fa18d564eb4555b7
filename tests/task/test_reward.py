"""Reward terms, each with an answer worked by hand, and the reward of a control step."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scripted_world import ScriptedWorld

from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.reward import PAPER_REWARD, TERMS, energy_weight, step_reward
from surefoot.task.state import EnvState, RobotScales
from surefoot.task.velocity_tracking import VelocityTracking
from surefoot.world.ground import FLAT

DURATION = 0.1
SCALES = RobotScales(length=0.5, speed=2.0, rate=4.0, weight=100.0)


def moved_state(
    start: tuple[float, float, float] = (0.0, 0.0, 0.2),
    end: tuple[float, float, float] = (0.03, -0.01, 0.21),
    yaw: tuple[float, float] = (0.0, 0.08),
) -> EnvState:
    """Return the state of one robot that has moved from `start` to `end`, rotated, and used 5 J."""
    robot = RobotDescription.load("minitaur")
    world = ScriptedWorld(robot, 1, PhysicalParams.nominal(robot))
    truth = world.truth()
    torque, heat = np.zeros((2, 1, 8))
    torque[0, :2], heat[0, 3] = 5.0, 20.0
    before = replace(truth, base_position_world=np.array([start]), roll_pitch_yaw=np.array([[0.0, 0.0, yaw[0]]]))
    after = replace(
        truth,
        base_position_world=np.array([end]),
        roll_pitch_yaw=np.array([[0.04, -0.08, yaw[1]]]),
        energy=np.array([5.0]),
        motor_torque=torque,
        heat=heat,
    )
    gait = SimpleNamespace(action=lambda feedback: feedback, action_names=robot.motor_names, robot=robot)
    state = replace(
        EnvState.of_world(world, gait, FLAT),
        scales=SCALES,
        duration=np.array([DURATION]),
        before=before,
        truth=after,
        start_position=np.array([[0.0, 0.0, 0.16]]),
        feedback=np.full((1, 8), 0.5),
        last_feedback=np.full((1, 8), 0.2),
        filtered_command=np.array([[0.06, -0.1, 0.48]]),
        heading_error=np.array([-0.3]),
        stride_error=np.array([[0.04, 0.0, -0.08]]),
        foothold_error=np.array([2.5]),
    )
    VelocityTracking(0.4).measure(state)
    return state


EXPECTED = {
    "progress": 0.03,  # m
    "energy": 5.0,  # J
    "transport_cost": 0.05,  # 5 J / 100 N
    "forward_speed": 0.15,  # 0.3 m/s / 2 m/s
    "power": 0.25,  # 50 W / (100 N 2 m/s)
    "track_velocity": math.exp(-1),  # (0.3 - 0.06) / 2 = 0.12, the width
    "track_yaw_rate": math.exp(-1),  # (0.8 - 0.48) / 4 = 0.08, the width
    "velocity_error": 0.12,
    "yaw_rate_error": 0.08,
    "stride_velocity_error": 0.045,  # (0.04 + 0.1 / 0.4 (0.24 - 0.04)) / 2
    "stride_yaw_rate_error": 0.005,  # (-0.08 + 0.1 / 0.4 (0.32 + 0.08)) / 4
    "heading_error": 0.3,
    "vertical_speed": 0.0025,  # (0.1 / 2)^2
    "roll_pitch_rate": 0.05,  # (0.4 / 4)^2 + (0.8 / 4)^2
    "tilt": 0.008,  # 0.04^2 + 0.08^2
    "height": 0.01,  # ((0.21 - 0.16) / 0.5)^2
    "torque": 0.02,  # 2 (5 / 50)^2
    "heat": math.sqrt(8),  # sqrt(8 * (200 W)^2) / 200 W
    "foothold_error": 2.5,
    "feedback": 0.25,  # 0.5^2
    "feedback_change": 0.09,  # (0.5 - 0.2)^2
}


def test_every_term_has_an_expected_value():
    assert EXPECTED.keys() == TERMS.keys()


@pytest.mark.parametrize(("name", "value"), EXPECTED.items())
def test_term_has_the_value_worked_by_hand(name: str, value: float):
    np.testing.assert_allclose(TERMS[name].value(moved_state()), [value])


def test_speed_is_along_the_heading_and_progress_along_the_worlds_x_axis():
    motion = moved_state(end=(0.0, 0.03, 0.2), yaw=(np.pi / 2, np.pi / 2))
    np.testing.assert_allclose(TERMS["forward_speed"].value(motion), [0.15])
    np.testing.assert_allclose(TERMS["progress"].value(motion), [0.0])


def test_yaw_rate_is_continuous_where_yaw_wraps():
    np.testing.assert_allclose(moved_state(yaw=(np.pi - 0.05, 0.05 - np.pi)).attitude_rates[0, 2], 1.0 / SCALES.rate)


@pytest.mark.parametrize(
    ("weights", "limits", "reward"),
    [
        (PAPER_REWARD, {}, 0.03 - 0.008 * 5),
        ({"progress": 1.0, "transport_cost": -0.4}, {}, 0.03 - 0.4 * 0.05),
        # Sums are unchanged, rates are multiplied by 0.1 s.
        ({"progress": 1.0, "tilt": -2.0, "forward_speed": 1.0}, {}, 0.03 + 0.1 * (-2 * 0.008 + 0.15)),
        # 0.2 m/s for 0.1 s are 20 mm.
        (PAPER_REWARD, {"progress": 0.2}, 0.02 - 0.008 * 5),
        (PAPER_REWARD, {"progress": 0.4}, 0.03 - 0.008 * 5),
        ({"forward_speed": 1.0}, {"forward_speed": 0.1}, 0.1 * 0.1),
    ],
)
def test_reward_of_a_step_is_the_weighted_sum_of_limited_terms(weights, limits, reward):
    total, parts = step_reward(weights, limits, moved_state())
    np.testing.assert_allclose(total, [reward], atol=1e-15)
    assert list(parts) == list(weights)
    np.testing.assert_allclose(sum(parts.values()), total, atol=1e-15)


def test_a_limit_of_progress_limits_the_reward_of_an_environment():
    task = replace(load_task("trot")[0], reward_limits={"progress": 0.5})
    env = LocomotionEnv(task, 2, ScriptedWorld, autoreset=False)
    env.reset()
    env.world.speed[:], env.world.power[:] = (0.4, 3.0), 10.0
    reward = env.step(np.zeros((2, 8)))[1]
    # 6 ms: 2.4 mm forward; 18 mm clipped to 3 mm; 0.06 J cost 0.48 mm.
    np.testing.assert_allclose(reward, [0.0024 - 0.00048, 0.003 - 0.00048])


@pytest.mark.parametrize(
    ("weights", "limits", "expected"),
    [
        (PAPER_REWARD, {}, 0.008),
        ({"progress": 1.0, "energy": -0.01, "transport_cost": -1.0}, {}, 0.02),  # 0.01 + 1 / 100 N
        ({"progress": 1.0}, {"progress": 0.5}, 0.0),
        ({"progress": 2.0, "energy": -0.01}, {}, None),
        ({"progress": 1.0, "tilt": -1.0}, {}, None),
        ({"progress": 1.0, "energy": 0.01}, {}, None),
        (PAPER_REWARD, {"energy": 0.0}, None),
        ({"track_velocity": 1.0}, {}, None),
    ],
)
def test_only_rewards_of_progress_and_energy_have_the_papers_weight(weights, limits, expected):
    assert energy_weight(weights, limits, 100.0) == (None if expected is None else pytest.approx(expected))
