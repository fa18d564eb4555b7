"""Does `surefoot doctor` name the mistake in an adopted policy's configuration?

Twenty configurations are made from those of two policies of rl_sar (`data/rl_sar`), each wrong in one way, drawn with a
seed. Each is adopted and examined in simulation. Prints a line a configuration and the count.

    python benchmarks/adopted_mistakes.py [--count 20] [--seed 1] [--out results/adopted_mistakes.json]
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.adopt.adoption import FORMATS, load_network
from surefoot.adopt.builder import NetworkSizes, PolicyMaker, build_policy, check_specification
from surefoot.adopt.examination import Answer, Diagnosis, examine, stated_specification
from surefoot.adopt.mistakes import corrections, joint_orders
from surefoot.adopt.specification import PolicySpecification
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.contract_mapping import task_from_contract

DATA = Path(__file__).resolve().parents[1] / "data" / "rl_sar"
NETWORKS = {"himloco": DATA / "himloco" / "himloco.pt", "robot_lab": DATA / "robot_lab" / "policy.pt"}
Change = Callable[[PolicySpecification], PolicySpecification]


def place(spec: PolicySpecification, term: str) -> int:
    """Return the place of a term."""
    return [str(one.term) for one in spec.observations].index(term)


def with_term(term: str, **changes: object) -> Change:
    """Return a change of a term's fields."""

    def change(spec: PolicySpecification) -> PolicySpecification:
        terms, k = list(spec.observations), place(spec, term)
        terms[k] = replace(terms[k], **changes)  # type: ignore[arg-type]
        return replace(spec, observations=tuple(terms))

    return change


def scaled(term: str, factor: float, columns: tuple[int, ...] = ()) -> Change:
    """Return a change of a term's scale, of some of its numbers or of all."""

    def change(spec: PolicySpecification) -> PolicySpecification:
        own = spec.observations[place(spec, term)].scale
        if not columns:
            scale = tuple(factor * x for x in own) if isinstance(own, tuple) else factor * own
            return with_term(term, scale=scale)(spec)
        scales = np.broadcast_to(own, 3) * [factor if k in columns else 1.0 for k in range(3)]
        return with_term(term, scale=tuple(scales.tolist()))(spec)

    return change


def swapped(first: str, second: str) -> Change:
    """Return a change in which two terms change places."""

    def change(spec: PolicySpecification) -> PolicySpecification:
        terms, i, k = list(spec.observations), place(spec, first), place(spec, second)
        terms[i], terms[k] = terms[k], terms[i]
        return replace(spec, observations=tuple(terms))

    return change


def times(factor: float, *names: str) -> Change:
    """Return a change in which numbers of the specification are multiplied."""

    def change(spec: PolicySpecification) -> PolicySpecification:
        values: dict[str, Any] = {name: getattr(spec, name) for name in names}
        for name, value in values.items():
            values[name] = tuple(factor * x for x in value) if isinstance(value, tuple) else factor * value
        return replace(spec, **values)

    return change


def ordered(robot: RobotDescription, name: str) -> Change:
    """Return a change of the order of joints."""
    return lambda spec: replace(spec, joints=joint_orders(robot)[name])


def turned_history(spec: PolicySpecification) -> PolicySpecification:
    """Return a specification with its histories the other way round."""
    return replace(spec, observations=tuple(replace(term, steps=term.steps[::-1]) for term in spec.observations))


def turned_abduction(spec: PolicySpecification) -> PolicySpecification:
    """Return a specification with the other sense of abduction."""
    signs = [-1.0 if "hip" in joint else 1.0 for joint in spec.joints]
    pose = tuple(sign * angle for sign, angle in zip(signs, spec.default_pose, strict=True))
    return replace(spec, joint_signs=tuple(signs), default_pose=pose)


