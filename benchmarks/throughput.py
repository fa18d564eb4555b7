"""Physics steps per second of each layer of surefoot, relative to bare MuJoCo on the same motion.

    bare    only `mj_step`, called from a compiled loop that applies the forces recorded from the world: the same
            robots repeat the same motion, to the last bit
    rollout the same with `mujoco.rollout`, which reads all forces and writes all states
    world   `SimWorld.step`: servo, motor, delays, foot contact and sensors around every physics step
    env     `LocomotionEnv.step` with a policy file
    drawn   the same with physical parameters randomized (table I without the control step) at every reset
    unequal the same with control steps of 3 to 20 ms in one batch, counted in physics steps
    train   complete PPO updates, including learning
    train+  the same with all of table I randomized
    train 1, train N    with --threads N: updates with one thread and with all, in turns
    authors one process per core of the paper authors' PyBullet environment, if `pybullet` is installed

Bare, world and env take turns of one control step of all robots, some milliseconds each, so that other load on the
machine affects all equally. The longer layers follow, with a second or more each, also in turn. With one thread, the
default, time is processor time; with several threads it is wall time. Ratios are medians over turns, with quartiles.
--out writes one row per layer.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mujoco
import mujoco.rollout
import numpy as np
from numba import njit
from rounds import measure, ratio_quartiles

from surefoot.api.policies import find_policy
from surefoot.learn.config import load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot.randomization import Ranges, load_ranges
from surefoot.tables import write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.task.randomized_params import RandomizedParams
from surefoot.world.mujoco_model import build_model
from surefoot.world.native import call_step, doubles, function_address
from surefoot.world.sim_world import SimWorld

STATE = mujoco.mjtState.mjSTATE_INTEGRATION
PHYSICS = mujoco.mjtState.mjSTATE_FULLPHYSICS
FORCES = int(mujoco.mjtState.mjSTATE_QFRC_APPLIED) | int(mujoco.mjtState.mjSTATE_XFRC_APPLIED)


@njit(nogil=True)
def _replay(step, model, data, places, forces, robots, steps):  # type: ignore[no-untyped-def]
    """Step some robots with their recorded forces; with `step` 0 only apply the forces."""
    for i in range(robots[0], robots[1]):
        for k in range(steps[0], steps[1]):
            for j in range(places.shape[1]):
                doubles(places[i, j])[0] = forces[i, k, j]
            if step:
                call_step(step, model, data[i])


class Bare:
    """Bare MuJoCo: the robots of a world with the recorded forces of that world."""

    def __init__(self, env: LocomotionEnv, threads: int) -> None:
        self.world = cast(Any, env.world)
        self.threads, self.pool = threads, ThreadPoolExecutor(threads)
        self.model = build_model(env.robot)
        self.datas = [mujoco.MjData(self.model) for _ in range(env.num_envs)]
        self.step = function_address("mj_step")
        self.addresses = np.array([data._address for data in self.datas], np.int64)
        native = self.world.engine._native
        xfrc = (6 * native.foot_body[:, None] + np.arange(6)).ravel()
        self.places = np.array(
            [
                np.concatenate(
                    [data.qfrc_applied.ctypes.data + 8 * native.motor_dof, data.xfrc_applied.ctypes.data + 8 * xfrc]
                )
                for data in self.datas
            ]
        )

    def record(self, targets: np.ndarray, servo_steps: int) -> None:
        """Step the world with targets, one servo step at a time, and record its states and forces."""
        world, model, datas = self.world, self.world.engine.models[0], self.world.engine.datas
        control_step = world.params.control_step.copy()
        world.params.control_step[:] = world.robot.timing.servo_step
        self.initial = self._states(datas, STATE)
        self.physics, self.warmstart = self._states(datas, PHYSICS), np.array([data.qacc_warmstart for data in datas])
        self.forces = np.empty((len(datas), len(targets) * servo_steps, mujoco.mj_stateSize(model, FORCES)))
        for k, target in enumerate(np.repeat(targets, servo_steps, axis=0)):
            world.step(target)
            self.forces[:, k] = self._states(datas, FORCES)
        self.final = np.array([data.qpos for data in datas])
        world.params.control_step[:] = control_step
        native, nv = world.engine._native, model.nv
        xfrc = (6 * native.foot_body[:, None] + np.arange(6)).ravel()
        self.compact = np.ascontiguousarray(self.forces[:, :, np.concatenate([native.motor_dof, nv + xfrc])])

    def _states(self, datas: list[Any], kind: int) -> np.ndarray:
        rows = np.empty((len(datas), mujoco.mj_stateSize(self.model, kind)))
        for data, row in zip(datas, rows, strict=True):
            mujoco.mj_getState(self.model, data, row, kind)
        return rows

    def restart(self) -> None:
        """Reset all robots to the start of the record."""
        for data, state in zip(self.datas, self.initial, strict=True):
            mujoco.mj_setState(self.model, data, state, STATE)

    def run(self, first: int, last: int, step: int | None = None) -> None:
        """Replay the recorded servo steps from `first` to `last` (exclusive)."""
        step = self.step if step is None else step
        parts = np.linspace(0, len(self.datas), self.threads + 1).astype(int)

        def work(part: int) -> None:
            robots = (parts[part], parts[part + 1])
            _replay(step, self.model._address, self.addresses, self.places, self.compact, robots, (first, last))

        if self.threads == 1:
            work(0)
        else:
            list(self.pool.map(work, range(self.threads)))


class Bench:
    """Layers that are set up once; a method for each runs a turn and returns (physics steps, seconds)."""

    def __init__(self, num_envs: int, steps: int, threads: int, policy: str = "gallop", training: str = "") -> None:
        self.num_envs, self.steps, self.threads, self.training = num_envs, steps, threads, training or policy
        self.clock = time.process_time if threads == 1 else time.perf_counter
        self.policy = PolicyRuntime.load(find_policy(policy))
        task = replace(task_from_contract(self.policy.contract), start_linear_speed=0.3, start_angular_speed=1.0)
        self.servo_env, self.env = (self._env(task, task.randomize) for _ in range(2))
        self.servo_steps = round(self.policy.contract.control_step / self.env.robot.timing.servo_step)
        self.observation, _ = self.env.reset()
        self.env_start = self.env.get_state(), self.observation
        self.targets = self._targets()
        self.bare_layer = Bare(self.servo_env, threads)
        world_start = self.servo_env.world.get_state()
        self.bare_layer.record(self.targets, self.servo_steps)
        self.world_start = world_start
        self.rollout_layer = mujoco.rollout.Rollout(nthread=threads)
        self.scratch = [mujoco.MjData(self.bare_layer.model) for _ in range(threads)]
        self.at = dict.fromkeys(("bare", "world", "env"), 0)
        self.replay_error = self._replay_error()
        self.copy_share = self._copy_share()

    def make_long(self) -> None:
        """Set up the layers with longer turns."""
        table1 = load_ranges("table1", robot=self.env.task.robot)
        self.episode_env = self._env(self.env.task, self.env.task.randomize)
        self.drawn_env = self._env(
            self.env.task, {name: interval for name, interval in table1.items() if name != "control_step"}
        )
        self.unequal_env = self._env(self.env.task, {"control_step": table1["control_step"]})
        self.redraw_seconds = 0.0
        self._time_redraws(self.drawn_env)
        config = load_train_config(self.training, self.env.task.robot)
        config = replace(config, threads=self.threads, learning_threads=self.threads)
        self.learner = PpoLearner(config, SimWorld)
        self.drawn_learner = PpoLearner(replace(config, task=replace(config.task, randomize=table1)), SimWorld)
        learners = [self.learner, self.drawn_learner]
        if self.threads > 1:
            self.single_learner = PpoLearner(replace(config, threads=1, learning_threads=1), SimWorld)
            learners.append(self.single_learner)
        for learner in learners:
            learner.update()

    def _env(self, task: TaskConfig, ranges: Ranges) -> LocomotionEnv:
        drawn = replace(task, randomize=ranges)
        return LocomotionEnv(drawn, self.num_envs, SimWorld, seed=1, threads=self.threads)

    def _time_redraws(self, env: LocomotionEnv) -> None:
        """Measure the time for sampling and applying parameters."""
        randomizer = env.component(RandomizedParams).randomizer
        draw, apply = randomizer.draw, env.world.set_params

        def timed(function: Any) -> Any:
            def call(*arguments: Any) -> Any:
                start = self.clock()
                result = function(*arguments)
                self.redraw_seconds += self.clock() - start
                return result

            return call

        randomizer.draw, env.world.set_params = timed(draw), timed(apply)  # type: ignore[method-assign]

    def _act(self, env: LocomotionEnv, observation: np.ndarray) -> np.ndarray:
        return env.gait.action(self.policy.feedback(observation))

    def _targets(self) -> np.ndarray:
        """Return the motor angles (steps, N, M) that the policy commands; this also warms up compiled code."""
        observation, _ = self.servo_env.reset()
        world_start = self.servo_env.world.get_state()
        targets = []
        for _ in range(self.steps):
            observation, *_ = self.servo_env.step(self._act(self.servo_env, observation))
            targets.append(cast(Any, self.servo_env.world).actuation.target.copy())
        self.servo_env.world.set_state(world_start)
        return np.array(targets)

    def _replay_error(self) -> float:
        """Return the final deviation of the replay from the world's motion [m, rad]."""
        bare = self.bare_layer
        bare.restart()
        bare.run(0, self.steps * self.servo_steps)
        return float(np.abs(np.array([data.qpos for data in bare.datas]) - bare.final).max())

    def _copy_share(self) -> float:
        """Return the fraction of the bare loop's time for applying forces; an upper bound, since memory is cold."""
        seconds = []
        for step in (None, 0):
            self.bare_layer.restart()
            start = self.clock()
            self.bare_layer.run(0, self.steps * self.servo_steps, step)
            seconds.append(self.clock() - start)
        return seconds[1] / seconds[0]

    def _place(self, layer: str, restart: Any) -> int:
        """Return the number of the next control step; the first follows the last."""
        k = self.at[layer]
        if k == 0:
            restart()
        self.at[layer] = (k + 1) % self.steps
        return k

    def bare(self) -> tuple[int, float]:
        """Bare MuJoCo, one control step."""
        first = self._place("bare", self.bare_layer.restart) * self.servo_steps
        start = self.clock()
        self.bare_layer.run(first, first + self.servo_steps)
        return self.num_envs * self.servo_steps, self.clock() - start

    def world(self) -> tuple[int, float]:
        """MuJoCo with servo, motor, delays, contact and sensors."""
        world = self.servo_env.world
        target = self.targets[self._place("world", lambda: world.set_state(self.world_start))]
        start = self.clock()
        world.step(target)
        return self.num_envs * self.servo_steps, self.clock() - start

    def environment(self) -> tuple[int, float]:
        """The world with observation, policy, reward and episodes."""

        def restart() -> None:
            self.env.set_state(self.env_start[0])
            self.observation = self.env_start[1]

        self._place("env", restart)
        start = self.clock()
        self.observation, *_ = self.env.step(self._act(self.env, self.observation))
        return self.num_envs * self.servo_steps, self.clock() - start

    def whole_bare(self) -> tuple[int, float]:
        """Bare MuJoCo, all control steps."""
        self.bare_layer.restart()
        start = self.clock()
        self.bare_layer.run(0, self.steps * self.servo_steps)
        return self.num_envs * self.steps * self.servo_steps, self.clock() - start

    def rollout(self) -> tuple[int, float]:
        """The function of the `mujoco` package for stepping many robots."""
        bare = self.bare_layer
        models = [bare.model] * self.num_envs
        start = self.clock()
        self.rollout_layer.rollout(
            models,
            self.scratch,
            bare.physics,
            bare.forces,
            control_spec=FORCES,
            nstep=bare.forces.shape[1],
            initial_warmstart=bare.warmstart,
            chunk_size=8,
        )
        return self.num_envs * self.steps * self.servo_steps, self.clock() - start

    def episode(self) -> tuple[int, float]:
        """As `environment`, in a turn as long as `drawn` and `unequal`, including a reset of all robots."""
        return self._run(self.episode_env)

    def drawn(self) -> tuple[int, float]:
        """The environment with physical parameters randomized at every reset."""
        self.redraw_seconds = 0.0
        steps, seconds = self._run(self.drawn_env)
        self.redraw_share = self.redraw_seconds / seconds
        return steps, seconds

    def unequal(self) -> tuple[int, float]:
        """The environment with control steps that differ between robots."""
        return self._run(self.unequal_env)

    def _run(self, env: LocomotionEnv) -> tuple[int, float]:
        """Run the average number of control steps of an episode, including a reset."""
        start = self.clock()
        observation, _ = env.reset()
        physics, world = 0, cast(Any, env.world)
        for _ in range(self.steps):
            servo_steps = world.actuation.ticks.copy()
            observation, *_ = env.step(self._act(env, observation))
            went = world.actuation.ticks - servo_steps
            physics += int(went[went > 0].sum())
        return physics, self.clock() - start

    def train(self) -> tuple[int, float]:
        """One PPO update."""
        return self._train(self.learner)

    def train_drawn(self) -> tuple[int, float]:
        """One PPO update with all of table I randomized."""
        return self._train(self.drawn_learner)

    def train_single(self) -> tuple[int, float]:
        """One PPO update with one thread."""
        return self._train(self.single_learner)

    def _train(self, learner: PpoLearner) -> tuple[int, float]:
        world = learner.env.world
        start = self.clock()
        learner.update()
        seconds = self.clock() - start
        servo_steps = world.params.control_step.mean() / learner.env.robot.timing.servo_step
        return int(learner.config.samples_per_update * servo_steps), seconds


