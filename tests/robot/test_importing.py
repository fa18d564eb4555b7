"""Import of URDF and MJCF: the robot that is read, the folder that is written, and rejected files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription, SerialLegs
from surefoot.robot.importing.imported import LEGS
from surefoot.robot.importing.names import robot_name
from surefoot.robot.importing.reader import read_robot
from surefoot.robot.importing.writer import write_robot
from surefoot.world.mujoco_model import build_model, foot_geoms

SHIPPED = {name: RobotDescription.load(name) for name in ("go2", "solo8", "pupper_v2")}
CORNERS = {"FL": (1, 1), "FR": (1, -1), "RL": (-1, 1), "RR": (-1, -1)}
BODY = """<geom type="box" size=".2 .1 .05"/><inertial pos="0 0 0" mass="6" diaginertia=".05 .1 .12"/>"""
LINK = """<inertial pos="0 0 -.1" mass=".5" diaginertia=".002 .002 .0005"/>"""

HEAD = f"""<body name="neck" pos=".2 0 0"><joint name="pan" axis="0 0 1"/>{LINK}
  <body name="head"><joint name="nod" axis="0 1 0"/>{LINK}</body></body>"""


def leg(name: str, x: float, y: float, axes: tuple[str, str, str] = ("1 0 0", "0 1 0", "0 1 0"), foot: str = "") -> str:
    """A leg of an MJCF: upper and lower links of 0.2 m, 0.06 m out from the abduction axis."""
    out = 0.06 * np.sign(y)
    foot = foot or '<geom type="sphere" size=".02" pos="0 0 -.2"/>'
    return f"""
    <body name="{name}_hip" pos="{x} {y} 0"><joint name="{name}_abduction" axis="{axes[0]}" range="-1 1"/>
      <inertial pos="0 0 0" mass=".3" diaginertia=".0005 .0005 .0005"/>
      <body name="{name}_upper" pos="0 {out} 0"><joint name="{name}_hip" axis="{axes[1]}"/>{LINK}
        <body name="{name}_lower" pos="0 0 -.2"><joint name="{name}_knee" axis="{axes[2]}" range="-2.6 -.5"/>{LINK}
          {foot}</body></body></body>"""


def legs(names: Sequence[str] = tuple(CORNERS), **options: Any) -> str:
    return "".join(leg(name, 0.2 * CORNERS[name][0], 0.08 * CORNERS[name][1], **options) for name in names)


def mjcf(body: str = "", extra: str = "") -> str:
    """A quadruped, or another body on the trunk."""
    return f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body name="trunk"><freejoint/>{BODY}
      {body or legs()}</body></worldbody>{extra}</mujoco>"""


def write(tmp_path: Path, text: str, name: str = "dog.xml") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def test_the_reader_returns_the_files_values(tmp_path: Path) -> None:
    imported = read_robot(write(tmp_path, mjcf()))
    assert imported.name == "dog"
    assert imported.mass == pytest.approx(6 + 4 * 1.3)
    assert imported.length == pytest.approx(0.4)
    assert imported.forward == "+x"
    np.testing.assert_allclose(imported.feet[0], [0.2, 0.14, -0.4], atol=1e-12)
    assert imported.foot_radius.tolist() == [0.02] * 4
    assert imported.joints[0] == ("FL_abduction", "FL_hip", "FL_knee")
    np.testing.assert_array_equal(imported.limits[0], [(-1.0, 1.0), (np.nan, np.nan), (-2.6, -0.5)])
    np.testing.assert_allclose(imported.base_box, ([0, 0, 0], [0.2, 0.1, 0.05]), atol=1e-12)
    assert imported.guess_knees() == ("backward", "the knees' limits", False)
    assert "feet: the last link's sphere, radius 0.02 m" in imported.notes
    toe = '<body name="FL_toe" pos="0 0 -.2"/>'
    text = mjcf().replace('<geom type="sphere" size=".02" pos="0 0 -.2"/>', toe, 1)
    notes = read_robot(write(tmp_path, text)).notes
    assert any(note.startswith("feet of FL_knee: a link with the name of a foot") for note in notes)


