"""How well a robot follows commands after some minutes of training on this computer, from nothing.

The time runs from the start of training (models built, compiled code loaded) to its end; with one thread it is the
process's time on a processor, which other programs change little, with more it is the wall's. Then the deterministic
policy is run on fresh commands, one for each robot: 8 s from standing, of which the first second does not count.
Errors are root mean squares of speed forward and sideways [m/s] and yaw rate [rad/s], of every control step and
averaged over a stride. Episodes that fell count up to the fall.

    python benchmarks/velocity_tracking.py --minutes 4 --every 1 --threads 1 --out results/steer/reference-0.csv

writes errors on the way too, for `velocity_curves.py`.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.tracking import STRIDE, Tracking
from surefoot.learn.config import load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.robot.commands import COMMANDS
from surefoot.tables import write_csv
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.pushes import PushConfig
from surefoot.task.reference import ReferenceConfig
from surefoot.world.sim_world import SimWorld

FRESH = 7_000_003
"""Added to the seed of fresh commands."""
SECONDS = 8.0
"""How long a command holds [s]."""


class TrainedPolicy:
    """The deterministic policy of a learner, as a policy file's runtime gives it."""

    def __init__(self, learner: PpoLearner) -> None:
        self.learner = learner

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A) for observations (N, O * history)."""
        return self.learner.env.gait.feedback(self.learner.act(np.asarray(observation, np.float32)))


def fresh_commands(task: TaskConfig, control_step: float) -> TaskConfig:
    """Return the task with one command an episode, on nominal robots without pushes."""
    commands = replace(task.commands, hold=(SECONDS, SECONDS), ramp=0)
    pushes = PushConfig(enabled=False)
    return replace(task, commands=commands, pushes=pushes, max_steps=round(SECONDS / control_step))


def from_scratch(task: TaskConfig) -> TaskConfig:
    """Return the task without a reference gait, with wide bounds on the feedback."""
    wide = FeedbackConfig(abduction=(-0.4, 0.4), swing=(-0.8, 0.8), extension=(0.45, 0.9))
    seen = tuple(name for name in task.observations if name != "reference_phase")
    return replace(task, reference=ReferenceConfig(), feedback=wide, observations=seen)


def measure(learner: PpoLearner, episodes: int) -> dict[str, Any]:
    """Return errors and falls of the present policy on fresh commands."""
    config, env = learner.config, learner.env
    task = fresh_commands(config.task, float(env.nominal.control_step[0]))
    traces = run_episodes(TrainedPolicy(learner), task, episodes, SimWorld, config.seed + FRESH, config.threads)
    errors = Tracking.from_traces(traces, env.gait.reference.period or STRIDE)
    return {
        "rmse": errors.rmse.round(4).tolist(),
        "rmse_stride": errors.rmse_stride.round(4).tolist(),
        "falls": sum(trace.fell for trace in traces),
        "episodes": episodes,
    }


def write_curve(path: Path, run: dict[str, Any], curve: list[dict[str, Any]]) -> None:
    """Write a row for each point of the curve, after the columns that name the run."""
    rows = []
    for point in curve:
        errors = {
            f"{command}{ending}": error
            for ending in ("", "_stride")
            for command, error in zip(COMMANDS, point[f"rmse{ending}"], strict=True)
        }
        rows.append({**run, **{name: value for name, value in point.items() if "rmse" not in name}, **errors})
    write_csv(path, rows)


def main() -> int:
    """Train for some minutes and print the errors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", default="go2", help="name or folder of the robot")
    parser.add_argument("--minutes", type=float, default=4.0, help="of training")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--episodes", type=int, default=128, help="fresh commands at the end")
    parser.add_argument("--scratch", action="store_true", help="without a reference gait")
    parser.add_argument("--every", type=float, default=0.0, help="minutes between errors on the way, outside the time")
    parser.add_argument("--threads", type=int, default=0, help="of simulation and learning; 0: one a core")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--out", type=Path, help="CSV file for the errors on the way")
    options = parser.parse_args()
    config = replace(load_train_config("steer", options.robot), seed=options.seed, threads=options.threads)
    config = replace(config, learning_threads=options.threads)
    if options.scratch:
        config = replace(config, task=from_scratch(config.task))
    run = {"robot": options.robot, "start": "scratch" if options.scratch else "reference"}
    run |= {"seed": options.seed, "threads": options.threads}
    spent = 0.0
    curve: list[dict[str, Any]] = []
    clock = time.process_time if options.threads == 1 else time.perf_counter
    start = clock()
    learner = PpoLearner(config, SimWorld)
    while spent <= 60 * options.minutes:
        learner.update()
        spent += clock() - start
        if options.every and spent > 60 * options.every * (len(curve) + 1):
            curve.append(
                {"seconds": round(spent, 1), "control_steps": learner.steps, **measure(learner, options.episodes)}
            )
            if options.out:
                write_curve(options.out, run, curve)
            if not options.json:
                print(curve[-1], flush=True)
        start = clock()
    seconds = {"seconds": round(spent, 1), "control_steps": learner.steps, "robot": learner.env.robot.name}
    result = {**seconds, "seed": options.seed, **measure(learner, options.episodes)}
    print(json.dumps({**result, "curve": curve} if curve else result) if options.json else result)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
