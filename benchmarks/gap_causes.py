"""Which difference between a robot and its identified simulation makes a policy return less on the robot?

    python benchmarks/gap_causes.py --runs runs/identified

The hidden robots of a study (`surefoot study run`) differ from the simulations in which their policies were trained by
errors of the identification, by effects that no experiment finds, by motors of another family, and by the physics
engine. Each policy of a group runs on its robot as it is, and then with one difference taken away at a time: the
parameters of a group as identified (of motors: with the data sheet's motors), or the effects that no experiment finds,
such as play, at their nominal values. Without any difference only the engine is another one. --out has one row per
robot and variant, with means over policies and starts; the tables that are printed have means over robots.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import tyro
from rich.progress import track

from surefoot.errors import SurefootError
from surefoot.evaluation.conditions import undisturbed_task
from surefoot.evaluation.runs import measure_runs
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.actuator import nominal_params
from surefoot.robot.params import CONTROLLER_PARAMETERS, PARAMETER_GROUPS, PARAMETERS
from surefoot.robot.params_file import ParamsFile, ParamValue, param_values
from surefoot.studies.evaluations import GAP_SEED, EvaluationRun
from surefoot.studies.hidden_robots import HiddenRobots, other_motors_folder, read_identified
from surefoot.studies.robot_comparison import without_hidden_parts
from surefoot.studies.robot_runs import HOME, robot_task
from surefoot.studies.study_config import load_study
from surefoot.tables import plain_rows, print_table, write_csv
from surefoot.task.config import TaskConfig

_PARTS = {"imu_bias": "imu_mount", "motor_friction": "knee_friction"}
"""Parameters that are part of what an experiment finds as another one."""


@dataclass(frozen=True)
class Command:
    """Take differences between robots and their simulations away, one at a time."""

    study: Path = Path("studies/identified.yaml")
    """The study."""
    identified: Path = Path("results/identified/robots")
    """Folder of the robots' identified parameters."""
    runs: Path = Path("runs/identified")
    """Folder of the study's trainings."""
    group: str = "improved_pushes"
    """Group of the study, whose trainings take all identified parameters."""
    out: Path = Path("results/identified/gap_causes.csv")
    """Table to write."""
    robots: tuple[int, ...] = ()
    """Seeds of the robots; all by default. The table keeps its rows of other robots."""


def variants(
    task: TaskConfig, robots: HiddenRobots, seed: int, file: ParamsFile, folder: Path
) -> Iterator[tuple[str, str, TaskConfig]]:
    """Yield name, world and task of each variant of a robot.

    Args:
        task: a policy's task, with the robot's identified parameters.
        robots: the study's robots.
        seed: the robot's seed.
        file: the robot's identified parameters.
        folder: folder of the robot description with other motors.
    """
    truth, sheet = robot_task(task, robots, seed, folder), RobotDescription.load(task.robot)
    nominal = param_values(PhysicalParams.nominal(sheet), PhysicalParams.names(sheet))
    # What an experiment finds as a bias of the IMU or friction of a motor is in part of another origin.
    sums = param_values(without_hidden_parts(robots.params(seed, folder)), PhysicalParams.names(sheet))
    # A parameter of the motors that is not in the file is the data sheet's.
    known = {**{name: nominal[name] for name in nominal_params(sheet.actuator)}, **file.values}
    known = {name: value for name, value in known.items() if name not in CONTROLLER_PARAMETERS}
    hidden = {
        name: nominal[name]
        for name, value in truth.params.items()
        if name not in known and name not in CONTROLLER_PARAMETERS and not np.array_equal(value, nominal[name])
    }

    def with_params(values: Mapping[str, ParamValue], robot: str = truth.robot) -> TaskConfig:
        return replace(truth, robot=robot, params={**truth.params, **values})

    yield "training simulator", HOME, undisturbed_task(task)
    yield "robot as it is", robots.world, truth
    for group in PARAMETER_GROUPS:
        values = {name: value for name, value in known.items() if PARAMETERS[name].group == group}
        values |= {part: sums[part] for name, part in _PARTS.items() if name in values}
        motors = task.robot if group == "motors" else truth.robot
        yield f"{group} as identified", robots.world, with_params(values, motors)
    found = {name: sums[name] for name in _PARTS}
    yield "without effects that no experiment finds", robots.world, with_params({**hidden, **found})
    yield "no difference but the engine", robots.world, with_params({**known, **hidden}, task.robot)


def measure(command: Command) -> pd.DataFrame:
    """Return the mean metrics of every robot and variant."""
    study = load_study(command.study)
    folder = other_motors_folder(command.runs / "robots")
    rows = []
    for seed in track(command.robots or study.hidden.seeds, "robots"):
        file = read_identified(command.identified, seed, study.hidden.robot)
        policies = sorted((command.runs / command.group / f"robot_{seed}").glob("seed_*/policy.onnx"))
        if file is None or not policies:
            raise SurefootError(f"robot {seed}: no identified parameters, or no policy in {command.runs}")
        for policy in policies:
            run = EvaluationRun.load(policy, {"episodes": study.hidden.starts, "seed": GAP_SEED})
            for name, world, task in variants(run.task, study.hidden, seed, file, folder):
                runs = measure_runs(run.run(task, world))
                row = {"robot": seed, "motors": study.hidden.family(seed), "variant": name, "policies": len(policies)}
                rows.append(row | {"return": runs["return"].mean(), "falls_percent": 100 * (1 - runs.balanced.mean())})
    keys = ["robot", "motors", "variant", "policies"]
    return pd.DataFrame(rows).groupby(keys, sort=False, as_index=False).mean()


def main(command: Command) -> None:
    """Write the table, and print its means over robots."""
    table = measure(command)
    if command.out.is_file():
        others = pd.read_csv(command.out)
        table = pd.concat([others[~others.robot.isin(table.robot)], table]).sort_values("robot", kind="stable")
    write_csv(command.out, table)
    for motors, part in table.groupby("motors", sort=False):
        means = part.groupby("variant", sort=False)[["return", "falls_percent"]].mean().reset_index()
        print_table(plain_rows(means), f"{part.robot.nunique()} robots, motors: {motors}")


if __name__ == "__main__":
    try:
        main(tyro.cli(Command))
    except SurefootError as error:
        print(error, file=sys.stderr)
        raise SystemExit(2) from None
