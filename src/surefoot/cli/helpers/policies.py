"""Finding a policy file and the task to run, from words of the command line; running it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.cli.helpers.simulator import Simulator
from surefoot.configuration import to_mapping
from surefoot.deploy.checks import check_policy
from surefoot.errors import SurefootError, choices
from surefoot.policy.contract import config_hash
from surefoot.policy.runtime import PolicyRuntime
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription, parse_settings
from surefoot.robot.randomization import Ranges, check_ranges
from surefoot.studies.handcrafted import HandcraftedGait
from surefoot.task.commands import read_schedule
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.trace import EpisodeTrace
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    from surefoot.evaluate.rollout import Policy

PACKAGE = Path(__file__).resolve().parents[2]
SEARCH_PATHS = (PACKAGE / "policies", PACKAGE.parents[1] / "policies")
"""Folders of policies that ship: of an installed package, and of the repository."""


def shipped_policies() -> dict[str, Path]:
    """Return the files of the policies that ship, by name."""
    return {path.stem: path for folder in reversed(SEARCH_PATHS) for path in sorted(folder.glob("*.onnx"))}


def find_policy(policy: str) -> Path:
    """Return the file of a policy given by path or by the name of one that ships; refuse what is neither."""
    shipped = shipped_policies()
    if Path(policy).is_file():
        return Path(policy)
    if policy in shipped:
        return shipped[policy]
    names = f"policies that ship: {choices(shipped)}" if shipped else "no policies ship with this surefoot"
    raise SurefootError(f"policy '{policy}' does not exist; {names}, or the path of a policy file")


def find_policies(policies: Sequence[str]) -> list[Path]:
    """Return the files of one policy or more; refuse none."""
    if not policies:
        raise SurefootError("no policy is given; give one or more .onnx files, or names of policies that ship")
    return [find_policy(policy) for policy in policies]


def open_policy(path: Path, robot: str | None = None) -> tuple[PolicyRuntime, RobotDescription]:
    """Return a policy and the robot to run it on, given by name or folder; the policy's own, if None.

    Raises:
        SurefootError: a file that is no policy, or one for another robot.
    """
    policy = PolicyRuntime.load(path)
    description = RobotDescription.load(robot or policy.contract.description)
    check_policy(policy.contract, description)
    return policy, description


def load_policy(path: Path, robot: str | None) -> tuple[PolicyRuntime, RobotDescription, TaskConfig]:
    """Return a policy, the robot to simulate it on and the task it was made for.

    Control step, latencies, gains and voltage are those that the policy was trained with. Otherwise as `open_policy`.
    """
    policy, description = open_policy(path, robot)
    task = task_from_contract(policy.contract, description)
    return policy, description, replace(task, robot=robot or policy.contract.description)


def load_gait(path: Path, robot: str | None) -> tuple[Policy, RobotDescription, TaskConfig, dict[str, str]]:
    """Return what runs a policy file or a handcrafted gait (.yaml), robot, task, name and hash of its configuration.

    Raises:
        SurefootError: as `load_policy`, or a file that is no handcrafted gait.
    """
    if path.suffix != ".yaml":
        policy, description, task = load_policy(path, robot)
        return policy, description, task, {"name": policy.contract.name, "config_hash": policy.contract.config_hash}
    gait = HandcraftedGait.load(path)
    task = gait.task if robot is None else replace(gait.task, robot=robot)
    whole = {"task": to_mapping(task), "raibert": gait.raibert and to_mapping(gait.raibert)}
    about = {"name": task.name, "config_hash": config_hash(whole)}
    return replace(gait, task=task).policy(), RobotDescription.load(task.robot), task, about


@dataclass(frozen=True)
class Candidate:
    """A policy that is compared with others."""

    name: str
    """Name that tells it from the others."""
    path: Path
    """Its file."""
    policy: PolicyRuntime
    """What runs it."""
    task: TaskConfig
    """The task that it was made for."""


def load_policies(paths: Sequence[Path]) -> tuple[list[Candidate], RobotDescription]:
    """Return the policies of one file or more, which are compared, and the one robot that all of them are for."""
    loaded = [load_policy(path, None) for path in paths]
    names = distinct_names([policy.contract.name for policy, _, _ in loaded], [path.stem for path in paths])
    robot = loaded[0][1]
    for name, (_, other, _) in zip(names, loaded, strict=True):
        if other.name != robot.name:
            raise SurefootError(
                f"policy '{name}' is for robot '{other.name}' and '{names[0]}' for '{robot.name}'; "
                "policies that are compared must be for the same robot"
            )
    found = zip(names, paths, loaded, strict=True)
    return [Candidate(name, path, policy, task) for name, path, (policy, _, task) in found], robot


def distinct_names(names: Sequence[str], stems: Sequence[str]) -> list[str]:
    """Return distinct names of policies: a repeated name becomes that of the policy's file, and then gets a number."""
    often = Counter(names)
    chosen = [name if often[name] == 1 else stem for name, stem in zip(names, stems, strict=True)]
    often, taken = Counter(chosen), set(chosen)
    for i, name in enumerate(chosen):
        if often[name] > 1:
            number = 1
            while f"{name}-{number}" in taken:
                number += 1
            chosen[i] = f"{name}-{number}"
            taken.add(chosen[i])
    return chosen


