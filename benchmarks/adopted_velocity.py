"""What does the estimated velocity of the base cost an adopted policy that observes it?

    python benchmarks/adopted_velocity.py                    # writes results/adopted_velocity.csv
    python benchmarks/adopted_velocity.py --world bullet
    python benchmarks/adopted_velocity.py --policy mine.onnx # any policy adopted with --base-velocity estimate

The policy is robot_lab of rl_sar (`data/rl_sar`) with a velocity loop in its first layer: it observes the velocity v of
the base, and its network gets the command c + K (c - v) in place of c, for the speeds forward and to the left. It is
written as a network of 48 numbers in the format of rl_sar, and adopted. Each command of an examination by doctor goes
to the same number of robots, with the estimate, with the true velocity, and with a velocity of 0. Rows of the same
policy and world are replaced.
"""

from __future__ import annotations

import io
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import tyro
import yaml
from adopted_mistakes import ROOT
from onnx import helper, numpy_helper

from surefoot.adopt.adoption import adopt
from surefoot.adopt.examination import Change, TrialResult, TrueVelocity, examine, require_specification
from surefoot.adopt.mistakes import Correction
from surefoot.adopt.specification import PolicySpecification
from surefoot.adopt.torchscript_tracing import trace
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.tables import read_csv, write_csv
from surefoot.task.contract_mapping import task_from_contract

RESULTS = ROOT / "results" / "adopted_velocity.csv"
DATA = ROOT / "data" / "rl_sar"
GAIN = 1.0
"""Gain K of the velocity loop."""
NAME = "robot_lab-velocity"


@dataclass(frozen=True)
class Command:
    """Simulate, print and write."""

    policy: Path | None = None
    world: str = "mujoco"
    repeats: int = 8
    """Robots for each of the eight commands."""
    seed: int = 1
    threads: int = 1
    gain: float = GAIN
    out: Path = RESULTS


def add_velocity_loop(model: bytes, gain: float) -> bytes:
    """Return robot_lab's network with the velocity of the base as its first three inputs, and the velocity loop."""
    network = onnx.load_from_string(model)
    (inner,) = network.graph.input
    width = inner.type.tensor_type.shape.dim[-1].dim_value
    (table,) = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text()).values()
    # Angular velocity and gravity come before the command.
    assert table["observations"][:3] == ["ang_vel", "gravity_vec", "commands"]
    matrix = np.vstack([np.zeros((3, width)), np.eye(width)]).astype(np.float32)
    for axis in range(2):
        scale = table["commands_scale"][axis]
        matrix[axis, 6 + axis] = -gain * scale
        matrix[3 + 6 + axis, 6 + axis] = 1.0 + gain
    network.graph.initializer.append(numpy_helper.from_array(matrix, "velocity_loop"))
    network.graph.node.insert(0, helper.make_node("MatMul", ["observation_48", "velocity_loop"], [inner.name]))
    network.graph.input.remove(inner)
    network.graph.input.append(helper.make_tensor_value_info("observation_48", onnx.TensorProto.FLOAT, [1, width + 3]))
    data: bytes = network.SerializeToString()
    return data


def adopt_velocity_loop(robot: RobotDescription, gain: float) -> PolicyRuntime:
    """Write robot_lab with a velocity loop in rl_sar's format, and adopt it with the estimated velocity."""
    model, _ = trace(io.BytesIO((DATA / "robot_lab" / "policy.pt").read_bytes()), 45, 3)
    with tempfile.TemporaryDirectory() as folder:
        network, config = Path(folder) / "policy.onnx", Path(folder) / "config.yaml"
        network.write_bytes(add_velocity_loop(model, gain))
        table = yaml.safe_load((DATA / "robot_lab" / "config.yaml").read_text())
        (own,) = table.values()
        own["observations"] = ["lin_vel", *own["observations"]]
        config.write_text(yaml.safe_dump(table))
        (Path(folder) / "base.yaml").write_text((DATA / "base.yaml").read_text())
        changes = {"base_velocity": "estimate"}
        return PolicyRuntime.parse(adopt(network, "rl_sar", robot, NAME, config, changes).data)


def without_velocity(specification: PolicySpecification) -> Correction:
    """Return the specification with a velocity of 0."""
    terms = tuple(
        replace(term, scale=0.0) if term.term == "base_velocity" else term for term in specification.observations
    )
    return Correction("observations", "velocity 0", replace(specification, observations=terms))


def row_of(trial: TrialResult, source: str) -> dict[str, Any]:
    """Return the columns of a trial."""
    forward, sideways, yaw_rate = trial.errors.tolist()
    robots = trial.upright_fraction.size
    errors = {"forward": forward, "sideways": sideways, "yaw_rate": yaw_rate}
    return {"velocity": source, "robots": robots, "falls": trial.falls, **errors, "score": trial.score}


def main(command: Command) -> None:
    """Run the benchmark."""
    if command.policy is None:
        policy = adopt_velocity_loop(RobotDescription.load("go2"), command.gain)
    else:
        policy = PolicyRuntime.load(command.policy)
    robot = policy.load_robot()
    task = task_from_contract(policy.contract, robot)
    changes: list[Change | None] = [None, TrueVelocity(), without_velocity(require_specification(policy.contract))]
    trials = examine(
        policy, robot, task, changes, command.world, command.seed, command.threads, repeats=command.repeats
    )
    key = {"policy": policy.contract.name, "world": command.world}
    rows = [{**key, **row_of(trial, source)} for trial, source in zip(trials, ("estimated", "true", "0"), strict=True)]
    for row in rows:
        print("  ".join(f"{value:.3f}" if isinstance(value, float) else str(value) for value in row.values()))
    kept = [row for row in read_csv(command.out) if any(row[name] != value for name, value in key.items())]
    write_csv(command.out, [*kept, *rows])


if __name__ == "__main__":
    main(tyro.cli(Command))
