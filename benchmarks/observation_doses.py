"""Offsets of encoders, latency, and no observation at all: what they do to trots and to the gallop.

    python benchmarks/observation_doses.py

The paper's policies with few observations did better on the robot than those with motor angles. A reason would be
encoders that are off, or readings that are late. Here each takes several values, and nothing else differs from the
simulation of the training:

    offset     each encoder is off by a constant angle, drawn between minus and plus the dose [rad]
    latency    readings at the control computer are this old [s]
    constant   the policy receives the mean of its own observations, always the same (no dose)

Policies are the trots of the study results/reality-gap without and with randomization, four trainings for each set of
observations: 4-D (roll, pitch and their rates) and 12-D (motor angles in addition). Latency and constant observations
also change the released gaits trot, trot-robust, gallop and gallop-robust. Every policy runs the same starts in MuJoCo,
without pushes. Rows go to doses.csv, one per policy and dose; a second call runs only missing ones.
"""

from __future__ import annotations

import tarfile
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from numpy.typing import ArrayLike, NDArray

from surefoot.api.policies import find_policy, load_policy
from surefoot.arrays import Array
from surefoot.configuration import from_mapping
from surefoot.evaluation.conditions import undisturbed_task
from surefoot.evaluation.rollout import Controller, run_to_end
from surefoot.evaluation.statistics import Interval, difference_interval, t_interval
from surefoot.tables import print_table, read_csv, write_csv
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

GROUPS = {"small_plain": "4-D", "large_plain": "12-D", "small_randomized": "4-D", "large_randomized": "12-D"}
"""Groups of the study, and their observations."""
RELEASED = ("trot", "trot-robust", "gallop", "gallop-robust")
DOSES: dict[str, tuple[float, ...]] = {
    "offset": (0.0, 0.02, 0.05, 0.1),
    "latency": (0.0, 0.02, 0.04, 0.06, 0.08, 0.1),
    "constant": (0.0,),
}
"""Doses by kind: rad, s, none."""
SEED = 62


@dataclass(frozen=True)
class Command:
    """Run missing policies and doses, write the rows and print the tables."""

    folder: Annotated[Path, tyro.conf.Positional] = Path("results/observations")
    """Folder of the results."""
    archive: Path = Path("results/reality-gap/runs.tar.xz")
    """Archive of the study with the trots."""
    episodes: int = 8
    """Starts of each policy and dose."""
    threads: int = 0
    """Threads of the simulation; 0: one per core."""


