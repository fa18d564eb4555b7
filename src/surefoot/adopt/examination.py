"""An adopted policy in simulation: does it stand and answer, and which change of its specification makes it walk?

All corrections run side by side, each with a robot for each command. A correction is a linear map in front of the
policy file and another one behind it: the raw observation for which the file's network gets what the corrected
specification would give it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from surefoot.adopt.builder import NetworkSizes, PolicyMaker
from surefoot.adopt.mistakes import Correction
from surefoot.adopt.specification import PolicySpecification
from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge
from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Progress, run_to_end
from surefoot.policy.contract import MEMORY, Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandConfig
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.reward import base_rates
from surefoot.world.registry import find_world

DURATION, SETTLE = 4.0, 1.5
"""Length of an episode [s], and the part of it that is not measured."""
MAX_ERROR = np.array([0.5, 0.4, 0.8])
"""Errors of speeds [m/s, m/s] and yaw rate [rad/s] that are worth nothing."""
SHARES = {
    "stand": (0, 0, 0),
    "forward": (0.6, 0, 0),
    "backward": (-0.6, 0, 0),
    "left": (0, 0.75, 0),
    "turn": (0, 0, 0.75),
    "curve": (0.5, 0, 0.75),
}
"""Commands of an examination, in shares of the policy's range."""


@dataclass(frozen=True)
class Answer:
    """How robots with one specification answered commands; rows are commands, by name."""

    correction: Correction | None
    """The change; None: the policy as it is."""
    commands: tuple[str, ...]
    command: Array
    """What was commanded (C, 3) [m/s, m/s, rad/s]."""
    velocity: Array
    """Mean speeds forward and to the left and yaw rate (C, 3); NaN of a robot that fell early."""
    time: Array
    """How long each robot stood [s] (C,)."""
    power: Array
    """Mechanical power [W] (C,)."""

    @property
    def scores(self) -> Array:
        """Score of each command (C,): 0 of a robot that fell, 1 of one that follows it exactly."""
        error = np.linalg.norm((self.velocity - self.command) / MAX_ERROR, axis=1)
        stood = self.time >= DURATION - 1e-6
        return np.where(stood, np.maximum(0.0, 1.0 - np.nan_to_num(error, nan=9.0)), 0.0)

    @property
    def score(self) -> float:
        """Mean score."""
        return float(self.scores.mean())


def stated_specification(contract: Contract) -> PolicySpecification:
    """Return the specification that an adopted policy was made of.

    Raises:
        SurefootError: a policy that was not adopted.
    """
    stated = contract.figures.get("adopted")
    if not isinstance(stated, Mapping) or not isinstance(stated.get("specification"), Mapping):
        raise SurefootError(
            f"policy '{contract.name}' was not adopted; only of an adopted one the specification is known"
        )
    return from_mapping(PolicySpecification, stated["specification"], "specification")


class Corrected:
    """A policy file as if it had been made of other specifications: of rows of robots, one after another.

    Args:
        policy: the file.
        robot: that it is for.
        specifications: as many as there are groups of robots.
    """

    def __init__(
        self, policy: PolicyRuntime, robot: RobotDescription, specifications: Sequence[PolicySpecification]
    ) -> None:
        self._policy, contract = policy, policy.contract
        own = self._maker(stated_specification(contract), robot, contract)
        self._motors = len(contract.motor_names)
        self._joints = len(own.specification.joints)
        self._has_last = any(term.term == "last_action" for term in own.specification.observations)
        weight, offset, scale = own.observation_map()
        matrix = (weight * scale).T
        self._limits = np.array([contract.low, contract.high])[:, : self._motors]
        inverse = np.linalg.pinv(matrix)
        self._own = own.target_map()
        self.makers = [self._maker(one, robot, contract) for one in specifications]
        self._maps: list[tuple[Array, Array] | None] = []
        for maker in self.makers:
            other, shift, factor = maker.observation_map()
            if np.array_equal(other * factor, weight * scale) and np.array_equal(shift * factor, offset * scale):
                self._maps.append(None)
                continue
            # Columns that the network does not observe stay as they are.
            change = inverse @ ((other * factor).T - matrix)
            self._maps.append((np.eye(len(weight)) + change, inverse @ (shift * factor - offset * scale)))

    @staticmethod
    def _maker(specification: PolicySpecification, robot: RobotDescription, contract: Contract) -> PolicyMaker:
        joints = len(specification.joints)
        kept = sum(name.startswith(f"{MEMORY}.") for name in contract.action_names)
        kept -= joints * any(term.term == "last_action" for term in specification.observations)
        kept -= 2 * sum(term.term == "clock" for term in specification.observations)
        return PolicyMaker(specification, NetworkSizes(None, joints, (kept,) if kept else ()), robot)

    def feedback(self, observation: ArrayLike) -> Array:
        """Return the feedback (N, A) for observations (N, O * history); each group has as many rows."""
        inputs = np.array(observation, np.float64)
        rows = len(inputs) // len(self._maps)
        for k, change in enumerate(self._maps):
            if change is not None:
                group = slice(k * rows, (k + 1) * rows)
                inputs[group] = inputs[group] @ change[0].T + change[1]
        feedback = self._policy.feedback(np.nan_to_num(inputs, posinf=1e6, neginf=-1e6))
        scale, offset, to_motors = self._own
        if self._has_last:
            actions = feedback[:, self._motors : self._motors + self._joints]
        else:
            actions = (feedback[:, : self._motors] @ to_motors.T - offset) / scale
        for k, maker in enumerate(self.makers):
            group = slice(k * rows, (k + 1) * rows)
            scale, offset, to_motors = maker.target_map()
            target = (actions[group] * scale + offset) @ to_motors
            feedback[group, : self._motors] = np.clip(target, *self._limits)
        return feedback


