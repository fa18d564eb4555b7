"""Find, load and run policies by name or path."""

from __future__ import annotations

import itertools
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from surefoot.configuration import to_mapping
from surefoot.deploy.checks import check_policy
from surefoot.errors import SurefootError, suggest
from surefoot.policy.contract import config_hash
from surefoot.policy.runtime import PolicyRuntime
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.handcrafted import HandcraftedGait
from surefoot.task.policy_plugins import plugin_notes
from surefoot.task.trace import EpisodeTrace
from surefoot.world.registry import check_randomized, find_world

if TYPE_CHECKING:
    from surefoot.evaluation.rollout import Controller

PACKAGE = Path(__file__).resolve().parents[1]
SEARCH_PATHS = (PACKAGE / "policies", PACKAGE.parents[1] / "policies")
"""Folders of released policies: in an installed package, and in the repository."""

POLICY_FILE = "policy.onnx"
"""Name of the policy file in a run folder."""


def released_policies() -> dict[str, Path]:
    """Return the files of the released policies, by name."""
    return {path.stem: path for folder in reversed(SEARCH_PATHS) for path in sorted(folder.glob("*.onnx"))}


def find_policy(policy: str) -> Path:
    """Return the file of a policy that is given by its path, its run folder or the name of a released policy.

    Raises:
        SurefootError: no such policy, a run without a policy, or a folder of several runs.
    """
    released, path = released_policies(), Path(policy)
    if path.is_file():
        return path
    if policy in released:
        return released[policy]
    if path.is_dir():
        if (path / POLICY_FILE).is_file():
            return path / POLICY_FILE
        if (path / "run.json").is_file():
            raise SurefootError(f"run {path} has no {POLICY_FILE} yet; its first evaluation writes it, or its end")
        if runs := sorted(path.glob(f"*/{POLICY_FILE}"), key=lambda file: file.stat().st_mtime):
            raise SurefootError(
                f"{path} is a folder of {len(runs)} runs; give one of them, such as the newest: {runs[-1].parent}"
            )
        raise SurefootError(f"folder {path} is not a run: it has no {POLICY_FILE}")
    names = suggest(policy, sorted(released)) if released else "this installation has no released policies"
    raise SurefootError(f"policy '{policy}' does not exist; {names}, or the path of a policy file or run")


def open_policy(path: Path, robot: str | None = None) -> tuple[PolicyRuntime, RobotDescription]:
    """Return a policy and its robot; `robot` is a name or folder, and defaults to the policy's.

    Raises:
        SurefootError: the file is not a policy, or is for another robot.
    """
    policy = PolicyRuntime.load(path)
    description = policy.load_robot(robot)
    check_policy(policy.contract, description)
    for line in plugin_notes(policy.contract):
        print(f"surefoot: {policy.contract.name}: {line}", file=sys.stderr)
    return policy, description


def load_policy(path: Path, robot: str | None) -> tuple[PolicyRuntime, RobotDescription, TaskConfig]:
    """Return a policy, its robot and its task, see `open_policy`.

    The task's control step, latencies, gains and voltage are the values with which the policy was trained.
    """
    policy, description = open_policy(path, robot)
    return policy, description, task_from_contract(policy.contract, description)


def load_gait(path: Path, robot: str | None) -> tuple[Controller, RobotDescription, TaskConfig, dict[str, str]]:
    """Load a policy file or a handcrafted gait (.yaml).

    Returns:
        Policy, robot, task, and a dict with the policy's `name` and `config_hash`.

    Raises:
        SurefootError: see `load_policy`; or the file is not a handcrafted gait.
    """
    if path.suffix != ".yaml":
        policy, description, task = load_policy(path, robot)
        return policy, description, task, {"name": policy.contract.name, "config_hash": policy.contract.config_hash}
    gait = HandcraftedGait.load(path)
    task = gait.task if robot is None else replace(gait.task, robot=robot)
    whole = {"task": to_mapping(task), "raibert": gait.raibert and to_mapping(gait.raibert)}
    origin = {"name": task.name, "config_hash": config_hash(whole)}
    return replace(gait, task=task).policy(), RobotDescription.load(task.robot), task, origin


class Candidate(NamedTuple):
    """A policy in a comparison, with a unique name."""

    name: str
    path: Path
    policy: PolicyRuntime
    task: TaskConfig


def load_policies(policies: Sequence[str]) -> tuple[list[Candidate], RobotDescription]:
    """Return the policies of a comparison (names or paths, see `find_policy`), and their common robot."""
    if not policies:
        raise SurefootError("no policy is given; give one or more policy files (.onnx), or names of released policies")
    paths = [find_policy(policy) for policy in policies]
    loaded = [load_policy(path, None) for path in paths]
    names = distinct_names([policy.contract.name for policy, _, _ in loaded], [path.stem for path in paths])
    robot = loaded[0][1]
    for name, (_, other, _) in zip(names, loaded, strict=True):
        if other.name != robot.name:
            raise SurefootError(
                f"policy '{name}' is for robot '{other.name}', but '{names[0]}' is for '{robot.name}'; "
                "policies that are compared must be for the same robot"
            )
    parts = zip(names, paths, loaded, strict=True)
    return [Candidate(name, path, policy, task) for name, path, (policy, _, task) in parts], robot


def distinct_names(names: Sequence[str], stems: Sequence[str]) -> list[str]:
    """Make names unique: a repeated name is replaced by the stem of its file, and a repeated stem is numbered."""
    repeated = {name for name, count in Counter(names).items() if count > 1}
    chosen = [stem if name in repeated else name for name, stem in zip(names, stems, strict=True)]
    counts, taken = Counter(chosen), set(chosen)
    for i, name in enumerate(chosen):
        if counts[name] > 1:
            chosen[i] = next(text for k in itertools.count(1) if (text := f"{name}-{k}") not in taken)
            taken.add(chosen[i])
    return chosen


def run_policy(
    policy: Controller,
    task: TaskConfig,
    episodes: int,
    world: str,
    seed: int,
    threads: int = 0,
    name: str = "",
    title: str = "",
) -> list[EpisodeTrace]:
    """Run episodes of a policy in a world with a progress bar; return their traces.

    Args:
        policy: policy to run.
        task: task to run.
        episodes: number of episodes.
        world: name of the world.
        seed: seed of the episodes.
        threads: threads of the simulation; 0: one per core.
        name: name of the policy in the traces.
        title: title of the progress bar; defaults to the name.

    Raises:
        SurefootError: the world's robots can't be randomized.
    """
    from surefoot.evaluation.rollout import run_episodes

    check_randomized(world, task.randomize)
    with ProgressBar(title or name) as bar:
        return run_episodes(
            policy, task, episodes, find_world(world), seed, threads, bar.advance, world_name=world, policy_name=name
        )
