"""Serial legs against figures worked by hand, and their geometry from a URDF."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription, SerialLegs

UPPER, LOWER, ASIDE = 0.2, 0.25, 0.08


def make(
    *, knee: float = -1.0, abducts: bool = True, angles: tuple[float, float] = (0.0, 0.0), turn: float = 1.0
) -> SerialLegs:
    """Return a left and a right leg; links at zero are turned by `angles` from straight down."""
    side = np.array([1.0, -1.0])
    return SerialLegs(
        turn=np.full((2, 3 if abducts else 2), turn),
        side=side,
        hip=np.stack([side * (ASIDE if abducts else 0.0), np.zeros(2)], -1),
        upper=np.full(2, UPPER),
        lower=np.full(2, LOWER),
        upper_angle=np.full(2, angles[0]),
        lower_angle=np.full(2, angles[1]),
        knee=np.full(2, knee),
    )


KINDS = {
    "backward": make(),
    "forward": make(knee=1.0),
    "without abduction": make(abducts=False),
    "other zero": make(angles=(0.4, -0.9)),
    "turned motors": make(turn=-1.0, angles=(-0.2, 0.3)),
}


@pytest.fixture(params=KINDS.values(), ids=KINDS.keys())
def legs(request: pytest.FixtureRequest) -> SerialLegs:
    return request.param


def pose_of(legs: SerialLegs, abduction: float, swing: float, extension: float) -> np.ndarray:
    """Return one pose (C, L) for both legs."""
    values = (abduction, swing, extension) if legs.abducts else (swing, extension)
    return np.tile(np.array(values)[:, None], 2)


def grid(legs: SerialLegs) -> np.ndarray:
    """Return poses (..., C, L) over the range of commands, both legs alike."""
    axes = np.linspace(-0.5, 0.5, 5), np.linspace(-1.0, 1.0, 9), np.linspace(0.35, 0.97, 9)
    values = np.stack(np.meshgrid(*(axes if legs.abducts else axes[1:]), indexing="ij"), -1)
    return np.repeat(values[..., None], 2, axis=-1)


def test_coordinates_and_length():
    assert make().coordinates == ("abduction", "swing", "extension")
    assert make().units == ("rad", "rad", "1")
    assert make(abducts=False).coordinates == ("swing", "extension")
    assert make(abducts=False).units == ("rad", "1")
    assert make().length == pytest.approx(UPPER + LOWER)


def test_a_straight_leg_hangs_down_as_long_as_it_is():
    legs = make()
    angles = np.zeros((2, 3))
    np.testing.assert_allclose(legs.foot_in_plane(angles), [(0.0, -0.45)] * 2, atol=1e-15)
    np.testing.assert_allclose(legs.foot_position(angles), [(0.0, 0.08, -0.45), (0.0, -0.08, -0.45)], atol=1e-15)
    np.testing.assert_allclose(legs.to_pose(angles), pose_of(legs, 0.0, 0.0, 1.0), atol=1e-15)
    np.testing.assert_allclose(legs.to_motors(pose_of(legs, 0.0, 0.0, 1.0)), angles, atol=1e-9)


# The upper link points straight down and the lower one to the back (knee forward) or to the front (knee backward):
# r = sqrt(.2^2 + .25^2) = .3201562 of .45 m is .7114583, the swing atan(.25 / .2) = .8960554.
@pytest.mark.parametrize(("knee", "bend", "x"), [(1.0, np.pi / 2, -0.25), (-1.0, -np.pi / 2, 0.25)])
@pytest.mark.parametrize("abducts", [True, False])
def test_a_knee_at_a_right_angle(knee: float, bend: float, x: float, abducts: bool):
    legs = make(knee=knee, abducts=abducts)
    angles = np.tile([0.0, 0.0, bend][-legs.turn.shape[1] :], (2, 1))
    np.testing.assert_allclose(legs.foot_in_plane(angles), [(x, -0.2)] * 2, atol=1e-15)
    pose = pose_of(legs, 0.0, knee * 0.8960554, 0.7114583)
    np.testing.assert_allclose(legs.to_pose(angles), pose, atol=1e-7)
    np.testing.assert_allclose(legs.to_motors(pose), angles, atol=1e-6)


# With equal links of .2 m and the foot .2 m straight below the hip the leg is an equilateral triangle: the upper link
# is turned by 60 degrees, the knee .2 sin 60 = .1732 m before or behind, and bent by 120 degrees.
@pytest.mark.parametrize("knee", [1.0, -1.0])
def test_knees_point_forward_or_backward(knee: float):
    one = np.ones(1)
    legs = SerialLegs(np.ones((1, 2)), one, np.zeros((1, 2)), 0.2 * one, 0.2 * one, 0 * one, 0 * one, knee * one)
    ((hip, bend),) = legs.to_motors([[0.0], [0.5]])
    assert (hip, bend) == (pytest.approx(-knee * np.pi / 3), pytest.approx(knee * 2 * np.pi / 3))
    assert -0.2 * np.sin(hip) == pytest.approx(knee * 0.1732051)
    np.testing.assert_allclose(legs.foot_in_plane([[hip, bend]]), [(0.0, -0.2)], atol=1e-15)


def test_positive_swing_moves_the_foot_backward_and_extension_makes_the_leg_longer(legs: SerialLegs):
    poses = grid(legs)
    foot = legs.foot_in_plane(legs.to_motors(poses))
    assert np.all(np.diff(foot[..., 0], axis=-3) < 0)
    assert np.all(np.diff(np.linalg.norm(foot, axis=-1), axis=-2) > 0)
    np.testing.assert_allclose(np.linalg.norm(foot, axis=-1), 0.45 * poses[..., -1, :], atol=1e-12)
    np.testing.assert_allclose(np.arctan2(-foot[..., 0], -foot[..., 1]), poses[..., -2, :], atol=1e-12)


# Straight legs turn by .3 rad about the base's x axis: the foot is at y = .08 cos .3 + .45 sin .3 = .2094111 on the
# left and z = .08 sin .3 - .45 cos .3 = -.4062598; the right leg is its mirror image.
def test_abduction_moves_feet_outward_on_both_sides():
    legs = make()
    angles = legs.to_motors(pose_of(legs, 0.3, 0.0, 1.0))
    np.testing.assert_allclose(angles[:, 0], [0.3, -0.3])
    feet = legs.foot_position(angles)
    np.testing.assert_allclose(feet, [(0.0, 0.2094111, -0.4062598), (0.0, -0.2094111, -0.4062598)], atol=1e-7)
    outward = [
        legs.side * legs.foot_position(legs.to_motors(pose_of(legs, a, 0.2, 0.8)))[:, 1]
        for a in np.linspace(-0.5, 0.5, 21)
    ]
    assert np.all(np.diff(outward, axis=0) > 0)


def test_a_hip_that_is_not_at_the_height_of_the_abduction_axis():
    legs = make()
    legs.hip[:, 1] = -0.05
    # The quarter turn brings the left foot, .08 to the left and .05 + .45 below, to .5 to the left and .08 above.
    feet = legs.foot_position([[np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(feet, [(0.0, 0.5, 0.08), (0.0, -0.08, -0.5)], atol=1e-15)


def test_links_that_are_turned_at_zero():
    # Upper link forward by .4, lower link back by .9: with motors at zero they stay so.
    legs = make(knee=1.0, angles=(-0.4, 0.9))
    x, z = 0.2 * np.sin(0.4) - 0.25 * np.sin(0.9), -0.2 * np.cos(0.4) - 0.25 * np.cos(0.9)
    np.testing.assert_allclose(legs.foot_in_plane(np.zeros((2, 3))), [(x, z)] * 2, atol=1e-15)
    # Straight down: the hip turns by .4, the knee by as much as both links are apart, 1.3, the other way.
    np.testing.assert_allclose(legs.foot_in_plane([[0.0, 0.4, -1.3]] * 2), [(0.0, -0.45)] * 2, atol=1e-15)
    np.testing.assert_allclose(legs.to_motors(pose_of(legs, 0.0, 0.0, 1.0)), [[0.0, 0.4, -1.3]] * 2, atol=1e-9)


def test_motors_that_turn_the_other_way_have_the_opposite_angles():
    there, back = make(), make(turn=-1.0)
    poses = grid(there)
    np.testing.assert_array_equal(back.to_motors(poses), -there.to_motors(poses))
    angles = there.to_motors(poses)
    np.testing.assert_array_equal(back.foot_position(-angles), there.foot_position(angles))


def test_to_pose_undoes_to_motors_over_the_range(legs: SerialLegs):
    poses = grid(legs)
    angles = legs.to_motors(poses)
    assert angles.shape == (*poses.shape[:-2], 2, legs.turn.shape[1])
    np.testing.assert_allclose(legs.to_pose(angles), poses, atol=1e-9)


@given(
    abduction=st.floats(-0.5, 0.5),
    swing=st.floats(-1.0, 1.0),
    extension=st.floats(0.35, 0.97),
    kind=st.sampled_from(sorted(KINDS)),
)
def test_poses_go_to_motors_to_the_foot_and_back(abduction: float, swing: float, extension: float, kind: str):
    legs = KINDS[kind]
    pose = pose_of(legs, abduction, swing, extension)
    angles = legs.to_motors(pose)
    np.testing.assert_allclose(legs.to_pose(angles), pose, atol=1e-9)
    np.testing.assert_allclose(legs.plane_pose(legs.foot_in_plane(angles)), pose[-2:], atol=1e-9)
    np.testing.assert_allclose(legs.to_motors(legs.to_pose(angles)), angles, atol=1e-9)


def test_what_is_out_of_reach_is_not_a_number():
    legs = make()
    # Straight it reaches .45 m; folded, .25 - .2 = .05 m, a ninth of that.
    too_long, too_short = pose_of(legs, 0.0, 0.0, 1.001), pose_of(legs, 0.0, 0.0, 0.11)
    for pose in (too_long, too_short):
        angles = legs.to_motors(pose)
        assert np.isnan(angles[:, 1:]).all()
        assert not legs.closes(angles).any()
    assert legs.closes(legs.to_motors(pose_of(legs, 0.0, 0.0, 1.0))).all()
    assert legs.closes(legs.to_motors(pose_of(legs, 0.0, 0.0, 0.112))).all()
    for foot in ((0.0, -0.4501), (0.0, -0.0499), (0.4, -0.3), (np.nan, 0.0)):
        assert np.isnan(legs.plane_pose([foot, foot])).all()
    # Both legs have their own answer.
    swing, extension = legs.plane_pose([(0.0, -0.5), (0.0, -0.225)])
    assert np.isnan([swing[0], extension[0]]).all()
    np.testing.assert_allclose([swing[1], extension[1]], [0.0, 0.5])


def test_jacobian_is_how_the_foot_moves_with_each_motor(legs: SerialLegs):
    angles, step = legs.to_motors(grid(legs)), 1e-6
    motors = angles.shape[-1]
    jacobian = legs.jacobian(angles)
    assert jacobian.shape == (*angles.shape[:-1], 3, motors)
    for motor, turn in enumerate(step * np.eye(motors)):
        moved = (legs.foot_position(angles + turn) - legs.foot_position(angles - turn)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., motor], moved, atol=1e-8)


# A straight left leg, .08 m to the side and .45 m long: abduction moves the foot by (0, .45, .08) m/rad, the hip by .45
# and the knee by .25 m/rad backward.
def test_jacobian_by_hand():
    expected = [(0.0, 0.45, 0.08), (-0.45, 0.0, 0.0), (-0.25, 0.0, 0.0)]
    np.testing.assert_allclose(make().jacobian(np.zeros((2, 3)))[0].T, expected, atol=1e-15)


def test_every_joint_has_a_motor():
    assert make().knee_angles(np.zeros((7, 2, 3))).shape == (7, 2, 0)


INERTIAL = '<inertial><mass value="{mass}"/><inertia ixx="0.01" iyy="0.01" izz="0.01"/></inertial>'
LEGS = {"fl": (0.2, 0.05), "fr": (0.2, -0.05), "rl": (-0.2, 0.05), "rr": (-0.2, -0.05)}
SHEET = """
name = "toy"
urdf = "toy.urdf"
base = "trunk"
[motors]
order = [{order}]
{sign}
[legs]
order = ["fl", "fr", "rl", "rr"]
{legs}
[actuator]
kind = "joint"
kp = [20.0, 30.0, 40.0]
kd = 0.5
torque_limit = 15.0
{actuator}
"""


def write_toy(
    folder: Path, *, sign: str = "", knee: str = "backward", axis: str = "0 1 0", actuator: str = "", more: str = ""
) -> Path:
    """Write a robot of 10 kg with twelve motors.

    Each leg's abduction axis is .05 m to the side, its hip .08 m further out and .01 m lower, its knee .2 m below and
    .05 m forward, its foot .2 m below and .1 m back.
    """
    folder.mkdir(exist_ok=True)
    links, joints, names = [("trunk", 7.6)], [], []
    for leg, (x, y) in LEGS.items():
        out = np.sign(y) * 0.08
        chain = (
            ("hip", "trunk", "continuous", (x, y, 0.0), "1 0 0"),
            ("thigh", f"{leg}_hip", "continuous", (0.0, out, -0.01), axis),
            ("calf", f"{leg}_thigh", "continuous", (0.05, 0.0, -0.2), axis),
            ("foot", f"{leg}_calf", "fixed", (-0.1, 0.0, -0.2), "1 0 0"),
        )
        for part, parent, kind, place, turn in chain:
            links.append((f"{leg}_{part}", 0.15))
            joints.append((f"{leg}_{part}_joint", kind, parent, f"{leg}_{part}", " ".join(map(str, place)), turn))
        names += [f"{leg}_{part}_joint" for part in ("hip", "thigh", "calf")]
    sphere = '<collision><geometry><sphere radius="0.02"/></geometry></collision>'
    body = "".join(
        f'<link name="{name}">{INERTIAL.format(mass=mass)}{sphere if name.endswith("foot") else ""}</link>'
        for name, mass in links
    )
    body += "".join(
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/><origin xyz="{place}"/>'
        f'<axis xyz="{turn}"/></joint>'
        for name, kind, parent, child, place, turn in joints
    )
    (folder / "toy.urdf").write_text(f'<robot name="toy">{body}</robot>')
    tables = "\n".join(
        f'[legs.{leg}]\nmotors = ["{leg}_hip_joint", "{leg}_thigh_joint", "{leg}_calf_joint"]\nfoot = "{leg}_foot"\n'
        f'knee = "{knee}"'
        for leg in LEGS
    )
    order = ", ".join(f'"{name}"' for name in names)
    (folder / "robot.toml").write_text(
        SHEET.format(order=order, sign=sign, legs=tables, actuator=actuator) + more,
    )
    return folder


def test_geometry_of_serial_legs_is_the_urdfs(tmp_path: Path):
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
    # Mounts are on the abduction axis, over the hip; feet at zero are where the URDF has them.
    np.testing.assert_allclose(robot.leg_mounts, [(x, y, 0.0) for x, y in LEGS.values()])
    feet = robot.leg_mounts + legs.foot_position(np.zeros((4, 3)))
    frames = robot.urdf.frames()
    np.testing.assert_allclose(feet, [frames[f"{leg}_foot"][:3, 3] for leg in LEGS], atol=1e-12)
    np.testing.assert_allclose(feet[0], (0.15, 0.13, -0.41), atol=1e-12)


def test_what_a_sheet_of_serial_legs_leaves_out(tmp_path: Path):
    robot = RobotDescription.load(write_toy(tmp_path / "toy", knee="forward"))
    assert robot.leg_geometry.knee.tolist() == [1.0] * 4
    assert robot.leg_space == {"abduction": (-0.5, 0.5), "swing": (-1.0, 1.0), "extension": (0.35, 0.97)}
    assert robot.rest == (0.0, 0.0, 0.75)
    assert (robot.poses.sit, robot.poses.spread) == ((0.0, 0.0, 0.35), None)
    # Feet sink in by a hundredth of the leg's length under a quarter of the weight of 10 kg.
    weight, length = 9.81 * 10.0 / 4, np.hypot(0.05, 0.2) + np.hypot(0.1, 0.2)
    assert robot.contact.stiffness == pytest.approx(weight / (0.01 * length))
    # Twice .5 sqrt(k m) with a quarter of the mass.
    assert robot.contact.damping == pytest.approx(np.sqrt(robot.contact.stiffness * 2.5))
    assert robot.body_length == pytest.approx(0.4)
    np.testing.assert_allclose(robot.to_pose(robot.resting_angles), np.tile([[0.0], [0.0], [0.75]], 4), atol=1e-9)


@pytest.mark.parametrize("number", range(12))
def test_signs_of_motors_turn_their_angles(tmp_path: Path, number: int):
    sign = [1] * 12
    sign[number] = -1
    plain = RobotDescription.load(write_toy(tmp_path / "plain"))
    turned = RobotDescription.load(write_toy(tmp_path / "turned", sign=f"sign = {sign}"))
    pose = (0.2, [0.3, -0.2, 0.1, 0.0], 0.8)
    np.testing.assert_allclose(turned.pose_angles(*pose), np.array(sign) * plain.pose_angles(*pose), atol=1e-15)
    # The URDF's angles are the same.
    expected = plain.joint_angles(plain.pose_angles(*pose))
    joints = turned.joint_angles(turned.pose_angles(*pose))
    np.testing.assert_allclose([joints[name] for name in expected], list(expected.values()), atol=1e-15)


def test_a_joint_about_the_negative_axis_turns_the_other_way(tmp_path: Path):
    plain = RobotDescription.load(write_toy(tmp_path / "plain"))
    turned = RobotDescription.load(write_toy(tmp_path / "turned", axis="0 -1 0"))
    np.testing.assert_allclose(turned.resting_angles, np.tile([1, -1, -1], 4) * plain.resting_angles, atol=1e-15)


def test_lists_of_a_leg_hold_for_every_leg(tmp_path: Path):
    folder = write_toy(tmp_path / "toy", actuator="rotor_inertia = [0.01, 0.02, 0.03]\nload_friction = 0.05")
    params = PhysicalParams.nominal(RobotDescription.load(folder), 2)
    np.testing.assert_array_equal(params.servo_kp, np.tile([20.0, 30.0, 40.0], (2, 4)))
    np.testing.assert_array_equal(params.servo_kd, np.full((2, 12), 0.5))
    np.testing.assert_array_equal(params.rotor_inertia, np.tile([0.01, 0.02, 0.03], (2, 4)))
    np.testing.assert_array_equal(params.load_friction, np.full((2, 12), 0.05))


def test_parameters_of_dc_motors_are_refused_for_joint_actuators(tmp_path: Path):
    robot = RobotDescription.load(write_toy(tmp_path / "toy"))
    assert robot.actuator.kind == "joint"
    params = PhysicalParams.nominal(robot)
    assert params.with_values(robot, load_friction=0.2).load_friction.tolist() == [[0.2] * 12]
    with pytest.raises(SurefootError, match="voltage belongs to motors of kind dc; the motors of toy are joint"):
        params.with_values(robot, voltage=12.0)
    with pytest.raises(SurefootError, match="the motors of toy are of kind joint; this takes DC motors"):
        _ = robot.dc_motor
    with pytest.raises(SurefootError, match="the legs of toy are serial; this takes five-bar legs"):
        _ = robot.five_bar


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"axis": "0 0 1"}, r"legs\.fl: fl_thigh_joint: its axis at zero is \(0, 0, 1\).*must be along y"),
        ({"axis": "0.1 1 0"}, r"legs\.fl: fl_thigh_joint: its axis at zero is \(0\.0995, 0\.995, 0\)"),
        ({"knee": "sideways"}, r"legs\.fl\.knee is 'sideways'; .*choices: forward, backward"),
        ({"actuator": "friction = [0.1, 0.2]"}, r"actuator\.friction has 2 numbers; it takes one, 3 .*, or 12 "),
        ({"more": "[leg_space]\nrest = [0.0, 0.75]\n"}, r"leg_space\.rest has 2 numbers; it must have abduction, "),
        ({"more": "[leg_space]\nextension = [0.35, 1.1]\n"}, r"leg_space\.extension is \[0\.35, 1\.1\], and a leg can"),
        ({"more": "[leg_space]\nrest = [0.0, 0.0, 1.2]\n"}, r"leg can't have its resting pose .*extension 1\.2"),
        ({"sign": "sign = [1, 1, 1]"}, r"motors\.sign has 3 numbers; it must have 12"),
    ],
)
def test_a_broken_sheet_of_serial_legs_is_refused_in_one_line(tmp_path: Path, change: dict[str, str], said: str):
    with pytest.raises(SurefootError, match=said) as caught:
        RobotDescription.load(write_toy(tmp_path / "toy", **change))
    assert "\n" not in str(caught.value)