def examine(
    policy: PolicyRuntime,
    robot: RobotDescription,
    task: TaskConfig,
    tried: Sequence[Correction | None],
    world: str = "mujoco",
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> list[Answer]:
    """Return how robots answer commands with the policy as it is (None) and with corrections.

    Args:
        policy: an adopted policy.
        robot: that it is for.
        task: its task.
        tried: what is tried, side by side.
        world: name of the world.
        seed: of noise and starts.
        threads: of the simulation; 0: one a core.
        progress: called with the share that is done.
    """
    stated = stated_specification(policy.contract)
    corrected = Corrected(policy, robot, [stated if one is None else one.specification for one in tried])
    limits = policy.contract.commands
    names, rows = _commands(limits is not None, limits)
    robots = len(names) * len(tried)
    commands = replace(task.commands, each=tuple(map(tuple, rows.tolist()))) if limits else CommandConfig()
    task = replace(task, commands=commands, randomize={}, pushes=replace(task.pushes, enabled=False), max_steps=10**6)
    env = LocomotionEnv(task, robots, find_world(world), seed, autoreset=False, threads=threads, step_info=True)
    nominal = env.world.params
    changed = {
        name: np.repeat([_per_motor(maker, field) for maker in corrected.makers], len(names), axis=0)
        for name, field in (("servo_kp", "kp"), ("servo_kd", "kd"))
    }
    steps = np.repeat([maker.specification.control_step for maker in corrected.makers], len(names))
    env.world.set_params(np.arange(robots), nominal.with_values(robot, control_step=steps, **changed))
    observation, _ = env.reset()
    sums, times = np.zeros((robots, 3)), np.zeros(robots)

    def act(observation: NDArray[np.float32]) -> Array:
        return env.gait.action(corrected.feedback(observation))

    before = env.truth

    def record(start: Array, seen: NDArray[np.float32]) -> None:
        nonlocal before
        velocity, rates = base_rates(before, env.truth, env.world.params.control_step[:, None])
        before = env.truth
        counted = (start >= SETTLE) & (env.readings.time > start)
        sums[counted] += (np.column_stack([velocity[:, :2], rates[:, 2]]) * steps[:, None])[counted]
        times[counted] += steps[counted]

    limit = np.round(DURATION / steps).astype(np.int64)
    runs = run_to_end(act, env, observation, limit, progress, record)
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = sums / times[:, None]
    lasted = np.where(runs.balanced, DURATION, runs.steps.to_numpy() * steps)
    answers = []
    for k, one in enumerate(tried):
        group = slice(k * len(names), (k + 1) * len(names))
        power = runs.power.to_numpy()[group]
        answers.append(Answer(one, names, rows, velocity[group], lasted[group], power))
    return answers


def run_task(task: TaskConfig, maker: PolicyMaker, answer: Answer) -> TaskConfig:
    """Return the task of a run in which one robot with a specification is given all commands, one after another."""
    each = DURATION / 2
    rows = [(each * k, *row) for k, row in enumerate(answer.command.tolist())]
    step = maker.specification.control_step
    params = {"control_step": step, "servo_kp": maker.per_motor(maker.specification.kp)}
    params["servo_kd"] = maker.per_motor(maker.specification.kd)
    return replace(
        task,
        commands=replace(task.commands, schedule=tuple(rows)),
        randomize={},
        pushes=replace(task.pushes, enabled=False),
        params={**task.params, **params},
        max_steps=max(round(each * len(rows) / step), 1),
    )


def _per_motor(maker: PolicyMaker, field: str) -> Array:
    """Return gains of all motors (M,)."""
    values: Any = maker.per_motor(getattr(maker.specification, field))
    return np.broadcast_to(np.asarray(values, float), maker.robot.num_motors)


def _commands(follows: bool, limits: Any) -> tuple[tuple[str, ...], Array]:
    """Return the commands of an examination, by name; standing alone, without any to follow."""
    if not follows:
        return ("stand",), np.zeros((1, 3))
    rows = []
    for share in SHARES.values():
        shares = np.array(share, float)
        rows.append(np.where(shares >= 0, shares * limits.high, -shares * limits.low))
    kept = [k for k, row in enumerate(rows) if k == 0 or np.abs(row).max() > 0]
    names = tuple(SHARES)
    return tuple(names[k] for k in kept), np.array([rows[k] for k in kept])


MARGIN = 0.1
"""How much better a robot must answer after a change for the change to be named."""
ALIKE = 0.03
"""Difference of scores within which two changes can't be distinguished."""
UNUSUAL = 0.05
"""What the score of a change with unusual numbers is reduced by when changes are ranked."""
GOOD = 0.4
"""Score of a command that a robot answers."""


@dataclass(frozen=True)
class Diagnosis:
    """What an examination says of a policy."""

    own: Answer
    """The policy as it is."""
    ranked: tuple[Answer, ...]
    """All changes that were tried, the most likely one first."""

    @classmethod
    def from_answers(cls, answers: Sequence[Answer]) -> Diagnosis:
        """Return the diagnosis of answers, the first of which is the policy's as it is."""
        own, *others = answers
        return cls(own, tuple(sorted(others, key=lambda answer: -_likelihood(answer))))

    @property
    def mistake(self) -> Answer | None:
        """The change that makes it walk, or walk clearly better; None: there is none."""
        best = self.ranked[0] if self.ranked else None
        if best is None or _likelihood(best) < self.own.score + MARGIN or best.score < GOOD:
            return None
        return best

    @property
    def alike(self) -> tuple[Answer, ...]:
        """Other changes that are as likely."""
        best = self.mistake
        if best is None:
            return ()
        return tuple(one for one in self.ranked[1:] if _likelihood(one) >= _likelihood(best) - ALIKE)


def _likelihood(answer: Answer) -> float:
    unusual = answer.correction is not None and not answer.correction.usual
    return answer.score - UNUSUAL * unusual


def check_answers(diagnosis: Diagnosis) -> list[CheckResult]:
    """Judge a policy's answers to commands and its specification; one result a rule."""
    own, mistake = diagnosis.own, diagnosis.mistake
    remedy = "see the line specification" if mistake else "perhaps it was not trained for that: see its training"
    results = []
    for name, command, velocity, score, time in zip(
        own.commands, own.command, own.velocity, own.scores, own.time, strict=True
    ):
        asked, went = (", ".join(f"{number:+.2f}" for number in np.nan_to_num(row)) for row in (command, velocity))
        message = f"asked {asked} (m/s, m/s, rad/s), went {went}"
        if time < DURATION - 1e-6:
            message = f"asked {asked} (m/s, m/s, rad/s), fell after {time:.1f} s"
        results.append(judge(name, bool(score >= GOOD), message, "", remedy, float(score)))
    tried = f"{len(diagnosis.ranked)} usual mistakes tried"
    if mistake is None:
        message = f"{tried}; without any of them it does not walk clearly better (score {own.score:.2f}"
        message += f", best {diagnosis.ranked[0].score:.2f})" if diagnosis.ranked else ")"
        fell = bool((own.time < DURATION - 1e-6).any())
        deaf = not fell and not (own.scores[1:] >= GOOD).any()
        rule = "; what is wrong is another thing, or several things"
        what = "compare with the training, field by field"
        results.append(judge("specification", not (fell or deaf), message, rule, what, own.score))
        return results
    assert mistake.correction is not None
    message = f"{tried}; {mistake.correction.text} (score {own.score:.2f}, then {mistake.score:.2f})"
    others = [one.correction.text for one in diagnosis.alike if one.correction is not None]
    what = f"correct {mistake.correction.field} and adopt it again"
    if others:
        what += f"; as likely: {'; '.join(others[:3])}"
    results.append(CheckResult("specification", False, message, what, mistake.score))
    return results
