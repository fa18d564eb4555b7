"""Errors of the estimated base velocity of simulated robots, from their own readings; a table and the time of a step.

    python benchmarks/velocity_estimation.py
    python benchmarks/velocity_estimation.py --world bullet --cases go2-steer --episodes 32
    python benchmarks/velocity_estimation.py --cost
    python benchmarks/velocity_estimation.py --emulated 10
    python benchmarks/velocity_estimation.py --accelerometer 6 --cases go2-steer trot-robust

Every episode draws its robot from table I, with delays and noise of its sensors, as `surefoot evaluate --randomize
table1` does, and its commands. The estimator gets what the robot's computer gets: delayed and noisy readings. Errors
are those of `EstimationErrors`. Rows go to results/estimation/velocity.csv; rows of the same case are replaced. The
constants of the estimator were chosen on runs with seed 100.

With --accelerometer, robots of table I are emulated, and their runs are estimated with and without the samples of their
accelerometers; rows go to results/estimation/accelerometer.csv.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from emulated import deploy

from surefoot.api.policies import find_policy, load_gait
from surefoot.arrays import Array
from surefoot.estimation.interface import MotionReadings, VelocityEstimate
from surefoot.estimation.legged_odometry import LeggedOdometry
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.estimated_motion import (
    EstimatedMotion,
    EstimatorFactory,
    estimate_intervals,
    estimate_motion,
    with_motion,
)
from surefoot.evaluation.rollout import run_episodes
from surefoot.robot import RobotDescription
from surefoot.robot.commands import COMMANDS
from surefoot.robot.params_file import write_params
from surefoot.robot.randomization import draw_hidden, load_ranges
from surefoot.rotations import in_heading_frame, quat_yaw
from surefoot.tables import read_csv, write_csv
from surefoot.task.trace import EpisodeTrace
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
POLICY = "trot-robust"
"""Policy of the emulated robots."""
UNSEEN = ("base_position_world", "base_quat_world", "foot_contact", "foot_position_world", "true_motor_angle")
"""Columns that only motion capture measures."""
DURATION = 10.0
"""Length of an episode [s]."""
VELOCITIES = ((0.5, 0.0, 0.0), (0.8, 0.0, 0.3), (0.3, 0.2, 0.0), (0.6, -0.2, -0.3), (0.2, 0.0, 0.6), (-0.3, 0.1, 0.0))
"""Velocity commands of emulated robots with an accelerometer: forward and sideways [m/s], yaw rate [rad/s]. Each robot
follows four of them for a quarter of its run, and begins with the next one."""
STEPS = 2000
"""Updates whose times are measured."""
WINDOW = 0.5
"""Time [s] over which errors of the velocity are averaged: about a stride."""


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
    emulated: int = 0
    """Number of emulated robots, whose returns are estimated and measured instead of simulations."""
    accelerometer: int = 0
    """Number of emulated robots of each case that are estimated with and without their accelerometers instead."""
    out: Path = RESULTS


@dataclass(frozen=True)
class EstimationErrors:
    """Errors of estimated motion over runs of a simulation."""

    rmse: Array
    """Root mean square errors (3,) of speeds forward, to the left and up, of means over `WINDOW` [m/s]."""
    bias: Array
    """Mean errors (3,) [m/s]."""
    normalized: float
    """Root mean square error of the horizontal velocity of single steps, over the standard deviation that the filter
    states."""
    distance_rmse: float
    """Root mean square error of the path length of a run, over the mean path length."""
    distance_bias: float
    """Ratio of the sum of estimated path lengths to the sum of true ones, minus 1."""
    covered: float
    """Fraction of runs whose distance along x is in its 95 % interval."""

    @classmethod
    def from_runs(cls, traces: Sequence[EpisodeTrace], motions: Sequence[EstimatedMotion]) -> EstimationErrors:
        """Compare estimates with the truth at the times of the readings.

        Path lengths come from the mean velocities over `WINDOW`, so that steps do not count.
        """
        errors, normalized, lengths, covered = [], [], [], []
        for trace, motion in zip(traces, motions, strict=True):
            truth, count = true_motion(trace), max(round(WINDOW / trace.meta["control_step"]), 1)
            if trace.num_steps < count:
                continue
            means, true_means = (window_means(velocity, count) for velocity in (motion.velocity, truth))
            errors.append(means - true_means)
            normalized.append((motion.velocity - truth)[:, :2] ** 2 / motion.variance[:, :2])
            estimated_run = with_motion(trace, motion)
            distance = forward_distance(trace)
            low, high = estimate_intervals([estimated_run], {"distance_mean": forward_distance(estimated_run)})[
                "distance_mean"
            ]
            covered.append(low <= distance <= high)
            lengths.append([np.hypot(*velocity[:, :2].T).sum() * WINDOW for velocity in (means, true_means)])
        error, (estimated, true) = np.concatenate(errors), np.array(lengths).T
        return cls(
            rmse=np.sqrt((error**2).mean(axis=0)),
            bias=error.mean(axis=0),
            normalized=float(np.sqrt(np.concatenate(normalized).mean())),
            distance_rmse=float(np.sqrt(((estimated - true) ** 2).mean()) / true.mean()),
            distance_bias=float(estimated.sum() / true.sum() - 1.0),
            covered=float(np.mean(covered)),
        )


def forward_distance(trace: EpisodeTrace) -> float:
    """Return the distance of a run along its first heading [m]."""
    moved = trace.base_position_world[-1:] - trace.base_position_world[:1]
    return float(in_heading_frame(moved, quat_yaw(trace.base_quat_world[:1]))[0, 0])


def window_means(values: Array, count: int) -> Array:
    """Return the means (K, ...) over consecutive windows of `count` rows; the rest is left out."""
    whole = len(values) // count
    return np.asarray(values[: whole * count].reshape(whole, count, *values.shape[1:]).mean(axis=1))


def true_motion(trace: EpisodeTrace) -> Array:
    """Return the true mean velocity between the times of readings (T, 3) [m/s] in the heading frame.

    Readings were taken one control latency of the simulation before the time of their row.
    """
    rows = np.concatenate([[0.0], trace.time])
    at = rows - trace.meta["params"].get("control_latency", 0.0)
    place = np.stack([np.interp(at, rows, one) for one in trace.base_position_world.T], axis=-1)
    yaw = np.interp(at, rows, np.unwrap(quat_yaw(trace.base_quat_world)))
    velocity = np.diff(place, axis=0) / np.diff(rows)[:, None]
    return in_heading_frame(velocity, (yaw[:-1] + yaw[1:]) / 2)


def record_runs(
    name: str, world: str, episodes: int, seed: int, threads: int
) -> tuple[list[EpisodeTrace], RobotDescription]:
    """Return the runs of a case, on robots of table I, and the robot's description."""
    policy_name, terrain = CASES[name]
    policy, robot, task, _ = load_gait(find_policy(policy_name), None)
    ranges = load_ranges("table1", robot=robot.folder)
    run = Condition(randomize=ranges, duration=DURATION, terrain=terrain).apply(task, robot)
    return run_episodes(policy, run, episodes, find_world(world), seed, threads, world_name=world), robot


