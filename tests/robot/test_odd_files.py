"""Imperfect robot files of CAD exporters and others: repaired with a note, or rejected with the fix."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from odd_quadrupeds import SPHERE, joint, link, mjcf, urdf

from surefoot.errors import SurefootError
from surefoot.evaluation.trot_check import check_trot
from surefoot.robot import RobotDescription, SerialLegs
from surefoot.robot.importing.imported import ImportedRobot
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.writer import write_robot
from surefoot.robot.mirror import MAX_SIDE_DIFFERENCE, asymmetry, is_symmetric, side_difference
from surefoot.robot.rigid_body import box_moments
from surefoot.world.body_checks import check_file, check_masses, check_sides
from surefoot.world.description_checks import run_description_checks, visual_overhang


def read(text: str, folder: Path, name: str = "odd.urdf") -> ImportedRobot:
    path = folder / name
    path.write_text(text)
    return read_robot(path)


def make(text: str, folder: Path) -> RobotDescription:
    shutil.rmtree(folder / "odd", ignore_errors=True)
    write_robot(read(text, folder), folder / "odd", "odd")
    return RobotDescription.load(folder / "odd")


def with_inertia(text: str, name: str, xx: float, yy: float, zz: float) -> str:
    """Return a URDF with other moments of a link."""
    head, tail = text.split(f'<link name="{name}">')
    return f'{head}<link name="{name}">' + re.sub(
        r'ixx="[^"]*" iyy="[^"]*" izz="[^"]*"', f'ixx="{xx}" iyy="{yy}" izz="{zz}"', tail, count=1
    )


FIXED = joint("{0}_joint", "fixed", "trunk", "{0}", "0.1 0 0")
IMU = re.sub(r"<visual>.*</collision>", "", link("imu", 0.001, (0.1, 0.1, 0.1), SPHERE)) + FIXED.format("imu")


def test_almost_massless_frames_are_dropped_with_one_note(tmp_path: Path) -> None:
    frames = "".join(
        link(name, mass, (moment,) * 3, '<box size="0.001 0.001 0.001"/>') + FIXED.format(name)
        for name, mass, moment in (("camera", 1e-14, 1e-26), ("lidar", 1e-9, 0.0), ("gps", 5e-7, 1e-12))
    )
    robot, plain = read(urdf(more=frames), tmp_path), read(urdf(), tmp_path)
    assert "frames of less than 1e-06 kg count as massless: camera, lidar, gps" in robot.notes
    assert robot.mass == plain.mass
    np.testing.assert_allclose(robot.base.inertia, plain.base.inertia, atol=1e-12)
    frame = '<body name="imu"><inertial pos="0 0 0" mass="1e-14" diaginertia="1e-26 1e-26 1e-26"/></body>'
    text = mjcf().replace("<freejoint/>", f"<freejoint/>{frame}")
    assert "frames of less than 1e-06 kg count as massless: imu" in read(text, tmp_path, "odd.xml").notes


def test_zero_inertias_are_estimated_from_masses_and_shapes(tmp_path: Path) -> None:
    text = re.sub(r'ixx="[^"]*" iyy="[^"]*" izz="[^"]*"', 'ixx="0" iyy="0" izz="0"', urdf())
    robot = read(text, tmp_path)
    made = "inertias of 0 or less in the file are estimated from masses and shapes"
    assert f"{made}: trunk, FL_hip, FL_thigh, FL_calf and 13 more" in robot.notes
    np.testing.assert_allclose(robot.base.inertia, np.diag(box_moments(6, np.array([0.4, 0.2, 0.1]))), rtol=1e-5)
    assert robot.warnings == ()
    # A moving link without shapes, the thigh, is as long as the distance between its joints.
    bare = with_inertia(urdf(), "FL_thigh", 0, 0, 0)
    head, tail = bare.split('<link name="FL_thigh">')
    tail = re.sub(r"<visual>.*?</collision>", "", tail, count=1)
    robot = read(f'{head}<link name="FL_thigh">{tail}', tmp_path)
    assert "inertias of 0 or less in the file are estimated from masses and shapes: FL_thigh" in robot.notes
    moments = box_moments(0.5, np.array([0.04, 0.04, 0.2]))
    np.testing.assert_allclose(robot.bodies[0][1].inertia, np.diag(moments), rtol=1e-5)


@pytest.mark.parametrize(("name", "made"), [("FL_calf", True), ("FL_foot", False)])
@pytest.mark.parametrize("moment", ["0", "1e-20"])
def test_moments_rounded_to_zero_are_accepted(moment: str, name: str, made: bool, tmp_path: Path) -> None:
    text = with_inertia(urdf(), name, *(float(moment),) * 3)
    robot = read(text, tmp_path)
    note = f"inertias of 0 or less in the file are estimated from masses and shapes: {name}"
    assert (note in robot.notes) is made  # a fixed link is a point mass
    assert robot.mass == pytest.approx(10.6)
    for xx in (0.0, -8e-4):
        text = with_inertia(urdf(), "FL_calf", xx, 8e-4, 8e-4)
        assert any("FL_calf" in note for note in read(text, tmp_path).notes)


@pytest.mark.parametrize(
    ("name", "moments", "failed", "words"),
    [
        ("trunk", (0.001, 0.0013, 0.0019), False, "'trunk': 6 kg with a radius of gyration of 0.0178 m"),
        ("trunk", (40.0, 90.0, 110.0), True, "'trunk': 6 kg with a radius of gyration of 4.28 m"),
        ("FL_calf", (100.0, 100.0, 100.0), True, "'FL_calf': 0.2 kg with a radius of gyration of 22.4 m"),
        ("RR_thigh", (2.0, 2.0, 0.5), True, "'RR_thigh': 0.5 kg with a radius of gyration of 2 m"),
    ],
)
def test_an_implausible_inertia_is_reported_with_the_inertia_of_a_box(
    name: str, moments: tuple[float, float, float], failed: bool, words: str, tmp_path: Path
) -> None:
    robot = make(with_inertia(urdf(), name, *moments), tmp_path)
    (noted,) = check_file(robot)
    assert words in noted.message
    assert (noted.passed, noted.warn) == (True, True)
    assert "a box of this size has (" in noted.message
    masses = check_masses(robot)
    assert (masses.passed, masses.warn) == (not failed, not failed)
    assert "radius of gyration" in masses.message
    assert "a box of each link's size" in masses.remedy
    plain = make(urdf(), tmp_path)
    assert list(check_file(plain)) == []
    assert (check_masses(plain).passed, check_masses(plain).warn) == (True, False)


def test_names_with_line_ends_stay_within_comments(tmp_path: Path) -> None:
    robot = make(urdf(more=IMU.replace("imu", "i&#10;[actuator]&#x7f;")), tmp_path)
    (result,) = check_file(robot)
    assert "link 'i [actuator] '" in result.message


def test_an_inertia_larger_than_the_robot_is_reported_without_shapes(tmp_path: Path) -> None:
    (warning,) = read(urdf(more=IMU), tmp_path).warnings
    assert warning.startswith("link 'imu': 0.001 kg with a radius of gyration of 10 m, but the whole robot is only 0.7")
    imu = IMU.replace('"0.1"', '"1e-5"')
    assert read(urdf(more=imu), tmp_path).warnings == ()


@pytest.mark.parametrize(
    ("scale", "mass", "words"),
    [
        (1000.0, 1.0, "10.6 kg on legs of 400 m are implausible; it looks as if lengths are in mm"),
        (1.0, 1000.0, "1.06e+04 kg on legs of 0.4 m are implausible; it looks as if masses are in g"),
        (1000.0, 1000.0, "it looks as if lengths are in mm and masses in g: use m and kg"),
    ],
)
def test_implausible_units_are_rejected_with_a_likely_unit(
    scale: float, mass: float, words: str, tmp_path: Path
) -> None:
    text = re.sub(r'mass value="([^"]*)"', lambda m: f'mass value="{float(m[1]) * mass}"', urdf())
    text = re.sub(
        r'(xyz|size|radius|length)="([^"]*)"',
        lambda m: (
            f'{m[1]}="{m[2]}"'
            if m[1] == "xyz" and set(m[2].split()) <= {"0", "1"}
            else f'{m[1]}="{" ".join(str(float(v) * scale) for v in m[2].split())}"'
        ),
        text,
    )
    text = re.sub(r' (i[xyz]{2})="([^"]*)"', lambda m: f' {m[1]}="{float(m[2]) * mass * scale**2}"', text)
    with pytest.raises(SurefootError) as caught:
        read(text, tmp_path)
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("longer", "passed", "warn", "words"),
    [
        (0.0, True, False, "left and right are mirror images"),
        (0.0005, True, False, "mirror images within 0.5 mm"),
        (0.004, True, True, "back_left's upper link is 4 mm longer than back_right's (limit 2 mm): training does"),
        (0.02, False, False, "back_left's upper link is 20 mm longer than back_right's"),
    ],
)
def test_sides_are_compared_by_link_lengths(
    longer: float, passed: bool, warn: bool, words: str, tmp_path: Path
) -> None:
    robot = make(urdf(longer), tmp_path)
    result = check_sides(robot)
    assert (result.passed, result.warn) == (passed, warn)
    assert words in result.message
    assert side_difference(robot).length == pytest.approx(longer, abs=1e-7)
    assert is_symmetric(robot) is (longer <= MAX_SIDE_DIFFERENCE * robot.leg_geometry.length)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('xyz="0.18 0.06 0"', 'xyz="0.18 0.065 0"', "front_left's hip position is 5 mm from the mirror image of"),
        ('xyz="0 -0.08 0"', 'xyz="0 -0.084 0"', "hip offset is 4 mm from the mirror image of"),
    ],
)
def test_one_sided_position_errors_are_reported(old: str, new: str, words: str, tmp_path: Path) -> None:
    result = check_sides(make(urdf().replace(old, new, 1), tmp_path))
    assert result.warn
    assert words in result.message


def test_sides_with_other_zero_angles_are_reported() -> None:
    robot = RobotDescription.load("go2")
    legs = robot.leg_geometry
    assert isinstance(legs, SerialLegs)
    second = np.array([0.0, 1.0, 0.0, 0.0])
    lower = legs.lower_angle + 0.1 * second
    turned = replace(robot, leg_geometry=replace(legs, lower_angle=lower))
    one, two = (robot.leg_names[k] for k in (0, 1))
    assert side_difference(turned).length < 1e-6
    assert asymmetry(turned) == f"at zero angles the lower links of {one} and {two} are 0.1 rad apart"
    other = replace(robot, leg_geometry=replace(legs, knee=legs.knee * (1.0 - 2.0 * second)))
    assert asymmetry(other) == f"the knees of {one} and {two} point in different directions"
    # A whole turn changes nothing.
    whole = replace(legs, lower_angle=legs.lower_angle + 2.0 * np.pi * second)
    assert asymmetry(replace(robot, leg_geometry=whole)) is None


@pytest.mark.parametrize("name", RobotDescription.available())
def test_built_in_robots_are_symmetric(name: str) -> None:
    robot = RobotDescription.load(name)
    assert side_difference(robot).length < 1e-6
    assert is_symmetric(robot)
    assert np.abs(visual_overhang(robot)).max() < 0.01 * robot.leg_geometry.length


def test_a_link_with_a_missing_mesh_is_drawn_as_primitive_shape(tmp_path: Path) -> None:
    mesh = '<geometry><mesh filename="package://odd/meshes/{}.stl"/></geometry>'
    text = re.sub(r"(<visual><origin[^>]*>)<geometry>.*?</geometry>", rf"\1{mesh.format('part')}", urdf())
    chip = link("imu", 0.01, (1e-7,) * 3, '<box size="0.001 0.001 0.001"/>') + FIXED.format("imu")
    robot = make(text.replace("</robot>", f"{chip}</robot>"), tmp_path)
    drawn = {part.link: np.ptp(part.vertices, axis=0) for part in robot.appearance().parts if len(part.vertices) > 8}
    parts = robot.appearance().parts
    assert max(np.ptp(part.vertices, axis=0).max() for part in parts if part.link == "base") == pytest.approx(
        0.4, abs=0.01
    )
    assert {f"{leg}_{part}" for leg in ("front_left", "back_right") for part in ("upper", "lower", "foot")} <= set(
        drawn
    )
    # Links with a mesh are still drawn with their mesh.
    whole = make(urdf(), tmp_path)
    assert not [part for part in whole.appearance().parts if part.link.endswith("_foot")]


def test_an_mjcf_with_missing_assets_is_read_without_meshes(tmp_path: Path) -> None:
    assets = (
        '<asset><mesh name="m" file="none.stl"/><texture name="t" type="2d" file="none.png"/>'
        '<material name="a" texture="t"/></asset><worldbody>'
    )
    text = mjcf().replace("<worldbody>", assets).replace('<geom type="sphere"', '<geom material="a" type="sphere"')
    mesh = '<inertial pos="0 0 0" mass="6" diaginertia="0.04 0.09 0.11"/><geom type="mesh" mesh="m"/>'
    text = text.replace('<geom type="box" size="0.2 0.1 0.05" mass="6"/>', mesh)
    with pytest.raises(SurefootError, match=r"which does not exist; put it there, or leave out meshes \(--no"):
        read(text, tmp_path, "odd.xml")
    robot, plain = read_robot(tmp_path / "odd.xml", meshes=False), read(mjcf(), tmp_path, "plain.xml")
    assert robot.mass == pytest.approx(plain.mass)
    np.testing.assert_allclose(robot.feet, plain.feet)


def test_gear_play_is_dropped_with_a_note(tmp_path: Path) -> None:
    def with_play(text: str, order: str) -> str:
        motor, play = r"\g<0>", r'<joint name="\1_backlash" axis="\2" range="-0.01 0.01" damping="0.01"/>'
        return re.sub(
            r'<joint name="(\w+)_joint" axis="([^"]*)"[^>]*>', motor + play if order == "last" else play + motor, text
        )

    plain = read(mjcf(), tmp_path, "odd.xml")
    for order in ("last", "first"):
        robot = read(with_play(mjcf(), order), tmp_path, "odd.xml")
        assert robot.joints == plain.joints
        np.testing.assert_array_equal(robot.limits, plain.limits)
        np.testing.assert_allclose(robot.feet, plain.feet)
        assert robot.notes[0] == (
            "'FL_hip_backlash' is play of 'FL_hip_joint' (-0.01 to 0.01 rad) (and 11 more): gear play is left out"
        )
    # Play on a separate link, as in URDFs.
    link_play = '<joint name="FL_play" axis="0 1 0" range="-0.02 0.02"/><inertial pos="0 0 0" mass="0.01" ' \
        'diaginertia="1e-6 1e-6 1e-6"/><body name="FL_geared">'  # fmt: skip
    text = mjcf().replace('<body name="FL_calf" pos="0 0 -0.2">', f'<body name="p" pos="0 0 -0.2">{link_play}', 1)
    text = text.replace("</body></body></body>", "</body></body></body></body>", 1)
    robot = read(text, tmp_path, "odd.xml")
    assert robot.joints == plain.joints
    assert robot.notes[0].startswith("'FL_play' is play of 'FL_calf_joint'")


WHEEL = '<origin rpy="1.5707963 0 0"/><geometry><cylinder radius="0.05" length="0.03"/></geometry>'


@pytest.mark.parametrize(
    ("kind", "limits"),
    [("continuous", ""), ("revolute", 'lower="-1e9" upper="1e9"')],
)
def test_wheels_are_rejected_and_locked_wheels_are_feet(kind: str, limits: str, tmp_path: Path) -> None:
    text = re.sub(
        r'<joint name="(\w+)_foot_fixed" type="fixed">(.*?)</joint>',
        rf'<joint name="\1_wheel" type="{kind}">\2<axis xyz="0 1 0"/>'
        rf'<limit {limits} effort="20" velocity="20"/></joint>',
        urdf(foot=WHEEL),
    )
    with pytest.raises(SurefootError) as caught:
        read(text, tmp_path)
    assert (
        "FL_wheel, FR_wheel, RL_wheel, RR_wheel turn wheels at the end of its legs, and robots with wheels are not "
        'supported; type="fixed" instead of type="continuous" locks them'
    ) in str(caught.value)
    robot = read(re.sub(rf'(_wheel" type=)"{kind}"', r'\1"fixed"', text), tmp_path)
    assert robot.foot_radius == pytest.approx([0.05] * 4, rel=0.01)
    assert robot.feet[0, 2] == pytest.approx(-0.4, abs=1e-3)


def test_sliding_feet_are_rejected(tmp_path: Path) -> None:
    text = re.sub(
        r'_foot_fixed" type="fixed">(.*?)</joint>',
        r'_spring" type="prismatic">\1<axis xyz="0 0 1"/>'
        r'<limit lower="-0.02" upper="0" effort="1" velocity="1"/></joint>',
        urdf(),
    )
    words = r"FL_spring, FR_spring, RL_spring, RR_spring slide at the end of its legs.*type=\"fixed\" instead of"
    with pytest.raises(SurefootError, match=words):
        read(text, tmp_path)


def test_a_mesh_in_millimetres_is_rejected(tmp_path: Path) -> None:
    text = urdf(foot='<origin xyz="0 0 0"/><geometry><sphere radius="20"/></geometry>')
    with pytest.raises(
        SurefootError, match=r"the shapes of the base are .* m long, and its upper links 0\.2 m; meshes"
    ):
        read(text.replace('size="0.4 0.2 0.1"', 'size="400 200 100"').replace('radius="20"', 'radius="0.02"'), tmp_path)


def test_an_inertia_in_other_units_is_reported(tmp_path: Path) -> None:
    text = re.sub(r' (i[xyz]{2})="([^"]*)"', lambda m: f' {m[1]}="{float(m[2]) * 1e6}"', urdf())
    (warning,) = read(text, tmp_path).warnings
    assert "shapes and joints span 0.4 x 0.2 x 0.1 m; a box of this size has (0.025, 0.085, 0.1) kg m2" in warning
    assert "it fits if the file has kg mm2; 16 more links are like this" in warning


def test_a_foot_with_a_missing_mesh_is_at_its_link(tmp_path: Path) -> None:
    foot = '<origin xyz="0 0 0"/><geometry><mesh filename="none.stl"/></geometry>'
    robot = read(urdf(foot=foot), tmp_path)
    np.testing.assert_allclose(robot.feet[0], [0.18, 0.14, -0.4], atol=1e-9)
    assert any(note.startswith("feet: a link with the name of a foot") for note in robot.notes)


def test_a_fourth_hinge_with_limits_is_not_a_wheel(tmp_path: Path) -> None:
    text = re.sub(
        r'<joint name="(\w+)_foot_fixed" type="fixed">(.*?)</joint>',
        r'<joint name="\1_toe" type="revolute">\2<axis xyz="0 1 0"/>'
        r'<limit lower="-0.5" upper="0.5" effort="20" velocity="20"/></joint>',
        urdf(),
    )
    with pytest.raises(SurefootError, match="its legs have 4, 4, 4, 4 hinges"):
        read(text, tmp_path)


def test_hips_that_swing_before_they_abduct_are_rejected(tmp_path: Path) -> None:
    text = urdf().replace('axis xyz="1 0 0"', 'axis xyz="0 9 0"').replace('axis xyz="0 1 0"', 'axis xyz="1 0 0"')
    text = re.sub(r'(_calf_joint.*?axis xyz=)"1 0 0"', r'\1"0 1 0"', text)
    with pytest.raises(SurefootError) as caught:
        read(text, tmp_path)
    words = (
        "its hips swing before they abduct ('FL_hip_joint' turns about y, 'FL_thigh_joint' about x): such legs are not"
    )
    assert words in str(caught.value)


def test_an_mjcf_in_radians_without_the_compiler_setting_is_rejected_with_the_fix(tmp_path: Path) -> None:
    with pytest.raises(SurefootError) as caught:
        read(mjcf(compiler='angle="degree"'), tmp_path, "odd.xml")
    assert "the hinges of its legs turn by 0.08 rad or less" in str(caught.value)
    assert 'angle="radian"' in str(caught.value)


XACRO = 'xmlns:xacro="http://www.ros.org/wiki/xacro"'


def test_a_xacro_is_rejected_with_the_commands_to_expand_it(tmp_path: Path) -> None:
    folder = tmp_path / "dog_description"
    (folder / "urdf").mkdir(parents=True)
    file = folder / "urdf/dog.urdf.xacro"
    include = '<xacro:include filename="$(find dog_description)/urdf/leg.xacro"/>'
    file.write_text(f'<robot name="dog" {XACRO}>{include}</robot>')
    with pytest.raises(SurefootError, match=r"includes leg\.xacro, which is not there"):
        read_robot(file)
    (folder / "urdf/leg.xacro").write_text(
        f'<robot {XACRO}><link name="a"/><xacro:include filename="$(find arm_description)/arm.xacro"/></robot>'
    )
    with pytest.raises(SurefootError) as caught:
        read_robot(file)
    for words in ("needs the package arm_description, which is not next to it", "pip install xacro"):
        assert words in str(caught.value)
    # A package next to this one, identified by its package.xml, and its file.
    (tmp_path / "arm_description").mkdir()
    (tmp_path / "arm_description/arm.xacro").write_text(f"<robot {XACRO}/>")
    with pytest.raises(SurefootError) as caught:
        read_robot(file)
    message = str(caught.value)
    for words in (
        "pip install xacro",
        f"dog_description is {folder}",
        f"arm_description is {tmp_path / 'arm_description'}",
        f"-e 's|$(find dog_description)|{folder}|g'",
        "`xacro dog.urdf.xacro > robot.urdf`, and give robot.urdf",
    ):
        assert words in message
    edit = message.split("`")[1]
    assert str(folder / "urdf/leg.xacro") in edit
    assert "\n" not in message


@pytest.mark.parametrize(
    "text",
    [
        urdf().replace('<robot name="odd">', f'<!-- made by xacro of ${{name}} --><robot name="odd" {XACRO}>'),
        urdf(),
    ],
)
def test_a_urdf_that_only_mentions_xacro_is_read(text: str, tmp_path: Path) -> None:
    assert read(text, tmp_path, "odd.urdf.xacro").mass == pytest.approx(10.6)


def test_xacro_expressions_and_a_missing_namespace_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match="is a xacro, which is a template"):
        read(urdf().replace('value="6"', 'value="${2 * 3}"'), tmp_path)
    with pytest.raises(SurefootError, match="a xacro without xmlns:xacro="):
        read('<robot name="r"><xacro:leg/></robot>', tmp_path)


@pytest.mark.parametrize(
    ("speed", "passed", "warn", "words"),
    [
        ("0.7", False, False, "and its limit is 0.7 rad/s"),
        ("3.2", False, False, "if these are revolutions per second, it is 20.1 rad/s"),
        ("8", True, True, "and its limit is 8 rad/s"),
        ("20", True, False, "and its limit is 20 rad/s"),
    ],
)
def test_a_speed_limit_too_low_for_a_trot_is_reported(
    speed: str, passed: bool, warn: bool, words: str, tmp_path: Path
) -> None:
    robot = make(urdf().replace('velocity="20"', f'velocity="{speed}"'), tmp_path)
    result = next(result for result in check_trot(robot) if result.name == "speed to trot")
    assert (result.passed, result.warn) == (passed, warn)
    assert words in f"{result.message}; {result.remedy}"
    assert result.value == pytest.approx(9.6, rel=0.1)


def test_a_visual_that_extends_beyond_the_foot_sphere_is_a_warning(tmp_path: Path) -> None:
    robot = make(urdf(), tmp_path)
    assert np.abs(visual_overhang(robot)).max() < 1e-3
    text = robot.urdf.path.read_text()
    shorter, count = re.subn(r'(<joint name="front_left_ankle".*?xyz="0 0 )-0.2"', r'\1-0.17"', text, flags=re.DOTALL)
    assert count == 1
    robot.urdf.path.write_text(shorter)
    assert visual_overhang(RobotDescription.load(robot.folder)) == pytest.approx([0.03, 0, 0, 0], abs=1e-3)
    result = next(one for one in run_description_checks(RobotDescription.load(robot.folder)) if one.name == "feet")
    assert result.warn
    assert "the visual mesh of front_left ends 30 mm below its sphere" in result.message
