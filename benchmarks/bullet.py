"""Control steps per second of the Bullet world, relative to Bullet's bare steps and to the MuJoCo world.

    bare      only `stepSimulation`, replaying the torques recorded from `one`: the same robots with the same motion
    one       the Bullet world in one process, including servo, motor, delays, sensors and contacts
    all       the Bullet world on all cores
    mujoco 1  the MuJoCo world on one thread, galloping with the same policy
    mujoco    the MuJoCo world on all cores

They are timed in turn over several rounds, and the median is reported. A control step is one of a single robot, with 6
physics steps. `one` is compared with `bare` on one core, `all` with `one`, and each Bullet world with the MuJoCo world
on the same number of cores.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from typing import Any, cast

import numpy as np
from rounds import measure, median_ratio

from surefoot.api.policies import find_policy
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import PhysicalParams
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.world.bullet_model import import_pybullet
from surefoot.world.interface import Simulation, SimulationFactory, WorldConfig
from surefoot.world.registry import find_world


class Bench:
    """Worlds that are set up once; a method for each runs it and returns (control steps, seconds)."""

    def __init__(self, num_envs: int, steps: int, processes: int) -> None:
        self.num_envs, self.steps = num_envs, steps
        self.policy = PolicyRuntime.load(find_policy("gallop"))
        mujoco, bullet = find_world("mujoco"), find_world("bullet")
        self.bullet_targets = self._targets(bullet)
        self.mujoco_targets = self._targets(mujoco)
        self.one_world = self._make(bullet, 1)
        self.all_world = self._make(bullet, processes)
        self.mujoco_one = self._make(mujoco, 1)
        self.mujoco_all = self._make(mujoco, processes)
        self.servo_steps = round(self.policy.contract.control_step / self.robot.timing.servo_step)
        self.torques, self.final = self._record_torques()
        self.bare_world = self._make(bullet, 1)

    def _targets(self, make_world: SimulationFactory) -> np.ndarray:
        """Return the motor angles (steps, N, M) that the policy commands in a world."""
        task = task_from_contract(self.policy.contract)
        env = LocomotionEnv(task, self.num_envs, make_world, seed=1, threads=1)
        self.robot = env.robot
        observation, _ = env.reset(seed=1)
        targets, world = [], cast(Any, env.world)
        for _ in range(self.steps):
            observation, *_ = env.step(env.gait.action(self.policy.feedback(observation)))
            targets.append(world.actuation.target.copy())
        return np.array(targets)

    def _make(self, make_world: SimulationFactory, threads: int) -> Simulation:
        params = PhysicalParams.nominal(self.robot, self.num_envs)
        return make_world(self.robot, self.num_envs, params, 1, WorldConfig(threads=threads))

    def _record_torques(self) -> tuple[np.ndarray, np.ndarray]:
        """Return joint torques (control steps x servo steps, N, M) of the Bullet world, and final robot positions."""
        world: Any = self._make(find_world("bullet"), 1)
        world.params.control_step[:] = self.robot.timing.servo_step
        torques = []
        for target in self.bullet_targets:
            for _ in range(self.servo_steps):
                world.step(target)
                torques.append(world.actuation.torque * self.robot.motor_sign)
        return np.array(torques), world.truth().base_position_world

    def bare(self) -> tuple[int, float]:
        """Replay the recorded torques; only the time in `stepSimulation` counts."""
        p, world = import_pybullet(), self.bare_world
        world.reset()
        engine: Any = world.engine  # type: ignore[attr-defined]
        motors, body, seconds = engine.models[0].motors, engine.models[0].body, 0.0
        for torques in self.torques:
            for model, torque in zip(engine.models, torques.tolist(), strict=True):
                client = model.client
                p.setJointMotorControlArray(body, motors, p.TORQUE_CONTROL, forces=torque, physicsClientId=client)
                start = time.perf_counter()
                p.stepSimulation(client)
                seconds += time.perf_counter() - start
        for i in range(self.num_envs):
            engine._rows[i] = engine._read(i, engine._joints)[: engine._rows.shape[1]]
        self.replay_error = float(np.abs(world.truth().base_position_world - self.final).max())
        return self.num_envs * self.steps, seconds

    def _run(self, world: Simulation, targets: np.ndarray) -> tuple[int, float]:
        world.reset()
        start = time.perf_counter()
        for target in targets:
            world.step(target)
        return self.num_envs * len(targets), time.perf_counter() - start

    def one(self) -> tuple[int, float]:
        return self._run(self.one_world, self.bullet_targets)

    def all(self) -> tuple[int, float]:
        return self._run(self.all_world, self.bullet_targets)

    def mujoco_1(self) -> tuple[int, float]:
        return self._run(self.mujoco_one, self.mujoco_targets)

    def mujoco(self) -> tuple[int, float]:
        return self._run(self.mujoco_all, self.mujoco_targets)


def main() -> int:
    """Run all worlds and print rates and ratios."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--num-envs", type=int, default=16)
    parser.add_argument("--steps", type=int, default=100, help="control steps of each robot")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--processes", type=int, default=os.cpu_count() or 1)
    options = parser.parse_args()
    bench = Bench(options.num_envs, options.steps, options.processes)
    layers = {
        "bare": bench.bare,
        "one": bench.one,
        "all": bench.all,
        "mujoco 1": bench.mujoco_1,
        "mujoco": bench.mujoco,
    }
    rates = measure(layers, options.rounds)
    result: dict[str, Any] = {name: statistics.median(values) for name, values in rates.items()}
    pairs = [("one", "bare"), ("all", "one"), ("one", "mujoco 1"), ("all", "mujoco")]
    for name, base in pairs:
        result[f"{name} of {base}"] = median_ratio(rates, name, base)
    result["replay_error_m"] = bench.replay_error
    if options.json:
        print(json.dumps(result))
        return 0
    print(f"{options.num_envs} robots, {options.processes} processes, median of {options.rounds} rounds")
    for name in layers:
        ratio = ", ".join(f"{result[f'{a} of {b}']:.3g} of {b}" for a, b in pairs if a == name)
        spread = f"({min(rates[name]):,.0f} to {max(rates[name]):,.0f})"
        print(f"  {name:9} {result[name]:>9,.0f} control steps/s {spread:22} {ratio}")
    print(f"  the bare engine's replay ends within {result['replay_error_m']:.1e} m of the world's motion")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
