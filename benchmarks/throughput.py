"""Physics steps per second of each layer of surefoot, as ratios to MuJoCo alone on the same motion, in one run.

    bare    `mujoco.rollout` on all cores, many steps a call, replaying the forces recorded from the layers below: the
            same model goes through the same motion
    world   `SimWorld.step`: servo, motor, delays, foot contact and sensors around every physics step
    env     `LocomotionEnv.step` with the policy file deciding
    train   whole PPO updates, learning included
    authors one process a core of the authors' PyBullet environment, where `pybullet` is installed

Each layer is timed in turns, several rounds; the median is reported.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import mujoco.rollout
import numpy as np

from surefoot.cli.policies import find_policy
from surefoot.evaluate.rollout import task_from_contract
from surefoot.learn.config import load_train_config
from surefoot.learn.trainer import Trainer
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.env import LocomotionEnv
from surefoot.world.mujoco_model import build_model
from surefoot.world.sim_world import SimWorld

PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
FORCES = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)


class Bench:
    """The layers, set up once, each with a method that runs it and returns (physics steps, seconds)."""

    def __init__(self, num_envs: int, steps: int, threads: int) -> None:
        self.num_envs, self.steps, self.threads = num_envs, steps, threads
        self.policy = PolicyRuntime.load(find_policy("gallop"))
        task = replace(task_from_contract(self.policy.contract), start_linear_speed=0.3, start_angular_speed=1.0)
        self.env = LocomotionEnv(task, num_envs, SimWorld, seed=1, threads=threads)
        self.servo_steps = round(self.policy.contract.control_step / self.env.robot.timing.servo_step)
        self.targets = self._warm_up_and_record_targets()
        self.initial, self.forces, self.final = self._record_forces()
        self.model = build_model(self.env.robot)
        self.rollout = mujoco.rollout.Rollout(nthread=threads)
        self.datas = [mujoco.MjData(self.model) for _ in range(threads)]
        config = replace(load_train_config("gallop"), threads=threads)
        self.trainer = Trainer(config, SimWorld)
        self.trainer.update()

    def _act(self, observation: np.ndarray) -> np.ndarray:
        return self.env.gait.action(self.policy.feedback(observation))

    def _warm_up_and_record_targets(self) -> np.ndarray:
        observation, _ = self.env.reset(seed=1)
        targets = []
        for _ in range(self.steps):
            observation, *_ = self.env.step(self._act(observation))
            targets.append(self.env.world.drive.target.copy())
        return np.array(targets)

    def _record_forces(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """States and applied forces of the same motion, one servo step at a time, for the bare engine."""
        env = self.env
        env.reset(seed=1)
        world = env.world
        world.params.control_step[:] = env.robot.timing.servo_step
        models, datas = world.engine.models, world.engine.datas
        size = mujoco.mj_stateSize(models[0], FORCES)
        initial = np.empty((self.num_envs, mujoco.mj_stateSize(models[0], PHYSICS)))
        forces = np.empty((self.num_envs, self.steps * self.servo_steps, size))
        for i in range(self.num_envs):
            mujoco.mj_getState(models[i], datas[i], initial[i], PHYSICS)
        for k, target in enumerate(self.targets):
            for j in range(self.servo_steps):
                world.step(target)
                for i in range(self.num_envs):
                    mujoco.mj_getState(models[i], datas[i], forces[i, k * self.servo_steps + j], FORCES)
        final = np.array([data.qpos.copy() for data in datas])
        world.params.control_step[:] = self.policy.contract.control_step
        return initial, forces, final

    def bare(self) -> tuple[int, float]:
        """MuJoCo alone."""
        steps = self.forces.shape[1]
        models = [self.model] * self.num_envs
        start = time.perf_counter()
        states, _ = self.rollout.rollout(
            models, self.datas, self.initial, self.forces, control_spec=FORCES, nstep=steps, chunk_size=8
        )
        seconds = time.perf_counter() - start
        self.replay_error = float(np.abs(states[:, -1, 1 : 1 + self.model.nq] - self.final).max())
        return self.num_envs * steps, seconds

    def world(self) -> tuple[int, float]:
        """Servo, motor, delays, contact and sensors added."""
        self.env.reset(seed=1)
        world = self.env.world
        start = time.perf_counter()
        for target in self.targets:
            world.step(target)
        return self.num_envs * self.steps * self.servo_steps, time.perf_counter() - start

    def environment(self) -> tuple[int, float]:
        """Observation, policy, reward and episodes added."""
        observation, _ = self.env.reset(seed=1)
        start = time.perf_counter()
        for _ in range(self.steps):
            observation, *_ = self.env.step(self._act(observation))
        return self.num_envs * self.steps * self.servo_steps, time.perf_counter() - start

    def train(self) -> tuple[int, float]:
        """Learning added."""
        start = time.perf_counter()
        for _ in range(3):
            self.trainer.update()
        return 3 * self.trainer.config.samples_per_update * self.servo_steps, time.perf_counter() - start


def authors_rate() -> float | None:
    """Physics steps per second of the authors' environment, one process a core; None where it does not run."""
    script = [sys.executable, str(Path(__file__).with_name("authors_environment.py"))]
    pipe = subprocess.PIPE
    processes = [
        subprocess.Popen(script, stdout=pipe, stderr=subprocess.DEVNULL, text=True) for _ in range(os.cpu_count() or 1)
    ]
    said = [process.communicate()[0].split() for process in processes]
    if any(process.returncode for process in processes):
        return None
    return sum(float(words[-1]) for words in said)


def main() -> int:
    """Run all layers and print rates and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100, help="control steps of each robot")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--threads", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    bench = Bench(options.num_envs, options.steps, options.threads)
    layers = {"bare": bench.bare, "world": bench.world, "env": bench.environment, "train": bench.train}
    rates: dict[str, list[float]] = {name: [] for name in layers}
    for _ in range(options.rounds):
        for name, layer in layers.items():
            steps, seconds = layer()
            rates[name].append(steps / seconds)
    result: dict[str, Any] = {name: statistics.median(values) for name, values in rates.items()}
    for name in ("world", "env", "train"):
        ratios = [layer / bare for layer, bare in zip(rates[name], rates["bare"], strict=True)]
        result[f"{name}_ratio"] = statistics.median(ratios)
    result["replay_error_m"] = bench.replay_error
    result["authors"] = authors_rate()
    if result["authors"]:
        result["env_to_authors_ratio"] = result["env"] / result["authors"]
    if options.json:
        print(json.dumps(result))
        return 0
    print(f"{options.num_envs} robots, {options.threads} threads, median of {options.rounds} rounds")
    for name in layers:
        ratio = f"{result[f'{name}_ratio']:.2f} of bare" if name != "bare" else ""
        spread = f"({min(rates[name]):,.0f} to {max(rates[name]):,.0f})"
        print(f"  {name:6} {result[name]:>9,.0f} physics steps/s {spread:24} {ratio}")
    print(f"  the bare engine's replay ends within {result['replay_error_m']:.1e} of the world's motion")
    if result["authors"]:
        print(
            f"  authors' environment {result['authors']:,.0f}; env runs {result['env_to_authors_ratio']:.0f} times that"
        )
    else:
        print("  authors' environment: not run (pip install pybullet)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