def measure(name: str, world: str, episodes: int, seed: int, threads: int) -> dict[str, Any]:
    """Return the errors in a case."""
    traces, robot = record_runs(name, world, episodes, seed, threads)
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
        "covered": round(errors.covered, 3),
    }


def update_times(name: str) -> Array:
    """Return the times of updates of one robot (STEPS,) [s]."""
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
    return np.array(times)


def compare_returns(robots: int) -> dict[str, Any]:
    """Deploy `POLICY` on emulated robots, one run each; return its gap from runs with motion capture to those without.

    Every robot has other parameters of table I, which the estimator does not know.
    """
    command = (sys.executable, "-m", "surefoot")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        port, measured, estimated = (folder / part for part in ("robot", "measured", "estimated"))
        for number in range(robots):
            capture = folder / f"{number}.csv"
            words: list[str | Path] = ["--lockstep", "--hidden-seed", str(number), "--symlink", port, "--out", capture]
            emulator = subprocess.Popen([*command, "emulate", *words], stdout=subprocess.PIPE, text=True)
            try:
                assert emulator.stdout is not None
                emulator.stdout.readline()
                words = ["--port", port, "--lockstep", "--duration", str(DURATION), "--out", measured]
                words += ["--motion-capture", capture]
                subprocess.run([*command, "deploy", POLICY, *words], check=True)
            finally:
                emulator.terminate()
                emulator.wait()
        for path in sorted(measured.glob("*.npz")):
            trace = EpisodeTrace.load(path)
            unknown = {name: np.full_like(getattr(trace, name), np.nan) for name in UNSEEN}
            replace(trace, **unknown).save(estimated / path.name)
        words = ["--from", "trace", measured, "--to", "trace", estimated, "--duration", str(DURATION)]
        gap: list[str | Path] = [*command, "gap", POLICY, *words, "--out", folder / "gap", "--json"]
        done = subprocess.run(gap, check=True, stdout=subprocess.PIPE, text=True)
        returns = [float(row["return"]) for row in read_csv(folder / "gap" / "episodes.csv")]
    output: dict[str, Any] = json.loads(done.stdout)
    home, away = output["policies"][0]["worlds"]
    ((low, high),) = (ends["return_mean"] for ends in output["estimated_intervals"][POLICY].values())
    pairs = np.array(returns).reshape(2, robots)
    return {
        "policy": POLICY,
        "robots": robots,
        "return_measured": round(home["return_mean"], 3),
        "return_estimated": round(away["return_mean"], 3),
        "low": round(low, 3),
        "high": round(high, 3),
        "difference": round(away["return_mean"] / home["return_mean"] - 1.0, 4),
        "rms_difference": round(float(np.sqrt(((pairs[1] / pairs[0] - 1.0) ** 2).mean())), 4),
    }


