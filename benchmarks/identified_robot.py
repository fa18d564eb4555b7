"""Identify a robot with hidden parameters, and compare simulations of it with a policy's runs on it.

    python benchmarks/identified_robot.py

The robot is emulated in Bullet (`surefoot emulate --hidden-seed`) and identified by the four experiments, which write
--params; an existing file is used as it is. The policy is deployed on that robot, and runs in simulations of the data
sheet's robot and of the identified robot, in both engines. --out has one row per simulation: returns [m], and the gap,
which is the return in simulation minus the mean return on the robot.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from pathlib import Path

from emulated import deploy

from surefoot.evaluation.runs import measure_runs
from surefoot.studies.robot_identification import SUREFOOT_COMMAND, identify_robot
from surefoot.tables import write_csv


def surefoot(*words: object) -> str:
    """Run a command; return its output."""
    done = subprocess.run([*SUREFOOT_COMMAND, *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", default="trot-robust")
    parser.add_argument("--hidden-seed", type=int, default=48)
    parser.add_argument("--hidden-ranges", default="table1", help="as for `surefoot emulate`")
    parser.add_argument("--runs", type=int, default=3, help="runs on the robot")
    parser.add_argument("--params", type=Path, default=Path("results/identification/hidden-48.toml"))
    parser.add_argument("--out", type=Path, default=Path("results/identification/end_to_end.csv"))
    options = parser.parse_args()
    hidden = ("--hidden-seed", options.hidden_seed, "--hidden-ranges", options.hidden_ranges)
    robot = ("--world", "bullet", *hidden, "--seed", options.hidden_seed)
    if not options.params.exists():
        with tempfile.TemporaryDirectory() as folder:
            identify_robot(robot, options.params, Path(folder) / "work", "minitaur")
    traces = deploy(options.policy, "--episodes", options.runs, robot=robot)
    runs = measure_runs(traces)
    on_robot = {
        **{"runs": len(runs), "falls": int(runs.fell.sum()), "on_robot": runs["return"].mean()},
        "shortest": min(trace.duration for trace in traces),
    }
    table = []
    for world in ("mujoco", "bullet"):
        for kind, params in (("sheet", ()), ("identified", ("--params", options.params))):
            words = ("--world", world, "--episodes", 20, "--threads", 1, "--json", *params)
            simulated = json.loads(surefoot("evaluate", options.policy, *words))["return_mean"]
            row = {"simulation": f"{world}/{kind}", "return": simulated, "gap": simulated - on_robot["on_robot"]}
            table.append(row | on_robot)
            print(table[-1], flush=True)
    write_csv(options.out, table)


if __name__ == "__main__":
    main()
