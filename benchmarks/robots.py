"""Simulation cost of robots, and check that their physics step is short enough, with one policy each.

    python benchmarks/robots.py trot go2-trot runs/mine-trot/*/policy.onnx
    python benchmarks/robots.py trot solo8-trot go2-trot pupper_v2-trot --turns 0 --episodes 20 --out results/robots.csv

For each policy: physics steps per second of `world`, `env` and `train` relative to `bare` (see
benchmarks/throughput.py); and the policy's speed with its robot's physics step and with half of it, which must agree
within 3 %. Control step and latencies are the same.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from rounds import measure, ratio_quartiles
from throughput import Bench

from surefoot.api.policies import find_policy
from surefoot.evaluation.conditions import undisturbed_task
from surefoot.evaluation.rollout import run_episodes
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.tables import write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract
from surefoot.world.sim_world import SimWorld

WITHIN = 0.03
"""Maximum relative change of the speed with half the physics step."""


def speed_and_falls(policy: PolicyRuntime, task: TaskConfig, episodes: int) -> tuple[float, int]:
    """Return the mean ground speed [m/s] and the number of falls."""
    traces = run_episodes(policy, task, episodes, SimWorld, seed=1)
    moved = [(trace.base_position_world[-1, 0] - trace.base_position_world[0, 0]) / trace.time[-1] for trace in traces]
    return float(np.mean(moved)), sum(trace.meta["ended"] == "fall" for trace in traces)


def with_half_step(robot: RobotDescription, folder: Path) -> Path:
    """Write a copy of a robot whose physics step is half as long; return its folder."""
    copy = folder / robot.name
    shutil.copytree(robot.folder, copy, ignore=shutil.ignore_patterns("__pycache__"))
    sheet, half = (copy / "robot.toml").read_text(), f"servo_step = {robot.timing.servo_step / 2:g}"
    text, count = re.subn(r"^servo_step = [^ \n#]+", half, sheet, flags=re.M)
    if not count:
        text = re.sub(r"^\[timing\]$", f"[timing]\n{half}", sheet, flags=re.M) if "[timing]" in sheet else ""
        text = text or f"{sheet}\n[timing]\n{half}\n"
    (copy / "robot.toml").write_text(text)
    assert RobotDescription.load(copy).timing.servo_step == robot.timing.servo_step / 2
    return copy


def measure_robot(name: str, episodes: int, num_envs: int, turns: int, rounds: int) -> dict[str, float | str]:
    """Return one policy's row."""
    policy = PolicyRuntime.load(find_policy(name))
    task = undisturbed_task(task_from_contract(policy.contract))
    robot = RobotDescription.load(task.robot)
    row: dict[str, float | str] = {"policy": name, "robot": robot.name, "step": robot.timing.servo_step}
    row["speed"], row["falls"] = speed_and_falls(policy, task, episodes)
    with tempfile.TemporaryDirectory() as folder:
        half = replace(task, robot=str(with_half_step(robot, Path(folder))))
        row["speed_half_step"], row["falls_half_step"] = speed_and_falls(policy, half, episodes)
    row["change"] = abs(float(row["speed_half_step"]) / float(row["speed"]) - 1.0)
    if not turns:
        return row
    bench = Bench(num_envs, 100, 1, name, "trot")
    rates = measure({"bare": bench.bare, "world": bench.world, "env": bench.environment}, turns)
    row |= {layer: ratio_quartiles(rates, layer, "bare")[1] for layer in ("world", "env")}
    if rounds:
        bench.make_long()
        rates = measure({"bare": bench.whole_bare, "train": bench.train}, rounds)
        row["train"] = ratio_quartiles(rates, "train", "bare")[1]
    return row


def main() -> int:
    """Print a line for each policy; exit code 1 if half the step changes a speed by more than 3 %."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policies", nargs="+", help="policy files, or names of released policies")
    parser.add_argument("--episodes", type=int, default=5)
    parser.add_argument("--num-envs", type=int, default=256)
    parser.add_argument("--turns", type=int, default=200, help="turns of the layers; 0 leaves them out")
    parser.add_argument("--rounds", type=int, default=5, help="updates of training; 0 leaves them out")
    parser.add_argument("--json", action="store_true", help="print one JSON object per policy")
    parser.add_argument("--out", type=Path, help="file for the rows (.csv)")
    options = parser.parse_args()
    worst, rows = 0.0, []
    for name in options.policies:
        row = measure_robot(name, options.episodes, options.num_envs, options.turns, options.rounds)
        rows.append(row)
        worst = max(worst, float(row["change"]))
        formatted = {key: f"{value:.4g}" if isinstance(value, float) else value for key, value in row.items()}
        print(
            json.dumps(row) if options.json else "  ".join(f"{key} {value}" for key, value in formatted.items()),
            flush=True,
        )
    if options.out:
        write_csv(options.out, rows)
    return int(not worst <= WITHIN)


if __name__ == "__main__":
    raise SystemExit(main())
