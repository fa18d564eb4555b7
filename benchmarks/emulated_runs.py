"""Deploy policies on emulated robots in lockstep; measure distances, falls and reasons for a run's end.

    python benchmarks/emulated_runs.py                    # all cases; results/emulator/{runs,cases}.csv
    python benchmarks/emulated_runs.py gallop/bullet      # one case; rows of other cases are kept

Every robot has noisy sensors, a battery with voltage drop and motors that heat up. `runs.csv` has one row per run,
`cases.csv` one row per case: distances [m], falls, duration of the shortest run, and why it ended.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from emulated import deploy

from surefoot.evaluation.runs import measure_runs
from surefoot.tables import read_csv, write_csv


class Case(NamedTuple):
    """Policy on one or more emulated robots."""

    policy: str
    world: str
    options: tuple[object, ...] = ()
    """Options of `surefoot deploy`."""
    hidden: tuple[int, ...] = ()
    """Seeds of robots with hidden parameters; empty for the robot of the data sheet."""
    forward: float = 0.0
    """Forward command, for policies with commands [m/s]."""
    robot: str = "minitaur"


CASES = {
    "trot-robust/bullet": Case("trot-robust", "bullet", ("--episodes", 3)),
    "gallop/mujoco": Case("gallop", "mujoco"),
    "gallop/bullet": Case("gallop", "bullet"),
    "trot-robust/hidden": Case("trot-robust", "bullet", hidden=tuple(range(1, 11))),
    "trot-robust/mujoco-minute": Case("trot-robust", "mujoco", ("--duration", 60)),
    "trot-robust/bullet-minute": Case("trot-robust", "bullet", ("--duration", 60)),
    "steer/mujoco-ten-minutes": Case("steer", "mujoco", ("--duration", 600), forward=0.66),
    "go2-steer/mujoco-ten-minutes": Case("go2-steer", "mujoco", ("--duration", 600), forward=1.0, robot="go2"),
}


def run(name: str, case: Case) -> list[dict[str, Any]]:
    """Return one row per run of a case."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        options = case.options
        if case.forward:
            commands = Path(folder) / "commands.csv"
            commands.write_text(f"time,forward,sideways,yaw_rate\n0.5,{case.forward},0,0\n")
            options += ("--commands", commands)
        for seed in case.hidden or (None,):
            robot: tuple[object, ...] = ("--robot", case.robot, "--world", case.world)
            if seed is not None:
                robot += ("--hidden-seed", seed, "--seed", seed)
            traces = deploy(case.policy, *options, robot=robot)
            for trace, row in zip(traces, measure_runs(traces, case.world).to_dict("records"), strict=True):
                rows.append(
                    {
                        **{"case": name, "hidden_seed": seed, "run": row["run"], "seconds": trace.duration},
                        **{key: row[key] for key in ("distance", "speed", "power")},
                        **{"fell": int(row["fell"]), "ended": trace.meta["ended"], "why": trace.meta["what"]},
                    }
                )
    return rows


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of a case."""
    distance = np.array([row["distance"] for row in rows], np.float64)
    shortest = min(rows, key=lambda row: float(row["seconds"]))
    return {
        **{"case": rows[0]["case"], "runs": len(rows), "falls": sum(int(row["fell"]) for row in rows)},
        **{"distance": distance.mean(), "distance_low": distance.min(), "distance_high": distance.max()},
        **{"speed": np.mean([float(row["speed"]) for row in rows])},
        **{"seconds": float(shortest["seconds"]), "ended": shortest["ended"], "why": shortest["why"]},
    }


def main() -> None:
    """Run cases and write both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", choices=[[], *CASES], help="defaults to all")
    parser.add_argument("--out", type=Path, default=Path("results/emulator"), help="folder of the tables")
    options = parser.parse_args()
    path = options.out / "runs.csv"
    kept: dict[str, list[dict[str, Any]]] = {}
    for row in read_csv(path):
        kept.setdefault(row["case"], []).append(row)
    for name in options.cases or CASES:
        kept[name] = run(name, CASES[name])
        print(summary(kept[name]), flush=True)
        cases = [kept[name] for name in CASES if name in kept]
        write_csv(path, [row for rows in cases for row in rows])
        write_csv(options.out / "cases.csv", [summary(rows) for rows in cases])


if __name__ == "__main__":
    main()
