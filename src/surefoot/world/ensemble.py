"""Ensemble of simulated robots that are not used in training and replace a real robot in evaluations.

The physical parameters of each robot are drawn once, with its seed, from the table of ranges `ensemble`. It includes
all parameters of the paper's table I, motors, servo and feet, and effects that training never includes: friction and
play in the knees, an uneven floor, and an IMU that is not aligned with the base. Robot k of a batch has the k-th seed
of its world (`registry.WORLDS`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import CONTROLLER_PARAMETERS
from surefoot.robot.randomization import draw_hidden, load_ranges

RANGES_TABLE = "ensemble"


def ensemble_params(robot: RobotDescription, num_envs: int, seeds: Sequence[int]) -> PhysicalParams:
    """Return the physical parameters of `num_envs` robots, one row per robot; seeds repeat after the last one."""
    ranges = load_ranges(RANGES_TABLE, robot=robot.folder)
    params = [draw_hidden(robot, ranges, seed) for seed in seeds[:num_envs]]
    rows = {name: np.concatenate([getattr(one, name) for one in params]) for name in PhysicalParams.names()}
    return PhysicalParams(**rows).rows(np.arange(num_envs) % len(seeds))


def draw_ensemble(robot: RobotDescription, params: PhysicalParams, seeds: Sequence[int]) -> PhysicalParams:
    """Return the ensemble's parameters with the control steps and gains of `params`.

    Raises:
        SurefootError: another parameter of `params` that is not nominal.
    """
    nominal = PhysicalParams.nominal(robot, params.num_envs)
    for name in PhysicalParams.names():
        if name not in CONTROLLER_PARAMETERS and not np.array_equal(getattr(params, name), getattr(nominal, name)):
            raise SurefootError(
                f"{name} is given, but robots of the ensemble have their own value: leave it out, or use world bullet"
            )
    own = {name: getattr(params, name) for name in CONTROLLER_PARAMETERS}
    return replace(ensemble_params(robot, params.num_envs, seeds), **own)
