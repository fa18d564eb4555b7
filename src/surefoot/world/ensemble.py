"""An ensemble of simulated robots that no policy was trained with: it stands for reality where there is no robot.

A robot is drawn once by its seed from the table of ranges `ensemble`: all of table I of the paper, motors, servo and
feet, and friction and play in the knees, an uneven floor and an IMU that is not mounted along the base, which no policy
here is trained with. Robot k of a batch is that of the k-th seed of its world (`registry.WORLDS`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import CONTROLLER_PARAMETERS
from surefoot.robot.randomization import draw_hidden, load_ranges

RANGES = "ensemble"


def ensemble_params(robot: RobotDescription, num_envs: int, seeds: Sequence[int]) -> PhysicalParams:
    """Return the physical parameters of `num_envs` robots, one row each; after the last seed comes the first again."""
    ranges = load_ranges(RANGES, robot=robot.folder)
    drawn = [draw_hidden(robot, ranges, seed) for seed in seeds[:num_envs]]
    rows = {name: np.concatenate([getattr(one, name) for one in drawn]) for name in PhysicalParams.names()}
    return PhysicalParams(**rows).rows(np.arange(num_envs) % len(seeds))


def draw_ensemble(robot: RobotDescription, params: PhysicalParams, seeds: Sequence[int]) -> PhysicalParams:
    """Return the robots of these seeds with control steps and gains of `params`; all else must be nominal there."""
    nominal = PhysicalParams.nominal(robot, params.num_envs)
    for name in PhysicalParams.names():
        if name not in CONTROLLER_PARAMETERS and not np.array_equal(getattr(params, name), getattr(nominal, name)):
            raise SurefootError(
                f"{name} is given; robots of the ensemble have their own: leave it out, or world bullet"
            )
    own = {name: getattr(params, name) for name in CONTROLLER_PARAMETERS}
    return replace(ensemble_params(robot, params.num_envs, seeds), **own)
