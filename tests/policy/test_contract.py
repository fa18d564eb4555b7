"""The contract: a round trip without loss, and refusals in one line."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract, ObservationPart, check_robot, config_hash
from surefoot.robot import RobotDescription


@pytest.fixture
def contract(robot: RobotDescription) -> Contract:
    legs = robot.leg_names
    actions = tuple(f"{part}.{leg}" for part in ("swing", "extension") for leg in legs)
    return Contract(
        name="test",
        robot=robot.name,
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
        task={"name": "test", "observations": ("roll",), "rest": None},
        config_hash=config_hash({"a": 1}),
        figures={"speed_mean": np.float64(2 / 7), "return_mean": float("nan"), "falls": np.int64(0)},
    )


def test_json_and_back_gives_an_equal_contract_to_the_last_bit(contract: Contract):
    again = Contract.from_json(contract.to_json())
    assert again == contract
    assert again.high[0] == 1 / 3
    assert again.rest[1] == np.pi / 2
    assert again.figures == {"speed_mean": 2 / 7, "return_mean": None, "falls": 0}
    assert again.width == 2


def test_json_states_kind_and_schema(contract: Contract):
    data = json.loads(contract.to_json())
    assert (data["kind"], data["schema"]) == ("surefoot-policy", 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "recipe"}, "its kind must be 'surefoot-policy'"),
        ({"schema": 2}, "has schema 2; this surefoot reads schema 1"),
        ({"history": "two"}, "contract.history is 'two'; it must be a whole number"),
        ({"low": [0.0]}, "low has 1 numbers; it must have 8"),
        ({"low": [9.0] * 8}, r"bounds of swing.front_left are \[9, 0.333333\]"),
        ({"motor_signs": [2.0] * 8}, "each must be 1 or -1"),
        ({"control_step": 0.0}, "control_step is 0.0; it must be a number from 0.0001 to 1 s"),
        ({"control_latency": -0.001}, "control_latency is -0.001; it must be a number from 0 to 1 s"),
        ({"servo_latency": 3}, "servo_latency is 3.0; it must be a number from 0 to 1 s"),
        ({"servo_kp": -1.0}, "servo_kp is -1.0; it must be a number from 0 to 10000 1/rad or N m/rad"),
        ({"servo_kd": 1e300}, "servo_kd is 1e.300; it must be a number from 0 to 10000 s/rad or N m s/rad"),
        ({"voltage": 0.0}, "voltage is 0.0; it must be a number from 1 to 1000 V"),
        ({"rest": [0.0, 1e9]}, "rest is 1000000000.0; it must be a number from -6.28319 to 6.28319 rad"),
        ({"high": [1e9] * 8}, r"bounds of swing.front_left are \[-0.1, 1e.09\]; the lower one first, both within 2 pi"),
        ({"task": {"fall_angle": 1e9}}, "task.fall_angle is 1000000000.0; it must be a number from 0.001 to 3.14"),
        ({"task": {"fall_angle": 0}}, "task.fall_angle is 0; it must be a number"),
        ({"task": {"fall_angle": None}}, "task.fall_angle is None; it must be a number"),
        ({"task": {"fall_angle": True}}, "task.fall_angle is True; it must be a number"),
        ({"task": {"max_steps": 10**12}}, "task.max_steps is 1000000000000; it must be a number from 1 to 1e.06"),
        ({"task": {"max_steps": "long"}}, "task.max_steps is 'long'; it must be a number"),
        (
            {"task": {"params": {"control_latency": [0.02]}}},
            "task.params.control_latency is \\[0.02\\]; it must be a number",
        ),
        ({"task": {"params": {"control_latency": "x"}}}, "task.params.control_latency is 'x'; it must be a number"),
        ({"task": {"params": {"servo_kp": [1.0] * 7 + [-1.0]}}}, "task.params.servo_kp is -1.0; it must be a number"),
        ({"servo_kp": [1.0] * 7}, "servo_kp has 7 numbers; a robot has one for each motor"),
        ({"servo_kd": [0.01] * 7 + [-1.0]}, "servo_kd is -1.0; it must be a number from 0 to 10000"),
        ({"task": {"energy_weight": "x"}}, "task.energy_weight is 'x'; it must be a number from 0 to 1e.06 m/J"),
        ({"reference": {"swing": {"amplitude": 10**300}}}, "it holds 10{39}; whole numbers must be below 2.64"),
        ({"task": {"params": [0.02]}}, r"task.params is \[0.02\]; it must be a table"),
        ({"colour": "red"}, "contract.colour is not a key"),
        ({"columns": []}, "the policy observes nothing"),
    ],
)
def test_what_does_not_fit_is_refused(contract: Contract, change: dict, message: str):
    data = json.loads(contract.to_json()) | change
    with pytest.raises(SurefootError, match=message) as caught:
        Contract.from_json(json.dumps(data))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("number", ["NaN", "-Infinity", "1e400", "1" + 400 * "0"])
@pytest.mark.parametrize("where", ["control_latency", "voltage", "history", "fall_angle", "speed_mean"])
def test_a_number_that_is_not_finite_is_refused_wherever_it_stands(contract: Contract, where: str, number: str):
    whole = replace(contract, task={"fall_angle": 0.5}, figures={"speed_mean": 0.5}).to_json()
    text = re.sub(rf'("{where}": )[0-9.]+', rf"\g<1>{number}", whole)
    with pytest.raises(SurefootError, match=f"^contract: is not JSON: it holds {number[:40]}; numbers must be finite$"):
        Contract.from_json(text)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", '"surefoot-policy"', "{}"])
def test_what_is_no_contract_is_refused(text: str):
    with pytest.raises(SurefootError, match="contract: is no"):
        Contract.from_json(text)


def test_a_missing_key_is_named(contract: Contract):
    data = json.loads(contract.to_json())
    del data["voltage"]
    with pytest.raises(SurefootError, match=r"contract\.voltage is missing"):
        Contract.from_json(json.dumps(data))


def swapped(names: tuple[str, ...]) -> tuple[str, ...]:
    return (names[1], names[0], *names[2:])


def test_another_robot_than_it_was_made_for_is_refused(contract: Contract, robot: RobotDescription):
    check_robot(contract, robot)
    cases = [
        (replace(contract, robot="spot"), "is for robot 'spot'; this robot is 'minitaur'"),
        (replace(contract, leg_names=swapped(contract.leg_names)), "has legs back_left, front_left"),
        (replace(contract, motor_names=swapped(contract.motor_names)), "has 'front_left_1_motor' as motor 0"),
        (replace(contract, motor_signs=tuple(-s for s in contract.motor_signs)), "sign .1 for front_left_2"),
        (
            replace(contract, motor_names=contract.motor_names[:7], motor_signs=contract.motor_signs[:7]),
            "has 7 motors; minitaur has 8",
        ),
    ]
    for changed, message in cases:
        with pytest.raises(SurefootError, match=message):
            check_robot(changed, robot)


def test_the_hash_knows_content_and_not_order():
    assert config_hash({"a": 1, "b": (1, 2.5)}) == config_hash({"b": [1, 2.5], "a": 1})
    assert config_hash({"a": 1}) != config_hash({"a": 2})
    # SHA-256 of {"a":1}, by coreutils' sha256sum.
    assert config_hash({"a": 1}) == "015abd7f5cc57a2dd94b7590f04ad8084273905ee33ec5cebeae62276a97f862"
