"""Construction of an environment's components from its task, in the order in which their hooks are called.

To add a capability, write a `Component` in a file of its own and append it in `make_components`.
"""

from __future__ import annotations

from dataclasses import dataclass

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.randomization import Randomizer
from surefoot.task.base_velocity import BaseVelocity
from surefoot.task.commands import CommandGenerator
from surefoot.task.component import Component
from surefoot.task.config import TaskConfig
from surefoot.task.episode_metrics import EpisodeMetrics, StepInfo
from surefoot.task.foothold_error import FootholdError
from surefoot.task.footholds import Footholds
from surefoot.task.gait import HybridGait
from surefoot.task.gait_components import gait_components
from surefoot.task.height_scan import HeightScan, HeightScanner
from surefoot.task.privileged import ReferencePhase, TrueHeights, TrueState
from surefoot.task.pushes import Pusher
from surefoot.task.randomized_params import RandomizedParams
from surefoot.task.reward import TERMS
from surefoot.task.terrain_curriculum import EpisodeStarts, TerrainCurriculum
from surefoot.task.velocity_tracking import VelocityTracking
from surefoot.world.terrain import TerrainField


@dataclass(frozen=True)
class Setup:
    """Inputs for constructing the components of an environment."""

    task: TaskConfig
    robot: RobotDescription
    gait: HybridGait
    nominal: PhysicalParams
    """Physical parameters without randomization, one row per robot."""
    tiles: TerrainField
    """Terrain of all robots."""
    num_envs: int
    seed: int
    source: CommandGenerator | None
    """Command generator. Defaults to the one that the task configures."""
    step_info: bool
    """Whether `info` describes every step; see `StepInfo`."""


def make_components(setup: Setup) -> list[Component]:
    """Return the components that the task needs, in calling order."""
    task, robot, num_envs, seed = setup.task, setup.robot, setup.num_envs, setup.seed
    limits, terrain = task.commands.limits(robot), task.terrain
    needed = {TERMS[term].needs for term in task.reward}
    components: list[Component] = [TrueState(robot, in_heading_frame=limits is not None)]
    if setup.tiles.kinds:
        components.append(TerrainCurriculum(terrain, setup.tiles, num_envs, seed))
    if setup.tiles.kinds or terrain.heading:
        components.append(EpisodeStarts(terrain.heading, num_envs, seed))
    if not terrain.is_flat:
        components.append(TrueHeights(robot))
    if task.needs_height_map:
        components.append(HeightScan(HeightScanner(terrain.scan, robot, num_envs, seed)))
    if task.needs_base_velocity:
        components.append(BaseVelocity(robot, num_envs))
    if limits is not None:
        source = setup.source or task.commands.make_generator(limits, num_envs, seed)
        components += gait_components(setup.gait, limits, source, num_envs)
    if "foothold_error" in needed:
        components.append(FootholdError(_footholds(components)))
    if limits is not None or "stride_error" in needed:
        components.append(VelocityTracking(setup.gait.reference.period))
    if setup.gait.reference.period is not None:
        components.append(ReferencePhase())
    if task.pushes.enabled:
        components.append(Pusher(task.pushes, num_envs, seed, robot.weight))
    if task.randomize:
        ramp = task.randomize_ramp
        components.append(RandomizedParams(Randomizer(task.randomize, robot, setup.nominal, seed, ramp)))
    components.append(EpisodeMetrics())
    if setup.step_info:
        components.append(StepInfo())
    return components


def _footholds(components: list[Component]) -> Footholds:
    for component in components:
        if isinstance(component, Footholds):
            return component
    raise SurefootError("a term of the reward needs footholds: set reference.foothold_radius above 0")
