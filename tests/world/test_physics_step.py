"""The physics step of trainings: as long as is stable, never shorter than the data sheet's."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.world.interface import WorldConfig
from surefoot.world.physics_step import longest_servo_step, with_physics_step
from surefoot.world.sim_world import SimWorld


@pytest.mark.parametrize(
    ("name", "longest", "step"),
    [
        ("go2", 0.004, 0.004),
        ("go2", 0.003, 0.003),
        ("go2", 0.001, 0.002),  # the data sheet's is longer
        ("minitaur", 0.004, 0.00105),  # stiff feet on light legs
        ("pupper_v2", 0.004, 0.00197),
    ],
)
def test_a_step_is_as_long_as_asked_for_and_stable(name: str, longest: float, step: float) -> None:
    robot = RobotDescription.load(name)
    slow = with_physics_step(robot, longest)
    assert slow.timing.servo_step == pytest.approx(step, abs=2e-5)
    assert slow.timing.servo_step <= max(longest_servo_step(robot), robot.timing.servo_step)
    assert replace(slow, timing=robot.timing) == robot


def test_a_longer_step_moves_the_robot_alike() -> None:
    task = replace(load_task("trot", "go2")[0], start_linear_speed=0.0, start_angular_speed=0.0)
    positions = []
    for step in (0.0, 0.004):
        env = LocomotionEnv(replace(task, physics_step=step), 1, SimWorld, threads=1, autoreset=False)
        assert isinstance(env.world, SimWorld)
        assert env.world.robot.timing.servo_step == (step or 0.002)
        env.reset()
        for _ in range(200):
            env.step(np.zeros((1, 12), np.float32))
        positions.append(env.state.truth.base_position_world[0])
    assert positions[0][0] > 1.0  # the reference alone trots
    np.testing.assert_allclose(positions[1], positions[0], atol=0.05)


def test_a_step_out_of_bounds_is_rejected() -> None:
    with pytest.raises(SurefootError, match=r"physics_step is 0\.1"):
        TaskConfig(physics_step=0.1)
    with pytest.raises(SurefootError, match=r"physics_step is -0\.001 s; it must be at least 0 and at most 0\.02"):
        WorldConfig(physics_step=-0.001)
