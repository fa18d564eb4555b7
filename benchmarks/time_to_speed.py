"""Wall time until a gallop, learned from scratch, reaches the paper's speed.

From the start of training (models built, compiled code loaded) until the deterministic policy averages 1.34 m/s over
eight full episodes without a fall. The evaluations are inside the time; few are made, as early policies only move
while they explore: one second of a few robots decides before eight whole episodes are run. Seconds on processors are
given beside those on the wall, for machines that do other work too. --out writes a row for each seed.
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
    """Speed [m/s] of the deterministic policy over an episode's first moments, standing start included.

    A policy that runs at all is at speed by the last third, which alone counts.
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
    """Few robots on the learner's task."""
    config = learner.config
    return LocomotionEnv(config.task, 4, SimWorld, config.seed, autoreset=False, threads=config.threads)


def run(seed: int, limit: float, threads: int) -> dict[str, Any]:
    """Train until the target is met, or for `limit` seconds; return the row of the seed."""
    start, start_cpu = time.perf_counter(), time.process_time()
    config = replace(load_train_config("gallop"), seed=seed, threads=threads, learning_threads=threads)
    learner = PpoLearner(config, SimWorld)
    world: Any = learner.env.world
    dt = world.params.control_step[0]
    reached, evaluations, next_evaluation = None, 0, 0
    while reached is None and time.perf_counter() - start < limit:
        figures = learner.update()
        # An evaluation costs as much as ten updates: only ask where exploration alone already runs, then where a short
        # one says so, and not again at once after one that failed.
        promising = learner.steps >= next_evaluation and figures.reward_rate / dt > 0.35
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
    """Train with each seed until the target is met and print the times."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--limit", type=float, default=900.0, help="give up a seed after this many seconds")
    parser.add_argument("--threads", type=int, default=0, help="of simulation and learning; 0: one a core")
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
