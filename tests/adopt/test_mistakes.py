"""The usual mistakes: each correction, put around a policy file, is the file that the corrected specification makes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from foreign import perceptron

from surefoot.adopt.builder import build_policy
from surefoot.adopt.examination import Answer, Corrected, Diagnosis, check_answers, stated_specification
from surefoot.adopt.mistakes import Correction, corrections, fits, joint_orders, unusual_numbers
from surefoot.adopt.onnx_network import OnnxNetwork
from surefoot.adopt.specification import PolicySpecification, Term
from surefoot.errors import SurefootError
from surefoot.policy.runtime import PolicyRuntime

STEPS = (0, 1, 2)
SPECIFICATION = PolicySpecification(
    joints=tuple(f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")),
    default_pose=(0.1, 0.8, -1.5, -0.1, 0.8, -1.5, 0.1, 1.0, -1.5, -0.1, 1.0, -1.5),
    kp=(40.0, 41.0, 42.0) * 4,
    kd=1.0,
    control_step=0.02,
    observations=(
        Term("command", scale=(2.0, 2.0, 0.25), steps=STEPS),
        Term("angular_velocity", scale=0.25, steps=STEPS),
        Term("gravity", steps=STEPS),
        Term("joint_positions", steps=STEPS),
        Term("joint_speeds", scale=0.05, steps=STEPS),
        Term("last_action", steps=STEPS),
    ),
    action_scale=(0.125, 0.25, 0.25) * 4,
    action_clip=(-100.0, 100.0),
)


@pytest.fixture(scope="module")
def network():
    return OnnxNetwork(perceptron(135))


@pytest.fixture(scope="module")
def tried(go2):
    return corrections(SPECIFICATION, go2)


def test_corrections_fit_the_robot_and_differ(go2, tried):
    texts = {one.text.partition(":")[0] for one in tried}
    assert {
        "order of joints",
        "history",
        "order of the observation",
        "control step",
        "gains",
        "scale of actions",
    } <= texts
    assert len({repr(one.specification) for one in tried}) == len(tried) > 120
    assert all(fits(one.specification, go2) for one in tried)
    assert SPECIFICATION not in [one.specification for one in tried]


def test_unusual_numbers_are_named(tried):
    assert unusual_numbers(SPECIFICATION) == ()
    by_text = {one.text: unusual_numbers(one.specification) for one in tried}
    rates = "scales of angular velocity and joint speeds"
    assert by_text["scale of joint speeds: it should be 1, 20 times as large"] == (rates,)
    assert by_text["control step: it should be 40 ms"] == ("control step",)
    assert by_text["derivative gains: they should be 4 N m s/rad, 4 times as large"] == ("gains",)
    assert by_text["scale of command's yaw rate: it should be 4 times as large"] == ("scale of command",)
    assert by_text["sign of gravity (x): it should be the other one"] == ()
    # legged_gym's scales of commands, whatever their order.
    turned = Term("command", scale=(0.25, 2.0, 2.0), columns=(2, 0, 1))
    assert unusual_numbers(replace(SPECIFICATION, observations=(turned,))) == ()


def test_orders_of_joints_are_the_usual_ones(go2):
    orders = joint_orders(go2)
    assert orders["FR FL RR RL, leg by leg"] == go2.motor_names
    assert orders["FL FR RL RR, joint by joint"][:5] == (
        *("FL_hip_joint", "FR_hip_joint", "RL_hip_joint", "RR_hip_joint"),
        "FL_thigh_joint",
    )


def test_a_corrected_policy_is_the_policy_of_the_corrected_specification(go2, network, tried):
    policy = PolicyRuntime.parse(build_policy(SPECIFICATION, network, go2, "own", {}))
    assert stated_specification(policy.contract) == SPECIFICATION
    some = [one.specification for one in tried[::6]]
    random = np.random.default_rng(0)
    contract = policy.contract
    names = [*contract.columns]
    raw = random.normal(scale=0.2, size=(3, contract.history, len(names)))
    raw[..., [name.startswith("angle.") for name in names]] += np.tile([0.0, 0.8, -1.5], 4)
    rows = np.tile(raw.reshape(3, -1), (len(some), 1))
    mine = Corrected(policy, go2, some).feedback(rows)
    low, high = go2.motor_limits
    for k, specification in enumerate(some):
        whole = PolicyRuntime.parse(build_policy(specification, network, go2, "corrected", {}))
        theirs = whole.feedback(raw.reshape(3, -1))
        np.testing.assert_allclose(mine[3 * k : 3 * k + 3, 12:], theirs[:, 12:], atol=2e-4, rtol=1e-4)
        np.testing.assert_allclose(mine[3 * k : 3 * k + 3, :12], np.clip(theirs[:, :12], low, high), atol=1e-4)


def answer(correction: Correction | None, scores, fell: bool = False, unusual: int = 0) -> Answer:
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
    diagnosis = Diagnosis.from_answers([own, answer(made("a"), [0.5, 0.5, 0.5]), answer(made("b"), [0.8, 0.8, 0.8])])
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
    diagnosis = Diagnosis.from_answers([own, odd, usual, also])
    assert diagnosis.mistake.correction.text == "usual"
    assert [one.correction.text for one in diagnosis.alike] == ["also"]
    assert check_answers(diagnosis)[-1].remedy == "correct kp and adopt it again; as likely: also"


def test_an_unusual_number_that_robots_do_not_show_is_no_failure():
    own, usual = answer(None, [0.8] * 3, unusual=1), answer(made("usual"), [0.79] * 3)
    diagnosis = Diagnosis.from_answers([own, usual, answer(made("worse"), [0.6] * 3)])
    assert diagnosis.mistake is usual
    *_, last = check_answers(diagnosis)
    assert last.passed is True
    assert last.message == (
        "2 usual mistakes tried; robots do not show it, but a number is unusual: usual (score 0.80, then 0.79)"
    )
    # As unusual as the policy itself: nothing speaks for it.
    assert Diagnosis.from_answers([own, answer(made("other"), [0.81] * 3, unusual=1)]).mistake is None


def test_a_policy_that_walks_is_left_alone():
    diagnosis = Diagnosis.from_answers([answer(None, [0.9, 0.7, 0.8]), answer(made("a"), [0.85] * 3)])
    assert diagnosis.mistake is None
    assert all(check.passed for check in check_answers(diagnosis))


def test_a_fall_that_no_mistake_explains_is_said():
    own = answer(None, [0.9, 0.9, 0.9], fell=True)
    assert own.score == 0.0
    diagnosis = Diagnosis.from_answers([own, answer(made("a"), [0.2] * 3)])
    first, *_, last = check_answers(diagnosis)
    assert first.message == "asked forward 0.00, left 0.00 m/s, turn 0.00 rad/s; it fell after 1.0 s"
    assert last.message.endswith("what is wrong is another thing, or several things")


def test_only_adopted_policies_have_a_specification():
    from surefoot.api.policies import find_policy

    with pytest.raises(SurefootError, match="policy 'go2-steer' was not adopted"):
        stated_specification(PolicyRuntime.load(find_policy("go2-steer")).contract)