@pytest.mark.parametrize(
    ("path", "inside", "name"),
    [
        ("a/My Dog-2.urdf", "", "my_dog_2"),
        ("a/hyq_no_sensors.urdf", "hyq", "hyq"),
        ("a/solo12.urdf", "solo", "solo12"),
        ("a/dog.xml", "dog_description", "dog"),
        ("go2/scene_flat.xml", "go2 scene", "go2"),
        ("go2/robot.urdf", "", "go2"),
        ("dog_c_simple_description/urdf/dog.urdf", "dog", "dog_c"),
        ("dog_description/urdf/cat.urdf", "plane", "cat"),
    ],
)
def test_robot_name_is_the_most_specific_name(path: str, inside: str, name: str) -> None:
    assert robot_name(Path(path), inside) == name


def test_a_written_folder_loads_and_keeps_masses_and_kinematics(tmp_path: Path) -> None:
    imported = read_robot(write(tmp_path, mjcf()))
    guesses = write_robot(imported, tmp_path / "dog", "dog")
    robot = RobotDescription.load(tmp_path / "dog")
    assert robot.urdf.total_mass == pytest.approx(imported.mass, abs=1e-4)
    assert robot.coordinates == ("abduction", "swing", "extension")
    assert any(line.startswith("kp = ") for line in guesses)
    assert all("guessed" in line for line in (tmp_path / "dog/robot.toml").read_text().splitlines() if "kp =" in line)
    np.testing.assert_allclose(
        robot.leg_mounts + robot.leg_geometry.foot_position(np.zeros((4, 3))),
        imported.feet,
        atol=1e-9,
    )
    # The inertia about the robot's centre of mass equals the file's.
    whole = []
    for model in (mujoco.MjModel.from_xml_string(mjcf()), build_model(robot)):
        assert model.body_subtreemass[0] == pytest.approx(imported.mass, abs=1e-4)
        data = mujoco.MjData(model)
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        whole.append(inertia[:6, :6])
    np.testing.assert_allclose(*whole, atol=2e-5)
    with pytest.raises(SurefootError, match="already has a robot"):
        write_robot(imported, tmp_path / "dog", "dog")


@pytest.mark.parametrize("name", SHIPPED)
def test_closed_forms_agree_with_mujoco_over_the_whole_range(name: str) -> None:
    robot = SHIPPED[name]
    model, rng = build_model(robot), np.random.default_rng(1)
    data, feet = mujoco.MjData(model), foot_geoms(robot, model)
    poses = np.stack([rng.uniform(*span, (100, 4)) for span in robot.leg_space.values()], axis=-2)
    angles = robot.to_motors(poses)
    np.testing.assert_allclose(robot.to_pose(angles), poses, atol=1e-9)
    expected = robot.foot_positions(angles)
    for k, joints in enumerate(angles):
        for joint, angle in robot.joint_angles(joints).items():
            data.qpos[model.joint(joint).qposadr[0]] = angle
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(data.geom_xpos[feet], expected[k], atol=1e-9)


def test_a_robot_with_another_forward_axis_is_rotated(tmp_path: Path) -> None:
    # A free base is moved to the origin, so the rotation is in the positions and axes of the legs.
    body = "".join(
        leg(name, 0.08 * y, -0.2 * x, axes=("0 1 0", "1 0 0", "1 0 0")).replace(
            f"0 {0.06 * np.sign(-x)} 0", f"{0.06 * y} 0 0"
        )
        for name, (x, y) in CORNERS.items()
    )
    imported = read_robot(write(tmp_path, mjcf(body)))
    assert imported.forward == "-y"
    np.testing.assert_allclose(imported.feet[0], [0.2, 0.14, -0.4], atol=1e-9)
    # The file's x axis points to the robot's left, so knee axes along it become +y.
    np.testing.assert_allclose(imported.axes[0, 1], [0, 1, 0])


def test_opposite_axes_become_signs(tmp_path: Path) -> None:
    body = "".join(
        leg(name, 0.2 * x, 0.08 * y, axes=("1 0 0", f"0 {y} 0", f"0 {y} 0")) for name, (x, y) in CORNERS.items()
    ).replace('axis="0 -1 0" range="-2.6 -.5"', 'axis="0 -1 0" range=".5 2.6"')
    imported = read_robot(write(tmp_path, mjcf(body)))
    write_robot(imported, tmp_path / "dog", "dog")
    robot = RobotDescription.load(tmp_path / "dog")
    assert isinstance(robot.leg_geometry, SerialLegs)
    np.testing.assert_array_equal(robot.leg_geometry.turn[:, 1], [1, -1, 1, -1])
    angles = robot.pose_angles(0.0, 0.2, 0.8)
    places = robot.leg_geometry.foot_in_plane(angles[robot.leg_motor_index])
    np.testing.assert_allclose(places, np.tile(places[:1], (4, 1)), atol=1e-12)


