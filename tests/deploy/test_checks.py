"""Compatibility checks of policy, data sheet and handshake."""

from __future__ import annotations

import functools
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from surefoot.api.policies import find_policy
from surefoot.check_result import CheckResult, first_failure
from surefoot.deploy.checks import check_contract, check_map, check_policy, format_gains
from surefoot.deploy.messages import Handshake
from surefoot.errors import SurefootError
from surefoot.policy.contract import Contract
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.task.config import load_task
from surefoot.task.contract_mapping import contract_from_task

ROBOT = RobotDescription.load("minitaur")
CHECKS = [
    *("robot", "motors", "motor signs", "servo period"),
    *("servo gains", "control step", "watchdog", "angle limits"),
]
HANDSHAKE = Handshake(
    session=1,
    robot=ROBOT.name,
    firmware="test 1.0",
    motor_names=ROBOT.motor_names,
    motor_signs=ROBOT.motor_sign,
    servo_period=0.001,
    servo_kp=np.full(8, 1.0),
    servo_kd=np.full(8, 0.015),
    command_period_min=0.002,
    command_period_max=0.02,
    # A leg may swing by 1 rad at extensions of 0.6 to 2.7.
    angle_low=np.full(8, -0.4),
    angle_high=np.full(8, 3.7),
    tilt_limit=1.0,
    voltage_min=12.5,
    temperature_max=90.0,
    command_timeout=0.05,
    rearm_after=0.5,
)


@functools.cache
def contract_of(policy: str = "trot") -> Contract:
    return PolicyRuntime.load(find_policy(policy)).contract


def failures(contract: Contract, handshake: Handshake = HANDSHAKE) -> dict[str, CheckResult]:
    results = check_contract(contract, handshake, ROBOT)
    assert [result.name for result in results] == CHECKS
    for result in results:
        assert result.message
        assert "\n" not in result.message + result.remedy
        assert bool(result.remedy) == (result.passed is not True)
    return {result.name: result for result in results if not result.passed}


@pytest.mark.parametrize("policy", ["trot", "trot-robust", "gallop", "gallop-robust"])
def test_released_policies_pass_on_their_robot(policy: str):
    check_policy(contract_of(policy), ROBOT)
    assert failures(contract_of(policy)) == {}
    assert first_failure(check_contract(contract_of(policy), HANDSHAKE, ROBOT)) is None


def swapped(names: tuple[Any, ...], one: int, other: int) -> tuple[Any, ...]:
    order = list(range(len(names)))
    order[one], order[other] = other, one
    return tuple(names[index] for index in order)


# The handshake of the robot.


