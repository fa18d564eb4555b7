"""The diagnosis of an adopted policy: the mistake that robots show, or the guess about the robot that explains as much.

All changes run for a short time, then the best of them for longer, with other robots. A number that a configuration
states is called a mistake only if the policy walks with the corrected one, and walks well neither as it is nor on any
robot that surefoot could have guessed as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from surefoot.adopt.constant_inputs import ConstantInputs, constant_inputs
from surefoot.adopt.examination import (
    DURATION,
    GOOD,
    Answer,
    examine,
    require_specification,
)
from surefoot.adopt.mistakes import corrections
from surefoot.adopt.robot_variants import RobotVariant, robot_variants
from surefoot.check_result import CheckResult, judge
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Progress
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import TaskConfig

SCREENING_DURATION = 2.0
"""Length of an episode [s] in the first round, with all changes; the second one's is `DURATION`."""
SCREENING_COMMANDS = ("forward", "backward", "left", "turn", "curve left")
"""Commands of the first round."""
MAX_FINALISTS, FINAL_REPEATS = 16, 2
"""Corrections in the second round, and robots for each command there."""
MAX_FINAL_VARIANTS = 6
"""Other robots in the second round."""
MARGIN = 0.06
"""How much likelier a change must be than none for it to be named, if it does not lead to usual numbers."""
TIE_MARGIN = 0.03
"""Difference within which two changes can't be distinguished."""
MIN_WALKING_SCORE, MIN_GOOD_WALKING_SCORE = 0.6, 0.65
"""Scores of a policy that walks, and of one that walks so well that no number is called a mistake."""
DIFFERENCE_PENALTY = 0.02
"""What a further difference of a robot takes from its score, where the best ones are chosen."""


@dataclass(frozen=True)
class Diagnosis:
    """What an examination says of a policy."""

    own: Answer
    """The policy as it is."""
    ranked: tuple[Answer, ...]
    """All corrections that were tried, the most likely one first."""
    guesses: tuple[Answer, ...] = ()
    """The policy as it is on other robots, the best one first."""
    constants: ConstantInputs | None = None
    """Inputs of the network that are constants, if there are any."""

    @classmethod
    def from_results(
        cls, answers: Sequence[Answer], others: Sequence[Answer] = (), constants: ConstantInputs | None = None
    ) -> Diagnosis:
        """Return the diagnosis of answers, the policy's as it is first; corrections in `others`, sorted, come last."""
        found = sorted(
            (one for one in answers[1:] if one.correction is not None), key=lambda answer: -answer.likelihood
        )
        guesses = sorted((one for one in answers if isinstance(one.change, RobotVariant)), key=_variant_sort_key)
        return cls(answers[0], (*found, *others), tuple(guesses), constants)

    @property
    def mistake(self) -> Answer | None:
        """The correction with which it walks clearly better than without and on any other robot, or with usual numbers.

        None if there is none, or if inputs of the network are constants.
        """
        if not self.ranked or self.constants is not None:
            return None
        best = self.ranked[0]
        if walks(best) and self._is_clearly_better(best):
            return best
        usual = next((one for one in self.ranked if one.unusual < self.own.unusual and walks(one)), None)
        return usual if usual is not None and usual.likelihood >= self.own.likelihood + TIE_MARGIN else None

    def _is_clearly_better(self, answer: Answer) -> bool:
        rivals = (self.own, *self.guesses)
        if any(walks(rival, MIN_GOOD_WALKING_SCORE) for rival in rivals):
            return False
        return answer.score >= max(rival.score for rival in rivals) + MARGIN

    @property
    def is_confirmed(self) -> bool:
        """Whether robots show the mistake; else only numbers that are unusual hint at it."""
        return self.mistake is not None and self._is_clearly_better(self.mistake)

    @property
    def explained(self) -> Answer | None:
        """The robot on which the policy walks as it is, and clearly better than on the simulated one."""
        best = self.guesses[0] if self.guesses else None
        return best if best is not None and walks(best) and best.score >= self.own.score + MARGIN else None

    @property
    def alike(self) -> tuple[Answer, ...]:
        """Other changes that are as likely."""
        best = self.mistake
        if best is None:
            return ()
        others = (one for one in self.ranked[:MAX_FINALISTS] if one is not best)
        return tuple(one for one in others if one.likelihood >= best.likelihood - TIE_MARGIN)


def walks(answer: Answer, score: float = MIN_WALKING_SCORE) -> bool:
    """Return whether robots walk: none falls, and together they answer the commands with a score."""
    return not answer.fell.any() and answer.score >= score


def _variant_sort_key(answer: Answer) -> float:
    """Return a key that sorts answers on other robots, the best one first; one that differs less is preferred."""
    assert isinstance(answer.change, RobotVariant)
    return DIFFERENCE_PENALTY * answer.change.count - answer.score


