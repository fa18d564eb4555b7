"""Usual mistakes: a policy file with an applied correction equals a file built from the corrected specification."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from third_party_policies import perceptron

from surefoot.adopt.builder import build_policy
from surefoot.adopt.examination import CorrectedPolicy, require_specification
from surefoot.adopt.mistakes import corrections, fits_robot, joint_orders
from surefoot.adopt.onnx_network import OnnxNetwork
from surefoot.adopt.specification import ObservationTerm, PolicySpecification
from surefoot.adopt.usual_numbers import unusual_numbers
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
        ObservationTerm("command", scale=(2.0, 2.0, 0.25), steps=STEPS),
        ObservationTerm("angular_velocity", scale=0.25, steps=STEPS),
        ObservationTerm("gravity", steps=STEPS),
        ObservationTerm("joint_positions", steps=STEPS),
        ObservationTerm("joint_speeds", scale=0.05, steps=STEPS),
        ObservationTerm("last_action", steps=STEPS),
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


def test_corrections_are_distinct_and_compatible_with_the_robot(go2, tried):
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
    assert all(fits_robot(one.specification, go2) for one in tried)
    assert SPECIFICATION not in [one.specification for one in tried]


def test_unusual_numbers_are_named(go2, tried):
    assert unusual_numbers(SPECIFICATION, go2) == ()
    by_text = {one.text: unusual_numbers(one.specification, go2) for one in tried}
    rates = "scales of angular velocity and joint speeds"
    assert by_text["scale of joint speeds: it should be 1, 20 times as large"] == (rates,)
    assert by_text["control step: it should be 40 ms"] == ("control step",)
    assert by_text["derivative gains: they should be 4 N m s/rad, 4 times as large"] == ("gains",)
    assert by_text["scale of command's yaw rate: it should be 4 times as large"] == ("scale of command",)
    assert by_text["sign of gravity (x): it should be the other one"] == ("signs of scales",)
    assert by_text["order of gravity: it should be y, x, z"] == ("order of axes",)
    assert by_text["scale of gravity: it should be 9.81"] == ("scale of gravity",)
    # legged_gym's command scales are usual in any order.
    turned = ObservationTerm("command", scale=(0.25, 2.0, 2.0), columns=(2, 0, 1))
    assert unusual_numbers(replace(SPECIFICATION, observations=(turned,)), go2) == ("order of axes",)


def test_usual_joint_orders(go2):
    orders = joint_orders(go2)
    assert orders["FR FL RR RL, leg by leg"] == go2.motor_names
    assert orders["FL FR RL RR, joint by joint"][:5] == (
        *("FL_hip_joint", "FR_hip_joint", "RL_hip_joint", "RR_hip_joint"),
        "FL_thigh_joint",
    )


def test_a_corrected_policy_equals_one_built_from_the_corrected_specification(go2, network, tried):
    policy = PolicyRuntime.parse(build_policy(SPECIFICATION, network, go2, "own", {}))
    assert require_specification(policy.contract) == SPECIFICATION
    some = [one.specification for one in tried[::6]]
    random = np.random.default_rng(0)
    contract = policy.contract
    names = [*contract.columns]
    raw = random.normal(scale=0.2, size=(3, contract.history, len(names)))
    raw[..., [name.startswith("angle.") for name in names]] += np.tile([0.0, 0.8, -1.5], 4)
    rows = np.tile(raw.reshape(3, -1), (len(some), 1))
    mine = CorrectedPolicy(policy, go2, some).feedback(rows)
    low, high = go2.motor_limits
    for k, specification in enumerate(some):
        whole = PolicyRuntime.parse(build_policy(specification, network, go2, "corrected", {}))
        theirs = whole.feedback(raw.reshape(3, -1))
        np.testing.assert_allclose(mine[3 * k : 3 * k + 3, 12:], theirs[:, 12:], atol=2e-4, rtol=1e-4)
        np.testing.assert_allclose(mine[3 * k : 3 * k + 3, :12], np.clip(theirs[:, :12], low, high), atol=1e-4)


def test_a_corrected_policy_clips_targets(go2, network):
    clipped = replace(SPECIFICATION, target_clip=(-1.6, (0.05, 0.9, -1.4) * 4))
    policy = PolicyRuntime.parse(build_policy(clipped, network, go2, "own", {}))
    raw = np.random.default_rng(0).normal(scale=0.5, size=(20, policy.contract.width))
    mine = CorrectedPolicy(policy, go2, [clipped]).feedback(raw)
    np.testing.assert_allclose(mine[:, :12], policy.feedback(raw)[:, :12], atol=1e-5)


def test_another_order_of_joints_takes_all_numbers_along(go2):
    spec = replace(
        SPECIFICATION,
        action_clip=((-1.0, -2.0, -3.0) * 4, 5.0),
        observations=(ObservationTerm("joint_speeds", scale=(0.1, 0.2, 0.3) * 4), ObservationTerm("gravity")),
    )
    hips_first = "order of joints: it should be FL FR RL RR, joint by joint"
    (moved,) = (
        one.specification
        for one in corrections(spec, go2)
        if one.text == hips_first and one.specification.kp != spec.kp
    )
    assert moved.kp == (40.0,) * 4 + (41.0,) * 4 + (42.0,) * 4
    assert moved.action_clip == ((-1.0,) * 4 + (-2.0,) * 4 + (-3.0,) * 4, 5.0)
    assert moved.observations[0].scale == (0.1,) * 4 + (0.2,) * 4 + (0.3,) * 4
    assert moved.observations[1] == spec.observations[1]


def test_only_adopted_policies_have_a_specification():
    from surefoot.api.policies import find_policy

    with pytest.raises(SurefootError, match="policy 'go2-steer' was not adopted"):
        require_specification(PolicyRuntime.load(find_policy("go2-steer")).contract)
