"""Simulation of an adopted policy: it follows commands, and a mistake that makes it fall is identified."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.adopt.diagnosis import Diagnosis
from surefoot.adopt.examination import examine, require_specification
from surefoot.adopt.mistakes import corrections
from surefoot.policy.runtime import PolicyRuntime
from surefoot.task.contract_mapping import task_from_contract


@pytest.fixture(scope="module")
def policy(robot_lab):
    return PolicyRuntime.load(robot_lab)


def test_robot_lab_follows_commands_and_falls_in_another_order_of_legs(go2, policy):
    task = task_from_contract(policy.contract, go2)
    specification = require_specification(policy.contract)
    (other,) = [one for one in corrections(specification, go2) if one.text.endswith("FL FR RL RR, leg by leg")][:1]
    right, wrong = examine(policy, go2, task, [None, other])
    assert right.commands == ("stand", "forward", "backward", "left", "right", "turn", "curve left", "curve right")
    assert not right.fell.any()
    assert right.score > 0.6
    np.testing.assert_allclose(right.velocity[1, 0], 0.6, atol=0.2)
    assert right.velocity[5, 2] > 0.3
    assert wrong.score < 0.1
    assert wrong.fell.sum() >= 5
    # In reverse: for the file with the wrong order, the right order makes it walk.
    diagnosis = Diagnosis.from_results([replace(wrong, change=None), replace(right, change=other)])
    assert diagnosis.mistake.correction is other
