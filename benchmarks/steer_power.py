"""Power balance of a steered gait: a policy at 0.5 m/s straight ahead, on robots that differ in one parameter.

    python benchmarks/steer_power.py go2-steer --out results/steer/power.csv

Means over time and four robots from 1.5 s to 5 s, of every servo step, with the torque t and speed w of each motor [W]:

    mechanical   |sum of t w|, as in rewards and evaluations
    net          sum of t w; the excess of mechanical is exchanged with inertia, springs and weight
    coulomb      Coulomb friction in the joints, f |w|
    viscous      viscous friction in the joints, b w^2
    rest         net minus both: impacts, sliding feet, the ground
    abduction, hip, knee    parts of net
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from surefoot.api.policies import find_policy, load_gait
from surefoot.tables import print_table, write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.registry import find_world

ROBOTS = 4
START, END = 1.5, 5.0
JOINTS = ("abduction", "hip", "knee")
CONDITIONS: dict[str, dict[str, float]] = {
    "as trained": {},
    "no Coulomb friction": {"motor_friction": 0.0},
    "Coulomb friction 0.365 N m": {"motor_friction": 0.365},
    "no viscous friction": {"motor_viscous_friction": 0.0},
    "rotors 0.00712 kg m2": {"rotor_inertia": 0.00712},
    "friction and rotors of `fitted`": {
        "motor_friction": 0.365,
        "motor_viscous_friction": 0.285,
        "rotor_inertia": 0.00712,
    },
    "gains 50, 1.43": {"servo_kp": 50.0, "servo_kd": 1.43},
    "gains 35, 1": {"servo_kp": 35.0, "servo_kd": 1.0},
}
"""Changes of physical parameters relative to the policy's task, by condition."""


@dataclass(frozen=True)
class Command:
    """Measure, print the table and write it."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ("go2-steer",)
    """Names of released policies, or policy files."""
    speed: float = 0.5
    """Command [m/s]."""
    out: Path | None = None
    """CSV file."""


@dataclass
class Meter:
    """Sums of powers over servo steps [W]."""

    sums: dict[str, float] = field(default_factory=dict)
    steps: int = 0

    def add(self, world: Any, speed: np.ndarray) -> None:
        """Add the last servo step; `speed` (N, M) [rad/s] is the motor speed at its start."""
        state = world.actuation
        work = state.motor_torque * speed
        parts = {
            "mechanical": np.abs(work.sum(1)),
            "net": work.sum(1),
            "coulomb": (state.friction * np.tanh(speed / 0.1) * speed).sum(1),
            "viscous": (state.viscous * speed**2).sum(1),
        }
        parts |= {name: work[:, k::3].sum(1) for k, name in enumerate(JOINTS)}
        for name, values in parts.items():
            self.sums[name] = self.sums.get(name, 0.0) + float(values.mean())
        self.steps += 1

    def means(self) -> dict[str, float]:
        """Return the means over time."""
        means = {name: value / self.steps for name, value in self.sums.items()}
        return means | {"rest": means["net"] - means["coulomb"] - means["viscous"]}


def measure(policy: Any, task: TaskConfig, speed: float) -> dict[str, float]:
    """Return speed [m/s], falls and powers [W]."""
    commands = replace(task.commands, each=((speed, 0.0, 0.0),), ramp=0)
    task = replace(task, commands=commands, randomize={}, pushes=task.pushes.for_evaluation(False))
    env = LocomotionEnv(task, ROBOTS, find_world("mujoco"), 1, autoreset=False, threads=1)
    observation, _ = env.reset()
    world: Any = env.world
    motors, advance, meter, way = world.robot.num_motors, world.engine.advance, Meter(), 0.0

    def advance_and_measure(servo_steps: np.ndarray) -> None:
        for k in range(int(servo_steps.max(initial=0))):
            velocity = world.actuation.sample[:, motors : 2 * motors].copy()
            advance((servo_steps > k).astype(np.int64))
            if env.state.readings.time[0] >= START:
                meter.add(world, velocity)

    world.engine.advance = advance_and_measure
    while env.state.readings.time[0] < END and not env.state.over.any():
        before = env.state.truth.base_position_world[:, 0].copy()
        counts = env.state.readings.time[0] >= START
        observation, *_ = env.step(env.gait.action(policy.feedback(observation)))
        way += counts * float((env.state.truth.base_position_world[:, 0] - before).mean())
    del world.engine.advance
    return {"speed": way / (END - START), "falls": float(env.state.over.sum()), **meter.means()}


def main(command: Command) -> None:
    rows = []
    for name in command.policies:
        policy, _, task, _ = load_gait(find_policy(name), None)
        for condition, params in CONDITIONS.items():
            row = measure(policy, replace(task, params={**task.params, **params}), command.speed)
            rows.append({"policy": Path(name).stem, "condition": condition, **row})
    print_table([{key: f"{one:.3g}" if isinstance(one, float) else one for key, one in row.items()} for row in rows])
    if command.out is not None:
        write_csv(command.out, rows)


if __name__ == "__main__":
    main(tyro.cli(Command))
