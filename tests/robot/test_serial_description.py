"""Robots with serial legs: geometry from the URDF, defaults of the data sheet, and invalid data sheets."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription, SerialLegs

LEGS = {"fl": (0.2, 0.05), "fr": (0.2, -0.05), "rl": (-0.2, 0.05), "rr": (-0.2, -0.05)}
MOTORS = {leg: [f"{leg}_{part}_joint" for part in ("hip", "thigh", "calf")] for leg in LEGS}
SHEET = f"""
name = "toy"
urdf = "toy.urdf"
base = "trunk"
[motors]
order = {[name for names in MOTORS.values() for name in names]}
%(sign)s
[legs]
order = {list(LEGS)}
%(legs)s
[actuator]
kind = "joint"
kp = [20.0, 30.0, 40.0]
kd = 0.5
torque_limit = 15.0
%(actuator)s
%(more)s
"""
INERTIAL = '<inertial><mass value="{}"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial>'
SPHERE = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'


def write_toy(folder: Path, knee: str = "backward", axis: str = "0 1 0", **parts: str) -> Path:
    """Write a robot of 10 kg with twelve motors; `parts` are inserted into the data sheet.

    Each leg's abduction axis is 0.05 m to the side, its hip 0.08 m further out and 0.01 m lower, its knee 0.2 m below
    and 0.05 m forward, its foot 0.2 m below and 0.1 m back.
    """
    folder.mkdir(exist_ok=True)
    body, tables = f'<link name="trunk">{INERTIAL.format(7.6)}</link>', ""
    for leg, (x, y) in LEGS.items():
        parent = "trunk"
        for part, place, turn in (
            ("hip", f"{x} {y} 0", "1 0 0"),
            ("thigh", f"0 {np.sign(y) * 0.08} -0.01", axis),
            ("calf", "0.05 0 -0.2", axis),
            ("foot", "-0.1 0 -0.2", "1 0 0"),
        ):
            shape, kind = (SPHERE, "fixed") if part == "foot" else ("", "continuous")
            body += (
                f'<link name="{leg}_{part}">{INERTIAL.format(0.15)}{shape}</link>'
                f'<joint name="{leg}_{part}_joint" type="{kind}"><parent link="{parent}"/><child link="{leg}_{part}"/>'
                f'<origin xyz="{place}"/><axis xyz="{turn}"/></joint>'
            )
            parent = f"{leg}_{part}"
        tables += f'[legs.{leg}]\nmotors = {MOTORS[leg]}\nfoot = "{leg}_foot"\nknee = "{knee}"\n'
    (folder / "toy.urdf").write_text(f'<robot name="toy">{body}</robot>')
    sheet = SHEET % {"sign": "", "actuator": "", "more": "", "legs": tables, **parts}
    (folder / "robot.toml").write_text(sheet)
    return folder


def test_geometry_of_serial_legs_comes_from_the_urdf(tmp_path: Path):
    robot = RobotDescription.load(write_toy(tmp_path / "toy"))
    legs = robot.leg_geometry
    assert isinstance(legs, SerialLegs)
    assert robot.coordinates == ("abduction", "swing", "extension")
    np.testing.assert_allclose(legs.turn, np.ones((4, 3)))
    np.testing.assert_allclose(legs.side, [1, -1, 1, -1])
    np.testing.assert_allclose(legs.hip, [(0.08, -0.01), (-0.08, -0.01)] * 2)
    np.testing.assert_allclose(legs.upper, np.hypot(0.05, 0.2))
    np.testing.assert_allclose(legs.lower, np.hypot(0.1, 0.2))
    # An angle a points to (-sin a, -cos a): forward is negative.
    np.testing.assert_allclose(legs.upper_angle, -np.arctan(0.25))
    np.testing.assert_allclose(legs.lower_angle, np.arctan(0.5))
    np.testing.assert_allclose(legs.knee, -1.0)
    # Mounts are on the abduction axis above the hip; at zero angles, feet are at their positions in the URDF.
    np.testing.assert_allclose(robot.leg_mounts, [(x, y, 0.0) for x, y in LEGS.values()])
    feet = robot.leg_mounts + legs.foot_position(np.zeros((4, 3)))
    frames = robot.urdf.frames()
    np.testing.assert_allclose(feet, [frames[f"{leg}_foot"][:3, 3] for leg in LEGS], atol=1e-12)
    np.testing.assert_allclose(feet[0], (0.15, 0.13, -0.41), atol=1e-12)


def test_defaults_of_serial_legs(tmp_path: Path):
    robot = RobotDescription.load(write_toy(tmp_path / "toy", knee="forward"))
    assert robot.leg_geometry.knee.tolist() == [1.0] * 4
    assert robot.leg_space == {"abduction": (-0.5, 0.5), "swing": (-1.0, 1.0), "extension": (0.35, 0.97)}
    assert robot.rest == (0.0, 0.0, 0.75)
    assert (robot.poses.sit, robot.poses.spread) == ((0.0, 0.0, 0.35), None)
    # Feet sink in by 1 % of the leg length under a quarter of the weight of 10 kg.
    weight, length = 9.81 * 10.0 / 4, np.hypot(0.05, 0.2) + np.hypot(0.1, 0.2)
    assert robot.contact.stiffness == pytest.approx(weight / (0.01 * length))
    # A damping ratio of 0.5, which is 2 * 0.5 sqrt(k m), with a quarter of the mass.
    assert robot.contact.damping == pytest.approx(np.sqrt(robot.contact.stiffness * 2.5))
    assert robot.body_length == pytest.approx(0.4)
    np.testing.assert_allclose(robot.to_pose(robot.resting_angles), np.tile([[0.0], [0.0], [0.75]], 4), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "signs"),
    [({"sign": f"sign = {[1, -1, -1, 1] * 3}"}, [1, -1, -1, 1] * 3), ({"axis": "0 -1 0"}, [1, -1, -1] * 4)],
)
def test_signs_of_motors_and_axes_flip_angles(tmp_path: Path, change: dict[str, str], signs: list[int]):
    plain = RobotDescription.load(write_toy(tmp_path / "plain"))
    turned = RobotDescription.load(write_toy(tmp_path / "turned", **change))
    pose = (0.2, [0.3, -0.2, 0.1, 0.0], 0.8)
    np.testing.assert_allclose(turned.pose_angles(*pose), np.array(signs) * plain.pose_angles(*pose), atol=1e-15)
    feet = [robot.link_frames(robot.pose_angles(*pose))["fl_foot"] for robot in (plain, turned)]
    np.testing.assert_allclose(*feet, atol=1e-15)


def test_per_leg_lists_apply_to_every_leg(tmp_path: Path):
    folder = write_toy(tmp_path / "toy", actuator="rotor_inertia = [0.01, 0.02, 0.03]\nload_friction = 0.05")
    params = PhysicalParams.nominal(RobotDescription.load(folder), 2)
    np.testing.assert_array_equal(params.servo_kp, np.tile([20.0, 30.0, 40.0], (2, 4)))
    np.testing.assert_array_equal(params.servo_kd, np.full((2, 12), 0.5))
    np.testing.assert_array_equal(params.rotor_inertia, np.tile([0.01, 0.02, 0.03], (2, 4)))
    np.testing.assert_array_equal(params.load_friction, np.full((2, 12), 0.05))


def test_dc_motor_parameters_are_rejected_for_joint_actuators(tmp_path: Path):
    robot = RobotDescription.load(write_toy(tmp_path / "toy"))
    assert robot.actuator.kind == "joint"
    params = PhysicalParams.nominal(robot)
    assert params.with_values(robot, load_friction=0.2).load_friction.tolist() == [[0.2] * 12]
    with pytest.raises(SurefootError, match="voltage belongs to motors of kind dc; the motors of toy are joint"):
        params.with_values(robot, voltage=12.0)
    with pytest.raises(SurefootError, match="the motors of toy are of kind joint; this needs DC motors"):
        _ = robot.dc_motor
    with pytest.raises(SurefootError, match="the legs of toy are serial; this needs five-bar legs"):
        _ = robot.five_bar


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"axis": "0 0 1"}, r"legs\.fl: fl_thigh_joint: its axis at zero is \(0, 0, 1\).*must be along y"),
        ({"axis": "0.1 1 0"}, r"legs\.fl: fl_thigh_joint: its axis at zero is \(0\.0995, 0\.995, 0\)"),
        ({"knee": "sideways"}, r"legs\.fl\.knee is 'sideways'; .*choices: forward, backward"),
        ({"actuator": "friction = [0.1, 0.2]"}, r"actuator\.friction has 2 numbers; it takes one, 3 .*, or 12 "),
        ({"more": "[leg_space]\nrest = [0.0, 0.75]\n"}, r"leg_space\.rest has 2 numbers; it must have abduction, "),
        ({"more": "[leg_space]\nextension = [0.35, 1.1]\n"}, r"leg_space\.extension is \[0\.35, 1\.1\], but a leg can"),
        ({"more": "[leg_space]\nrest = [0.0, 0.0, 1.2]\n"}, r"leg can't reach its resting pose .*extension 1\.2"),
        ({"sign": "sign = [1, 1, 1]"}, r"motors\.sign has 3 numbers; it must have 12"),
    ],
)
def test_invalid_data_sheets_of_serial_legs_are_rejected_in_one_line(
    tmp_path: Path, change: dict[str, str], message: str
):
    with pytest.raises(SurefootError, match=message) as caught:
        RobotDescription.load(write_toy(tmp_path / "toy", **change))
    assert "\n" not in str(caught.value)