class AcceleratedOdometry:
    """Legged odometry that also gets the samples of the accelerometers in runs (N,) without missed steps."""

    def __init__(self, traces: Sequence[EpisodeTrace], robot: RobotDescription) -> None:
        self._odometry, self._traces, self._step = LeggedOdometry(robot, len(traces)), traces, 0

    def reset(self) -> None:
        """Begin again."""
        self._odometry.reset()
        self._step = 0

    def update(self, readings: MotionReadings) -> VelocityEstimate:
        """Return the estimate of the next control step; ended runs repeat their last sample."""
        force = np.array([trace.accelerometer[min(self._step, trace.num_steps - 1)] for trace in self._traces])
        self._step += 1
        return self._odometry.update(replace(readings, accelerometer=force))


def record_accelerometers(name: str, robots: int) -> tuple[list[EpisodeTrace], RobotDescription]:
    """Return runs of a case on emulated robots of table I that have an accelerometer, and the robot's description."""
    policy_name, terrain = CASES[name]
    _, robot, task, _ = load_gait(find_policy(policy_name), None)
    ranges, traces = load_ranges("table1", robot=robot.folder), []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(100, 100 + robots):
            params = draw_hidden(robot, ranges, seed)
            file, commands = Path(folder, f"{seed}.toml"), Path(folder, "commands.csv")
            write_params(file, robot, params)
            words: list[object] = ["--duration", DURATION]
            if task.commands.enabled:
                rows = [(k * DURATION / 4, *VELOCITIES[(seed + k) % len(VELOCITIES)]) for k in range(4)]
                write_csv(commands, [dict(zip(("time", *COMMANDS), row, strict=True)) for row in rows])
                words += ["--commands", commands]
            options = f"--robot {robot.name} --params {file} --terrain {terrain} --seed {seed} --accelerometer"
            (trace,) = deploy(policy_name, *words, robot=tuple(options.split()))
            known = {"control_latency": float(params.control_latency[0])}
            traces.append(replace(trace, meta={**trace.meta, "params": known}))
            print(f"{name}: robot {seed}, {trace.num_steps} steps, {trace.meta['ended']}", file=sys.stderr, flush=True)
    return traces, robot


def compare_accelerometer(name: str, robots: int) -> list[dict[str, Any]]:
    """Return the errors in a case without and with accelerometers."""
    traces, robot = record_accelerometers(name, robots)
    rows = []
    makers: dict[str, EstimatorFactory] = {
        "no": LeggedOdometry,
        "yes": lambda kind, _: AcceleratedOdometry(traces, kind),
    }
    for used, make in makers.items():
        errors = EstimationErrors.from_runs(traces, estimate_motion(traces, robot, make))
        rows.append(
            {
                "case": name,
                "accelerometer": used,
                "robots": robots,
                **dict(zip(("rmse_forward", "rmse_sideways", "rmse_up"), errors.rmse.round(4).tolist(), strict=True)),
                "distance_rmse": round(errors.distance_rmse, 4),
            }
        )
    return rows


def load() -> float:
    """Return the number of processes that use processors, mean of the last minute: others make updates slower."""
    return os.getloadavg()[0]


def main(command: Command) -> None:
    """Measure the cases that are asked for."""
    if command.cost:
        for name in ("minitaur", "go2"):
            low, median, high = 1e3 * np.quantile(update_times(name), (0.05, 0.5, 0.95))
            print(f"{name}: {median:.3f} ms an update, 5 % below {low:.3f}, 5 % above {high:.3f}; load {load():.1f}")
        return
    if command.emulated:
        row = compare_returns(command.emulated)
        print(*(f"{name} {value}" for name, value in row.items()), sep=", ")
        write_csv(command.out / "emulated.csv", [row])
        return
    path = command.out / ("accelerometer.csv" if command.accelerometer else "velocity.csv")
    table = read_csv(path)
    for name in command.cases:
        if name not in CASES:
            raise SystemExit(f"--cases {name} is no case; choose from {', '.join(CASES)}")
        if command.accelerometer:
            rows = compare_accelerometer(name, command.accelerometer)
        else:
            rows = [measure(name, command.world, command.episodes, command.seed, command.threads)]
        table = [row for row in table if row["case"] != rows[0]["case"]] + rows
        for row in rows:
            print(*row.values(), flush=True)
        write_csv(path, sorted(table, key=_place))


def _place(row: Mapping[str, Any]) -> tuple[bool, int]:
    """Return the sort key of a row: MuJoCo first, cases in their order."""
    case, _, world = str(row["case"]).partition("/")
    return bool(world), list(CASES).index(case)


if __name__ == "__main__":
    main(tyro.cli(Command))