class ConstantObservation:
    """Controller that answers every observation as it would answer one.

    Args:
        policy: the controller.
        observation: the observation (O * history,).
    """

    def __init__(self, policy: Controller, observation: Array) -> None:
        self._feedback = policy.feedback(np.asarray(observation, np.float32)[None])

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the same feedback (N, A) for any observations (N, O * history)."""
        return np.repeat(self._feedback, len(np.asarray(observation)), axis=0)


def with_dose(task: TaskConfig, kind: str, dose: float) -> TaskConfig:
    """Return a task whose robots have an offset of their encoders, or another latency of readings."""
    if kind == "latency":
        return replace(task, params={**task.params, "control_latency": dose})
    if kind == "offset" and dose:
        return from_mapping(TaskConfig, {"randomize": {"motor_offset": [-dose, dose]}}, base=task)
    return task


def run(policy: Controller, task: TaskConfig, command: Command) -> tuple[dict[str, Any], Array]:
    """Run a policy from all starts; return its row and the mean of its observations (O * history,)."""
    env = LocomotionEnv(task, command.episodes, SimWorld, SEED, autoreset=False, threads=command.threads)
    observation, _ = env.reset()
    seen: list[Array] = []

    def act(observation: NDArray[np.float32]) -> Array:
        seen.append(observation[~env.state.over].mean(axis=0))
        return env.gait.action(policy.feedback(observation))

    runs = run_to_end(act, env, observation)
    row = {
        "episodes": command.episodes,
        "falls": int((~runs.balanced).sum()),
        "return": round(float(runs["return"].mean()), 4),
        "speed": round(float(runs.speed.mean()), 4),
    }
    return row, np.mean(seen, axis=0)


def policies(archive: Path, folder: Path) -> Iterator[tuple[dict[str, Any], Path]]:
    """Yield group, observations and seed of every policy, and its file; trots are extracted to a folder."""
    with tarfile.open(archive) as file:
        wanted = [one for one in file if one.name.endswith("policy.onnx") and Path(one.name).parts[1] in GROUPS]
        file.extractall(folder, wanted, filter="data")
    for one in sorted(wanted, key=lambda one: one.name):
        group, seed = Path(one.name).parts[1:3]
        yield (
            {"group": group, "observations": GROUPS[group], "seed": int(seed.removeprefix("seed_"))},
            folder / one.name,
        )
    for name in RELEASED:
        yield {"group": name, "observations": "", "seed": 0}, find_policy(name)


def measure(command: Command) -> list[dict[str, Any]]:
    """Run what is missing in the file of rows, and return all rows."""
    path = command.folder / "doses.csv"
    rows = read_csv(path)
    known = {(row["group"], int(row["seed"]), row["kind"], float(row["dose"])) for row in rows}
    with tempfile.TemporaryDirectory() as temporary:
        for about, path_of in policies(command.archive, Path(temporary)):
            policy, _, own = load_policy(path_of, None)
            task, mean = undisturbed_task(own), None
            for kind, doses in DOSES.items():
                if kind == "offset" and about["group"] in RELEASED:
                    continue
                for dose in doses:
                    if (about["group"], about["seed"], kind, dose) in known:
                        continue
                    controller: Controller = policy
                    if kind == "constant":
                        mean = run(policy, task, command)[1] if mean is None else mean
                        controller = ConstantObservation(policy, mean)
                    row, _ = run(controller, with_dose(task, kind, dose), command)
                    rows.append({**about, "kind": kind, "dose": dose, **row})
                    write_csv(path, rows)
            print(f"{about['group']}, seed {about['seed']}: done", flush=True)
    return rows


def text(interval: Interval) -> str:
    """Return a mean and its 95 % interval, with two decimals."""
    return f"{interval.mean:.2f} [{interval.low:.2f}, {interval.high:.2f}]"


def print_doses(rows: list[dict[str, Any]]) -> None:
    """Print means of groups over trainings, and the difference between 12-D and 4-D."""

    def values(column: str, group: str, kind: str, dose: float) -> list[float]:
        """Return a column for each training of a group."""
        place = (group, kind, dose)
        return [float(row[column]) for row in rows if (row["group"], row["kind"], float(row["dose"])) == place]

    table = []
    for kind, doses in DOSES.items():
        for dose in doses:
            for small, large in (("small_plain", "large_plain"), ("small_randomized", "large_randomized")):
                one, two = values("return", small, kind, dose), values("return", large, kind, dose)
                fallen = [sum(values("falls", group, kind, dose)) for group in (small, large)]
                table.append(
                    {
                        "kind": kind,
                        "dose": f"{dose:g}",
                        "groups": small.removeprefix("small_"),
                        "4-D (m)": text(t_interval(one)),
                        "12-D (m)": text(t_interval(two)),
                        "12-D less 4-D (m)": text(difference_interval((two, one))),
                        "falls": f"{fallen[0]:g}, {fallen[1]:g}",
                    }
                )
    print_table(table, "Mean return over trainings, with 95 % intervals", text_columns=3)
    print_table(
        [
            {
                "gait": name,
                "kind": kind,
                "dose": f"{dose:g}",
                "return (m)": f"{values('return', name, kind, dose)[0]:.2f}",
                "falls": f"{values('falls', name, kind, dose)[0]:g}",
            }
            for name in RELEASED
            for kind in ("latency", "constant")
            for dose in DOSES[kind]
        ],
        "Released gaits",
        text_columns=3,
    )


if __name__ == "__main__":
    print_doses(measure(tyro.cli(Command)))
