"""Description of the Minitaur, and invalid copies of it."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription


@pytest.fixture
def folder(tmp_path: Path, robot: RobotDescription) -> Path:
    """A copy of the Minitaur's folder, which tests modify."""
    return Path(shutil.copytree(robot.folder, tmp_path / "robot", ignore=shutil.ignore_patterns("__pycache__")))


def test_total_mass(robot: RobotDescription):
    # 3.353 + 2 x 1.320 + 8 x 0.072 + 8 x 0.034 + 4 x 0.072 + 4 x 0.086
    assert robot.urdf.total_mass == pytest.approx(7.473, abs=1e-9)


def test_motor_order_and_signs(robot: RobotDescription):
    assert robot.num_motors == 8
    assert robot.motor_names[:2] == ("front_left_2_motor", "front_left_1_motor")
    assert robot.motor_names[-2:] == ("back_right_1_motor", "back_right_2_motor")
    # Motor 1 turns its upper link forward, about +y like the URDF's joints; motor 2 turns backward.
    expected = [1 if "_1_" in name else -1 for name in robot.motor_names]
    assert robot.motor_sign.tolist() == expected


def test_legs(robot: RobotDescription):
    assert robot.leg_names == ("front_left", "back_left", "front_right", "back_right")
    for leg, pair in zip(robot.legs, robot.leg_motor_index, strict=True):
        assert tuple(robot.motor_names[k] for k in pair) == leg.motors
        assert leg.motors == (f"{leg.name}_1_motor", f"{leg.name}_2_motor")
        # The longer lower link, which has the foot, belongs to motor 2.
        assert leg.foot == f"{leg.name}_2_lower"


def test_data_sheet_values(robot: RobotDescription):
    assert robot.five_bar is robot.leg_geometry
    assert robot.leg_space == {"swing": (-1.0, 1.0), "extension": (0.6, 2.7)}
    assert (robot.rest, robot.poses.sit, robot.poses.spread) == ((0.0, 2.0), (0.0, 0.9), 1.2)
    np.testing.assert_allclose(robot.resting_angles, np.full(8, 2.0))
    assert robot.dc_motor is robot.actuator
    assert (robot.dc_motor.torque_constant, robot.dc_motor.resistance) == (0.0954, 0.186)
    assert (robot.timing.servo_step, robot.timing.control_step) == (0.001, 0.006)
    current, torque = robot.torque_table
    assert current.tolist() == [0, 10, 20, 30, 40, 50, 60]
    assert torque.tolist() == [0, 1.0, 1.9, 2.45, 3.0, 3.25, 3.5]


def test_leg_poses_round_trip_through_motor_angles(robot: RobotDescription, rng: np.random.Generator):
    swing, extension = rng.uniform(-0.5, 0.5, (7, 4)), rng.uniform(1, 2, (7, 4))
    angles = robot.pose_angles(swing, extension)
    assert angles.shape == (7, 8)
    back = robot.to_pose(angles)
    assert back.shape == (7, 2, 4)
    np.testing.assert_allclose(np.moveaxis(back, -2, 0), (swing, extension), atol=1e-15)
    np.testing.assert_array_equal(robot.to_motors(back), robot.pose_angles(*np.moveaxis(back, -2, 0)))


def test_a_scalar_coordinate_applies_to_all_legs(robot: RobotDescription):
    np.testing.assert_array_equal(robot.pose_angles(0.1, 2.0), robot.pose_angles([0.1] * 4, [2.0] * 4))
    np.testing.assert_array_equal(robot.pose_angles(np.zeros((3, 1)), [2.0] * 4), np.full((3, 8), 2.0))


def test_each_leg_pose_maps_to_its_own_motors(robot: RobotDescription):
    # Only the front left leg swings, by 0.3: its motor 2 comes first in the order, then its motor 1.
    angles = robot.pose_angles([0.3, 0, 0, 0], [2.0, 2, 2, 2])
    np.testing.assert_allclose(angles, [1.7, 2.3, 2, 2, 2, 2, 2, 2])


def test_leg_mounts_are_between_the_motors(robot: RobotDescription):
    # Rails are 0.1265 to the side and 0.0185 below; motors 0.2375 in front and behind, 0.0275 to both sides of a rail.
    expected = [[0.2375, 0.1265], [-0.2375, 0.1265], [0.2375, -0.1265], [-0.2375, -0.1265]]
    np.testing.assert_allclose(robot.leg_mounts, [[*place, -0.0185] for place in expected], atol=1e-12)
    assert robot.leg_mounts.shape == (len(robot.legs), 3)


