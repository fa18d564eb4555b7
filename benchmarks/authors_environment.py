"""Physics steps per second of the paper authors' PyBullet environment, or the speed of policies in it.

    python benchmarks/authors_environment.py
    python benchmarks/authors_environment.py trot trot-robust --out results/authors_environment.csv

One process; needs `pybullet`. The environment was written in 2018 for gym, setuptools and protobuf of that time; this
script supplies what it needs of them.
"""

from __future__ import annotations

import argparse
import importlib
import os
import sys
import time
import types
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.api.policies import find_policy
from surefoot.arrays import Array
from surefoot.deploy.controller import Controller
from surefoot.policy.contract import Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.tables import write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.contract_mapping import task_from_contract


def install_legacy_stubs() -> None:
    """Install stubs of modules that the environment imports and that no longer exist; the timed loop uses none."""
    os.environ["PROTOCOL_BUFFERS_PYTHON_IMPLEMENTATION"] = "python"
    for name in ("", ".spaces", ".utils", ".utils.seeding", ".envs"):
        sys.modules[f"gym{name}"] = importlib.import_module(f"gymnasium{name}")
    registration: Any = types.ModuleType("gym.envs.registration")
    registration.registry = types.SimpleNamespace(env_specs={})
    registration.register = registration.make = registration.spec = lambda *_, **__: None
    sys.modules["gym.envs.registration"] = registration
    resources: Any = types.ModuleType("pkg_resources")
    resources.parse_version = importlib.import_module("packaging.version").Version
    sys.modules["pkg_resources"] = resources


def make_environment(**settings: Any) -> Any:
    """Return the authors' environment with settings of its constructor."""
    install_legacy_stubs()
    from pybullet_envs.minitaur.envs import minitaur_gym_env

    return minitaur_gym_env.MinitaurGymEnv(render=False, log_path=None, **settings)


def make_identified_environment(contract: Contract, **settings: Any) -> Any:
    """Return the authors' environment with their identified robot and motor model, and a policy's gains and delays."""
    return make_environment(
        urdf_version="rainbow_dash_v0",
        accurate_motor_model_enabled=True,
        motor_kp=contract.servo_kp,
        motor_kd=contract.servo_kd,
        control_latency=contract.control_latency,
        pd_latency=contract.servo_latency,
        control_time_step=contract.control_step,
        action_repeat=round(contract.control_step / 0.001),
        leg_model_enabled=False,
        **settings,
    )


def measure_rate(seconds: float = 5.0) -> float:
    """Return physics steps per second with the environment's defaults."""
    env = make_environment()
    env.reset()
    steps, start = 0, time.perf_counter()
    while time.perf_counter() - start < seconds:
        _, _, done, _ = env.step(np.array([0.1 * np.sin(0.1 * steps)] * 4 + [0.0] * 4))
        steps += 1
        if done:
            env.reset()
    rate: float = steps * env._action_repeat / (time.perf_counter() - start)
    return rate


def settle(env: Any, pose: Array, task: TaskConfig, draw: np.random.Generator) -> None:
    """Let the robot settle in a pose (M,) [rad], and start it with a random velocity as in surefoot's own episodes.

    Order and directions of motors are the same as in surefoot.
    """
    env.reset(initial_motor_angles=pose.tolist(), reset_duration=0.5)
    moved = draw.uniform(-task.start_linear_speed, task.start_linear_speed, 3)
    turned = draw.uniform(-task.start_angular_speed, task.start_angular_speed, 3)
    env._pybullet_client.resetBaseVelocity(env.minitaur.quadruped, moved.tolist(), turned.tolist())


def read_state(env: Any) -> Any:
    """Return what the control computer receives, with its latency, as the attributes of a robot's state."""
    bullet, seen = env._pybullet_client, np.asarray(env.minitaur._GetControlObservation())
    quat = seen[24:28] / np.linalg.norm(seen[24:28])
    base_to_world = np.array(bullet.getMatrixFromQuaternion(quat)).reshape(3, 3)
    return types.SimpleNamespace(
        motor_angle=seen[:8],
        motor_velocity=seen[8:16],
        roll_pitch_yaw=np.array(bullet.getEulerFromQuaternion(quat)),
        angular_velocity_base=base_to_world.T @ seen[28:31],
    )


def has_fallen(env: Any, task: TaskConfig) -> bool:
    """Return whether roll or pitch is beyond the task's fall angle."""
    return bool(np.abs(env.minitaur.GetTrueBaseRollPitchYaw()[:2]).max() > task.fall_angle)


def run_policy(env: Any, policy: PolicyRuntime, draw: np.random.Generator) -> tuple[float, bool]:
    """Return the speed [m/s] of a policy over an episode of its task, and whether it fell."""
    contract, robot = policy.contract, RobotDescription.load(policy.contract.robot)
    task, step = task_from_contract(contract), contract.control_step
    controller = Controller(policy, robot)
    settle(env, robot.pose_angles(*contract.rest), task, draw)
    start, k, fell = env.minitaur.GetBasePosition()[0], 0, False
    while k < task.max_steps and not fell:
        observation = controller.observe(k * step, read_state(env))
        env.minitaur.Step(controller.compute_target(k * step, observation))
        fell = has_fallen(env, task)
        k += 1
    return (env.minitaur.GetBasePosition()[0] - start) / (k * step), fell


def measure_policies(names: list[str], episodes: int, seed: int, out: Path) -> None:
    """Print and write speed and falls of policies with the authors' identified robot, motor model and latencies."""
    rows: list[dict[str, Any]] = []
    for name in names:
        policy = PolicyRuntime.load(find_policy(name))
        contract = policy.contract
        env = make_identified_environment(contract)
        draw = np.random.default_rng(seed)
        runs = [run_policy(env, policy, draw) for _ in range(episodes)]
        speeds = [speed for speed, _ in runs]
        row = {"policy": name, "episodes": episodes, "falls": sum(fell for _, fell in runs)}
        row |= {"speed_mean": np.mean(speeds), "speed_min": min(speeds), "speed_max": max(speeds)}
        print(*(f"{key} {value:.4g}" if key != "policy" else value for key, value in row.items()), flush=True)
        rows.append(row)
    write_csv(out, rows)


def main() -> int:
    """Print the environment's rate, or the speed of policies in it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("policy", nargs="*", help="policies to run there; without any, physics steps per second")
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=Path("authors_environment.csv"), help="table of policies to write")
    options = parser.parse_args()
    try:
        if options.policy:
            measure_policies(options.policy, options.episodes, options.seed, options.out)
        else:
            print(measure_rate())
    except ImportError as error:
        print(f"the authors' environment does not run here: {error!r}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