def test_a_urdf_without_meshes_and_with_two_motors_per_leg(tmp_path: Path) -> None:
    robot = SHIPPED["solo8"]
    imported = read_robot(robot.urdf.path)
    assert [len(leg) for leg in imported.joints] == [2] * 4
    # Its joints are named as in ANYmal and Solo, and have no limits.
    assert imported.guess_knees()[::2] == ("inward", True)


FREE = mjcf().replace(' range="-2.6 -.5"', "")
"""A quadruped whose knees have no limits."""


def write_srdf(path: Path, **states: Sequence[float]) -> None:
    """Write an SRDF with knee angles in the order FL, FR, RL, RR for each state."""
    groups = "".join(
        f'<group_state name="{state}">'
        + "".join(f'<joint name="{leg}_knee" value="{angle}"/>' for leg, angle in zip(CORNERS, angles, strict=True))
        + "</group_state>"
        for state, angles in states.items()
    )
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'<robot name="dog">{groups}</robot>')


def test_a_named_pose_shows_the_knee_direction_without_limits(tmp_path: Path) -> None:
    assert read_robot(write(tmp_path, FREE)).guess_knees()[::2] == ("backward", True)
    # Straight legs do not show the knee direction, and a keyframe of another model is ignored.
    legs_at = {"zero": (0, 0), "home": (-1.2, 1.2)}
    keys = "".join(
        f'<key name="{name}" qpos="0 0 .3 1 0 0 0 {f"0 .6 {front} " * 2} {f"0 -.6 {back} " * 2}"/>'
        for name, (front, back) in legs_at.items()
    )
    text = FREE.replace("</mujoco>", f"<keyframe>{keys}</keyframe></mujoco>")
    assert read_robot(write(tmp_path, text)).guess_knees() == ("inward", "keyframe 'home'", False)


def test_srdf_states_show_the_knee_direction_standing_states_first(tmp_path: Path) -> None:
    write_srdf(tmp_path / "srdf/dog.srdf", folded=[-1, -1, -1, -1], straight_standing=[0] * 4, standing=[1, 1, -1, -1])
    path = tmp_path / "robots"
    path.mkdir()
    imported = read_robot(write(path, FREE))
    assert imported.guess_knees() == ("outward", "state 'standing' of dog.srdf", False)
    # Limits take precedence; an unreadable file is ignored.
    assert read_robot(write(path, mjcf())).guess_knees() == ("backward", "the knees' limits", False)
    (tmp_path / "srdf/dog.srdf").write_text("<robot")
    assert read_robot(write(path, FREE)).guess_knees()[2]


def urdf(body: str) -> str:
    return f'<robot name="r">{body}</robot>'


def link(name: str, shape: str = "", mass: str = "1") -> str:
    inertial = f'<inertial><mass value="{mass}"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    return f'<link name="{name}">{inertial if mass else ""}{shape}</link>'


MESH = '<collision><geometry><mesh filename="package://r/trunk.stl"/></geometry></collision>'
BOMB = '<?xml version="1.0"?><!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]><robot name="r">&b;</robot>'
TWO_CHAINS = """<body name="b{n}" pos="{x} {y} 0"><joint name="m{n}a" axis="0 1 0"/>{link}
  <body name="c{n}" pos="0 0 -.2"><joint name="m{n}b" axis="0 1 0"/>{link}</body>
  <body name="d{n}" pos="0 0 -.2"><joint name="m{n}c" axis="0 1 0"/>{link}</body></body>"""