def diagnose(
    policy: PolicyRuntime,
    robot: RobotDescription,
    task: TaskConfig,
    world: str = "mujoco",
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Diagnosis:
    """Examine a policy as it is, with each of the usual mistakes corrected and on other robots; see `examine`."""
    tried = corrections(require_specification(policy.contract), robot)
    guesses = _allowed_variants(robot, task)

    def half_from(start: float) -> Progress | None:
        return None if progress is None else lambda share: progress(start + 0.5 * share)

    own, *first = examine(
        policy, robot, task, [None, *tried, *guesses], world, seed, threads, half_from(0.0), SCREENING_DURATION, 1, SCREENING_COMMANDS
    )
    first.sort(key=lambda answer: -answer.likelihood)
    better = [one for one in first if one.correction is not None]
    other_robots = sorted((one for one in first if one.correction is None), key=_variant_sort_key)[:MAX_FINAL_VARIANTS]
    again = [one.change for one in (own, *better[:MAX_FINALISTS], *other_robots)]
    # Other robots than those by which the finalists were chosen.
    final = examine(policy, robot, task, again, world, seed + 1, threads, half_from(0.5), DURATION, FINAL_REPEATS)
    return Diagnosis.from_results(final, better[MAX_FINALISTS:], constant_inputs(policy.contract, robot))


def _allowed_variants(robot: RobotDescription, task: TaskConfig) -> list[RobotVariant]:
    """Return the other robots that the robot's description allows."""
    nominal = PhysicalParams.nominal(robot).with_values(robot, **task.params)
    guesses = []
    for guess in robot_variants(float(nominal.control_latency[0])):
        try:
            nominal.with_values(robot, **guess.params(nominal))
        except SurefootError:
            continue
        guesses.append(guess)
    return guesses


def check_answers(diagnosis: Diagnosis, notes: Mapping[str, str] = MappingProxyType({})) -> list[CheckResult]:
    """Judge a policy's answers to commands and its specification; one result a rule.

    Args:
        diagnosis: of the policy.
        notes: of the specification; `stand` is shown where the robot stands.
    """
    own = diagnosis.own
    explained = diagnosis.is_confirmed or diagnosis.explained is not None
    remedy = "see the line specification" if explained else "perhaps it was not trained for that: see its training"
    results = []
    for k, (name, command, velocity, score) in enumerate(
        zip(own.commands, own.command, own.velocity, own.scores, strict=True)
    ):
        asked, went = (
            "forward {:.2f}, left {:.2f} m/s, turn {:.2f} rad/s".format(*(np.round(np.nan_to_num(row), 2) + 0.0))
            for row in (command, velocity)
        )
        end = f"it fell after {DURATION * own.stood[:, k].min():.1f} s" if own.fell[k] else f"it went {went}"
        message = f"asked {asked}; {end}"
        if name == "stand" and "stand" in notes:
            message += f"; {notes['stand']}"
        results.append(judge(name, bool(score >= GOOD), message, "", remedy, float(score)))
    if diagnosis.constants is not None:
        results.append(_check_constants(diagnosis))
    return [*results, _check_specification(diagnosis)]


def _check_constants(diagnosis: Diagnosis) -> CheckResult:
    assert diagnosis.constants is not None
    walking = walks(diagnosis.own)
    remedy = "give the quantities that the training had there, or train without them"
    return judge("constant inputs", walking, diagnosis.constants.text, "", remedy, float(diagnosis.constants.count))


def _check_specification(diagnosis: Diagnosis) -> CheckResult:
    own, mistake, guess = diagnosis.own, diagnosis.mistake, diagnosis.explained
    if diagnosis.constants is not None:
        message = f"no mistake is named while inputs are constants (score {own.score:.2f})"
        return judge("specification", walks(own), message, "", "see the line constant inputs", own.score)
    tried = f"{len(diagnosis.ranked)} usual mistakes tried"
    if mistake is not None and mistake.correction is not None and diagnosis.is_confirmed:
        message = f"{tried}; {mistake.text} (score {own.score:.2f}, then {mistake.score:.2f})"
        what = f"correct {mistake.correction.field} and adopt it again"
        if others := [one.text for one in diagnosis.alike]:
            what += f"; as likely: {'; '.join(others[:3])}"
        return CheckResult("specification", False, message, what, mistake.score)
    if guess is not None or mistake is not None:
        message = tried
        if guess is not None:
            message += f"; with {guess.text} it walks as it is (score {own.score:.2f}, then {guess.score:.2f}): the "
            message += "configuration may be right, and the robot of its training another than the simulated one"
        if mistake is not None:
            message += f"; {'' if guess else 'robots do not show it, but '}a number is unusual: {mistake.text}"
            message += f" (score {own.score:.2f}, then {mistake.score:.2f})"
        return CheckResult("specification", True, message, "", own.score)
    message = f"{tried}; without any of them it does not walk clearly better (score {own.score:.2f}"
    message += f", best {diagnosis.ranked[0].score:.2f})" if diagnosis.ranked else ")"
    passed = bool(not own.fell.any() and (own.scores[1:] >= GOOD).any())
    rule = "; what is wrong is another thing, or several things"
    return judge("specification", passed, message, rule, "compare with the training, field by field", own.score)
