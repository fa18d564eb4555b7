"""Wall time until a gallop that is learned from scratch reaches the paper's speed.

The time is from the start of training (models built, compiled code loaded) until the deterministic policy averages
1.34 m/s over eight full episodes without a fall. It includes evaluations. These are few, because early policies only
move while they explore: a short run of a few robots decides whether eight full episodes are run. Processor time is
reported in addition to wall time, for machines with other load. --out writes one row per seed.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.learn.config import load_train_config
from surefoot.learn.evaluation import evaluate_policy
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.tables import write_csv
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

TARGET = 1.34


def early_speed(learner: PpoLearner, seconds: float = 1.5) -> float:
    """Return the speed [m/s] of the deterministic policy at the beginning of an episode.

    Only the last third counts, in which a running policy has reached its speed.
    """
    env = early_env(learner)
    observation, _ = env.reset()
    steps = round(seconds / env.world.params.control_step[0])
    last = steps // 3
    for k in range(steps):
        observation, *_ = env.step(learner.act(observation))
        if k == steps - last - 1:
            before, since = env.state.truth.base_position_world[:, 0], env.state.readings.time
    forward = env.state.truth.base_position_world[:, 0] - before
    return float(np.mean(forward / np.maximum(env.state.readings.time - since, 1e-9)))


@cache
def early_env(learner: PpoLearner) -> LocomotionEnv:
    """Return an environment with few robots on the learner's task."""
    config = learner.config
    return LocomotionEnv(config.task, 4, SimWorld, config.seed, autoreset=False, threads=config.threads)


def run(seed: int, limit: float, threads: int) -> dict[str, Any]:
    """Train until the target is reached, or for `limit` seconds; return the row of the seed."""
    start, start_cpu = time.perf_counter(), time.process_time()
    config = replace(load_train_config("gallop"), seed=seed, threads=threads, learning_threads=threads)
    learner = PpoLearner(config, SimWorld)
    world: Any = learner.env.world
    dt = world.params.control_step[0]
    reached, evaluations, next_evaluation = None, 0, 0
    while reached is None and time.perf_counter() - start < limit:
        metrics = learner.update()
        # An evaluation takes as long as ten updates. It is made only if the exploring policy and a short run are fast
        # enough, and not again immediately after a failed one.
        promising = learner.steps >= next_evaluation and metrics.reward_rate / dt > 0.35
        if promising and early_speed(learner) > 0.7 * TARGET:
            evaluations, next_evaluation = evaluations + 1, learner.steps + 30_000
            evaluation = evaluate_policy(learner, SimWorld, 8)
            if evaluation.speed_mean >= TARGET and evaluation.falls == 0:
                reached = evaluation
    return {
        "seed": seed,
        "seconds": round(time.perf_counter() - start, 1),
        "cpu_seconds": round(time.process_time() - start_cpu, 1),
        "control_steps": learner.steps,
        "evaluations": evaluations,
        "reached": reached is not None,
        "speed": None if reached is None else round(reached.speed_mean, 3),
    }


def main() -> int:
    """Train with each seed until the target is reached, and print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--limit", type=float, default=900.0, help="give up a seed after this many seconds")
    parser.add_argument("--threads", type=int, default=0, help="threads of simulation and learning; 0: one per core")
    parser.add_argument("--out", type=Path, help="CSV file")
    options = parser.parse_args()
    rows = []
    for seed in options.seeds:
        rows.append(run(seed, options.limit, options.threads))
        print(json.dumps(rows[-1]), flush=True)
        if options.out:
            write_csv(options.out, rows)
    return 0 if all(row["reached"] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