BAD = [
    ("dog.urdf", urdf(link("a", mass="") + link("b", mass="")), "no link has an <inertial> with a mass"),
    ("dog.urdf", BOMB, "declares XML entities"),
    ("dog.urdf", "<robot", "is not well-formed XML in line 1, column 1: unclosed token"),
    ("dog.urdf", urdf(link("a")), "is an object or a scene without hinge joints"),
    ("dog.urdf", "", "is empty"),
    ("dog.urdf", "\x7fELF\0\0", "is a binary file"),
    ("trunk.stl", "solid", "is a mesh; give the URDF or MJCF that names it"),
    ("dog.urdf", urdf(""), "has no links"),
    ("dog.srdf", urdf('<group_state name="standing"/>'), "is an SRDF, which names groups and poses; give the URDF"),
    (
        "dog.urdf",
        '<robot name="r" xmlns:xacro="http://ros.org/wiki/xacro"><xacro:macro name="leg"/></robot>',
        "is a xacro, which is a template; in its folder: pip install xacro, then `xacro dog.urdf > robot.urdf`",
    ),
    (
        "dog.urdf",
        urdf(
            link("a")
            + link("b", mass="0")
            + '<joint name="j" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint>'
        ),
        "'b' moves and has no mass or no inertia; state both in its <inertial>",
    ),
    ("dog.xml", mjcf(legs(("FL",))), "is an arm or another single chain: 'trunk' has one chain of 3 joints"),
    ("dog.xml", mjcf(legs(("FL", "FR"))), "is a biped, humanoid or other robot: 'trunk' has 2 chains of 3, 3"),
    (
        "dog.xml",
        mjcf().split("</worldbody>")[0] + mjcf().split("<worldbody>")[1].replace('name="', 'name="other_'),
        "contains 2 robots: trunk, other_trunk; give a file with one",
    ),
    (
        "dog.xml",
        mjcf("".join(leg(f"{n}{k}", 0.2 * x, 0.08 * y) for n, (x, y) in CORNERS.items() for k in (1, 2))).replace(
            'axis="1 0 0" range="-1 1"', 'axis="1 0 0"'
        ),
        "has 8 legs: 'trunk' has 8 chains",
    ),
    ("dog.urdf", urdf(link("a", mass="heavy")), "link 'a': mass is 'heavy'; it must be a finite number"),
    ("dog.xml", "<sdf/>", "is an SDF of Gazebo; convert it to a URDF"),
    ("dog.xml", mjcf(legs() + leg("M", 0.0, 0.2)), "has 5 legs: 'trunk' has 5 chains of 3, 3, 3, 3, 3 joints"),
    ("dog.xml", mjcf(legs(("FL", "FR", "RL"))), "has 3 legs: 'trunk' has 3 chains"),
    (
        "dog.xml",
        mjcf("".join(TWO_CHAINS.format(n=n, x=0.2 * x, y=0.1 * y, link=LINK) for n, (x, y) in CORNERS.items())),
        "has legs that branch at 'bFL'; five-bar legs need a data sheet that is written by hand",
    ),
    ("dog.xml", mjcf(legs(axes=("1 0 0", "0 1 .3", "0 1 0"))), "should be the hip, and its axis at zero is"),
    ("dog.xml", mjcf(legs(foot="<site/>")), "has neither a shape nor a foot link"),
    ("dog.xml", mjcf().replace('axis="0 1 0"', 'type="slide" axis="0 1 0"', 1), "does not have a single hinge"),
    ("dog.xml", "<mujoco><wheel/></mujoco>", "MuJoCo can't read it: line 1, <wheel>: Schema violation"),
    (
        "dog.xml",
        mjcf()
        .replace('type="box"', 'type="mesh" mesh="m"')
        .replace("<worldbody>", '<asset><mesh name="m" file="none.stl"/></asset><worldbody>'),
        "names the file 'none.stl', which does not exist; put it there",
    ),
    (
        "dog.xml",
        mjcf().replace('<body name="trunk"><freejoint/>' + BODY, "").replace("</body></worldbody>", "</worldbody>"),
        "its legs are attached to the world",
    ),
    ("dog.xml", mjcf().replace("<freejoint/>", "").replace(BODY, ""), "body 'trunk' has no mass"),
    (
        "dog.xml",
        mjcf().replace('<joint name="FL_abduction" axis="1 0 0" range="-1 1"/>', ""),
        "its legs have 2, 3, 3, 3 hinges; all must have 2, or all 3",
    ),
    (
        "dog.xml",
        mjcf("".join(leg(n, 0.2 if n != "RR" else -0.2, 0.08 * y) for n, (x, y) in CORNERS.items())),
        "its hips are not at four corners, one leg at each",
    ),
    (
        "dog.xml",
        mjcf(extra='<equality><connect body1="FL_lower" body2="FL_hip" anchor="0 0 0"/></equality>'),
        "has closed loops; five-bar legs need",
    ),
    (
        "dog.xml",
        mjcf(extra='<equality><joint joint1="FL_knee" joint2="FL_hip"/></equality>'),
        "has a joint that follows another one or is held, 'FL_knee'; five-bar legs need",
    ),
    (
        "dog.xml",
        mjcf().replace(' name="RL_hip"', ""),
        "the joint of body 'RL_upper' has no name; name the joints of all legs",
    ),
]