def mistakes(robot: RobotDescription) -> dict[str, Change]:
    """Return the mistakes by name."""
    return {
        "order FR FL RR RL": ordered(robot, "FR FL RR RL, leg by leg"),
        "order FL FR RL RR": ordered(robot, "FL FR RL RR, leg by leg"),
        "order FL RL FR RR": ordered(robot, "FL RL FR RR, leg by leg"),
        "sense of abduction": turned_abduction,
        "sign of gravity": scaled("gravity", -1.0),
        "scale of angular velocity forgotten": with_term("angular_velocity", scale=1.0),
        "angular velocity in degrees": scaled("angular_velocity", 180 / math.pi),
        "scale of joint speeds forgotten": with_term("joint_speeds", scale=1.0),
        "joint positions in degrees": scaled("joint_positions", 180 / math.pi),
        "default pose not subtracted": with_term("joint_positions", relative=False),
        "sign of yaw in commands": scaled("command", -1.0, (2,)),
        "scale of commands halved": scaled("command", 0.5),
        "yaw first in commands": with_term("command", columns=(2, 0, 1)),
        "angular velocity and gravity exchanged": swapped("angular_velocity", "gravity"),
        "command and angular velocity exchanged": swapped("command", "angular_velocity"),
        "joint positions and speeds exchanged": swapped("joint_positions", "joint_speeds"),
        "actions twice as large": times(2.0, "action_scale"),
        "actions half as large": times(0.5, "action_scale"),
        "gains twice as large": times(2.0, "kp", "kd"),
        "proportional gain four times as large": times(4.0, "kp"),
        "derivative gain four times as large": times(4.0, "kd"),
        "control step halved": times(0.5, "control_step"),
        "history the other way round": turned_history,
        "history by term": lambda spec: replace(spec, history_by="term"),
    }


def same(one: PolicySpecification, other: PolicySpecification, robot: RobotDescription) -> bool:
    """Return whether two specifications mean the same."""

    def meaning(spec: PolicySpecification) -> list[np.ndarray]:
        maker = PolicyMaker(spec, NetworkSizes(None, len(spec.joints)), robot)
        weight, offset, scale = maker.observation_map()
        action, middle, to_motors = maker.target_map()
        gains = [np.broadcast_to(maker.per_motor(gain), robot.num_motors) for gain in (spec.kp, spec.kd)]
        return [
            weight * scale,
            offset * scale,
            action[:, None] * to_motors,
            middle @ to_motors,
            *gains,
            np.array(spec.control_step),
        ]

    return all(x.shape == y.shape and np.allclose(x, y) for x, y in zip(meaning(one), meaning(other), strict=True))


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path, help="file (.json) for the results")
    options = parser.parse_args()
    robot = RobotDescription.load("go2")
    cases = []
    right, networks = {}, {}
    for name, path in NETWORKS.items():
        right[name] = FORMATS["rl_sar"].read(path.parent / "config.yaml", robot)
        networks[name] = load_network(path, path.read_bytes(), check_specification(right[name], robot))
        changes = {what: change(right[name]) for what, change in mistakes(robot).items()}
        cases += [(name, what, spec) for what, spec in changes.items() if not same(spec, right[name], robot)]
    chosen = np.random.default_rng(options.seed).permutation(len(cases))[: options.count]
    named = likely = 0
    rows = []
    for name, what, wrong in (cases[k] for k in sorted(chosen)):
        started = time.monotonic()
        policy = PolicyRuntime.parse(build_policy(wrong, networks[name], robot, name, {}))
        task = task_from_contract(policy.contract, robot)
        tried = corrections(stated_specification(policy.contract), robot)
        diagnosis = Diagnosis.from_answers(examine(policy, robot, task, [None, *tried], threads=options.threads))

        # An order of joints is tried with and without the numbers of each joint: the same text for both.
        right_texts = {one.text for one in tried if same(one.specification, right[name], robot)}

        def is_right(answer: Answer | None, texts: set[str] = right_texts) -> bool:
            return answer is not None and answer.correction is not None and answer.correction.text in texts

        mistake = diagnosis.mistake
        first, among = is_right(mistake), any(map(is_right, diagnosis.alike))
        named, likely = named + first, likely + (first or among)
        result = "named" if first else "as likely as another" if among else "not named"
        text = mistake.correction.text if mistake is not None and mistake.correction is not None else "nothing found"
        score = diagnosis.own.score
        rows.append({"policy": name, "mistake": what, "result": result, "answer": text, "score": round(score, 3)})
        print(f"{name}: {what}: {result}: {text} (score {score:.2f}; {time.monotonic() - started:.0f} s)", flush=True)
    print(f"named: {named} of {len(chosen)}; with those that are as likely: {likely}")
    if options.out is not None:
        counts = {"kinds": len(mistakes(robot)), "named": named, "likely": likely, "configurations": len(chosen)}
        text = json.dumps({**counts, "seed": options.seed, "rows": rows}, indent=1)
        options.out.write_text(text + "\n")


if __name__ == "__main__":
    main()
