"""Does a network estimate the velocity of the base better than legged odometry?

    python benchmarks/learned_velocity.py

A network is trained for each robot by regression on simulated runs with known velocity, from the last readings, as in
Ji et al. (2022, "Concurrent Training of a Control Policy and a State Estimator for Dynamic and Robust Legged
Locomotion"). It gets what the estimator gets (`surefoot.evaluation.estimated_motion`), on robots of table I, and is
trained on the policies and terrains on which it is tested, with other robots and commands. That is the best case for a
network: a real run has another robot, ground and gait. Both are compared on the runs of
benchmarks/velocity_estimation.py. Rows go to results/estimation/learned.csv.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from numpy.typing import NDArray
from torch import nn
from velocity_estimation import CASES, RESULTS, EstimationErrors, record_runs, true_motion

from surefoot.arrays import Array
from surefoot.evaluation.estimated_motion import EstimatedMotion, estimate_motion, run_readings, torque_delay
from surefoot.robot import RobotDescription
from surefoot.tables import write_csv
from surefoot.task.trace import EpisodeTrace

HISTORY = 12
"""Number of control steps whose readings the network gets: 0.2 s of a Go2."""
HIDDEN = (256, 128)
EPOCHS, BATCH, RATE = 8, 2048, 1e-3


@dataclass(frozen=True)
class Command:
    """Train, measure, print and write."""

    episodes: int = 128
    """Runs of each case, in training and in the test."""
    training_seed: int = 100
    seed: int = 1
    threads: int = 0
    out: Path = RESULTS


class Network(nn.Module):
    """Regression of the velocity in the heading frame [m/s] from normalized inputs.

    Args:
        inputs: inputs of the training (K, I).
    """

    def __init__(self, inputs: torch.Tensor) -> None:
        super().__init__()
        self.mean, self.std = inputs.mean(dim=0), inputs.std(dim=0) + 1e-6
        sizes = (inputs.shape[1], *HIDDEN)
        layers = [layer for pair in itertools.pairwise(sizes) for layer in (nn.Linear(*pair), nn.ELU())]
        self.layers = nn.Sequential(*layers, nn.Linear(HIDDEN[-1], 3))

    def forward(self, inputs: torch.Tensor) -> torch.Tensor:
        """Return velocities (K, 3) for inputs (K, I)."""
        output: torch.Tensor = self.layers((inputs - self.mean) / self.std)
        return output


def inputs_of(trace: EpisodeTrace, robot: RobotDescription) -> NDArray[np.float32]:
    """Return the inputs of a run (T, I): the readings of the last `HISTORY` steps, without the yaw."""
    values = run_readings(trace, np.arange(trace.num_steps), torque_delay(trace, robot))
    values |= {"duration": values["duration"][:, None], "roll_pitch_yaw": values["roll_pitch_yaw"][:, :2]}
    readings = np.concatenate(list(values.values()), axis=1).astype(np.float32)
    padded = np.concatenate([np.repeat(readings[:1], HISTORY - 1, axis=0), readings])
    return np.concatenate([padded[HISTORY - 1 - k :][: len(readings)] for k in range(HISTORY)], axis=1)


def train(traces: Sequence[EpisodeTrace], robot: RobotDescription, seed: int) -> Network:
    """Return a network trained on runs of a robot."""
    torch.manual_seed(seed)
    inputs = torch.from_numpy(np.concatenate([inputs_of(trace, robot) for trace in traces]))
    targets = torch.from_numpy(np.concatenate([true_motion(trace) for trace in traces]).astype(np.float32))
    network = Network(inputs)
    optimizer = torch.optim.Adam(network.parameters(), RATE)
    steps = EPOCHS * (len(inputs) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=steps)
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(inputs)).split(BATCH)[: len(inputs) // BATCH]:
            loss = (network(inputs[rows]) - targets[rows]).square().mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network


def predict(network: Network, traces: Sequence[EpisodeTrace], robot: RobotDescription) -> list[EstimatedMotion]:
    """Return the velocities that a network estimates; variance, height and contacts have no meaning."""
    motions = []
    for trace in traces:
        with torch.no_grad():
            velocity: Array = network(torch.from_numpy(inputs_of(trace, robot))).numpy().astype(float)
        steps, legs = len(velocity), trace.foot_contact.shape[1]
        motions.append(
            EstimatedMotion(trace.time, velocity, np.ones((steps, 3)), np.zeros(steps), np.zeros((steps, legs)))
        )
    return motions


def main(command: Command) -> None:
    """Compare both in all cases of each robot."""
    robots: dict[str, tuple[RobotDescription, dict[str, list[EpisodeTrace]]]] = {}
    for name in CASES:
        traces, robot = record_runs(name, "mujoco", command.episodes, command.training_seed, command.threads)
        robots.setdefault(robot.name, (robot, {}))[1][name] = traces
    rows: list[dict[str, Any]] = []
    for robot, cases in robots.values():
        network = train([trace for traces in cases.values() for trace in traces], robot, command.seed)
        for name in cases:
            traces, _ = record_runs(name, "mujoco", command.episodes, command.seed, command.threads)
            motions = {"odometry": estimate_motion(traces, robot), "network": predict(network, traces, robot)}
            for kind, motion in motions.items():
                errors = EstimationErrors.from_runs(traces, motion)
                forward, sideways, _ = errors.rmse.round(4).tolist()
                row = {"case": name, "estimator": kind, "episodes": len(traces), "rmse_forward": forward}
                row |= {"rmse_sideways": sideways, "distance_rmse": round(errors.distance_rmse, 4)}
                print(*row.values(), flush=True)
                rows.append(row)
            write_csv(command.out / "learned.csv", rows)


if __name__ == "__main__":
    main(tyro.cli(Command))
