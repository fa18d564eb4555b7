"""Rules of the diagnosis for naming a mistake, on synthetic trial results."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import yaml

from surefoot.adopt.constant_inputs import ConstantInputs
from surefoot.adopt.diagnosis import Diagnosis, check_answers
from surefoot.adopt.examination import TrialResult
from surefoot.adopt.formats import manual
from surefoot.adopt.mistakes import Correction
from surefoot.adopt.robot_variants import RobotVariant, robot_variants
from surefoot.adopt.specification import ObservationTerm, PolicySpecification

SPECIFICATION = PolicySpecification(
    joints=("hip", "knee"),
    default_pose=(0.8, -1.5),
    kp=25.0,
    kd=0.5,
    control_step=0.02,
    observations=(ObservationTerm("command", scale=(2.0, 2.0, 0.25)), ObservationTerm("gravity")),
    notes={"forward": "assumed"},
)
YOUNG = RobotVariant(latency=0.0)


def trial(correction: Correction | RobotVariant | None, scores, fell: bool = False, unusual: int = 0) -> TrialResult:
    """Return a trial result with these scores, made by errors of the forward velocity."""
    command = np.zeros((len(scores), 3))
    command[1:, 0] = 0.5
    motion = command + np.outer(1.0 - np.array(scores), [0.5, 0, 0])
    upright_fraction = np.full((1, len(scores)), 0.25 if fell else 1.0)
    return TrialResult(
        correction, ("stand", "forward", "back")[: len(scores)], command, motion[None], upright_fraction, unusual
    )


def correction_of(text: str) -> Correction:
    return Correction("kp", text, replace(SPECIFICATION, name=text))


def test_the_correction_that_makes_the_policy_walk_is_named():
    own = trial(None, [0.2, 0.0, 0.1])
    diagnosis = Diagnosis.from_results(
        [own, trial(correction_of("a"), [0.5, 0.5, 0.5]), trial(correction_of("b"), [0.8, 0.8, 0.8])]
    )
    assert diagnosis.mistake.correction.text == "b"
    assert diagnosis.ties == ()
    *_, last = check_answers(diagnosis)
    assert last.passed is False
    assert last.message == "2 usual mistakes tried; b (score 0.10, then 0.80)"
    assert last.remedy == "correct kp and adopt it again"


def test_among_tied_corrections_the_one_with_usual_numbers_is_first():
    own = trial(None, [0.2, 0.0, 0.1])
    odd, usual = trial(correction_of("odd"), [0.82] * 3, unusual=1), trial(correction_of("usual"), [0.8] * 3)
    also = trial(correction_of("also"), [0.79] * 3)
    diagnosis = Diagnosis.from_results([own, odd, usual, also])
    assert diagnosis.mistake.correction.text == "usual"
    assert [one.correction.text for one in diagnosis.ties] == ["also"]
    assert check_answers(diagnosis)[-1].remedy == "correct kp and adopt it again; as likely: also"


def test_an_unusual_number_that_simulation_does_not_confirm_is_not_a_failure():
    own, usual = trial(None, [0.8] * 3, unusual=1), trial(correction_of("usual"), [0.79] * 3)
    diagnosis = Diagnosis.from_results([own, usual, trial(correction_of("worse"), [0.6] * 3)])
    assert diagnosis.mistake is usual
    *_, last = check_answers(diagnosis)
    assert last.passed is True
    assert last.message == (
        "2 usual mistakes tried; robots do not show it, but a number is unusual: usual (score 0.80, then 0.79)"
    )
    # A correction that leaves the number unusual is not named.
    assert Diagnosis.from_results([own, trial(correction_of("other"), [0.81] * 3, unusual=1)]).mistake is None


def test_a_walking_policy_has_no_mistake():
    diagnosis = Diagnosis.from_results([trial(None, [0.9, 0.7, 0.8]), trial(correction_of("a"), [0.85] * 3)])
    assert diagnosis.mistake is None
    assert all(check.passed for check in check_answers(diagnosis))


def test_an_unexplained_fall_is_reported():
    own = trial(None, [0.9, 0.9, 0.9], fell=True)
    assert own.score == 0.0
    diagnosis = Diagnosis.from_results([own, trial(correction_of("a"), [0.2] * 3)])
    first, *_, last = check_answers(diagnosis)
    assert first.message == "asked forward 0.00, left 0.00 m/s, turn 0.00 rad/s; it fell after 1.0 s"
    assert last.message.endswith("something else is wrong, or several things")


def test_no_mistake_is_named_if_a_robot_variant_walks():
    own, better = trial(None, [0.5] * 3), trial(correction_of("kd"), [0.9] * 3)
    assert Diagnosis.from_results([own, better, trial(YOUNG, [0.5] * 3)]).is_confirmed
    diagnosis = Diagnosis.from_results([own, better, trial(YOUNG, [0.7] * 3)])
    assert diagnosis.mistake is None
    last = check_answers(diagnosis)[-1]
    assert last.passed is True
    assert "with readings 0 ms old it walks as it is (score 0.50, then 0.70)" in last.message
    assert "configuration may be right" in last.message


def test_no_mistake_is_named_if_the_policy_walks_well():
    assert Diagnosis.from_results([trial(None, [0.68] * 3), trial(correction_of("hips"), [0.95] * 3)]).mistake is None


def test_a_correction_must_make_the_policy_walk():
    own = trial(None, [0.1] * 3)
    assert Diagnosis.from_results([own, trial(correction_of("a"), [0.55] * 3)]).mistake is None
    assert Diagnosis.from_results([own, trial(correction_of("a"), [0.9] * 3, fell=True)]).mistake is None
    # An unusual number is not named if the policy falls with the usual number.
    own, usual = trial(None, [0.5] * 3, unusual=1), trial(correction_of("usual"), [0.55] * 3)
    assert Diagnosis.from_results([own, usual]).mistake is None


def test_the_variant_with_fewest_differences_is_named():
    both = RobotVariant(latency=0.0, rotor=2.0)
    diagnosis = Diagnosis.from_results([trial(None, [0.3] * 3), trial(both, [0.71] * 3), trial(YOUNG, [0.7] * 3)])
    assert diagnosis.explaining_variant.change == YOUNG
    assert both.text == "readings 0 ms old and 2 times the rotor inertia"


def test_no_mistake_is_named_with_constant_inputs():
    constants = ConstantInputs(12, 45, 0.31)
    trials = [trial(None, [0.2] * 3), trial(correction_of("a"), [0.9] * 3)]
    diagnosis = Diagnosis.from_results(trials, constants=constants)
    assert diagnosis.mistake is None
    inputs, last = check_answers(diagnosis)[-2:]
    assert (inputs.name, inputs.passed) == ("constant inputs", False)
    assert inputs.message.startswith("12 of 45 inputs of the network are constants; if one of them changes by 1")
    assert "0.31 rad" in inputs.message
    assert last.passed is False
    assert "a (score" not in last.message


def test_the_result_for_stand_says_that_standing_was_not_trained():
    first, second, *_ = check_answers(
        Diagnosis.from_results([trial(None, [0.9] * 3)]), {"stand": "trained at 0.3 to 0.8 m/s", "forward": "assumed"}
    )
    assert first.message.endswith("; trained at 0.3 to 0.8 m/s")
    assert "trained" not in second.message


def test_variants_differ_from_the_simulated_robot():
    assert RobotVariant(latency=0.0) in robot_variants(0.03)
    assert RobotVariant(latency=0.0) not in robot_variants(0.0)
    assert RobotVariant() not in robot_variants(0.01)


def test_a_specification_round_trips_through_its_file(tmp_path):
    path = tmp_path / "folder" / "mine.yaml"
    manual.write(path, SPECIFICATION)
    assert manual.read(path, None, {}) == SPECIFICATION
    assert "action_scale" not in yaml.safe_load(path.read_text())