@pytest.mark.parametrize(
    ("change", "check", "message"),
    [
        ({"robot": "spot"}, "robot", "it is 'spot'; the data sheet is for 'minitaur'"),
        (
            {"motor_names": swapped(ROBOT.motor_names, 0, 5)},
            "motors",
            "motor 0 is 'front_right_2_motor' (robot), 'front_left_2_motor' (data sheet)",
        ),
        ({"motor_names": ROBOT.motor_names[:7]}, "motors", "there are 7 motors (robot), 8 (data sheet)"),
        (
            {"motor_signs": np.array([-1.0, 1, -1, -1, 1, -1, 1, -1])},
            "motor signs",
            "back_left_1_motor has -1 (robot), +1 (data sheet)",
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
        ({"command_period_min": 0.007}, "control step", "6 ms; the robot accepts commands every 7 to 20 ms"),
        ({"command_period_max": 0.005}, "control step", "6 ms; the robot accepts commands every 2 to 5 ms"),
        ({"servo_period": 0.00105, "command_timeout": 1.0}, "control step", "5.71 servo periods of 1.05 ms"),
        ({"command_timeout": 0.017}, "watchdog", "after 17 ms without a command; it must allow 3 control steps, 18 ms"),
        # The trot swings 0.3 + 0.25 rad and extends to 2.0 + 0.35 + 0.25 rad: 3.15 rad at most, 0.85 at least.
        (
            {"angle_high": np.full(8, 3.1)},
            "angle limits",
            "can be commanded to 0.850 to 3.150 rad; the robot accepts -0.400",
        ),
        ({"angle_low": np.full(8, 0.9)}, "angle limits", "0.850 to 3.150 rad; the robot accepts 0.900 to 3.700"),
        (
            {"angle_high": np.array([3.7, 3.7, 3.7, 3.0, 3.7, 3.7, 3.7, 3.7])},
            "angle limits",
            "back_left_1_motor can be commanded to",
        ),
    ],
)
def test_a_robot_that_does_not_match_the_policy_is_rejected(change: dict[str, Any], check: str, message: str):
    failed = failures(contract_of(), replace(HANDSHAKE, **change))
    assert list(failed) == [check]
    assert failed[check].passed is False
    assert message in failed[check].message
    assert first_failure(list(failed.values())) == f"{check}: {failed[check].message}; {failed[check].remedy}"


def test_a_servo_period_of_zero_is_rejected():
    assert list(failures(contract_of(), replace(HANDSHAKE, servo_period=0.0))) == ["servo period", "control step"]


@pytest.mark.parametrize(
    "change", [{"servo_kp": np.full(8, 1.049)}, {"servo_period": 0.00101}, {"command_timeout": 0.018}]
)
def test_a_robot_within_tolerances_passes(change: dict[str, Any]):
    assert failures(contract_of(), replace(HANDSHAKE, **change)) == {}


def test_the_standing_pose_must_be_within_the_robots_limits():
    # Standing at 0.6 rad, below the range of the trot.
    contract = replace(contract_of(), rest=(0.0, 0.6))
    failed = failures(contract, replace(HANDSHAKE, angle_low=np.full(8, 0.8)))
    assert "can be commanded to 0.600 to 3.150 rad" in failed["angle limits"].message
    assert failed["angle limits"].value == pytest.approx(-0.2)


def test_corners_of_leg_space_are_the_extremes_of_motor_angles():
    """Without a reference, the gallop swings from -0.5 to 0.5 and extends from 1.0708 to 2.0708 rad."""
    result = check_contract(contract_of("gallop"), HANDSHAKE, ROBOT)[-1]
    assert "0.571 to 2.571 rad" in result.message
    poses = [ROBOT.pose_angles(s, e) for s in (-0.5, 0.0, 0.5) for e in (1.0707963, 1.5, 2.0707963)]
    assert np.min(poses) == pytest.approx(0.5707963)
    assert np.max(poses) == pytest.approx(2.5707963)


def test_several_failures_are_named_in_one_line():
    handshake = replace(HANDSHAKE, servo_kp=np.full(8, 2.0), command_timeout=0.01)
    message = first_failure(check_contract(contract_of(), handshake, ROBOT))
    assert message is not None
    assert message.startswith("servo gains: the robot's servos have kp 2 and kd 0.015;")
    assert message.endswith("(also failed: watchdog; surefoot doctor lists every check)")


def test_different_gains_are_written_as_a_range():
    assert format_gains(1.0, 0.015) == "kp 1 and kd 0.015"
    assert format_gains((20.0, 40.0, 30.0), 0.5) == "kp 20 to 40 and kd 0.5"


# The data sheet.


def shipped_variants(change: dict[str, Any], policy: str = "trot") -> Contract:
    """Return a policy's contract with values replaced at any depth."""
    data = json.loads(contract_of(policy).to_json())

    def merge(table: dict[str, Any], changes: dict[str, Any]) -> None:
        for key, value in changes.items():
            if isinstance(value, dict) and isinstance(table.get(key), dict):
                merge(table[key], value)
            else:
                table[key] = value

    merge(data, change)
    return Contract.from_json(json.dumps(data))


TROT, COLUMNS = contract_of(), contract_of("gallop").columns


@pytest.mark.parametrize(
    ("policy", "change", "message"),
    [
        ("trot", {"robot": "spot"}, "it is for robot 'spot'"),
        (
            "gallop",
            {"motor_names": swapped(ROBOT.motor_names, 2, 3)},
            "motor 2 is 'back_left_1_motor' (policy), 'back_left_2_motor' (data sheet); names and order must be",
        ),
        ("trot", {"motor_signs": [1.0, *TROT.motor_signs[1:]]}, "front_left_2_motor has +1 (policy), -1 (data sheet)"),
        ("trot", {"leg_names": swapped(ROBOT.leg_names, 0, 1)}, "leg 0 is 'back_left' (policy), 'front_left'"),
        (
            "gallop",
            {"columns": swapped(COLUMNS, 5, 6)},
            "column 5 is 'angle.back_left_2_motor' (policy), 'angle.front_left_1_motor' (data sheet)",
        ),
        ("gallop", {"columns": COLUMNS[:-1]}, f"there are {len(COLUMNS) - 1} columns (policy), {len(COLUMNS)} (data"),
        (
            "trot",
            {"observation": [{"name": "roll", "unit": "deg", "frame": "base in world"}], "columns": ["roll"]},
            "'roll' is in deg, base",
        ),
        ("trot", {"observation": [{"name": "mood", "unit": "", "frame": ""}]}, "'mood' does not exist; choices: roll"),
        ("trot", {"action_names": [*TROT.action_names[4:], *TROT.action_names[:4]]}, "its actions are extension.front"),
        ("trot", {"low": [-1.6] * 8}, "swing can be -1.900 to 0.550 rad"),
        ("trot", {"reference": {"kind": "hop"}}, "reference.kind is 'hop'"),
        ("trot", {"reference": {"swing": {"amplitude": {"front_left": "x"}}}}, "amplitude"),
        ("trot", {"task": {"feedback": [1]}}, "task.feedback is not a key; the contract states it outside the task"),
        ("trot", {"task": {"colour": "red"}}, "task.colour is not a key"),
        ("trot", {"task": {"fall_angle": None}}, "task.fall_angle is None"),
        ("trot", {"task": {"fall_angle": 0}}, "fall_angle is 0; it must be 0.001 or more"),
        ("trot", {"task": {"max_steps": 10**12}}, "max_steps is 1000000000000"),
        ("trot", {"rest": [0.0, 3.0]}, "extension at rest is 3 rad; a leg of minitaur allows 0.6 to 2.7"),
        ("go2-steer", {"reference": {"stride_gain": 100.0}}, "reference.stride_gain is 100"),
        ("go2-steer", {"rest": [0.0, 0.0]}, "rest has 2 numbers; go2 has abduction, swing, extension"),
    ],
)
def test_a_policy_that_does_not_match_the_data_sheet_is_rejected(policy: str, change: dict[str, Any], message: str):
    contract = shipped_variants(change, policy)
    robot = RobotDescription.load(contract_of(policy).robot)
    with pytest.raises(SurefootError) as error:
        check_policy(contract, robot)
    assert message in str(error.value)
    assert str(error.value).startswith(f"policy '{contract.name}' must not run on {robot.name}: ")
    assert "\n" not in str(error.value)


def test_the_height_map_grid_of_a_policy_must_match_the_robot():
    task = load_task("steer")[0]
    seeing = contract_from_task(replace(task, observations=(*task.observations, "height_scan")), ROBOT)
    check_policy(seeing, ROBOT)
    grid = seeing.height_map
    assert grid is not None
    for change, message in (
        (
            None,
            "height_map is the grid of height_scan and footholds; it must be there with these, and only then",
        ),
        (replace(grid, ahead=grid.ahead[1:]), "its height map has 18 other points ahead than the 19 of minitaur here"),
        (
            replace(grid, left=tuple(1.1 * place for place in grid.left)),
            "its height map has 13 other points left than the 13 of minitaur here",
        ),
    ):
        with pytest.raises(SurefootError, match=message):
            check_policy(replace(seeing, height_map=change), ROBOT)
    with pytest.raises(SurefootError, match=r"needs a height map; give --height-map PORT, to which a program sends"):
        check_map(seeing, None)
    with pytest.raises(SurefootError, match="follows no commands; it cannot stand when a map is late"):
        check_map(replace(seeing, commands=None), 5556)
    check_map(seeing, 5556)


def test_the_rate_of_a_policy_may_differ_from_the_data_sheet():
    contract = shipped_variants({"control_step": 0.008})
    check_policy(contract, ROBOT)
    assert failures(contract) == {}
