"""Diagnosis of an adopted policy: a mistake in its configuration, or a robot variant that explains its behaviour.

All changes are first tried in short episodes, the best of them in longer ones with other random robots. A number of the
configuration is called a mistake only if the policy walks with the corrected number, and walks well neither unchanged
nor on any robot variant.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from surefoot.adopt.constant_inputs import ConstantInputs, constant_inputs
from surefoot.adopt.examination import (
    EPISODE_DURATION,
    MIN_GOOD_SCORE,
    Change,
    TrialResult,
    TrueVelocity,
    examine,
    require_specification,
)
from surefoot.adopt.mistakes import corrections
from surefoot.adopt.robot_variants import RobotVariant, robot_variants
from surefoot.check_result import CheckResult, pass_if
from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import Progress
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.task.config import TaskConfig

SCREENING_DURATION = 2.0
"""Duration of episodes in the first round, with all changes [s]; in the second round it is `EPISODE_DURATION`."""
SCREENING_COMMANDS = ("forward", "backward", "left", "turn", "curve left")
"""Commands of the first round."""
MAX_FINALISTS, FINAL_REPEATS = 16, 2
"""Number of corrections in the second round, and of robots per command there."""
MAX_FINAL_VARIANTS = 6
"""Number of robot variants in the second round."""
MIN_SCORE_GAIN = 0.06
"""Minimum gain in score for a change to be named, unless it leads to usual numbers."""
TIE_MARGIN = 0.03
"""Difference in likelihood up to which two changes can't be distinguished."""
MIN_WALKING_SCORE, MIN_GOOD_WALKING_SCORE = 0.6, 0.65
"""Minimum score of a policy that walks, and of one that walks so well that no number is called a mistake."""
MAX_ERROR_RATIO = 1.5
"""Maximum ratio of a policy's errors with the estimated speed of the base to its errors with the true speed."""
MIN_DIFFERENCE = np.array([0.02, 0.02, 0.04])
"""Differences of these errors [m/s, m/s, rad/s] that do not matter."""
DIFFERENCE_PENALTY = 0.02
"""Penalty on the score of a robot variant per property that differs, for the choice of the best variants."""


@dataclass(frozen=True)
class Diagnosis:
    """Result of the search for a mistake in an adopted policy."""

    baseline: TrialResult
    """Result of the unchanged policy."""
    ranked: tuple[TrialResult, ...]
    """Results of all corrections, the most likely first."""
    variants: tuple[TrialResult, ...] = ()
    """Results of the unchanged policy on robot variants, the best first."""
    constants: ConstantInputs | None = None
    """Constant inputs of the network, or None."""
    with_true_velocity: TrialResult | None = None
    """Result of the unchanged policy with the true speed of the base; None if it does not observe the speed."""

    @classmethod
    def from_results(
        cls, trials: Sequence[TrialResult], others: Sequence[TrialResult] = (), constants: ConstantInputs | None = None
    ) -> Diagnosis:
        """Create a diagnosis from results.

        Args:
            trials: results, the unchanged policy's first.
            others: results of further corrections in order, which are ranked last.
            constants: constant inputs of the network.
        """
        corrected = sorted(
            (one for one in trials[1:] if one.correction is not None), key=lambda trial: -trial.likelihood
        )
        variants = sorted((one for one in trials if isinstance(one.change, RobotVariant)), key=_variant_sort_key)
        true = next((one for one in trials if isinstance(one.change, TrueVelocity)), None)
        return cls(trials[0], (*corrected, *others), tuple(variants), constants, true)

    @property
    def mistake(self) -> TrialResult | None:
        """The most likely mistake as the result of its correction, or None.

        With the correction, the policy either walks clearly better than unchanged and on all robot variants, or walks
        with fewer unusual numbers. No mistake is named if inputs of the network are constants.
        """
        if not self.ranked or self.constants is not None:
            return None
        best = self.ranked[0]
        if walks(best) and self._is_clearly_better(best):
            return best
        usual = next((one for one in self.ranked if one.unusual < self.baseline.unusual and walks(one)), None)
        return usual if usual is not None and usual.likelihood >= self.baseline.likelihood + TIE_MARGIN else None

    def _is_clearly_better(self, trial: TrialResult) -> bool:
        rivals = (self.baseline, *self.variants)
        if any(walks(rival, MIN_GOOD_WALKING_SCORE) for rival in rivals):
            return False
        return trial.score >= max(rival.score for rival in rivals) + MIN_SCORE_GAIN

    @property
    def is_confirmed(self) -> bool:
        """Whether the simulated robots confirm the mistake; otherwise only unusual numbers suggest it."""
        return self.mistake is not None and self._is_clearly_better(self.mistake)

    @property
    def explaining_variant(self) -> TrialResult | None:
        """The robot variant on which the unchanged policy walks, and clearly better than on the simulated robot."""
        best = self.variants[0] if self.variants else None
        return best if best is not None and walks(best) and best.score >= self.baseline.score + MIN_SCORE_GAIN else None

    @property
    def ties(self) -> tuple[TrialResult, ...]:
        """Other corrections that are as likely as the mistake."""
        best = self.mistake
        if best is None:
            return ()
        others = (one for one in self.ranked[:MAX_FINALISTS] if one is not best)
        return tuple(one for one in others if one.likelihood >= best.likelihood - TIE_MARGIN)


