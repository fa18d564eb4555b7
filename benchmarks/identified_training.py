"""Identify a robot with hidden parameters, train on what was identified, and deploy on that robot.

    python benchmarks/identified_training.py --runs runs/identified

The robot is emulated in Bullet (`surefoot emulate --hidden-seed`), and identified by the four experiments; --params is
the file that they write, and is made once. Trots are trained on it and on the data sheet; --runs keeps the trainings.
Each is deployed on that robot, emulated in either engine. The gap is its return at home, in the simulator of its
training, less its return there. Policies that ship are compared with simulations of both robots in both engines.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from emulated import SUREFOOT, deploy, emulated_robot

from surefoot.evaluation.runs import measure_runs
from surefoot.tables import write_csv

EXPERIMENTS = {"motor": True, "latency": True, "mass": False, "contact": False}
"""Whether the robot is on its rack, in the order in which they are made."""
WORLDS = ("mujoco", "bullet")


def surefoot(*words: object) -> str:
    """Run a command; return its output."""
    done = subprocess.run([*SUREFOOT, *map(str, words)], capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(done.stderr)
    return done.stdout


def identify(seed: int, path: Path) -> None:
    """Write what the experiments find of a hidden robot."""
    path.parent.mkdir(parents=True, exist_ok=True)
    for name, rack in EXPERIMENTS.items():
        robot = ("--world", "bullet", "--hidden-seed", seed, "--seed", seed)
        with tempfile.TemporaryDirectory() as folder, emulated_robot(*robot, *(["--rack"] if rack else [])) as port:
            surefoot(
                "identify", name, "--port", port, "--lockstep", "--yes", "--params", path, "--out", f"{folder}/{name}"
            )


def train(kind: str, seed: int, steps: int, runs: Path, params: Sequence[object]) -> str:
    """Return the policy of a training, which is made if it is not there."""
    out = runs / f"{kind}-{seed}"
    if not list(out.rglob("evaluation.json")):
        threads = ("--threads", 1, "--learning-threads", 1)
        surefoot("train", "trot", "--steps", steps, "--seed", seed, *threads, "--out", out, *params)
    return str(next(out.rglob("evaluation.json")).with_name("policy.onnx"))


def home(policy: str, world: str, params: Sequence[object], episodes: int = 20) -> float:
    """Return the mean return in simulation [m]."""
    words = ("--world", world, "--episodes", episodes, "--threads", 1, "--json", *params)
    return float(json.loads(surefoot("evaluate", policy, *words))["return_mean"])


def rows(options: argparse.Namespace) -> Iterator[dict[str, Any]]:
    """Give a row for each policy, simulator and emulated robot."""
    params: dict[str, tuple[object, ...]] = {"sheet": (), "identified": ("--params", options.params)}
    policies = [
        (f"{kind}-{seed}", train(kind, seed, options.steps, options.runs, words), (("mujoco", kind),), WORLDS)
        for kind, words in params.items()
        for seed in options.seeds
    ]
    everywhere = tuple((world, kind) for world in WORLDS for kind in params)
    ships = [(name, name, everywhere, WORLDS[1:]) for name in options.ships]
    for name, policy, simulators, engines in [*ships, *policies]:
        returns = {(world, kind): home(policy, world, params[kind]) for world, kind in simulators}
        for engine in engines:
            hidden = ("--world", engine, "--hidden-seed", options.hidden_seed, "--seed", options.hidden_seed)
            traces = deploy(policy, "--episodes", options.episodes, robot=hidden)
            runs = measure_runs(traces)
            for (world, kind), value in returns.items():
                yield {
                    **{"name": f"{name}/{engine}" if name not in options.ships else f"{name}/{world}/{kind}"},
                    **{"policy": name, "simulator": world, "parameters": kind, "home": value, "robot": engine},
                    **{"returned": runs["return"].mean(), "runs": len(runs), "falls": int(runs.fell.sum())},
                    **{"seconds": min(trace.duration for trace in traces), "gap": value - runs["return"].mean()},
                }


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hidden-seed", type=int, default=48)
    parser.add_argument("--seeds", type=int, nargs="*", default=[1, 2, 3], help="of the trainings")
    parser.add_argument("--steps", type=int, default=1_000_000, help="control steps of a training")
    parser.add_argument("--episodes", type=int, default=3, help="runs of a policy on a robot")
    parser.add_argument("--ships", nargs="*", default=["trot-robust"], help="policies that ship")
    parser.add_argument("--runs", type=Path, default=Path("runs/identified"))
    parser.add_argument("--params", type=Path, default=Path("results/identification/hidden-48.toml"))
    parser.add_argument("--out", type=Path, default=Path("results/identification/deployed.csv"))
    options = parser.parse_args()
    if not options.params.exists():
        identify(options.hidden_seed, options.params)
    table = []
    for row in rows(options):
        print(row, flush=True)
        table.append(row)
    write_csv(options.out, table)


if __name__ == "__main__":
    main()
