"""Does `surefoot doctor` name the mistake in an adopted policy's configuration?

Each configuration has one mistake: a change of `adopt/mistakes.py` is applied to the right configuration of one of two
rl_sar policies (`data/rl_sar`). The seed chooses policy, kind of mistake and change at random; no pair of policy and
kind is repeated before all have occurred. Each configuration is adopted and examined as the doctor does.

    python benchmarks/adopted_mistakes.py [--seeds 2 3] [--count 20] [--minutes 30]

Numbers -1 and -2 of a seed are the right configurations, in which the doctor must find nothing. Rows are added to
results/adopted_mistakes.csv; existing rows are not run again.

A mistake counts as named if the doctor's first proposal is equivalent to the right specification: the same observation
for all readings, the same motor angles for all actions, the same gains and control step.
"""

from __future__ import annotations

import argparse
import re
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from surefoot.adopt.adoption import FORMATS, load_network
from surefoot.adopt.builder import NetworkSizes, PolicyBuilder, build_policy, check_specification
from surefoot.adopt.diagnosis import diagnose
from surefoot.adopt.mistakes import Correction, corrections
from surefoot.adopt.specification import PolicySpecification
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.tables import read_csv, write_csv
from surefoot.task.contract_mapping import task_from_contract

ROOT = Path(__file__).resolve().parents[1]
NETWORKS = {
    name: ROOT / "data" / "rl_sar" / name / file
    for name, file in (("himloco", "himloco.pt"), ("robot_lab", "policy.pt"))
}
RIGHT = "none"
"""Kind of mistake of a right configuration."""
RESULTS = ROOT / "results" / "adopted_mistakes.csv"


class Case(NamedTuple):
    """A configuration to examine."""

    policy: str
    kind: str
    mistake: str
    specification: PolicySpecification


def kind_of(change: Correction) -> str:
    """Return the kind of a change: its subject, without the affected part."""
    if change.field == "joint_signs":
        return "sign of joints"
    return re.sub(r"'s .*| \(.*", "", change.text.partition(":")[0])


def meaning(specification: PolicySpecification, robot: RobotDescription) -> list[np.ndarray]:
    """Return all numbers that determine the policy's observation and the effect of its actions."""
    maker = PolicyBuilder(specification, NetworkSizes(None, len(specification.joints)), robot)
    weight, offset, scale = maker.observation_map()
    action, middle, to_motors = maker.target_map()
    gains = [np.broadcast_to(maker.per_motor(gain), robot.num_motors) for gain in (specification.kp, specification.kd)]
    step = np.array(specification.control_step)
    return [weight * scale, offset * scale, action[:, None] * to_motors, middle @ to_motors, *gains, step]


def same(one: PolicySpecification, other: PolicySpecification, robot: RobotDescription) -> bool:
    """Return whether two specifications are equivalent."""
    pairs = zip(meaning(one, robot), meaning(other, robot), strict=True)
    return all(x.shape == y.shape and np.allclose(x, y, rtol=1e-9, atol=1e-9) for x, y in pairs)


def draw(right: dict[str, PolicySpecification], robot: RobotDescription, seed: int) -> Iterator[Case]:
    """Yield wrong configurations indefinitely."""
    kinds: dict[tuple[str, str], list[Correction]] = {}
    for name, specification in right.items():
        for change in corrections(specification, robot):
            if not same(change.specification, specification, robot):
                kinds.setdefault((name, kind_of(change)), []).append(change)
    random, pairs = np.random.default_rng(seed), list(kinds)
    while True:
        for k in random.permutation(len(pairs)):
            (name, kind), changes = pairs[k], kinds[pairs[k]]
            change = changes[random.integers(len(changes))]
            text = (
                change.text.replace("they should be", "they were made")
                .replace("it should be", "it was made")
                .replace("should change", "changed")
            )
            yield Case(name, kind, text, change.specification)


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--count", type=int, default=20, help="configurations of each seed")
    parser.add_argument("--minutes", type=float, default=1e9, help="time after which no configuration is started")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULTS, help="table (.csv)")
    options = parser.parse_args()
    end = time.monotonic() + 60 * options.minutes
    robot = RobotDescription.load("go2")
    right = {name: FORMATS["rl_sar"].read(path.parent / "config.yaml", robot, {}) for name, path in NETWORKS.items()}
    widths = {name: check_specification(one, robot) for name, one in right.items()}
    networks = {name: load_network(path, path.read_bytes(), widths[name]) for name, path in NETWORKS.items()}
    rows = read_csv(options.out)
    done = {(str(row["seed"]), str(row["number"])) for row in rows}
    for seed in options.seeds:
        cases = draw(right, robot, seed)
        plan = [(-1 - k, Case(name, RIGHT, "", one)) for k, (name, one) in enumerate(right.items())]
        plan += [(number, next(cases)) for number in range(options.count)]
        for number, case in plan:
            if (str(seed), str(number)) in done or time.monotonic() > end:
                continue
            started = time.process_time()
            data = build_policy(case.specification, networks[case.policy], robot, case.policy, {})
            policy = PolicyRuntime.parse(data)
            diagnosis = diagnose(policy, robot, task_from_contract(policy.contract, robot), threads=options.threads)
            proposed = [one.correction.specification for one in diagnosis.ranked if one.correction is not None]
            is_right = [same(one, right[case.policy], robot) for one in proposed]
            answer = diagnosis.mistake
            best = max(
                (one.score for one, fits in zip(diagnosis.ranked, is_right, strict=True) if fits), default=float("nan")
            )
            if case.kind == RIGHT:
                result = "false alarm" if diagnosis.is_confirmed else "left alone"
            elif answer is None or not is_right[0]:
                result = "nothing named" if answer is None else "another named"
            else:
                result = "named, robots show it" if diagnosis.is_confirmed else "named by its unusual number"
            row = {
                "seed": seed,
                "number": number,
                "policy": case.policy,
                "kind": case.kind,
                "mistake": case.mistake,
                "result": result,
                "answer": answer.correction.text if answer is not None and answer.correction is not None else "",
                "score": f"{diagnosis.baseline.score:.3f}",
                "answer_score": f"{answer.score:.3f}" if answer is not None else "",
                "right_score": "" if np.isnan(best) else f"{best:.3f}",
                "right_rank": is_right.index(True) + 1 if any(is_right) else "",
                "seconds": f"{time.process_time() - started:.0f}",
            }
            rows.append(row)
            print(row, flush=True)
            write_csv(options.out, rows)
        results = Counter(str(row["result"]) for row in rows if str(row["seed"]) == str(seed))
        print(f"seed {seed}: {', '.join(f'{count} {result}' for result, count in results.most_common())}")


if __name__ == "__main__":
    main()
