"""Regression test: record results of policies and trainings to the last digit, and compare them after a change.

    python benchmarks/golden.py record /tmp/golden
    python benchmarks/golden.py compare /tmp/golden

Record before the change and compare after it on the same machine, because the last digits differ between processors.
Released policies run 200 control steps in their own task, on randomized robots with pushes, and on terrain. Trainings
run 20 thousand steps and are resumed in the middle, so that a resumed run is compared with an uninterrupted one.
`--only rollouts` leaves the trainings out.
"""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from surefoot.api.policies import load_policy, released_policies
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.world.registry import find_world

STEPS = 200
ROBOTS = 6
TRAININGS = (
    ("trot", "minitaur"),
    ("gallop-robust", "minitaur"),
    ("steer-robust", "go2"),
    ("terrain-robust", "go2"),
    ("terrain-seeing", "go2"),
)
"""Tasks and robots of trainings: without a reference, with pushes, symmetric, with a curriculum, and with two gaits."""
TRAINING_STEPS = 20_000
TERRAINS = {"go2-terrain": ("stairs:0.10", "rough:0.08"), "go2-terrain-seeing": ("gaps:0.20", "stones:0.35")}
TIMES = {"rollout_seconds", "learn_seconds"}


@dataclass(frozen=True)
class Command:
    """Record a golden file, or compare the current code with one."""

    action: Annotated[Literal["record", "compare"], tyro.conf.Positional]
    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of golden.json."""
    only: Literal["all", "rollouts", "trainings"] = "all"
    """Cases to run."""


def digest(*arrays: Any) -> str:
    """Return a short hash of arrays, to the last digit."""
    total = hashlib.sha256()
    for array in arrays:
        total.update(np.ascontiguousarray(array).tobytes())
    return total.hexdigest()[:16]


def variants(name: str, task: TaskConfig, robot: RobotDescription) -> Iterator[tuple[str, TaskConfig]]:
    """Yield tasks for a policy: its own, randomized robots with pushes, and terrain."""
    yield "own", task
    pushes = replace(task.pushes, enabled=True, relative=True, force=(0.3, 0.6))
    yield "randomized", replace(task, randomize=load_ranges("table1", robot=robot.folder), pushes=pushes)
    for ground in TERRAINS.get(name, ()):
        yield ground, replace(task, terrain=replace(task.terrain, ground=ground))


def rollout(policy: PolicyRuntime, task: TaskConfig, seed: int = 3) -> dict[str, Any]:
    """Run some robots for `STEPS` control steps; return hashes every 50 steps, and human-readable sums."""
    env = LocomotionEnv(task, ROBOTS, find_world("mujoco"), seed, threads=1)
    observation, _ = env.reset()
    hashes, total = [], 0.0
    for step in range(STEPS):
        observation, reward, terminated, truncated, info = env.step(env.gait.action(policy.feedback(observation)))
        total += float(reward.sum())
        if (step + 1) % 50 == 0:
            truth = env.state.truth
            figures = info["figures"]["return"] if "figures" in info else np.zeros(ROBOTS)
            arrays = (truth.base_position_world, truth.motor_angle, truth.energy, reward, terminated, truncated)
            hashes.append(digest(observation, *arrays, figures, env.privileged(), *env.state.reward_terms.values()))
    state = env.get_state()
    once = [env.step(np.zeros(env.action_space.shape))[0] for _ in range(3)]
    env.set_state(state)
    again = [env.step(np.zeros(env.action_space.shape))[0] for _ in range(3)]
    return {
        "hashes": [*hashes, digest(*once)],
        "reward": total,
        "x": env.state.truth.base_position_world[:, 0].tolist(),
        "resumes": bool(np.array_equal(once, again)),
    }


def random_rollout(task: TaskConfig, seed: int = 5) -> dict[str, Any]:
    """Run robots in a training's task with random actions, so that falls, curricula and resets occur."""
    env = LocomotionEnv(task, ROBOTS, find_world("mujoco"), seed, threads=1)
    env.reset()
    stream, hashes = np.random.default_rng(seed), []
    for step in range(STEPS):
        actions = stream.uniform(-1, 1, env.action_space.shape)
        observation, reward, terminated, _, info = env.step(actions)
        if (step + 1) % 20 == 0 or terminated.any():
            values = [*info["figures"].values(), info["final_obs"]] if "figures" in info else []
            hashes.append(digest(observation, reward, env.privileged(), *values, *env.state.reward_terms.values()))
    return {"hashes": [digest(*[np.frombuffer(one.encode(), np.uint8) for one in hashes])], "columns": len(hashes)}


def training(config: TrainConfig) -> dict[str, Any]:
    """Train with a checkpoint in the middle; return the metrics, and whether a resumed learner gives the same."""
    learner = PpoLearner(config, find_world("mujoco"))
    half, state, rows = config.updates // 2, None, []
    for update in range(config.updates):
        if update == half:
            state = learner.get_state()
        rows.append(_metrics(learner.update()))
    other = PpoLearner(config, find_world("mujoco"))
    assert state is not None
    other.set_state(state)
    resumed = [_metrics(other.update()) for _ in range(half, config.updates)]
    network = digest(*(value.detach().numpy() for value in learner.policy.state_dict().values()))
    return {"figures": rows, "network": network, "resumes": resumed == rows[half:]}


def _metrics(update: Any) -> dict[str, Any]:
    return {key: repr(value) for key, value in vars(update).items() if key not in TIMES}


def cases() -> Iterator[tuple[str, str]]:
    """Yield kind and name of each case."""
    for name in released_policies():
        yield "rollouts", name
    for task, robot in TRAININGS:
        yield "rollouts", f"{robot} {task}"
        yield "trainings", f"{robot} {task}"


def run(kind: str, name: str) -> dict[str, Any]:
    """Run one case."""
    if kind == "trainings":
        robot, task = name.split()
        config = load_train_config(task, robot)
        config = replace(config, steps=TRAINING_STEPS, num_envs=32, steps_per_update=64, start_from=None)
        return training(replace(config, threads=1, learning_threads=1))
    if " " in name:
        robot, task = name.split()
        return random_rollout(load_task(task, robot)[0])
    policy, description, own = load_policy(released_policies()[name], None)
    return {variant: rollout(policy, task) for variant, task in variants(name, own, description)}


def main(command: Command) -> None:
    """Record or compare."""
    path = command.folder / "golden.json"
    before = json.loads(path.read_text()) if command.action == "compare" else {}
    after, failed = {}, 0
    for kind, name in cases():
        if command.only not in ("all", kind):
            continue
        start = time.perf_counter()
        after[f"{kind} {name}"] = now = json.loads(json.dumps(run(kind, name)))
        verdict = ""
        if command.action == "compare":
            then = before.get(f"{kind} {name}")
            verdict = "the same" if now == then else "DIFFERS"
            failed += now != then
            if now != then:
                print(json.dumps({"then": then, "now": now})[:2000])
        print(f"{kind:10} {name:32} {time.perf_counter() - start:5.1f} s  {verdict}", flush=True)
    if command.action == "record":
        command.folder.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(after, indent=1) + "\n")
        print(f"wrote {path}")
    elif failed:
        raise SystemExit(f"{failed} of {len(after)} cases differ")
    else:
        print(f"{len(after)} cases, the same to the last digit")


if __name__ == "__main__":
    main(tyro.cli(Command, description=__doc__))
