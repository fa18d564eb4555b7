"""Foothold errors, worked by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.foothold_error import FootholdError
from surefoot.task.footholds import Footholds
from surefoot.world.interface import SimState
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")
LENGTH = 0.426
FRONT_LEFT = GO2.leg_names.index("front_left")


def seeing_task() -> TaskConfig:
    task = load_task("terrain", "go2")[0]
    reward = {**task.reward, "foothold_error": -1.0}
    return from_mapping(TaskConfig, {"reference": {"foothold_radius": 0.5}, "reward": reward}, base=task)


class Walk:
    """A robot at rest with a yaw angle, whose feet are at the positions of its reference at a phase."""

    def __init__(self, yaw: float = 0.0) -> None:
        task = seeing_task()
        self.reference = task.gait(GO2).reference
        self.footholds = Footholds(self.reference, 1)
        self.landings = FootholdError(self.footholds)
        env = LocomotionEnv(replace(task, terrain=replace(task.terrain, sizes={}, shares={})), 1, SimWorld, threads=1)
        half = 0.5 * yaw
        self.truth = replace(
            env.state.truth,
            base_position_world=np.array([[2.0, -1.0, 0.3]]),
            roll_pitch_yaw=np.array([[0.0, 0.0, yaw]]),
            base_quat_world=np.array([[np.cos(half), 0.0, 0.0, np.sin(half)]]),
        )

    def state(self, part: float) -> CommandState:
        """Return the state of stepping in place at a swing phase of the front left foot, negative in stance."""
        duty = float(self.reference.feet.duty_factor[FRONT_LEFT])
        phase = float(self.reference.feet.phase[FRONT_LEFT]) + duty + part * (1.0 - duty)
        return CommandState(np.zeros((1, 3)), np.ones(1), np.array([phase % 1.0]))

    def standing(self, offset: tuple[float, float]) -> SimState:
        """Return the true state with all feet on the ground at an offset [m] from neutral, in the heading frame."""
        foot = self.reference.neutral_feet + np.array([*offset, 0.0])
        angle = GO2.to_motors(GO2.leg_geometry.foot_pose(foot)[None])
        return replace(self.truth, motor_angle=angle, foot_contact=np.ones((1, 4)))

    def go(self, *parts: float) -> None:
        """Advance the swing of the front left foot to the given phases."""
        for part in parts:
            self.landings.plan(self.truth, self.state(part))

    def error_at(self, truth: SimState, part: float) -> float:
        """Return the foothold error at a swing phase of the front left foot."""
        self.go(part)
        return float(self.landings.compute(truth)[0])

    def land(self, offset: tuple[float, float], landing: tuple[float, float]) -> float:
        """Return the error of a foot that lands at the offset `offset` [m] with its foothold at `landing` [m]."""
        self.footholds.landing[:] = landing
        air = replace(self.truth, foot_contact=np.zeros((1, 4)))
        for _ in range(5):
            self.error_at(air, 0.2)
        self.go(0.2, 0.35)
        # Both diagonal feet land.
        return 0.5 * self.error_at(self.standing(offset), 0.95)


@pytest.mark.parametrize("yaw", [0.0, 1.2])
def test_a_landing_costs_its_squared_distance(yaw: float):
    unit = LENGTH / 12
    assert Walk(yaw).land((0.05, -0.02), (0.05, -0.02)) == pytest.approx(0.0, abs=1e-9)
    # 3 cm too far ahead and 4 cm to the left: 5 cm.
    assert Walk(yaw).land((0.08, 0.02), (0.05, -0.02)) == pytest.approx((0.05 / unit) ** 2, rel=1e-6)
    assert Walk(yaw).land((0.15, 0.0), (-0.05, 0.0)) == pytest.approx(4.0)


def test_a_foot_that_misses_the_ground_has_maximum_cost_once():
    walk = Walk()
    walk.go(0.2, 0.35)
    air = replace(walk.truth, foot_contact=np.zeros((1, 4)))
    duty = float(walk.reference.feet.duty_factor[FRONT_LEFT])
    late = (0.35 - duty) / (1.0 - duty)  # 0.35 of a cycle after the planned touchdown
    counts = [walk.error_at(air, part) for part in (0.9, late, late)]
    # Both diagonal feet swing.
    assert counts == [0.0, 8.0, 0.0]


def test_feet_that_never_left_the_ground_do_not_land():
    walk = Walk()
    walk.go(0.2, 0.35)
    assert walk.error_at(walk.standing((0.1, 0.0)), 0.95) == 0.0


def test_the_reward_needs_footholds():
    task = seeing_task()
    with pytest.raises(
        SurefootError, match=r"a term of the reward needs footholds: set reference.foothold_radius above 0"
    ):
        LocomotionEnv(replace(task, reference=replace(task.reference, foothold_radius=0.0)), 1, SimWorld, threads=1)