def test_foot_positions_follow_the_leg_mounts(folder: Path):
    text = (folder / "minitaur.urdf").read_text()
    (folder / "minitaur.urdf").write_text(text.replace('xyz="0 0.1265 -0.0185"', 'xyz="0.1 0.2 0.3"'))
    mounts = RobotDescription.load(folder).leg_mounts
    np.testing.assert_allclose(mounts[:2], [[0.3375, 0.2, 0.3], [-0.1375, 0.2, 0.3]], atol=1e-12)
    np.testing.assert_allclose(mounts[2:], [[0.2375, -0.1265, -0.0185], [-0.2375, -0.1265, -0.0185]], atol=1e-12)


def test_angle_extent_over_a_range_of_poses(robot: RobotDescription):
    # theta_1 = e + s and theta_2 = e - s; both from 1 - 0.3 to 2 + 0.3 for a range of swing that is even.
    low, high = robot.angle_extent((-0.3, 0.3), (1.0, 2.0))
    np.testing.assert_allclose((low, high), [[0.7] * 8, [2.3] * 8])
    # From 0 to 0.3: theta_1 from 1 to 2.3, theta_2 from 0.7 to 2. Legs on the left have motor 2 first, right ones 1.
    low, high = robot.angle_extent((0.0, 0.3), (1.0, 2.0))
    np.testing.assert_allclose(low, [0.7, 1.0, 0.7, 1.0, 1.0, 0.7, 1.0, 0.7])
    np.testing.assert_allclose(high, [2.0, 2.3, 2.0, 2.3, 2.3, 2.0, 2.3, 2.0])


def test_joint_angles_close_the_loops_of_the_urdf(robot: RobotDescription):
    angles = robot.pose_angles([0.2, -0.3, 0.0, 0.4], [1.8, 2.1, 1.5, 1.2])
    joints = robot.joint_angles(np.stack([angles, robot.resting_angles]))
    for number, leg in enumerate(robot.legs):
        theta = angles[robot.leg_motor_index[number]]
        assert [joints[name][0] for name in leg.motors] == [theta[0], -theta[1]]
        assert [joints[name][0] for name in leg.knees] == robot.five_bar.knee_angles(theta).tolist()
    assert {name: values[1] for name, values in joints.items()} == robot.joint_angles(robot.resting_angles)


def test_body_length_defaults_to_the_distance_between_legs(folder: Path):
    text = (folder / SHEET).read_text()
    assert text.count("body_length = 0.54") == 1
    (folder / SHEET).write_text(text.replace("body_length = 0.54", ""))
    assert RobotDescription.load(folder).body_length == pytest.approx(2 * 0.2375)


def test_an_unknown_robot_is_rejected_with_the_choices():
    names = RobotDescription.available()
    assert "minitaur" in names
    with pytest.raises(SurefootError, match=rf"robot 'snake': no such robot .*; choices: {', '.join(names)}$"):
        RobotDescription.load("snake")


@pytest.mark.parametrize("name", RobotDescription.available())
def test_every_pose_in_leg_space_is_feasible_for_every_robot(name: str):
    robot = RobotDescription.load(name)
    axes = np.meshgrid(*(np.linspace(*bounds, 7) for bounds in robot.leg_space.values()))
    poses = np.repeat(np.stack([axis.ravel() for axis in axes], -1)[..., None], len(robot.legs), axis=-1)
    angles = robot.to_motors(poses)
    assert robot.leg_geometry.is_feasible(angles[:, robot.leg_motor_index]).all()
    np.testing.assert_allclose(robot.to_pose(angles), poses, atol=1e-9)
    low, high = robot.angle_extent(*robot.leg_space.values())
    assert np.all((angles >= low - 1e-9) & (angles <= high + 1e-9))


SHEET, URDF = "robot.toml", "minitaur.urdf"


