"""An ensemble of simulated robots that no policy was trained with: it stands for reality where there is no robot.

Robot k of a batch is the same one in every batch, drawn once from the table of ranges `ensemble`: all of table I of the
paper, motors, servo and feet, and friction and play in the knees, an uneven floor and an IMU that is not mounted along
the base, which no policy here is trained with.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import draw_hidden, load_ranges

RANGES = "ensemble"
ROBOTS = 20
"""Different robots; robot 20 of a batch is robot 0 again."""
FIRST_SEED = 1


def ensemble_params(robot: RobotDescription, num_envs: int) -> PhysicalParams:
    """Return the physical parameters of the first `num_envs` robots of the ensemble, one row each."""
    ranges = load_ranges(RANGES, robot=robot.folder)
    drawn = [draw_hidden(robot, ranges, FIRST_SEED + k) for k in range(min(ROBOTS, num_envs))]
    rows = {name: np.concatenate([getattr(one, name) for one in drawn]) for name in PhysicalParams.names()}
    return PhysicalParams(**rows).rows(np.arange(num_envs) % ROBOTS)


def draw_ensemble(robot: RobotDescription, params: PhysicalParams) -> PhysicalParams:
    """Return the parameters of the ensemble with the control steps of `params`; all else must be nominal there."""
    nominal = PhysicalParams.nominal(robot, params.num_envs)
    for name in PhysicalParams.names():
        if name != "control_step" and not np.array_equal(getattr(params, name), getattr(nominal, name)):
            raise SurefootError(
                f"{name} is given; robots of the ensemble have their own: leave it out, or world bullet"
            )
    return replace(ensemble_params(robot, params.num_envs), control_step=params.control_step)
