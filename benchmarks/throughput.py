"""Physics steps per second of each layer of surefoot, as ratios to MuJoCo alone on the same motion, in one run.

    bare    `mujoco.rollout` on all cores, many steps a call, replaying the forces recorded from the layers below: the
            same model goes through the same motion
    world   `SimWorld.step`: servo, motor, delays, foot contact and sensors around every physics step
    env     `LocomotionEnv.step` with the policy file deciding
    drawn   the same with all of table I but the control step drawn anew at every reset
    unequal the same with control steps of 3 to 20 ms in one batch, counted in physics steps
    train   whole PPO updates, learning included
    train+  the same with all of table I drawn
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
from rounds import measure, median_ratio

from surefoot.cli.policies import find_policy
from surefoot.evaluate.rollout import task_from_contract
from surefoot.learn.config import load_train_config
from surefoot.learn.trainer import Trainer
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.randomize import RandomizeConfig, load_ranges
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
        table1 = load_ranges("table1")
        self.drawn_env = self._env(task, replace(table1, control_step=None))
        self.unequal_env = self._env(task, RandomizeConfig(control_step=table1.control_step))
        self.redraw_seconds = 0.0
        self._time_redraws(self.drawn_env)
        config = replace(load_train_config("gallop"), threads=threads)
        self.trainer = Trainer(config, SimWorld)
        self.drawn_trainer = Trainer(replace(config, task=replace(config.task, randomize=table1)), SimWorld)
        for trainer in (self.trainer, self.drawn_trainer):
            trainer.update()

    def _env(self, task: TaskConfig, ranges: RandomizeConfig) -> LocomotionEnv:
        drawn = replace(task, randomize=ranges)
        return LocomotionEnv(drawn, self.num_envs, SimWorld, seed=1, threads=self.threads)

    def _time_redraws(self, env: LocomotionEnv) -> None:
        """Add up the time that drawing and applying parameters takes."""
        draw, apply = env.randomizer.draw, env.world.set_params

        def timed(function: Any) -> Any:
            def call(*arguments: Any) -> Any:
                start = time.perf_counter()
                result = function(*arguments)
                self.redraw_seconds += time.perf_counter() - start
                return result

            return call

        env.randomizer.draw, env.world.set_params = timed(draw), timed(apply)  # type: ignore[method-assign]

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
        model, datas = world.engine.models[0], world.engine.datas
        size = mujoco.mj_stateSize(model, FORCES)
        initial = np.empty((self.num_envs, mujoco.mj_stateSize(model, PHYSICS)))
        forces = np.empty((self.num_envs, self.steps * self.servo_steps, size))
        for i in range(self.num_envs):
            mujoco.mj_getState(model, datas[i], initial[i], PHYSICS)
        for k, target in enumerate(self.targets):
            for j in range(self.servo_steps):
                world.step(target)
                for i in range(self.num_envs):
                    mujoco.mj_getState(model, datas[i], forces[i, k * self.servo_steps + j], FORCES)
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
        return self._run(self.env)

    def drawn(self) -> tuple[int, float]:
        """Physical parameters drawn at every reset added."""
        self.redraw_seconds = 0.0
        steps, seconds = self._run(self.drawn_env)
        self.redraw_share = self.redraw_seconds / seconds
        return steps, seconds

    def unequal(self) -> tuple[int, float]:
        """Control steps that differ between robots added."""
        return self._run(self.unequal_env)

    def _run(self, env: LocomotionEnv) -> tuple[int, float]:
        """As many control steps as an episode has on average here, the reset included."""
        start = time.perf_counter()
        observation, _ = env.reset()
        physics = 0
        for _ in range(self.steps):
            servo_steps = env.world.drive.ticks.copy()
            observation, *_ = env.step(self._act(observation))
            went = env.world.drive.ticks - servo_steps
            physics += int(went[went > 0].sum())
        return physics, time.perf_counter() - start

    def train(self) -> tuple[int, float]:
        """Learning added."""
        return self._train(self.trainer)

    def train_drawn(self) -> tuple[int, float]:
        """Learning with all of table I drawn."""
        return self._train(self.drawn_trainer)

    def _train(self, trainer: Trainer) -> tuple[int, float]:
        world = trainer.env.world
        start = time.perf_counter()
        mean_steps = []
        for _ in range(3):
            trainer.update()
            mean_steps.append(world.params.control_step.mean() / trainer.env.robot.timing.servo_step)
        seconds = time.perf_counter() - start
        return int(3 * trainer.config.samples_per_update * statistics.mean(mean_steps)), seconds


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
    layers = {
        "bare": bench.bare,
        "world": bench.world,
        "env": bench.environment,
        "drawn": bench.drawn,
        "unequal": bench.unequal,
        "train": bench.train,
        "train+": bench.train_drawn,
    }
    rates = measure(layers, options.rounds)
    result: dict[str, Any] = {name: statistics.median(values) for name, values in rates.items()}
    pairs = [(name, "bare") for name in ("world", "env", "train")]
    pairs += [("drawn", "env"), ("unequal", "env"), ("train+", "train")]
    for name, base in pairs:
        result[f"{name}_ratio"] = median_ratio(rates, name, base)
    result["redraw_share"] = bench.redraw_share
    result["replay_error_m"] = bench.replay_error
    result["authors"] = authors_rate()
    if result["authors"]:
        result["env_to_authors_ratio"] = result["env"] / result["authors"]
    if options.json:
        print(json.dumps(result))
        return 0
    print(f"{options.num_envs} robots, {options.threads} threads, median of {options.rounds} rounds")
    for name in layers:
        ratio = next((f"{result[f'{a}_ratio']:.2f} of {b}" for a, b in pairs if a == name), "")
        spread = f"({min(rates[name]):,.0f} to {max(rates[name]):,.0f})"
        print(f"  {name:7} {result[name]:>9,.0f} physics steps/s {spread:24} {ratio}")
    print(f"  drawing and applying parameters: {100 * result['redraw_share']:.1f} % of the time of 'drawn'")
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
