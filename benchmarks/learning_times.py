"""Duration of trainings, one row per run, from the metrics in its folder.

    surefoot train gallop --seed 0 --threads 1 --learning-threads 1
    python benchmarks/learning_times.py runs/gallop/* runs/trot/*

The time includes rollouts and learning, without evaluations; other load on the same cores increases it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.configuration import read_yaml
from surefoot.tables import print_table, write_csv


@dataclass(frozen=True)
class Command:
    """Collect the times of trainings."""

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Folders of runs."""
    out: Path = Path("results/learning_times.csv")


def read_run(folder: Path) -> dict[str, object]:
    """Return the row of a run."""
    last = json.loads((folder / "figures.jsonl").read_text(encoding="utf-8").splitlines()[-1])
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    config = read_yaml(folder / "config.yaml")
    name, threads = config["task"]["name"], config["threads"]
    row = {"run": f"{name}-s{about['seed']}", "task": name, "seed": about["seed"], "threads": threads}
    return row | {"steps": last["steps"], "minutes": last["seconds"] / 60, "git": about["git"]}


def main(command: Command) -> None:
    rows = sorted((read_run(folder) for folder in command.runs), key=lambda row: str(row["run"]))
    write_csv(command.out, rows)
    print_table([{key: f"{one:.2f}" if isinstance(one, float) else one for key, one in row.items()} for row in rows])


if __name__ == "__main__":
    main(tyro.cli(Command))