@pytest.mark.parametrize(("name", "text", "message"), BAD, ids=[message for _, _, message in BAD])
def test_files_without_a_quadruped_are_rejected_in_one_line(name: str, text: str, message: str, tmp_path: Path) -> None:
    with pytest.raises(SurefootError) as caught:
        read_robot(write(tmp_path, text, name))
    assert message in str(caught.value)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_mesh_is_left_out_with_a_note(tmp_path: Path) -> None:
    text = SHIPPED["solo8"].urdf.path.read_text()
    text = text.replace('<link name="base">', f'<link name="base">{MESH}', 1)
    path = write(tmp_path, text, "solo.urdf")
    missing = "shapes are left out: mesh 'package://r/trunk.stl' does not exist; put it where the file names it"
    assert missing in read_robot(path).notes
    assert missing not in read_robot(path, meshes=False).notes


def test_impossible_inertias_are_noted(tmp_path: Path) -> None:
    text = SHIPPED["solo8"].urdf.path.read_text()
    extra = link("camera").replace('ixx="1"', 'ixx="9"')
    fixed = '<joint name="mount" type="fixed"><parent link="base"/><child link="camera"/></joint>'
    imported = read_robot(write(tmp_path, text.replace("</robot>", f"{extra}{fixed}</robot>"), "solo.urdf"))
    assert any("camera" in note and "no rigid body" in note for note in imported.notes)


def test_a_tail_is_fixed_and_fused_with_the_base(tmp_path: Path) -> None:
    tail = f'<body name="tail" pos="-.2 0 0"><joint name="wag" axis="0 0 1"/>{LINK}</body>'
    poses = '<keyframe><key name="home" qpos="0 0 1 1 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0"/></keyframe>'
    imported = read_robot(write(tmp_path, mjcf(tail + legs(), poses)))
    assert "joint 'wag' and the bodies below it are fixed, because they are not part of a leg" in imported.notes
    assert imported.base.mass == pytest.approx(6.5)
    # The tail's centre is 0.1 m below its joint.
    np.testing.assert_allclose(imported.base.centre, 0.5 / 6.5 * np.array([-0.2, 0.0, -0.1]), atol=1e-12)


def test_a_head_with_as_few_joints_as_a_leg_is_fixed(tmp_path: Path) -> None:
    imported = read_robot(write(tmp_path, mjcf(HEAD + legs())))
    assert "joint 'pan' and the bodies below it are fixed, because they are not part of a leg" in imported.notes
    assert imported.joints[0] == ("FL_abduction", "FL_hip", "FL_knee")
    assert imported.base.mass == pytest.approx(7.0)


@pytest.mark.parametrize(
    "equality",
    [
        '<joint joint1="pan" joint2="nod"/>',  # what MuJoCo makes of <mimic>
        '<joint joint1="FL_knee" active="false"/>',
        '<weld body1="neck" body2="trunk"/>',
    ],
)
def test_couplings_outside_of_the_legs_or_inactive_ones_are_accepted(equality: str, tmp_path: Path) -> None:
    text = mjcf(HEAD + legs(), f"<equality>{equality}</equality>")
    assert len(read_robot(write(tmp_path, text)).joints) == 4


def test_a_joints_reference_angle_is_not_its_zero(tmp_path: Path) -> None:
    # The body of a joint with ref is placed as if the joint were at ref; limits and targets are angles of the joint.
    text = mjcf().replace('_knee" axis', '_knee" ref="-1.5" axis')
    path = write(tmp_path, text)
    write_robot(read_robot(path), tmp_path / "dog", "dog")
    robot = RobotDescription.load(tmp_path / "dog")
    model = mujoco.MjModel.from_xml_path(str(path))
    data, lower = mujoco.MjData(model), model.body("FL_lower").id
    for knee in (-2.5, -1.5, -0.6):
        data.qpos[:] = 0.0
        data.qpos[3] = 1.0
        data.qpos[model.jnt_qposadr[model.joint("FL_knee").id]] = knee
        mujoco.mj_kinematics(model, data)
        foot = data.xpos[lower] + data.xmat[lower].reshape(3, 3) @ [0.0, 0.0, -0.2]
        angles = np.zeros(robot.num_motors)
        angles[robot.motor_names.index("FL_knee")] = knee
        angles *= robot.motor_sign
        np.testing.assert_allclose(robot.foot_positions(angles)[0], foot, atol=1e-6)