def walks(trial: TrialResult, score: float = MIN_WALKING_SCORE) -> bool:
    """Return whether the policy walks: no robot falls, and the mean score reaches `score`."""
    return not trial.fell.any() and trial.score >= score


def _variant_sort_key(trial: TrialResult) -> float:
    """Sort key for results of robot variants: the best first, and fewer differences are preferred."""
    assert isinstance(trial.change, RobotVariant)
    return DIFFERENCE_PENALTY * trial.change.count - trial.score


def diagnose(
    policy: PolicyRuntime,
    robot: RobotDescription,
    task: TaskConfig,
    world: str = "mujoco",
    seed: int = 0,
    threads: int = 1,
    progress: Progress | None = None,
) -> Diagnosis:
    """Examine a policy unchanged, with each usual mistake corrected, and on robot variants; see `examine`."""
    specification = require_specification(policy.contract)
    tried = corrections(specification, robot)
    variants = _allowed_variants(robot, task)

    def half_from(start: float) -> Progress | None:
        return None if progress is None else lambda fraction: progress(start + 0.5 * fraction)

    own, *first = examine(
        policy,
        robot,
        task,
        [None, *tried, *variants],
        world,
        seed,
        threads,
        half_from(0.0),
        SCREENING_DURATION,
        1,
        SCREENING_COMMANDS,
    )
    first.sort(key=lambda trial: -trial.likelihood)
    better = [one for one in first if one.correction is not None]
    other_robots = sorted((one for one in first if one.correction is None), key=_variant_sort_key)[:MAX_FINAL_VARIANTS]
    again: list[Change | None] = [one.change for one in (own, *better[:MAX_FINALISTS], *other_robots)]
    if specification.observes_base_velocity:
        again.append(TrueVelocity())
    # Another seed than in the selection of finalists, so that the final scores are not biased by it.
    final = examine(
        policy, robot, task, again, world, seed + 1, threads, half_from(0.5), EPISODE_DURATION, FINAL_REPEATS
    )
    return Diagnosis.from_results(final, better[MAX_FINALISTS:], constant_inputs(policy.contract, robot))


def _allowed_variants(robot: RobotDescription, task: TaskConfig) -> list[RobotVariant]:
    """Return the robot variants that the robot's description allows."""
    nominal = PhysicalParams.nominal(robot).with_values(robot, **task.params)
    variants = []
    for variant in robot_variants(float(nominal.control_latency[0])):
        try:
            nominal.with_values(robot, **variant.params(nominal))
        except SurefootError:
            continue
        variants.append(variant)
    return variants


