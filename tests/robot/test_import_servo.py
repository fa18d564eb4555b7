"""Servos, torque limits, motor order and standing pose of an MJCF, and the origins of a data sheet's numbers."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from odd_quadrupeds import mjcf, urdf

from surefoot.robot import RobotDescription
from surefoot.robot.importing.imported import ImportedRobot
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.rules import actuator_rules, describe_origins, factor_between
from surefoot.robot.importing.writer import write_robot

HOME = '<keyframe><key name="{name}" qpos="0 0 .3 1 0 0 0 {legs}"/></keyframe>'
POSITION = '<position joint="{joint}" kp="35" kv="0.7" forcerange="-25 25"/>'


def read(text: str, folder: Path, name: str = "odd.xml") -> ImportedRobot:
    path = folder / name
    path.write_text(text)
    return read_robot(path)


def sheet_of(text: str, folder: Path) -> dict[str, Any]:
    write_robot(read(text, folder), folder / "odd", "odd")
    return tomllib.loads((folder / "odd/robot.toml").read_text())


@pytest.mark.parametrize(
    ("actuator", "joint", "kp", "kd", "damping"),
    [
        (POSITION, "", 35, 0.7, 0.0),
        # Without a velocity term, the joint's damping is the controller's kd.
        ('<position joint="{joint}" kp="35"/>', 'damping="0.5"', 35, 0.5, 0.0),
        ('<position joint="{joint}" kp="35" kv="0.7"/>', 'damping="0.1"', 35, 0.7, 0.1),
        ('<position joint="{joint}" kp="35"/><velocity joint="{joint}" kv="0.9"/>', "", 35, 0.9, 0.0),
        (
            '<general joint="{joint}" gainprm="40" biastype="affine" biasprm="0 -40 -1.5"/>',
            'damping="0.2"',
            *(40, 1.5, 0.2),
        ),
        # A gear scales both angle and torque.
        ('<position joint="{joint}" kp="2" kv="0.1" gear="-3"/>', "", 18, 0.9, 0.0),
        ('<motor joint="{joint}" gear="5" ctrlrange="-4 4"/>', 'damping="0.3"', np.nan, np.nan, 0.3),
    ],
)
def test_controller_gains_of_an_mjcf_are_converted_to_the_joint(
    actuator: str, joint: str, kp: float, kd: float, damping: float, tmp_path: Path
) -> None:
    imported = read(mjcf(actuator, joint), tmp_path)
    np.testing.assert_allclose(imported.kp, np.full((4, 3), float(kp)))
    np.testing.assert_allclose(imported.kd, np.full((4, 3), float(kd)))
    np.testing.assert_allclose(imported.damping, np.full((4, 3), damping))


@pytest.mark.parametrize(
    ("actuator", "joint", "torque"),
    [
        ('<motor joint="{joint}" gear="5" ctrlrange="-4 4"/>', "", 20.0),
        ('<motor joint="{joint}" gear="-6" forcerange="-3 3"/>', "", 18.0),
        ('<general joint="{joint}" gainprm="10" ctrlrange="-1 1" ctrllimited="true"/>', "", 10.0),
        ('<motor joint="{joint}" gear="5" ctrlrange="-4 4"/>', 'actuatorfrcrange="-12 12"', 12.0),
        # The smallest limit applies.
        ('<motor joint="{joint}" gear="5" ctrlrange="-4 4"/>', 'actuatorfrcrange="-100 100"', 20.0),
        ('<motor joint="{joint}" gear="5" ctrlrange="-4 4" forcerange="-3 3"/>', "", 15.0),
        (POSITION, "", 25.0),
        # A motor with back EMF; and a speed controller, whose control signal is not a torque.
        (
            '<general joint="{joint}" gainprm="5" biastype="affine" biasprm="0 0 -.3" ctrlrange="-4 4" '
            'ctrllimited="true"/>',
            *("", 20.0),
        ),
        ('<velocity joint="{joint}" kv="2" ctrlrange="-9 9" ctrllimited="true"/>', "", np.nan),
    ],
)
def test_torque_limits_include_gear_and_gain(actuator: str, joint: str, torque: float, tmp_path: Path) -> None:
    np.testing.assert_allclose(read(mjcf(actuator, joint), tmp_path).torque, np.full((4, 3), torque))


def test_the_data_sheet_has_the_files_servo_order_friction_and_pose(tmp_path: Path) -> None:
    key = HOME.format(name="home", legs="0 .9 -1.8 " * 4)
    joints = 'armature="0.004" frictionloss="0.3"'
    sheet = sheet_of(mjcf(POSITION, joints, key, order="FR FL RR RL"), tmp_path)
    actuator, order = sheet["actuator"], sheet["motors"]["order"]
    assert (actuator["kp"], actuator["kd"], actuator["torque_limit"]) == (35.0, 0.7, 25.0)
    assert (actuator["rotor_inertia"], actuator["friction"], actuator["viscous_friction"]) == (0.004, 0.3, 0.0)
    assert [name.split("_")[0] for name in order[::3]] == ["FR", "FL", "RR", "RL"]
    # Two links of 0.2 m that bend by 1.8 rad: 0.4 cos 0.9 long.
    assert sheet["leg_space"]["rest"] == pytest.approx([0.0, 0.0, np.cos(0.9)], abs=1e-3)
    lines = (tmp_path / "odd/robot.toml").read_text().splitlines()
    for key in ("kp", "kd", "order", "rest", "rotor_inertia", "torque_limit"):
        line = next(line for line in lines if line.startswith(f"{key} = "))
        assert "guessed" not in line
        assert "odd.xml" in line


def test_per_motor_numbers_are_in_actuator_order(tmp_path: Path) -> None:
    text = mjcf(POSITION, order="FR FL RR RL").replace('joint="RL_calf_joint" kp="35"', 'joint="RL_calf_joint" kp="50"')
    sheet = sheet_of(text, tmp_path)
    assert sheet["actuator"]["kp"] == [35.0] * 11 + [50.0]
    assert sheet["motors"]["order"][-1] == "RL_calf_joint"


def test_a_joint_without_controller_gets_an_estimated_stiffness_with_a_comment(tmp_path: Path) -> None:
    text = mjcf(POSITION).replace(POSITION.format(joint="RR_hip_joint"), "")
    sheet = sheet_of(text, tmp_path)
    assert sheet["actuator"]["kp"][:9] == [35.0] * 9
    assert sheet["actuator"]["kp"][9] > 50
    assert sheet["motors"]["order"][0] == "FL_hip_joint"
    assert "for RR_hip_joint, else from odd.xml" in (tmp_path / "odd/robot.toml").read_text()


@pytest.mark.parametrize(
    ("name", "legs"),
    [
        ("folded", "0 .9 -1.8 " * 4),  # its name does not say that the robot stands
        ("home", "0 .9 -1.8 " * 2 + "0 .3 -1.8 " * 2),  # legs differ
        ("home", "0 1.4 -2.75 " * 4),  # shorter than commands allow
    ],
)
def test_unsuitable_keyframes_are_not_used_as_resting_pose(name: str, legs: str, tmp_path: Path) -> None:
    assert sheet_of(mjcf(more=HOME.format(name=name, legs=legs)), tmp_path)["leg_space"]["rest"] == [0.0, 0.0, 0.75]


def test_origins_report_source_and_deviation_from_the_rule(tmp_path: Path) -> None:
    write_robot(read(mjcf(POSITION), tmp_path), tmp_path / "odd", "odd")
    robot = RobotDescription.load(tmp_path / "odd")
    origins = {line.split(" = ")[0]: (guessed, line) for guessed, line in describe_origins(robot)}
    guessed, line = origins["actuator.kp"]
    rule = actuator_rules(robot.urdf.total_mass, 0.4)["kp"].value
    assert not guessed
    assert line == (
        "actuator.kp = 35.0: N m/rad, from odd.xml; the rule (1.5 m g l) gives "
        f"{rule:.3g}, which differs by a factor of {rule / 35:.2g}"
    )
    assert origins["actuator.torque_limit"] == (False, "actuator.torque_limit = 25.0: N m, from odd.xml")
    assert origins["actuator.speed_limit"][0]
    assert origins["timing.control_step"][0]
    assert origins["motors.order"][1].startswith("motors.order = [FL_hip_joint, FL_thigh_joint, FL_calf_joint, ...]")


def test_factor_between_is_symmetric() -> None:
    assert factor_between([2.0, 8.0], 4.0) == pytest.approx(2.0)
    assert factor_between([0.0], 4.0) == 1.0
    assert factor_between(12.0, 4.0) == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("speed", "words"),
    [
        ("310", "the file has 310 rad/s, which no joint reaches; if these are rpm, it is 32.5 rad/s"),
        ("1200", "if these are degrees per second, it is 20.9 rad/s"),
        ("1000", "the file has 1e+03 rad/s, which no joint reaches"),
        ("0", "the file has no real limit"),
    ],
)
def test_unrealistic_speeds_are_reported_with_a_likely_unit(speed: str, words: str, tmp_path: Path) -> None:
    robot = read(urdf().replace('velocity="20"', f'velocity="{speed}"'), tmp_path, "odd.urdf")
    write_robot(robot, tmp_path / "odd", "odd")
    line = next(line for line in (tmp_path / "odd/robot.toml").read_text().splitlines() if "speed_limit" in line)
    assert words in line
    assert ("rpm" in line) is (speed == "310")


def test_limits_in_degrees_are_converted_to_radians(tmp_path: Path) -> None:
    text = urdf().replace('lower="-0.8" upper="0.8"', 'lower="-46" upper="46"')
    text = text.replace('lower="-1" upper="3"', 'lower="-57" upper="172"')
    text = text.replace('lower="-2.7" upper="-0.8"', 'lower="-155" upper="-46"')
    robot = read(text, tmp_path, "odd.urdf")
    np.testing.assert_allclose(robot.limits[0], np.radians([(-46, 46), (-57, 172), (-155, -46)]))
    assert robot.guess_knees()[0] == "backward"
    assert "angle limits, -155 to 172 in the file, are read as degrees, although a URDF has radians" in robot.notes
    # Placeholders of ten or a thousand radians are not converted.
    robot = read(urdf().replace('lower="-1" upper="3"', 'lower="-10" upper="10"'), tmp_path, "odd.urdf")
    np.testing.assert_allclose(robot.limits[0, 1], (-10, 10))