def authors_rate() -> float | None:
    """Return the physics steps per second of the authors' environment, one process per core; None if it fails."""
    script = [sys.executable, str(Path(__file__).with_name("authors_environment.py"))]
    pipe = subprocess.PIPE
    processes = [
        subprocess.Popen(script, stdout=pipe, stderr=subprocess.DEVNULL, text=True) for _ in range(os.cpu_count() or 1)
    ]
    outputs = [process.communicate()[0].split() for process in processes]
    if any(process.returncode for process in processes):
        return None
    return sum(float(words[-1]) for words in outputs)


def main() -> int:
    """Run all layers and print rates and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--out", type=Path, help="CSV file with one row per layer")
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100, help="control steps of the motion, which is repeated")
    parser.add_argument("--turns", type=int, default=400, help="short turns of bare, world and env")
    parser.add_argument("--rounds", type=int, default=5, help="long turns of the other layers; 0 leaves them out")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    bench = Bench(options.num_envs, options.steps, options.threads)
    groups = [({"bare": bench.bare, "world": bench.world, "env": bench.environment}, options.turns, "bare")]
    if options.rounds:
        bench.make_long()
        groups += [
            ({"bare": bench.whole_bare, "rollout": bench.rollout}, options.rounds, "bare"),
            (
                {"env": bench.episode, "drawn": bench.drawn, "unequal": bench.unequal},
                options.rounds,
                "env",
            ),
            ({"bare": bench.whole_bare, "train": bench.train}, 3 * options.rounds, "bare"),
            ({"train": bench.train, "train+": bench.train_drawn}, 3 * options.rounds, "train"),
        ]
        if options.threads > 1:
            several = f"train {options.threads}"
            groups.append(({"train 1": bench.train_single, several: bench.train}, 3 * options.rounds, "train 1"))
    result: dict[str, Any] = {}
    lines, rows = [], []
    for layers, turns, base in groups:
        rates = measure(layers, turns)
        for name, values in rates.items():
            if name in result:
                continue
            rate = result[name] = statistics.median(values)
            rows.append(
                {"layer": name, "rate": rate, "base": base, "ratio": 1.0, "ratio_low": None, "ratio_high": None}
            )
            line = f"  {name:7} {rate:>9,.0f} physics steps/s"
            if options.threads == 1:
                line += f" {1e6 / rate:6.2f} us"
            if name != base:
                low, middle, high = result[f"{name}_ratio"] = ratio_quartiles(rates, name, base)
                rows[-1] |= {"ratio": middle, "ratio_low": low, "ratio_high": high}
                line += f"  {middle:.3f} of {base} ({low:.3f} to {high:.3f})"
            lines.append(line)
    result |= {"replay_error": bench.replay_error, "copy_share": bench.copy_share, "authors": None}
    if options.rounds:
        result |= {"redraw_share": bench.redraw_share, "authors": authors_rate()}
    if options.out:
        write_csv(options.out, rows)
    if options.json:
        print(json.dumps(result))
        return 0
    print(f"{options.num_envs} robots, {options.threads} threads, medians of {options.turns} turns (quartiles)")
    print(*lines, sep="\n")
    print(
        f"  bare ends within {bench.replay_error:.1e} of the world's motion; applying forces takes at most "
        f"{100 * bench.copy_share:.1f} % of it"
    )
    if options.rounds:
        print(f"  sampling and applying parameters: {100 * bench.redraw_share:.1f} % of the time of 'drawn'")
        if result["authors"]:
            print(f"  authors' environment {result['authors']:,.0f} on {os.cpu_count()} cores")
        else:
            print("  authors' environment: not run (pip install pybullet)")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
