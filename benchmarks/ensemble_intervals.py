"""Intervals of `surefoot identify` on robots that are built unlike their model: how many contain the true value?

    python benchmarks/ensemble_intervals.py --seeds 221 222 --other-motors 223
    python benchmarks/ensemble_intervals.py --robots results/identified/robots

Robots are drawn as in a study file (`--study`): from the ensemble's ranges, in Bullet, with play and friction in the
knees, uneven floors and encoder offsets, and some with motors of another torque curve and servo law. Each is identified
by the four experiments over its emulated link, 5 to 10 minutes of one core. intervals.csv has one row per interval; its
true values are those that an experiment can find, see `parameter_rows`. coverage.csv counts them by family of motors,
parameter and robot. Robots that have been identified are kept.

With `--robots FOLDER` nothing is identified: the robots of the study are read from there, and counts go to
development.csv, because lower bounds of intervals were set on them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import tyro

from surefoot.studies.hidden_robots import other_motors_folder, read_identified
from surefoot.studies.robot_comparison import parameter_rows
from surefoot.studies.robot_identification import identify_robots
from surefoot.studies.study_config import load_study
from surefoot.tables import plain_rows, print_table, write_csv


@dataclass(frozen=True)
class Command:
    """Compare intervals of identified parameters with true values."""

    study: Path = Path("studies/identified.yaml")
    """Study with the ranges of its robots, and other motors."""
    seeds: tuple[int, ...] = (221, 222)
    """Seeds of robots with motors of the data sheet's family."""
    other_motors: tuple[int, ...] = (223,)
    """Seeds of robots with other motors."""
    robots: Path | None = None
    """Folder of the study's robots, which are then compared instead of new ones."""
    out: Path = Path("results/identification/ensemble")
    """Folder for the parameter files and intervals.csv."""
    work: Path = Path("runs/ensemble_intervals")
    """Folder for recordings."""
    workers: int = 0
    """Robots in parallel; 0 means one per core."""


def main(command: Command) -> None:
    """Identify the robots, write the table, and print a summary."""
    study = load_study(command.study)
    folder = command.robots or command.out
    if command.robots is None:
        other = study.hidden.other_motors
        assert other is not None
        seeds = (*command.seeds, *command.other_motors)
        hidden = replace(study.hidden, seeds=seeds, other_motors=replace(other, seeds=command.other_motors))
        study = replace(study, robots=hidden)

        def report(seed: int, error: str) -> None:
            print(f"robot {seed}: {error or 'identified'}", flush=True)

        if identify_robots(hidden, folder, command.work, command.workers, report):
            raise SystemExit(1)
    files = {seed: read_identified(folder, seed, study.hidden.robot) for seed in study.hidden.seeds}
    known = {seed: file for seed, file in files.items() if file is not None}
    rows = [row for row in parameter_rows(study, known, other_motors_folder(command.work)) if row["inside"] is not None]
    if command.robots is None:
        write_csv(command.out / "intervals.csv", rows)
    counts = coverage(pd.DataFrame(rows))
    write_csv(command.out / ("coverage.csv" if command.robots is None else "development.csv"), counts)
    print_table(plain_rows(counts), "Intervals that contain the true value")


def coverage(table: pd.DataFrame) -> pd.DataFrame:
    """Return the numbers of intervals, and of those with the true value, by motors, and by parameter and robot."""
    counts = []
    for part in ([], ["parameter"], ["robot"]):
        groups = table.groupby(["motors", *part], sort=False).inside
        rows = groups.agg(inside="sum", intervals="count").reset_index()
        names = rows[["motors", *part]].astype(str).agg(" ".join, axis="columns")
        counts.append(rows.assign(name=names)[["name", "inside", "intervals"]])
    return pd.concat(counts, ignore_index=True)


if __name__ == "__main__":
    main(tyro.cli(Command))
