"""Finding a policy file, the world to run it in and the task to run, from words of the command line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import check_robot
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import PhysicalParams, RobotDescription, parse_settings
from surefoot.task.config import TaskConfig
from surefoot.task.randomize import RandomizeConfig, check_ranges
from surefoot.world.interface import SimulationFactory

PACKAGE = Path(__file__).resolve().parents[1]
SHELVES = (PACKAGE / "policies", PACKAGE.parents[1] / "policies")
"""Where policies that ship lie: in an installed package, and in the repository."""
WORLDS = ("mujoco",)


def shipped_policies() -> dict[str, Path]:
    """The policies that ship with surefoot, by name."""
    return {path.stem: path for shelf in reversed(SHELVES) for path in sorted(shelf.glob("*.onnx"))}


def find_policy(policy: str) -> Path:
    """The file of a policy given by path or by the name of one that ships.

    Raises:
        SurefootError: neither.
    """
    shipped = shipped_policies()
    if Path(policy).is_file():
        return Path(policy)
    if policy in shipped:
        return shipped[policy]
    names = f"shipped policies: {choices(shipped)}" if shipped else "no policies ship with this surefoot"
    raise SurefootError(f"policy '{policy}' does not exist; give the path of an .onnx file ({names})")


def find_world(name: str) -> SimulationFactory:
    """What makes worlds of this name.

    Raises:
        SurefootError: no such world.
    """
    if name not in WORLDS:
        raise SurefootError(f"world '{name}' does not exist; choices: {choices(WORLDS)}")
    from surefoot.world.sim_world import SimWorld

    return SimWorld


def load_policy(path: Path, robot: str | None) -> tuple[PolicyRuntime, RobotDescription, TaskConfig]:
    """A policy, the robot it is to run on and the task it was made for.

    Args:
        path: the policy file.
        robot: name or folder of the robot; the one of the policy's task, if not given.

    Raises:
        SurefootError: a file that is no policy, or one for another robot.
    """
    from surefoot.evaluate.rollout import task_from_contract

    policy = PolicyRuntime.load(path)
    task = task_from_contract(policy.contract)
    if robot is not None:
        task = replace(task, robot=robot)
    description = RobotDescription.load(task.robot)
    check_robot(policy.contract, description)
    return policy, description, task


def adjust_task(
    task: TaskConfig,
    robot: RobotDescription,
    settings: Sequence[Sequence[str]],
    pushes: bool,
    thermal_protection: bool = False,
    randomize: RandomizeConfig | None = None,
) -> TaskConfig:
    """The task with other physical parameters, with pushes or without, with parameters drawn or without.

    Args:
        task: as the policy was trained.
        robot: says which values are allowed.
        settings: words NAME=VALUE, as often as `--set` was given.
        pushes: whether the base is pushed, as hard and often as the task says; every push that is due is given.
        thermal_protection: switch off motors that overheat, whatever the task says.
        randomize: ranges that every episode draws from, whatever the task says; none, if not given.

    Raises:
        SurefootError: no such parameter, or a value that the robot does not allow.
    """
    given = parse_settings([word for group in settings for word in group])
    PhysicalParams.nominal(robot).with_values(robot, **given)
    ranges = randomize or RandomizeConfig()
    check_ranges(ranges, robot)
    return replace(
        task,
        params={**task.params, **given},
        randomize=ranges,
        pushes=replace(task.pushes, enabled=pushes, probability=1.0),
        thermal_protection=task.thermal_protection or thermal_protection,
    )