def test_a_base_without_a_free_joint_is_the_origin(tmp_path: Path) -> None:
    free = read_robot(write(tmp_path, mjcf()))
    for pose in ('pos="1 2 .5"', 'pos="1 2 .5" euler="0 .3 0"'):
        held = read_robot(write(tmp_path, mjcf().replace('name="trunk"><freejoint/>', f'name="trunk" {pose}>')))
        np.testing.assert_allclose(held.base.centre, free.base.centre, atol=1e-12)
        np.testing.assert_allclose(held.axis_points, free.axis_points, atol=1e-12)
        np.testing.assert_allclose(held.feet, free.feet, atol=1e-12)


def test_inertias_follow_from_geoms_where_the_compiler_says_so(tmp_path: Path) -> None:
    text = mjcf().replace('<geom type="box"', '<geom mass="5" type="box"')
    assert read_robot(write(tmp_path, text)).base.mass == 6.0
    text = text.replace('autolimits="true"', 'autolimits="true" inertiafromgeom="true"')
    imported = read_robot(write(tmp_path, text))
    assert imported.base.mass == pytest.approx(5.0)
    # A body of a leg has no geom with a mass but its foot.
    assert imported.bodies[0][0].mass == pytest.approx(0.3)
    assert imported.bodies[0][2].mass == pytest.approx(1000 * 4 / 3 * np.pi * 0.02**3)


def test_springs_of_joints_are_noted(tmp_path: Path) -> None:
    imported = read_robot(write(tmp_path, mjcf().replace('name="FL_knee"', 'name="FL_knee" stiffness="30"')))
    assert any(note.startswith("springs at joints are left out") and "FL_knee" in note for note in imported.notes)
    assert not any("springs" in note for note in read_robot(write(tmp_path, mjcf())).notes)


def test_every_keyframe_without_a_name_is_a_pose(tmp_path: Path) -> None:
    keys = "".join(f'<key qpos="0 0 1 1 0 0 0 {" ".join(["0 0 -1." + digit] * 4)}"/>' for digit in "12")
    poses = read_robot(write(tmp_path, mjcf(extra=f"<keyframe>{keys}</keyframe>"))).poses
    assert [angles[0, 2] for _, angles in poses] == [-1.1, -1.2]


def test_a_rounded_inertia_keeps_its_moments(tmp_path: Path) -> None:
    text = SHIPPED["solo8"].urdf.path.read_text()
    plate = link("plate").replace('ixx="1" iyy="1" izz="1"', 'ixx="1e-3" iyy="1e-3" izz="2.0005e-3"')
    fixed = '<joint name="mount" type="fixed"><parent link="base"/><child link="plate"/></joint>'
    for extra in ("", plate + fixed):
        imported = read_robot(write(tmp_path, text.replace("</robot>", f"{extra}</robot>"), "solo.urdf"))
        assert not any("no rigid body" in note for note in imported.notes)
        if not extra:
            before = imported.base
    # The plate of 1 kg moves the base's centre; both bodies' moments about the common centre add up.
    total = before.mass + 1.0
    centre = before.mass * before.centre / total
    around = [
        mass * (offset @ offset * np.eye(3) - np.outer(offset, offset))
        for mass, offset in ((before.mass, before.centre - centre), (1.0, -centre))
    ]
    expected = before.inertia + np.diag([1e-3, 1e-3, 2e-3]) + sum(around)
    np.testing.assert_allclose(imported.base.inertia, expected, atol=2e-6)


