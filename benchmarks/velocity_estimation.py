"""Errors of the estimated base velocity of simulated robots, from their own readings; a table and the time of a step.

    python benchmarks/velocity_estimation.py
    python benchmarks/velocity_estimation.py --world bullet --cases go2-steer --episodes 32
    python benchmarks/velocity_estimation.py --cost

Every episode draws its robot from table I, with delays and noise of its sensors, as `surefoot evaluate --randomize
table1` does, and its commands. The estimator gets what the robot's computer gets: delayed and noisy readings. Errors
are those of `EstimationErrors`. Rows go to results/estimation/velocity.csv; rows of the same case are replaced. The
constants of the estimator were chosen on runs with seed 100.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from surefoot.api.policies import find_policy, load_gait
from surefoot.estimation.interface import MotionReadings
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.estimated_motion import EstimationErrors, estimate_motion
from surefoot.evaluation.rollout import run_episodes
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import load_ranges
from surefoot.tables import write_csv
from surefoot.world.registry import find_world

RESULTS = Path(__file__).parents[1] / "results" / "estimation"
CASES = {
    "go2-steer": ("go2-steer", "flat"),
    "trot-robust": ("trot-robust", "flat"),
    "go2-terrain-stairs": ("go2-terrain", "stairs:0.10"),
    "go2-terrain-rough": ("go2-terrain", "rough:0.10"),
    "gallop": ("gallop", "flat"),
}
"""Policy and terrain by name."""
DURATION = 10.0
"""Length of an episode [s]."""
STEPS = 2000
"""Updates of which the median time is taken."""


@dataclass(frozen=True)
class Command:
    """Measure, print and write."""

    cases: tuple[str, ...] = tuple(CASES)
    world: str = "mujoco"
    episodes: int = 128
    seed: int = 1
    threads: int = 0
    cost: bool = False
    """Measure the time of an update of one robot only."""
    out: Path = RESULTS


def measure(name: str, world: str, episodes: int, seed: int, threads: int) -> dict[str, Any]:
    """Return the errors in a case."""
    policy_name, terrain = CASES[name]
    policy, robot, task, _ = load_gait(find_policy(policy_name), None)
    ranges = load_ranges("table1", robot=robot.folder)
    run = Condition(randomize=ranges, duration=DURATION, terrain=terrain).apply(task, robot)
    traces = run_episodes(policy, run, episodes, find_world(world), seed, threads, world_name=world)
    errors = EstimationErrors.from_runs(traces, estimate_motion(traces, robot))
    return {
        "case": name if world == "mujoco" else f"{name}/{world}",
        "episodes": episodes,
        "falls": sum(trace.fell for trace in traces),
        **dict(zip(("rmse_forward", "rmse_sideways", "rmse_up"), errors.rmse.round(4).tolist(), strict=True)),
        "bias_forward": round(float(errors.bias[0]), 4),
        "distance_rmse": round(errors.distance_rmse, 4),
        "distance_bias": round(errors.distance_bias, 4),
        "normalized": round(errors.normalized, 2),
    }


def update_time(name: str) -> float:
    """Return the median time of an update of one robot [s]."""
    robot, random = RobotDescription.load(name), np.random.default_rng(0)
    estimator, times = LeggedOdometry(robot), []
    for _ in range(STEPS):
        readings = MotionReadings(
            duration=np.array([0.01]),
            roll_pitch_yaw=random.normal(scale=0.05, size=(1, 3)),
            angular_velocity_base=random.normal(scale=0.5, size=(1, 3)),
            motor_angle=robot.resting_angles[None] + random.normal(scale=0.05, size=(1, robot.num_motors)),
            motor_velocity=random.normal(size=(1, robot.num_motors)),
            motor_torque=random.normal(scale=5.0, size=(1, robot.num_motors)),
        )
        start = time.perf_counter()
        estimator.update(readings)
        times.append(time.perf_counter() - start)
    return float(np.median(times))


def main(command: Command) -> None:
    """Measure the cases that are asked for."""
    if command.cost:
        for name in ("minitaur", "go2"):
            print(f"{name}: {1e3 * update_time(name):.3f} ms an update, median of {STEPS}")
        return
    path = command.out / "velocity.csv"
    table: dict[str, dict[str, Any]] = {}
    if path.is_file():
        with path.open(newline="", encoding="utf-8") as file:
            table = {row["case"]: row for row in csv.DictReader(file)}
    for name in command.cases:
        if name not in CASES:
            raise SystemExit(f"--cases {name} is no case; choose from {', '.join(CASES)}")
        row = measure(name, command.world, command.episodes, command.seed, command.threads)
        table[row["case"]] = row
        print(*row.values(), flush=True)
        write_csv(path, sorted(table.values(), key=_place))


def _place(row: Mapping[str, Any]) -> tuple[bool, int]:
    """Return the sort key of a row: MuJoCo first, cases in their order."""
    case, _, world = str(row["case"]).partition("/")
    return bool(world), list(CASES).index(case)


if __name__ == "__main__":
    main(tyro.cli(Command))
