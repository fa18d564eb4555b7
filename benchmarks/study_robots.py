"""Compare the groups of a study on some robots of its ensemble, from the episodes that its results hold.

    python benchmarks/study_robots.py studies/reality-gap.yaml results/reality-gap

Robots of `--least` N/m and more of contact stiffness count: before the floor was mended, feet of less sank below it in
Bullet. Writes FOLDER/firm_feet.csv: a row a pair and figure (return away, gap) with difference, interval over policies
and robots, p value, and p after Holm's correction for the number of pairs.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pandas as pd

from surefoot.evaluation.statistics import crossed_interval, holm
from surefoot.robot import RobotDescription
from surefoot.studies.study_config import group_config, load_study
from surefoot.tables import write_csv
from surefoot.world.ensemble import ensemble_params
from surefoot.world.registry import WORLDS


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("study", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--world", default="ensemble")
    parser.add_argument("--least", type=float, default=8000.0, help="least contact stiffness of a robot's feet [N/m]")
    arguments = parser.parse_args()
    study, seeds = load_study(arguments.study), WORLDS[arguments.world].seeds or range(0)
    robot = RobotDescription.load(group_config(study, next(iter(study.groups))).task.robot)
    stiffness = ensemble_params(robot, len(seeds), seeds).contact_stiffness.reshape(len(seeds), -1).min(axis=1)
    robots = np.flatnonzero(stiffness >= arguments.least)
    episodes = pd.read_csv(arguments.folder / "episodes.csv")
    runs = episodes[episodes.evaluation.str.startswith("gap")]
    returns = runs.pivot_table(values="return", index=["group", "seed"], columns=["world", "run"])
    away = returns[arguments.world][robots]
    gaps = (-away).add(returns["mujoco"].mean(axis=1), axis=0)
    rows = [
        {"group": other, "against": base, "figure": figure, "robots": len(robots)}
        | interval.columns("difference")
        | {"p": interval.p}
        for figure, table in (("gap_away", away), ("gap", gaps))
        for base, other in study.pairs
        for interval in [crossed_interval(table.loc[other], table.loc[base])]
    ]
    pairs = pd.DataFrame(rows)
    pairs["p_holm"] = pairs.groupby("figure").p.transform(holm)
    print(write_csv(arguments.folder / "firm_feet.csv", pairs))


if __name__ == "__main__":
    main()
