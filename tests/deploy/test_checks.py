"""Contract against handshake and data sheet: what ships passes, and each thing that differs is named."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surefoot.check_result import CheckResult, first_failure
from surefoot.cli.helpers.policies import find_policy
from surefoot.deploy.checks import check_contract, check_description, format_gains
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription

ROBOT = RobotDescription.load("minitaur")
CHECKS = [
    *("policy file", "robot", "motors", "motor signs", "legs", "observation", "gait"),
    *("servo gains", "servo period", "control step", "watchdog", "angle limits"),
]


def handshake_of(robot: RobotDescription) -> Handshake:
    """What a robot says that is as its data sheet: a leg may swing 1 rad at extensions of 0.6 to 2.7."""
    return Handshake(
        session=1,
        robot=robot.name,
        firmware="test 1.0",
        motor_names=robot.motor_names,
        motor_signs=robot.motor_sign,
        servo_period=0.001,
        servo_kp=np.full(8, 1.0),
        servo_kd=np.full(8, 0.015),
        command_period_min=0.002,
        command_period_max=0.02,
        angle_low=np.full(8, -0.4),
        angle_high=np.full(8, 3.7),
        tilt_limit=1.0,
        voltage_min=12.5,
        temperature_max=90.0,
        command_timeout=0.05,
        rearm_after=0.5,
    )


HANDSHAKE = handshake_of(ROBOT)


@functools.cache
def contract_of(policy: str = "trot") -> Contract:
    return PolicyRuntime.load(find_policy(policy)).contract


def failures(
    contract: Contract, handshake: Handshake = HANDSHAKE, digest: str | None = "abc"
) -> dict[str, CheckResult]:
    results = check_contract(contract, handshake, ROBOT, digest)
    assert [result.name for result in results] == CHECKS
    for result in results:
        # A line each; who has something to mend is told how.
        assert result.message
        assert "\n" not in result.message + result.remedy
        assert bool(result.remedy) == (result.passed is not True)
    return {result.name: result for result in results if not result.passed}


@pytest.mark.parametrize("policy", ["trot", "trot-robust", "gallop", "gallop-robust"])
def test_a_policy_that_ships_passes_on_its_robot(policy: str):
    results = check_contract(contract_of(policy), HANDSHAKE, ROBOT, "abc")
    assert [result.name for result in results if not result.passed] == []
    assert first_failure(results) is None


def swapped(names: tuple[Any, ...], one: int, other: int) -> tuple[Any, ...]:
    order = list(range(len(names)))
    order[one], order[other] = other, one
    return tuple(names[index] for index in order)


@pytest.mark.parametrize(
    ("change", "check", "why"),
    [
        ({"robot": "spot"}, "robot", "is 'minitaur' (policy), 'spot' (robot), 'minitaur' (data sheet)"),
        (
            {"motor_names": swapped(ROBOT.motor_names, 0, 5)},
            "motors",
            "motor 0 is 'front_left_2_motor' (policy), 'front_right_2_motor' (robot), 'front_left_2_motor' (data",
        ),
        ({"motor_names": ROBOT.motor_names[:7]}, "motors", "8 (policy), 7 (robot), 8 (data sheet)"),
        (
            {"motor_signs": np.array([-1.0, 1, -1, -1, 1, -1, 1, -1])},
            "motor signs",
            "back_left_1_motor has +1 (policy), -1 (robot), +1 (data sheet)",
        ),
        (
            {"servo_kp": np.full(8, 1.06)},
            "servo gains",
            "have kp 1.06 and kd 0.015; the policy was trained with kp 1 and",
        ),
        (
            {"servo_kp": np.array([1, 1, 1.2, 1, 1, 1, 1, 1.0])},
            "servo gains",
            "motor 'back_left_2_motor': the robot's servo has kp 1.2 and kd 0.015; the policy was trained with kp 1",
        ),
        (
            {"servo_kd": np.array([0.015, 0.02, 0.015, 0.015, 0.015, 0.03, 0.015, 0.015])},
            "servo gains",
            "motor 'front_left_1_motor' and 1 more: the robot's servo has kp 1 and kd 0.02; the policy was trained",
        ),
        ({"servo_kd": np.full(8, 0.014)}, "servo gains", "each must be within 5%"),
        ({"servo_period": 0.002}, "servo period", "2 ms; the data sheet says 1 ms"),
        ({"command_period_min": 0.007}, "control step", "6 ms; the robot takes commands every 7 to 20 ms"),
        ({"command_period_max": 0.005}, "control step", "6 ms; the robot takes commands every 2 to 5 ms"),
        ({"servo_period": 0.00105, "command_timeout": 1.0}, "control step", "5.71 servo periods of 1.05 ms"),
        ({"command_timeout": 0.017}, "watchdog", "after 17 ms without a command; it must allow 3 control steps, 18 ms"),
        # The trot swings 0.3 + 0.25 rad and extends to 2.0 + 0.35 + 0.25 rad: 3.15 rad at most, 0.85 at least.
        ({"angle_high": np.full(8, 3.1)}, "angle limits", "can be sent to 0.850 to 3.150 rad; the robot takes -0.400"),
        ({"angle_low": np.full(8, 0.9)}, "angle limits", "0.850 to 3.150 rad; the robot takes 0.900 to 3.700"),
    ],
)
def test_a_robot_that_differs_is_found(change: dict[str, Any], check: str, why: str):
    failed = failures(contract_of(), replace(HANDSHAKE, **change))
    assert list(failed) == [check]
    assert failed[check].passed is False
    assert why in failed[check].message
    assert first_failure(list(failed.values())) == f"{check}: {failed[check].message}; {failed[check].remedy}"


def test_a_servo_period_of_zero_is_refused():
    failed = failures(contract_of(), replace(HANDSHAKE, servo_period=0.0))
    assert list(failed) == ["servo period", "control step"]


@pytest.mark.parametrize(
    "change", [{"servo_kp": np.full(8, 1.049)}, {"servo_period": 0.00101}, {"command_timeout": 0.018}]
)
def test_what_is_close_enough_passes(change: dict[str, Any]):
    assert failures(contract_of(), replace(HANDSHAKE, **change)) == {}


def test_the_pose_that_it_stands_in_must_be_within_the_limits_too():
    # Standing at 0.6 rad, below all that the trot asks for.
    contract = replace(contract_of(), rest=(0.0, 0.6))
    failed = failures(contract, replace(HANDSHAKE, angle_low=np.full(8, 0.8)))
    assert "can be sent to 0.600 to 3.150 rad" in failed["angle limits"].message
    assert failed["angle limits"].value == pytest.approx(-0.2)


def test_one_leg_that_has_less_room_is_named():
    high = np.full(8, 3.7)
    high[3] = 3.0
    failed = failures(contract_of(), replace(HANDSHAKE, angle_high=high))
    assert failed["angle limits"].message.startswith("back_left_1_motor can be sent to")


def edited(change: dict[str, Any], policy: str = "trot") -> Contract:
    """A policy's contract after someone's edit, at any depth."""
    data = json.loads(contract_of(policy).to_json())

    def merge(table: dict[str, Any], changes: dict[str, Any]) -> None:
        for key, value in changes.items():
            if isinstance(value, dict) and isinstance(table.get(key), dict):
                merge(table[key], value)
            else:
                table[key] = value

    merge(data, change)
    return Contract.from_json(json.dumps(data))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"low": [-1.6] * 8}, "swing can be -1.900 to 0.550 rad"),
        ({"reference": {"kind": "hop"}}, "reference.kind is 'hop'"),
        ({"reference": {"swing": {"amplitude": {"front_left": "x"}}}}, "amplitude"),
        ({"task": {"feedback": [1]}}, "task.feedback is not a key; the contract states it outside the task"),
        ({"task": {"colour": "red"}}, "task.colour is not a key"),
        ({"task": {"fall_angle": None}}, "task.fall_angle is None"),
        ({"task": {"max_steps": 10**12}}, "max_steps is 1000000000000"),
        ({"rest": [0.0, 3.0]}, "extension at rest is 3 rad; a leg of minitaur allows 0.6 to 2.7"),
    ],
)
def test_a_policy_with_a_gait_that_the_robot_does_not_allow_is_refused(change: dict[str, Any], why: str):
    failed = failures(edited(change))
    assert why in failed["gait"].message


def test_the_rate_may_differ_from_the_data_sheet():
    assert failures(edited({"control_step": 0.008})) == {}


def test_actions_in_another_order_are_found():
    names = contract_of().action_names
    failed = failures(replace(contract_of(), action_names=(*names[4:], *names[:4])))
    assert "its actions are extension.front_left" in failed["gait"].message


def with_part(index: int, **changes: str) -> Contract:
    """The trot with another part of its observation."""
    parts = list(contract_of().observation)
    parts[index] = replace(parts[index], **changes)
    return replace(contract_of(), observation=tuple(parts))


GALLOP, TROT = contract_of("gallop"), contract_of()


@pytest.mark.parametrize(
    ("contract", "check", "why"),
    [
        (
            replace(GALLOP, motor_names=swapped(GALLOP.motor_names, 2, 3)),
            "motors",
            "motor 2 is 'back_left_1_motor' (policy), 'back_left_2_motor' (robot)",
        ),
        (
            replace(GALLOP, columns=swapped(GALLOP.columns, 5, 6)),
            "observation",
            "column 5 is 'angle.back_left_2_motor' in the policy and 'angle.front_left_1_motor'",
        ),
        (
            replace(TROT, motor_signs=(1.0, *TROT.motor_signs[1:])),
            "motor signs",
            "front_left_2_motor has +1 (policy), -1 (robot)",
        ),
        (
            replace(TROT, leg_names=swapped(ROBOT.leg_names, 0, 1)),
            "legs",
            "the policy has back_left, front_left",
        ),
        (with_part(2, unit="deg/s"), "observation", "'roll_rate' is in deg/s, base, about x"),
        (with_part(0, name="mood"), "observation", "'mood' does not exist; choices: roll, pitch"),
    ],
    ids=["motors", "columns", "sign", "legs", "unit", "unknown"],
)
def test_a_policy_that_differs_is_refused(contract: Contract, check: str, why: str):
    failed = failures(contract)
    assert why in failed[check].message
    assert f"{check}: " in (first_failure(list(failed.values())) or "")
    # Angles are compared only where legs and motors are the robot's.
    assert check != "legs" or failed["angle limits"].passed is None


def test_a_policy_without_a_digest_is_refused():
    failed = failures(contract_of(), digest=None)
    assert list(failed) == ["policy file"]
    assert "python -m surefoot.policy.digest FILE" in failed["policy file"].remedy


def test_a_refusal_of_several_is_one_line_that_names_them_all():
    results = check_contract(
        contract_of(), replace(HANDSHAKE, servo_kp=np.full(8, 2.0), command_timeout=0.01), ROBOT, "abc"
    )
    said = first_failure(results)
    assert said is not None
    assert said.startswith("servo gains: the robot's servos have kp 2 and kd 0.015;")
    assert said.endswith("(also failed: watchdog; surefoot doctor lists every check)")
    assert "\n" not in said


def test_corners_of_leg_space_are_the_extremes_of_motor_angles():
    """Known answers: the gallop swings -0.5 to 0.5 and extends 1.0708 to 2.0708 rad, without a reference."""
    result = {one.name: one for one in check_contract(contract_of("gallop"), HANDSHAKE, ROBOT, "a")}["angle limits"]
    assert "0.571 to 2.571 rad" in result.message
    poses = [ROBOT.pose_angles(s, e) for s in (-0.5, 0.0, 0.5) for e in (1.0707963, 1.5, 2.0707963)]
    assert np.min(poses) == pytest.approx(0.5707963)
    assert np.max(poses) == pytest.approx(2.5707963)


def test_gains_of_each_motor_are_written_as_a_span():
    assert format_gains(1.0, 0.015) == "kp 1 and kd 0.015"
    assert format_gains((20.0, 40.0, 30.0), 0.5) == "kp 20 to 40 and kd 0.5"


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"commands": {"heading_gain": -0.5}}, "commands.heading_gain is -0.5; it must be 0 to"),
        ({"reference": {"stride_gain": 100.0}}, "reference.stride_gain is 100"),
        ({"rest": [0.0, 0.0]}, "rest has 2 numbers; go2 has abduction, swing, extension"),
        ({"task": {"history": 4}}, "task.history is not a key; the contract states it outside the task"),
    ],
)
def test_a_steered_policy_of_another_gait_than_the_robot_allows_is_refused(change: dict[str, Any], error: str):
    go2 = RobotDescription.load("go2")
    assert first_failure(check_description(contract_of("go2-steer"), go2)) is None
    try:
        message = first_failure(check_description(edited(change, "go2-steer"), go2))
    except SurefootError as caught:
        message = str(caught)
    assert error in str(message)
