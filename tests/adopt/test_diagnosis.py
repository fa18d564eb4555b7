"""What a diagnosis calls a mistake, and what it does not: rules on made-up answers of robots."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import yaml

from surefoot.adopt.constant_inputs import ConstantInputs
from surefoot.adopt.diagnosis import Diagnosis, check_answers
from surefoot.adopt.examination import Answer
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


def answer(correction: Correction | RobotVariant | None, scores, fell: bool = False, unusual: int = 0) -> Answer:
    """Return an answer with these scores, by errors forward."""
    command = np.zeros((len(scores), 3))
    command[1:, 0] = 0.5
    motion = command + np.outer(1.0 - np.array(scores), [0.5, 0, 0])
    stood = np.full((1, len(scores)), 0.25 if fell else 1.0)
    return Answer(correction, ("stand", "forward", "back")[: len(scores)], command, motion[None], stood, unusual)


def made(text: str) -> Correction:
    return Correction("kp", text, replace(SPECIFICATION, name=text))


def test_the_change_that_makes_it_walk_is_named():
    own = answer(None, [0.2, 0.0, 0.1])
    diagnosis = Diagnosis.from_results([own, answer(made("a"), [0.5, 0.5, 0.5]), answer(made("b"), [0.8, 0.8, 0.8])])
    assert diagnosis.mistake.correction.text == "b"
    assert diagnosis.alike == ()
    *_, last = check_answers(diagnosis)
    assert last.passed is False
    assert last.message == "2 usual mistakes tried; b (score 0.10, then 0.80)"
    assert last.remedy == "correct kp and adopt it again"


def test_of_changes_that_are_alike_the_usual_one_comes_first():
    own = answer(None, [0.2, 0.0, 0.1])
    odd, usual = answer(made("odd"), [0.82] * 3, unusual=1), answer(made("usual"), [0.8] * 3)
    also = answer(made("also"), [0.79] * 3)
    diagnosis = Diagnosis.from_results([own, odd, usual, also])
    assert diagnosis.mistake.correction.text == "usual"
    assert [one.correction.text for one in diagnosis.alike] == ["also"]
    assert check_answers(diagnosis)[-1].remedy == "correct kp and adopt it again; as likely: also"


def test_an_unusual_number_that_robots_do_not_show_is_no_failure():
    own, usual = answer(None, [0.8] * 3, unusual=1), answer(made("usual"), [0.79] * 3)
    diagnosis = Diagnosis.from_results([own, usual, answer(made("worse"), [0.6] * 3)])
    assert diagnosis.mistake is usual
    *_, last = check_answers(diagnosis)
    assert last.passed is True
    assert last.message == (
        "2 usual mistakes tried; robots do not show it, but a number is unusual: usual (score 0.80, then 0.79)"
    )
    # As unusual as the policy itself: nothing speaks for it.
    assert Diagnosis.from_results([own, answer(made("other"), [0.81] * 3, unusual=1)]).mistake is None


def test_a_policy_that_walks_is_left_alone():
    diagnosis = Diagnosis.from_results([answer(None, [0.9, 0.7, 0.8]), answer(made("a"), [0.85] * 3)])
    assert diagnosis.mistake is None
    assert all(check.passed for check in check_answers(diagnosis))


def test_a_fall_that_no_mistake_explains_is_said():
    own = answer(None, [0.9, 0.9, 0.9], fell=True)
    assert own.score == 0.0
    diagnosis = Diagnosis.from_results([own, answer(made("a"), [0.2] * 3)])
    first, *_, last = check_answers(diagnosis)
    assert first.message == "asked forward 0.00, left 0.00 m/s, turn 0.00 rad/s; it fell after 1.0 s"
    assert last.message.endswith("what is wrong is another thing, or several things")


def test_no_number_is_a_mistake_where_a_robot_with_other_readings_walks():
    own, better = answer(None, [0.5] * 3), answer(made("kd"), [0.9] * 3)
    assert Diagnosis.from_results([own, better, answer(YOUNG, [0.5] * 3)]).is_confirmed
    diagnosis = Diagnosis.from_results([own, better, answer(YOUNG, [0.7] * 3)])
    assert diagnosis.mistake is None
    last = check_answers(diagnosis)[-1]
    assert last.passed is True
    assert "with readings 0 ms old it walks as it is (score 0.50, then 0.70)" in last.message
    assert "configuration may be right" in last.message


def test_no_number_is_a_mistake_of_a_policy_that_walks():
    assert Diagnosis.from_results([answer(None, [0.68] * 3), answer(made("hips"), [0.95] * 3)]).mistake is None


def test_a_correction_must_make_it_walk():
    own = answer(None, [0.1] * 3)
    assert Diagnosis.from_results([own, answer(made("a"), [0.55] * 3)]).mistake is None
    assert Diagnosis.from_results([own, answer(made("a"), [0.9] * 3, fell=True)]).mistake is None
    # Nor is an unusual number named where the usual one makes it fall.
    own, usual = answer(None, [0.5] * 3, unusual=1), answer(made("usual"), [0.55] * 3)
    assert Diagnosis.from_results([own, usual]).mistake is None


def test_the_robot_that_differs_least_is_named():
    both = RobotVariant(latency=0.0, rotor=2.0)
    diagnosis = Diagnosis.from_results([answer(None, [0.3] * 3), answer(both, [0.71] * 3), answer(YOUNG, [0.7] * 3)])
    assert diagnosis.explained.change == YOUNG
    assert both.text == "readings 0 ms old and 2 times the rotor inertia"


def test_while_inputs_are_constants_no_mistake_is_named():
    constants = ConstantInputs(12, 45, 0.31)
    answers = [answer(None, [0.2] * 3), answer(made("a"), [0.9] * 3)]
    diagnosis = Diagnosis.from_results(answers, constants=constants)
    assert diagnosis.mistake is None
    inputs, last = check_answers(diagnosis)[-2:]
    assert (inputs.name, inputs.passed) == ("constant inputs", False)
    assert inputs.message.startswith("12 of 45 inputs of the network are constants; where one of them changes by 1")
    assert "0.31 rad" in inputs.message
    assert last.passed is False
    assert "a (score" not in last.message


def test_what_a_policy_was_not_trained_for_is_said_beside_stand():
    first, second, *_ = check_answers(
        Diagnosis.from_results([answer(None, [0.9] * 3)]), {"stand": "trained at 0.3 to 0.8 m/s", "forward": "assumed"}
    )
    assert first.message.endswith("; trained at 0.3 to 0.8 m/s")
    assert "trained" not in second.message


def test_other_robots_have_other_readings_than_the_simulated_one():
    assert RobotVariant(latency=0.0) in robot_variants(0.03)
    assert RobotVariant(latency=0.0) not in robot_variants(0.0)
    assert RobotVariant() not in robot_variants(0.01)


def test_a_specification_is_written_as_it_is_read(tmp_path):
    path = tmp_path / "folder" / "mine.yaml"
    manual.write(path, SPECIFICATION)
    assert manual.read(path, None, {}) == SPECIFICATION
    assert "action_scale" not in yaml.safe_load(path.read_text())
