"""Contracts of policy files: JSON round trip, and rejection of invalid contracts."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract, ObservationPart, config_hash
from surefoot.robot import RobotDescription


@pytest.fixture
def contract(robot: RobotDescription) -> Contract:
    legs = robot.leg_names
    actions = tuple(f"{part}.{leg}" for part in ("swing", "extension") for leg in legs)
    return Contract(
        name="test",
        robot=robot.name,
        description=robot.name,
        motor_names=robot.motor_names,
        motor_signs=tuple(robot.motor_sign.tolist()),
        leg_names=legs,
        observation=(ObservationPart("roll", "rad", "base in world"),),
        columns=("roll",),
        history=2,
        action_names=actions,
        low=(-0.1,) * 8,
        high=(1 / 3,) * 8,
        reference={"kind": "sine", "swing": {"amplitude": {"front_left": 0.1 + 0.2}}},
        rest=(0.0, np.pi / 2),
        control_step=0.006,
        servo_latency=0.003,
        control_latency=0.02,
        servo_kp=1.0,
        servo_kd=0.015,
        voltage=16.0,
        task={"name": "test", "params": {"imu_bias": (0.1, 0.0)}},
        config_hash=config_hash({"a": 1}),
        figures={"speed_mean": np.float64(2 / 7), "return_mean": float("nan"), "falls": np.int64(0)},
    )


def test_json_and_back_gives_an_equal_contract_to_the_last_bit(contract: Contract):
    data = json.loads(contract.to_json())
    assert (data["kind"], data["schema"]) == ("surefoot-policy", 2)
    again = Contract.from_json(contract.to_json())
    assert again == contract
    assert again.high[0] == 1 / 3
    assert again.rest[1] == np.pi / 2
    assert again.figures == {"speed_mean": 2 / 7, "return_mean": None, "falls": 0}
    assert again.width == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "recipe"}, "its kind must be 'surefoot-policy'"),
        ({"schema": 1}, "has schema 1; this surefoot reads schema 2: use the version that wrote it"),
        ({"history": "two"}, "contract.history is 'two'; it must be a whole number"),
        ({"history": 0}, "contract.history is 0; it must be 1 or more"),
        ({"low": [0.0]}, "contract.low has 1 numbers; it must have 8"),
        ({"low": [1.0] * 8}, "bounds of swing.front_left are [1, 0.333333]; the lower bound must come first"),
        ({"high": [1e9] * 8}, "contract.high[0] is 1e+09; it must be 6.28"),
        ({"control_step": 0.0}, "contract.control_step is 0; it must be 0.0001 or more"),
        ({"control_latency": -0.001}, "contract.control_latency is -0.001; it must be 0 or more"),
        ({"servo_latency": 3}, "contract.servo_latency is 3; it must be 1 or less"),
        ({"servo_kp": -1.0}, "contract.servo_kp is -1; it must be 0 or more"),
        ({"servo_kp": [1.0] * 7}, "contract.servo_kp has 7 numbers; it must have 8"),
        ({"servo_kd": [0.01] * 7 + [-1.0]}, "contract.servo_kd[7] is -1; it must be 0 or more"),
        ({"voltage": 0.0}, "contract.voltage is 0; it must be 1 or more"),
        ({"rest": [0.0, 1e9]}, "contract.rest[1] is 1e+09; it must be 6.28"),
        ({"reference": {"swing": {"amplitude": 10**300}}}, "it holds 1" + 39 * "0" + "; whole numbers"),
        (
            {"reference": {"kind": "table", "file": "t.npz"}},
            "contract.reference names a file; a policy must contain",
        ),
        ({"task": [0.02]}, "contract.task is [0.02]; it must be a table"),
        ({"colour": "red"}, "contract.colour is not a key"),
    ],
)
def test_a_contract_rejects_other_keys_and_values_than_it_has(contract: Contract, change: dict, message: str):
    data = json.loads(contract.to_json()) | change
    with pytest.raises(SurefootError) as error:
        Contract.from_json(json.dumps(data))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e400", "1" + 400 * "0"])
@pytest.mark.parametrize("where", ["control_latency", "voltage", "history", "fall_angle", "speed_mean"])
def test_a_number_that_is_not_finite_is_rejected_at_any_depth(contract: Contract, where: str, number: str):
    whole = replace(contract, task={"fall_angle": 0.5}, figures={"speed_mean": 0.5}).to_json()
    text = re.sub(rf'("{where}": )[0-9.]+', rf"\g<1>{number}", whole)
    with pytest.raises(SurefootError, match=f"^contract: is not JSON: it holds {number[:40]}; numbers must be finite$"):
        Contract.from_json(text)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"surefoot-policy"', "{}"])
def test_a_text_that_is_no_contract_is_rejected(text: str):
    with pytest.raises(SurefootError, match=r"contract: (is not JSON|its kind must be)"):
        Contract.from_json(text)


def test_a_missing_key_is_named(contract: Contract):
    data = json.loads(contract.to_json())
    del data["voltage"]
    with pytest.raises(SurefootError, match=r"contract\.voltage is missing"):
        Contract.from_json(json.dumps(data))


def test_the_hash_depends_on_content_but_not_on_order():
    assert config_hash({"a": 1, "b": (1, 2.5)}) == config_hash({"b": [1, 2.5], "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})
    # SHA-256 of {"a":1}, by coreutils' sha256sum.
    assert config_hash({"a": 1}) == "015abd7f5cc57a2dd94b7590f04ad8084273905ee33ec5cebeae62276a97f862"