# Text in the data sheet or URDF => its replacement => parts of the message.
BROKEN = r"""
name="back_left_1_motor" => name="back_left_x_motor" => motors.order ... 'back_left_1_motor' ... back_left_x_motor
"front_left_2_motor", "front => "front_left_3_motor", "front => motors.order ... 'front_left_3_motor' ... choices:
motors = ["back_right_1_motor" => motors = ["back_right_9_motor" => legs.back_right.motors ... 'back_right_9_motor'
["back_right_1_motor", "back_right_2_motor"] => ["back_right_1_motor"] => legs.back_right has 1 motors and 2 knees
["back_right_1_motor", "back_right_2_motor"] => ["front_right_1_motor", "front_right_2_motor"] => must belong to one leg
["back_right_1_knee", "back_right_2_knee"] => ["back_right_1_knee"] => 2 motors and 1 knees ... with leg_geometry
foot = "front_left_2_lower" => foot = "toe" => legs.front_left.foot ... 'toe' ... choices: ... front_left_2_lower
sphere radius="0.0085" => box size=".1 .1 .1" => legs.front_left.foot ... shapes: box; a foot must have exactly one
base = "base" => base = "trunk" => base names 'trunk' ... choices: base,
base = "base" => => base ... is missing
sign = [-1, 1, -1, 1, 1, => sign = [-1, 1, -1, 2, 1, => motors.sign[3] is 2 ... choices: -1, 1
sign = [-1, 1, -1, 1, 1, => sign = [1, -1, 1, 1, => motors.sign has 7 numbers ... it must have 8
<mass value="3.353"/> => <mass value="0"/> => link 'base' ... mass is 0 ... over 0 kg
<mass value="3.353"/> => <mass value="inf"/> => link 'base' ... mass is 'inf' ... a finite number
<mass value="3.353"/> => => link 'base' ... every link needs both
ixx="0.006837" => ixx="0.6837" => link 'base' ... inertia (0.6837, ... none over the sum of the other two
<parent link="base"/><child link="left_rail"/> => <parent link="b"/><child link="left_rail"/> => 'b' ... choices: base
lower = [0.200, 0.208] => lower = [0.020, 0.021] => can't reach its resting pose (swing 0, extension 2) ... must reach
lower = [0.200, 0.208] => lower = [0.095, 0.095] => leg_space.extension is [0.6, 2.7] ... narrow it
links = ["back_left_1_lower" => links = ["back_left_0_lower" => loops[1].links ... 'back_left_0_lower' ... choices:
points = [[0.0, 0.0045, 0.200], => points = [[0.0, 0.200], => loops[0].points[0] is [0.0, 0.2] ... 3 values
upper = 0.101 => upper = -0.101 => leg_geometry.upper is -0.101
foot_radius = 0.0085 => foot_radius = -0.1 => leg_geometry.foot_radius is -0.1
foot_radius = 0.0085 => foot_radius = 0.3 => leg_geometry.foot_radius is 0.3 ... from 0 to foot 0.24 m
body_length = 0.54 => body_lenght = 0.54 => body_lenght ... is not a key ... choices: ... body_length
\nviscous_friction = 0.0 => \nviscous_friction = -0.01 => actuator.viscous_friction is -0.01 ... 0 or more
resistance = 0.186 => resistance = 0.0 => actuator.resistance is 0 ... over 0
torque_table_current = [0.0, 10.0, 20.0 => torque_table_current = [0.0, 20.0, 10.0 => torque_table_current ... increase
torque_table_current = [0.0, 10.0, => torque_table_current = [0.0, => torque_table_current has 6 points ... the same
swing = [-1.0, 1.0] => swing = [1.0, -1.0] => leg_space.swing ... the lower bound must come first
rest = [0.0, 2.0] => rest = [2.0] => leg_space.rest has 1 numbers ... swing, extension
rest = [0.0, 2.0] => => leg_space has no swing, extension or rest ... need them
swing = [-1.0, 1.0] => abduction = [0.0, 0.1] => leg_space.abduction ... no abduction
sit = [0.0, 0.9] => sit = [0.9] => poses.sit has 1 numbers ... swing, extension
sit = [0.0, 0.9] => sit = [0.0, 0.5] => poses.sit has extension 0.5 ... 0.6 to 2.7
low = 14.0 => low = 15.0 => battery: empty is 12.5 V, low 15 V, warn 14.4 V; they must increase
[battery] => [heat]\nwarn = 90.0\n[battery] => heat: warn is 90 degC, high 80 degC, limit 90 degC; they must increase
kind = "dc" => kind = "steam" => actuator.kind is 'steam' ... choices: dc, joint
kp = 1.0 => kp = 0.0 => actuator.kp is 0 ... over 0
kp = 1.0 => kp = [1.0, 2.0, 3.0] => actuator.kp has 3 numbers ... it takes one, 2 for ... or 8 in the
voltage = [5.0, 30.0] => voltage = [30.0, 5.0] => allowed.voltage ... the lower bound must come first
voltage = [5.0, 30.0] => voltage = [17.0, 30.0] => nominal voltage is 16 ... 17 to 30 ... unit: V
voltage = [5.0, 30.0] => volts = [5.0, 30.0] => allowed.volts ... choices: ... voltage
[motors] => [motors => is not TOML
order = ["front_left", "back => order = ["front", "back => legs.order is ... it must name each leg once
</robot> => => is not well-formed XML
urdf = "minitaur.urdf" => urdf = "cheetah.urdf" => cheetah.urdf ... can't be read
"""