def adjust_task(
    task: TaskConfig,
    robot: RobotDescription,
    settings: Sequence[Sequence[str]],
    pushes: bool,
    thermal_protection: bool = False,
    randomize: Ranges | None = None,
    simulator: Simulator | None = None,
    push_force: tuple[float, float] | None = None,
    commands: Path | None = None,
) -> TaskConfig:
    """Return the task with another simulator, parameters, pushes and randomization.

    Args:
        task: as the policy was trained.
        robot: says which values are allowed.
        settings: words NAME=VALUE, as often as `--set` was given.
        pushes: whether the base is pushed, as hard and often as the task says; every push that is due is given.
        thermal_protection: switch off motors that overheat, whatever the task says.
        randomize: ranges that every episode draws from, whatever the task says; none, if not given.
        simulator: actuator, latencies and file of parameters; the task's, if not given.
        push_force: least and greatest force [N] of pushes in horizontal directions, in place of the task's.
        commands: file of commands over time, in place of drawn ones.

    Raises:
        SurefootError: no such parameter, a value that the robot does not allow, or what does not go together.
    """
    given = parse_settings([word for group in settings for word in group])
    task = replace(task, thermal_protection=task.thermal_protection or thermal_protection)
    task = (simulator or Simulator()).of(task, given)
    task.nominal(robot)  # refuses parameters that the robot does not allow
    ranges = randomize or {}
    check_ranges(ranges, robot)
    told = replace(task.commands, ramp=0)
    if commands is not None:
        if not task.commands.enabled:
            raise SurefootError(f"--commands is given; task '{task.name}' has no commands to follow")
        told = replace(told, schedule=read_schedule(commands))
    return replace(task, randomize=ranges, pushes=task.pushes.in_full(pushes, push_force), commands=told)


def lasting(task: TaskConfig, robot: RobotDescription, duration: float) -> TaskConfig:
    """Return the task with episodes of a duration [s], whatever its control step."""
    steps = round(duration / float(task.nominal(robot).control_step[0]))
    return replace(task, max_steps=max(steps, 1))


def described(task: TaskConfig) -> dict[str, Any]:
    """Return actuator and physical parameters of a task, as JSON holds them."""
    return {"actuator": task.actuator, "params": task.params, "params_source": task.params_source}


def run_policy(
    policy: Policy,
    task: TaskConfig,
    episodes: int,
    world: str,
    seed: int,
    threads: int = 0,
    name: str = "",
    title: str = "",
) -> list[EpisodeTrace]:
    """Run episodes of a policy in the world of a name, with a progress bar; return their traces.

    The policy goes by `name` in the traces, and by `title`, or else its name, over the bar.
    """
    from surefoot.evaluate.rollout import run_episodes

    with ProgressBar(title or name) as bar:
        return run_episodes(
            policy, task, episodes, find_world(world), seed, threads, bar.advance, world_name=world, policy_name=name
        )
