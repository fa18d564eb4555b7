"""Tracking errors after some minutes of training from scratch on this computer.

The time is from the start of training (models built, compiled code loaded) to its end; with one thread it is processor
time, which other programs hardly change, with several threads it is wall time. Then the deterministic policy runs on
new commands, one per robot, with robots randomized as in training and without pushes: 8 s from standing, without the
first second. Errors are root mean squares of forward and sideways speed [m/s] and yaw rate [rad/s], of every control
step and averaged over a stride. Episodes with a fall count up to the fall.

    python benchmarks/velocity_tracking.py --seeds 0 1 2 --minutes 3 --every 0.5 --out errors.csv

writes errors during training, one row per point. Complete runs in the file are kept; an interrupted one is trained
again.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from processor_time import Stopwatch

from surefoot.arrays import Array
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.tracking import Tracking
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.robot.commands import COMMANDS
from surefoot.robot.randomization import load_ranges
from surefoot.tables import read_csv, write_csv
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.pushes import PushConfig
from surefoot.task.reference_config import NoReferenceConfig
from surefoot.world.sim_world import SimWorld

FRESH = 7_000_003
"""Offset of the seed of new commands."""
SECONDS = 8.0
"""Duration of a command [s]."""


class TrainedPolicy:
    """Deterministic policy of a learner, with the interface of a policy file's runtime."""

    def __init__(self, learner: PpoLearner) -> None:
        self.learner = learner

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A) for observations (N, O * history)."""
        return self.learner.env.gait.feedback(self.learner.act(np.asarray(observation, np.float32)))


def fresh_commands(task: TaskConfig, control_step: float, within: Sequence[float]) -> TaskConfig:
    """Return the task with one command per episode, on robots as in training, without pushes; see `measure`."""
    commands = replace(task.commands, hold=(SECONDS, SECONDS), ramp=0)
    if within:
        low, high, sideways, turn = within
        aside, turns = (-sideways, sideways), (-turn, turn)
        commands = replace(commands, relative=False, forward=(low, high), sideways=aside, yaw_rate=turns)
    pushes = PushConfig(enabled=False)
    return replace(task, commands=commands, pushes=pushes, physics_step=0.0, max_steps=round(SECONDS / control_step))


def from_scratch(task: TaskConfig) -> TaskConfig:
    """Return the task without a reference gait, with wide bounds on the feedback."""
    wide = FeedbackConfig(abduction=(-0.4, 0.4), swing=(-0.8, 0.8), extension=(0.45, 0.9))
    seen = tuple(name for name in task.observations if name != "reference_phase")
    return replace(task, reference=NoReferenceConfig(), feedback=wide, observations=seen)


def measure(learner: PpoLearner, episodes: int, within: Sequence[float] = ()) -> dict[str, Any]:
    """Return errors and falls of the current policy on new commands.

    Args:
        learner: the learner.
        episodes: number of commands.
        within: minimum and maximum forward speed [m/s], maximum sideways speed [m/s] and yaw rate [rad/s]; defaults to
            the task's ranges.
    """
    config, env = learner.config, learner.env
    task = fresh_commands(config.task, float(env.nominal.control_step[0]), within)
    traces = run_episodes(TrainedPolicy(learner), task, episodes, SimWorld, config.seed + FRESH, config.threads)
    errors = Tracking.from_traces(traces)
    named: dict[str, float] = {}
    for ending, values in (("", errors.rmse), ("_stride", errors.rmse_stride)):
        named |= {f"{name}{ending}": x for name, x in zip(COMMANDS, values.round(4).tolist(), strict=True)}
    return {"falls": sum(trace.fell for trace in traces), "episodes": episodes, **named}


def checkpoints(config: TrainConfig, times: Sequence[float]) -> Iterator[tuple[float, Stopwatch, PpoLearner]]:
    """Train, and yield time [s], stopwatch and learner at the first update after each of some increasing times [s].

    The time includes building the models. With one thread it is processor time, with several wall time. It pauses while
    the caller uses the learner.
    """
    watch, left = Stopwatch(), list(times)
    watch.start()
    learner = PpoLearner(config, SimWorld)
    while left:
        learner.update()
        spent = watch.cpu if config.threads == 1 else watch.wall
        if spent >= left[0]:
            watch.stop()
            yield spent, watch, learner
            left = [time for time in left if time > spent]
            watch.start()


def train(
    config: TrainConfig, minutes: float, every: float, episodes: int, within: Sequence[float]
) -> Iterator[dict[str, Any]]:
    """Train for some minutes, and yield the errors every `every` minutes; measuring is not included in the time."""
    times = [60 * every * (k + 1) for k in range(int(minutes / every + 1e-9))]
    for seconds, _, learner in checkpoints(config, times):
        point = {"seconds": round(seconds, 1), "control_steps": learner.steps, **measure(learner, episodes)}
        if within:
            point |= {f"{name}_within": value for name, value in measure(learner, episodes, within).items()}
        yield point


def main() -> int:
    """Train with each seed and print the errors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--robot", default="go2", help="name or folder of the robot")
    parser.add_argument("--minutes", type=float, default=4.0, help="minutes of training")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--episodes", type=int, default=128, help="new commands at each point")
    parser.add_argument("--scratch", action="store_true", help="without a reference gait")
    parser.add_argument("--randomize", default="none", help="table of ranges for randomization in training")
    parser.add_argument(
        "--every",
        type=float,
        help="minutes between measurements of errors, which are not counted; defaults to the end only",
    )
    parser.add_argument("--threads", type=int, default=0, help="threads of simulation and learning; 0: one per core")
    parser.add_argument(
        "--within",
        type=float,
        nargs=4,
        default=(),
        metavar=("LOW", "HIGH", "SIDEWAYS", "TURN"),
        help="also measure on a smaller range of commands: forward speed from LOW to HIGH [m/s], SIDEWAYS [m/s] and "
        "TURN [rad/s] to both sides; those that all Go2 policies of results/steer follow: -0.5 1 0.4 0.8",
    )
    parser.add_argument("--out", type=Path, help="CSV file for the errors, which keeps earlier runs")
    options = parser.parse_args()
    every = options.every or options.minutes
    base = load_train_config("steer", options.robot)
    base = replace(base, threads=options.threads, learning_threads=options.threads)
    ranges = load_ranges(options.randomize, robot=base.task.robot)
    base = replace(base, task=replace(base.task, randomize=ranges))
    if options.scratch:
        base = replace(base, task=from_scratch(base.task))
    rows = read_csv(options.out) if options.out else []
    for seed in options.seeds:
        run = {"robot": options.robot, "start": "scratch" if options.scratch else "reference"}
        run |= {"randomize": options.randomize, "seed": str(seed), "threads": str(options.threads)}
        own = [row for row in rows if row.items() >= run.items()]
        if own and float(own[-1]["seconds"]) >= 60 * options.minutes:
            continue
        rows = [row for row in rows if row not in own]
        for point in train(replace(base, seed=seed), options.minutes, every, options.episodes, options.within):
            print({**run, **point}, flush=True)
            rows.append({**run, **point})
            if options.out:
                write_csv(options.out, rows)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