@pytest.mark.parametrize("case", BROKEN.strip().splitlines())
def test_invalid_descriptions_are_rejected_in_one_line(folder: Path, case: str):
    old, new, message = (part.strip().replace("\\n", "\n") for part in case.split("=>"))
    (path,) = (path for path in (folder / SHEET, folder / URDF) if old in path.read_text())
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SurefootError) as caught:
        RobotDescription.load(folder)
    assert "\n" not in str(caught.value)
    for piece in (str(folder), *message.split(" ... ")):
        assert piece in str(caught.value)


def test_battery_and_heat_of_the_data_sheet():
    go2, minitaur = RobotDescription.load("go2"), RobotDescription.load("minitaur")
    assert (minitaur.heat.warn, minitaur.heat.high, minitaur.heat.limit) == (70.0, 80.0, 90.0)
    assert (go2.heat.warn, go2.heat.high, go2.heat.limit) == (80.0, 85.0, 88.0)
    # Eight cells: nominal 3.7 V, sit down at 3.3 V, damp above the 3.0 V at which the battery cuts off.
    assert (go2.battery.nominal / 8, go2.battery.low / 8) == pytest.approx((3.7, 3.3))
    assert 8 * 3.0 < go2.battery.empty < go2.battery.low


def test_allowed_ranges_default_to_the_parameter_bounds(folder: Path):
    text = (folder / SHEET).read_text()
    (folder / SHEET).write_text(text[: text.index("[allowed]")] + "[allowed]\nvoltage = [10.0, 20.0]\n")
    allowed = RobotDescription.load(folder).allowed
    assert (allowed["voltage"], allowed["motor_friction"]) == ((10.0, 20.0), (0.0, 20.0))


@pytest.mark.parametrize(("line", "value"), [("", 0.0), ("viscous_friction = 0.02", 0.02)])
def test_viscous_friction_is_zero_by_default(folder: Path, line: str, value: float):
    text = (folder / SHEET).read_text()
    assert text.count("\nviscous_friction = 0.0 ") == 1
    (folder / SHEET).write_text(text.replace("\nviscous_friction = 0.0 ", f"\n{line} "))
    assert RobotDescription.load(folder).nominal_params()["motor_viscous_friction"] == value


def with_kp(folder: Path, value: str) -> RobotDescription:
    text = (folder / SHEET).read_text()
    assert text.count("\nkp = 1.0 ") == 1
    (folder / SHEET).write_text(text.replace("\nkp = 1.0 ", f"\nkp = {value} "))
    return RobotDescription.load(folder)


# The data sheet's order has motor 2 first on the left and motor 1 first on the right; a leg's list has motor 1 first.
@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ("2.0", [2.0] * 8),
        ("[2.0, 3.0]", [3.0, 2.0, 3.0, 2.0, 2.0, 3.0, 2.0, 3.0]),
        ("[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]", [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0]),
    ],
)
def test_actuator_lists_are_per_leg_motor_or_per_motor(folder: Path, value: str, expected: list[float]):
    robot = with_kp(folder, value)
    np.testing.assert_array_equal(PhysicalParams.nominal(robot, 2).servo_kp, [expected] * 2)
    np.testing.assert_array_equal(PhysicalParams.nominal(robot, 2).servo_kd, np.full((2, 8), 0.015))