def check_answers(diagnosis: Diagnosis, notes: Mapping[str, str] = MappingProxyType({})) -> list[CheckResult]:
    """Return check results: one per command, and one each for base velocity, constant inputs and the specification.

    Args:
        diagnosis: diagnosis of the policy.
        notes: notes of the specification; `stand` is added to the result of the command to stand.
    """
    own = diagnosis.baseline
    explained = diagnosis.is_confirmed or diagnosis.explaining_variant is not None
    remedy = "see the line specification" if explained else "perhaps it was not trained for this: see its training"
    results = []
    for k, (name, command, velocity, score) in enumerate(
        zip(own.commands, own.command, own.velocity, own.scores, strict=True)
    ):
        asked, went = (
            "forward {:.2f}, left {:.2f} m/s, turn {:.2f} rad/s".format(*(np.round(np.nan_to_num(row), 2) + 0.0))
            for row in (command, velocity)
        )
        time = EPISODE_DURATION * own.upright_fraction[:, k].min()
        end = f"it fell after {time:.1f} s" if own.fell[k] else f"it went {went}"
        message = f"asked {asked}; {end}"
        if name == "stand" and "stand" in notes:
            message += f"; {notes['stand']}"
        results.append(pass_if(name, bool(score >= MIN_GOOD_SCORE), message, "", remedy, float(score)))
    if diagnosis.with_true_velocity is not None:
        results.append(_check_velocity(own, diagnosis.with_true_velocity))
    if diagnosis.constants is not None:
        results.append(_check_constants(diagnosis))
    return [*results, _check_specification(diagnosis)]


def _check_velocity(own: TrialResult, true: TrialResult) -> CheckResult:
    """Compare a policy with the estimated and with the true speed of the base."""

    def describe(trial: TrialResult) -> str:
        errors = "errors {:.2f} m/s forward, {:.2f} m/s sideways, {:.2f} rad/s".format(*trial.errors)
        return f"{trial.falls} of {trial.upright_fraction.size} robots fell, {errors}"

    limit = np.maximum(MAX_ERROR_RATIO * true.errors, true.errors + MIN_DIFFERENCE)
    passed = own.falls <= true.falls and not bool((own.errors > limit).any())
    message = f"estimated: {describe(own)}; true: {describe(true)}"
    rule = f"; with the estimate no more may fall, and errors may be {MAX_ERROR_RATIO:g} times as large"
    remedy = "see docs/estimation.md on when not to trust the estimate, or train without the speed"
    return pass_if("base velocity", passed, message, rule, remedy, float(own.score - true.score))


def _check_constants(diagnosis: Diagnosis) -> CheckResult:
    assert diagnosis.constants is not None
    walking = walks(diagnosis.baseline)
    remedy = "observe the quantities that training had there, or train without them"
    return pass_if("constant inputs", walking, diagnosis.constants.text, "", remedy, float(diagnosis.constants.count))


def _check_specification(diagnosis: Diagnosis) -> CheckResult:
    own, mistake, variant = diagnosis.baseline, diagnosis.mistake, diagnosis.explaining_variant
    if diagnosis.constants is not None:
        message = f"no mistake is named while inputs are constants (score {own.score:.2f})"
        return pass_if("specification", walks(own), message, "", "see the line constant inputs", own.score)
    tried = f"{len(diagnosis.ranked)} usual mistakes tried"
    if mistake is not None and mistake.correction is not None and diagnosis.is_confirmed:
        message = f"{tried}; {mistake.text} (score {own.score:.2f}, then {mistake.score:.2f})"
        what = f"correct {mistake.correction.field} and adopt it again"
        if others := [one.text for one in diagnosis.ties]:
            what += f"; as likely: {'; '.join(others[:3])}"
        return CheckResult("specification", False, message, what, mistake.score)
    if variant is not None or mistake is not None:
        message = tried
        if variant is not None:
            message += (
                f"; with {variant.text} it walks as it is (score {own.score:.2f}, then {variant.score:.2f}): the "
            )
            message += "configuration may be right, and the robot in training different from the simulated one"
        if mistake is not None:
            message += f"; {'' if variant else 'robots do not show it, but '}a number is unusual: {mistake.text}"
            message += f" (score {own.score:.2f}, then {mistake.score:.2f})"
        return CheckResult("specification", True, message, "", own.score)
    message = f"{tried}; without any of them it does not walk clearly better (score {own.score:.2f}"
    message += f", best {diagnosis.ranked[0].score:.2f})" if diagnosis.ranked else ")"
    passed = bool(not own.fell.any() and (own.scores[1:] >= MIN_GOOD_SCORE).any())
    rule = "; something else is wrong, or several things"
    return pass_if("specification", passed, message, rule, "compare with the training, field by field", own.score)