def test_torque_limits_come_from_joints_or_actuators(tmp_path: Path) -> None:
    motors = """<actuator>
      <motor joint="FL_hip" gear="-9" forcerange="-2 3"/><motor joint="FL_knee" gear="6" ctrlrange="-1.5 1.5"/>
      <position joint="FR_hip" kp="20" ctrlrange="-2 2"/></actuator>"""
    text = mjcf(extra=motors)
    text = text.replace('<joint name="FL_abduction"', '<joint name="FL_abduction" actuatorfrcrange="-24 20"')
    imported = read_robot(write(tmp_path, text))
    # Commands of a position servo are angles.
    np.testing.assert_array_equal(imported.torque, [(24.0, 27.0, 9.0), *[[np.nan] * 3] * 3])


def test_feet_without_spheres_are_at_the_end_of_boxes(tmp_path: Path) -> None:
    box = '<geom type="box" size=".015 .01 .1" pos=".005 0 -.1"/>'
    imported = read_robot(write(tmp_path, mjcf(legs(foot=box))))
    radius, (x, y, z) = imported.foot_radius[0], imported.feet[0]
    # The centre of the lower end, 0.2 m below the knee; the sphere is not much wider than the end.
    assert 0.004 <= radius <= 1.5 * 0.015 + 1e-9
    assert (x, y) == pytest.approx((0.205, 0.14), abs=2e-3)
    assert z - radius == pytest.approx(-0.4, abs=1e-3)
    assert f"feet: a sphere with the lowest point of the last link's shapes, radius {radius:.3g} m" in imported.notes


FEET = {
    # Shapes at the ankle, 0.2 m below the knee, and radius and lowest point of the sphere that rolls like them.
    "disc": ('<geom type="cylinder" size=".02 .01" pos="0 0 -.2" euler="1.5707963 0 0"/>', 0.02, 0.22),
    "narrow disc": ('<geom type="cylinder" size=".006 .002" pos="0 0 -.2" euler="1.5707963 0 0"/>', 0.006, 0.206),
    "disc off the line": ('<geom type="cylinder" size=".03 .01" pos=".01 0 -.19" euler="1.5707963 0 0"/>', 0.03, 0.22),
    "capsule along the shank": ('<geom type="capsule" size=".012" fromto="0 0 0 0 0 -.2"/>', 0.012, 0.212),
    "capsule across": ('<geom type="capsule" size=".015" fromto="0 -.02 -.2 0 .02 -.2"/>', 0.015, 0.215),
    "round ellipsoid": ('<geom type="ellipsoid" size=".02 .01 .02" pos="0 0 -.2"/>', 0.02, 0.22),
}


@pytest.mark.parametrize("kind", FEET)
def test_a_foot_is_the_sphere_that_rolls_like_its_shape(kind: str, tmp_path: Path) -> None:
    shape, radius, reach = FEET[kind]
    imported = read_robot(write(tmp_path, mjcf(legs(foot=shape))))
    assert imported.foot_radius == pytest.approx([radius] * 4, rel=0.01)
    assert 0.2 + imported.feet[0, 2] - radius == pytest.approx(-reach, abs=3e-4)


@pytest.mark.parametrize(
    "shape",
    [
        '<geom type="box" size=".015 .015 .01" pos="0 0 -.21"/>',
        '<geom type="cylinder" size=".02 .01" pos="0 0 -.21"/>',  # a stamp: the axis is the shank's
        '<geom type="ellipsoid" size=".03 .02 .01" pos="0 0 -.21"/>',
    ],
)
def test_a_flat_foot_keeps_its_sole(shape: str, tmp_path: Path) -> None:
    imported = read_robot(write(tmp_path, mjcf(legs(foot=shape))))
    assert imported.feet[0, 2] - imported.foot_radius[0] == pytest.approx(-0.42, abs=2e-3)
    assert imported.feet[0, 0] == pytest.approx(0.2, abs=2e-3)


def test_a_sphere_at_the_knee_is_not_a_foot(tmp_path: Path) -> None:
    foot = '<geom type="sphere" size=".03"/><geom type="cylinder" size=".02 .01" pos="0 0 -.2" euler="1.5707963 0 0"/>'
    imported = read_robot(write(tmp_path, mjcf(legs(foot=foot))))
    assert imported.foot_radius == pytest.approx([0.02] * 4, rel=0.01)


