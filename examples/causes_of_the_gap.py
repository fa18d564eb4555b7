"""Find causes of a gait's difference between two simulators: change one physical property at a time in one world.

    python examples/causes_of_the_gap.py gallop --world bullet

Prints speed, power, balanced runs and the fraction of time that feet are on the ground, for the unchanged world and for
each change. A change that shifts the speed by as much as the worlds differ may be a cause.
"""

from __future__ import annotations

import json
import re
import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import tyro

from surefoot.api.policies import find_policy, load_policy
from surefoot.evaluation.conditions import data_sheet_task
from surefoot.evaluation.rollout import run_episodes
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.world.interface import SimulationFactory, WorldConfig
from surefoot.world.registry import find_world

FOOT_RADIUS = 0.02  # m, instead of 0.0085


@dataclass(frozen=True)
class Change:
    """Change of one property of the robot description."""

    name: str
    params: dict[str, float | tuple[float, ...]] = field(default_factory=dict)
    contact: dict[str, float] = field(default_factory=dict)
    thick_feet: bool = False
    thermal_protection: bool = False


CHANGES = (
    Change("as described"),
    # Also in the data sheet's contact, because robots settle with it before an episode.
    Change("foot stiffness x 10", params={"contact_stiffness": 30_000.0}, contact={"stiffness": 30_000.0}),
    Change("foot stiffness / 2", params={"contact_stiffness": 1500.0}, contact={"stiffness": 1500.0}),
    Change("foot damping x 3", contact={"damping": 300.0}),
    Change("foot damping / 3", contact={"damping": 33.0}),
    Change("no spinning friction", contact={"spinning_friction": 0.0}),
    Change("feet of radius 20 mm", thick_feet=True),
    Change("friction 1.0 -> 0.5", params={"contact_friction": 0.5}),
    Change("motor strength 0.8", params={"motor_strength": 0.8}),
    Change("battery 14 V", params={"voltage": 14.0}),
    Change("motor friction 0.05 N m", params={"motor_friction": 0.05}),
    Change("thermal protection", thermal_protection=True),
    Change("leg inertia x 1.5", params={"leg_inertia_ratio": 1.5}),
    Change("base inertia x 1.5", params={"base_inertia_ratio": 1.5}),
    Change("base mass x 1.2", params={"base_mass_ratio": 1.2}),
)


@dataclass(frozen=True)
class Command:
    """Run a policy in one world with one physical property changed at a time."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY [POLICY ...]")]
    """Policy files, or names of released policies."""
    world: str = "bullet"
    """mujoco or bullet."""
    episodes: int = 3
    """Episodes per change."""
    seed: int = 1
    """Seed of all random numbers."""
    json: bool = False
    """Print one JSON object."""


def thick_feet(robot: RobotDescription, folder: Path) -> RobotDescription:
    """Return the robot with larger foot radii; the lowest point along the leg stays the same."""
    shutil.copytree(robot.folder, folder)
    radius, end = robot.five_bar.foot_radius, robot.five_bar.foot
    sheet, urdf = folder / "robot.toml", folder / robot.urdf.path.name
    sheet.write_text(re.sub(r"foot_radius = \S+", f"foot_radius = {FOOT_RADIUS}", sheet.read_text()))
    text = urdf.read_text().replace(f'<sphere radius="{radius}"/>', f'<sphere radius="{FOOT_RADIUS}"/>')
    urdf.write_text(text.replace(f'xyz="0 0 {end - radius:.4f}"', f'xyz="0 0 {end - FOOT_RADIUS:.4f}"'))
    return RobotDescription.load(folder)


def changed(make: SimulationFactory, change: Change, other: RobotDescription | None) -> SimulationFactory:
    """Return a factory of the world with another contact or another robot."""

    def world(robot: RobotDescription, num_envs: int, params: PhysicalParams, seed: int, config: WorldConfig) -> Any:
        robot = other or replace(robot, contact=replace(robot.contact, **cast(Any, change.contact)))
        return make(robot, num_envs, params, seed, config)

    return world


def measure(command: Command, name: str) -> Iterator[dict[str, Any]]:
    """Yield one row of metrics per change."""
    policy, robot, task = load_policy(find_policy(name), None)
    base, make = data_sheet_task(task), find_world(command.world)
    with tempfile.TemporaryDirectory() as scratch:
        for change in CHANGES:
            other = thick_feet(robot, Path(scratch) / "thick") if change.thick_feet else None
            varied = replace(base, params=change.params, thermal_protection=change.thermal_protection)
            world = changed(make, change, other)
            traces = run_episodes(policy, varied, command.episodes, world, command.seed, world_name=command.world)
            runs = measure_runs(traces)
            yield {
                "policy": policy.contract.name,
                "change": change.name,
                "speed": runs.speed.tolist(),
                "power": runs.power.tolist(),
                "steps": runs.steps.tolist(),
                "balanced": int(runs.balanced.sum()),
                "contact": float(np.mean([trace.foot_contact.mean() for trace in traces])),
            }


def run(command: Command) -> None:
    """Measure all changes and print the table."""
    if not command.json:
        print(f"{'policy':<14} {'change, in ' + command.world:<26} speed m/s   power W   balanced   feet on ground")
    rows = []
    for name in command.policies:
        for row in measure(command, name):
            rows.append(row)
            if not command.json:
                speed, power = np.mean(row["speed"]), np.mean(row["power"])
                print(
                    f"{row['policy']:<14} {row['change']:<26} {speed:9.2f} {power:9.1f} "
                    f"{row['balanced']:>6} of {command.episodes} {100 * row['contact']:10.0f} %",
                    flush=True,
                )
    if command.json:
        print(json.dumps({"world": command.world, "runs": command.episodes, "seed": command.seed, "rows": rows}))


if __name__ == "__main__":
    run(tyro.cli(Command))
