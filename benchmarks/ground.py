"""Ratio of the time of a physics step on terrain to that on flat ground, for robots with the same policy.

    python benchmarks/ground.py
    python benchmarks/ground.py stairs:0.10 stones:0.25 --world bullet

Only `world.step` is timed: servo, motors, physics, contacts and sensors. Robots start 4 m from the level area in the
middle of a terrain and follow the commands of the policy's task; robots that fall are reset. The grounds take turns of
one control step of all robots, so that other load on the machine affects all equally. The ratio is the median over
turns, with quartiles. If legs or trunks touch the ground, MuJoCo must solve additional contacts; with --feet-only, only
feet touch the ground.
"""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, replace
from typing import Annotated, Any, cast

import numpy as np
import tyro
from rounds import measure, ratio_quartiles

from surefoot.api.policies import find_policy
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.contract_mapping import task_from_contract
from surefoot.task.env import LocomotionEnv
from surefoot.world.interface import Simulation, WorldConfig
from surefoot.world.registry import find_world
from surefoot.world.terrain import make_terrain

AWAY = (4.1, 4.1)
"""Distance of the robots' start from the middle of a terrain [m]."""


@dataclass(frozen=True)
class Command:
    """Measure the time of physics steps on terrain and print it."""

    terrains: Annotated[tuple[str, ...], tyro.conf.Positional] = (
        "slope:10",
        "rough:0.12",
        "blocks:0.12",
        "stairs:0.08",
    )
    policy: str = "go2-terrain"
    world: str = "mujoco"
    num_envs: int = 64
    turns: int = 400
    feet_only: bool = False
    json: bool = False


class Walk:
    """Robots walking on a ground; a turn is one control step of all robots."""

    def __init__(self, terrain: str, command: Command) -> None:
        policy = PolicyRuntime.load(find_policy(command.policy))
        ground, make = make_terrain(terrain), find_world(command.world)
        if not ground.is_flat:
            ground = replace(ground, center=AWAY)

        def make_world(robot: Any, num_envs: int, params: Any, seed: int, config: WorldConfig) -> Simulation:
            return make(robot, num_envs, params, seed, replace(config, ground=ground))

        task = replace(task_from_contract(policy.contract), randomize={})
        self.env = LocomotionEnv(task, command.num_envs, cast(Any, make_world), seed=1, threads=1)
        self.env.state.ground = ground
        self.observation, _ = self.env.reset()
        self.policy, self.env_step = policy, self.env.world.step
        self.env.world.step = self._step  # type: ignore[method-assign]
        self.feet_only = command.feet_only
        self.ended, self.steps = 0, 0
        self.control = policy.contract.control_step / self.env.robot.timing.servo_step

    def _step(self, *arguments: Any, **options: Any) -> Any:
        if self.feet_only:
            native = cast(Any, self.env.world).engine._native
            native.clearance[:], native.moved[:] = np.inf, False
        start = time.process_time()
        readings = self.env_step(*arguments, **options)
        self.seconds = time.process_time() - start
        return readings

    def turn(self) -> tuple[int, float]:
        """Run one turn; return the number of physics steps and their time [s]."""
        action = self.env.gait.action(self.policy.feedback(self.observation))
        self.observation, _, ended, _, _ = self.env.step(action)
        self.ended, self.steps = self.ended + int(np.sum(ended)), self.steps + self.env.num_envs
        return round(self.env.num_envs * self.control), self.seconds


def main(command: Command) -> None:
    """Measure all grounds in turns."""
    walks = {terrain: Walk(terrain, command) for terrain in ("flat", *command.terrains)}
    layers = {terrain: walk.turn for terrain, walk in walks.items()}
    measure(layers, 100)  # until the robots walk
    rates = measure(layers, command.turns)
    rows: dict[str, dict[str, float]] = {}
    for name, walk in walks.items():
        high, middle, low = (1 / one for one in ratio_quartiles(rates, name, "flat"))
        rows[name] = {
            "us": 1e6 / float(np.median(rates[name])),
            "ratio": middle,
            "low": low,
            "high": high,
            "falls_per_100_s": 100 * walk.ended / (walk.steps * walk.policy.contract.control_step),
        }
        if not command.json:
            print(
                f"{name:16} {rows[name]['us']:6.2f} us a physics step, {middle:.3f} of flat ({low:.3f} to {high:.3f}); "
                f"{rows[name]['falls_per_100_s']:.1f} falls in 100 s",
                flush=True,
            )
    if command.json:
        print(json.dumps(rows))


if __name__ == "__main__":
    main(tyro.cli(Command, description=__doc__))