def test_a_base_without_shapes_becomes_a_box_with_its_inertia(tmp_path: Path) -> None:
    half = np.array([0.3, 0.15, 0.1])
    inertia = 6 / 3 * (np.sum(half**2) - half**2)  # of a solid box with half sides
    body = f'<inertial pos=".01 0 0" mass="6" diaginertia="{" ".join(map(str, inertia))}"/>'
    imported = read_robot(write(tmp_path, mjcf().replace(BODY, body)))
    centre, sides = imported.base_box
    np.testing.assert_allclose(centre, [0.01, 0, 0], atol=1e-12)
    np.testing.assert_allclose(sides, half, rtol=1e-6)
    assert "the base has no shape: it is replaced by a box with the same inertia" in imported.notes


def test_forward_is_guessed_without_leg_names(tmp_path: Path) -> None:
    body = "".join(leg(f"leg{k}", 0.2 * x, 0.08 * y) for k, (x, y) in enumerate(CORNERS.values()))
    path = write(tmp_path, mjcf(body))
    imported = read_robot(path)
    assert imported.forward == "+x"
    assert "forward is guessed: the joints' names do not say which legs are in front" in imported.notes
    back = read_robot(path, "-x")
    assert (back.forward, [note for note in back.notes if "guessed" in note]) == ("-x", [])
    # Rotated by half a turn, so that the last leg of the file is the front left leg.
    assert back.joints[LEGS.index("front_left")][0] == "leg3_abduction"


def test_package_meshes_are_found_and_unreadable_meshes_are_noted(tmp_path: Path) -> None:
    corners = np.array([[0, 0, 0], [0.4, 0, 0], [0, 0.2, 0], [0, 0, 0.1]])
    faces = corners[[[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]]
    triangles = np.zeros(4, [("normal", "<f4", 3), ("points", "<f4", (3, 3)), ("more", "<u2")])
    triangles["points"] = faces
    stl = tmp_path / "pack" / "meshes" / "trunk.stl"
    stl.parent.mkdir(parents=True)
    stl.write_bytes(bytes(80) + np.uint32(4).tobytes() + triangles.tobytes())
    (stl.parent / "legs.dae").touch()
    text = SHIPPED["solo8"].urdf.path.read_text()
    meshes = MESH.replace("r/trunk.stl", "other_name/meshes/trunk.stl") + MESH.replace(
        "r/trunk.stl", "r/meshes/legs.dae"
    )
    text = text.replace('<link name="base">', f'<link name="base">{meshes}', 1)
    (tmp_path / "pack" / "urdf").mkdir()
    imported = read_robot(write(tmp_path, text, "pack/urdf/solo.urdf"))
    plain = read_robot(SHIPPED["solo8"].urdf.path)
    assert "shapes that MuJoCo can't read are left out: legs.dae" in imported.notes
    (low, high), (was_low, was_high) = (
        (box[0] - box[1], box[0] + box[1]) for box in (imported.base_box, plain.base_box)
    )
    np.testing.assert_allclose(low, np.minimum(was_low, 0.0), atol=1e-6)
    np.testing.assert_allclose(high, np.maximum(was_high, corners.max(axis=0)), atol=1e-6)


@pytest.mark.parametrize(("mass", "moment", "more"), [("0", "1", 0), ("", "1", 0), ("0.5", "0", 0.5), ("1", "1", 1)])
def test_fixed_links_add_mass_with_or_without_inertia(mass: str, moment: str, more: float, tmp_path: Path) -> None:
    extra = link("frame", mass=mass)
    for axis in ("ixx", "iyy", "izz"):
        extra = extra.replace(f'{axis}="1"', f'{axis}="{moment}"')
    extra += '<joint name="mount" type="fixed"><parent link="base"/><child link="frame"/></joint>'
    path = write(tmp_path, SHIPPED["solo8"].urdf.path.read_text().replace("</robot>", extra + "</robot>"), "solo.urdf")
    imported, plain = read_robot(path), read_robot(SHIPPED["solo8"].urdf.path)
    assert imported.base.mass == pytest.approx(plain.base.mass + more)
    assert imported.base.centre == pytest.approx(plain.base.centre * plain.base.mass / imported.base.mass, abs=1e-9)
    # Inertia about the origin of the base, where the link is.
    about = [
        one.inertia + one.mass * (one.centre @ one.centre * np.eye(3) - np.outer(one.centre, one.centre))
        for one in (imported.base, plain.base)
    ]
    np.testing.assert_allclose(about[0] - about[1], np.eye(3) * (float(moment) if more else 0.0), atol=1e-9)
    assert imported.notes == plain.notes
