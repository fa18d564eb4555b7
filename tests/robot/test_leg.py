"""Kinematics of five-bar and serial legs: properties of all legs, and numbers calculated by hand."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.robot import FiveBar, SerialLegs
from surefoot.robot.leg import Legs

MINITAUR = FiveBar(upper=0.101, lower=(0.200, 0.208), foot=0.240, foot_radius=0.0085)
EQUAL = FiveBar(upper=0.1, lower=(0.2, 0.2), foot=0.3, foot_radius=0.0)
SHORT = FiveBar(upper=0.2, lower=(0.1, 0.1), foot=0.15, foot_radius=0.0)
UPPER, LOWER, ASIDE = 0.2, 0.25, 0.08
RIGHT = np.full(2, np.pi / 2)


def serial_legs(
    knee: float = -1.0, abducts: bool = True, angles: tuple[float, float] = (0.0, 0.0), turn: float = 1.0
) -> SerialLegs:
    """Return a left and a right leg; at zero, links have `angles` from straight down."""
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


KINDS: dict[str, Legs] = {
    "five bars": MINITAUR,
    "backward": serial_legs(),
    "forward": serial_legs(knee=1.0),
    "without abduction": serial_legs(abducts=False),
    "other zero": serial_legs(angles=(0.4, -0.9)),
    "turned motors": serial_legs(turn=-1.0, angles=(-0.2, 0.3)),
}
each_kind = pytest.mark.parametrize("legs", KINDS.values(), ids=KINDS.keys())


def pose_of(legs: Legs, abduction: float, swing: float, extension: float) -> np.ndarray:
    """Return one pose (C, 2) for both legs."""
    return np.tile(np.array([abduction, swing, extension][-len(legs.coordinates) :])[:, None], 2)


def grid(legs: Legs) -> np.ndarray:
    """Return poses (..., C, 2) over the range of commands, equal for both legs."""
    extension = np.linspace(0.6, 2.7, 9) if isinstance(legs, FiveBar) else np.linspace(0.35, 0.97, 9)
    axes = (np.linspace(-0.5, 0.5, 5), np.linspace(-1.0, 1.0, 9), extension)[-len(legs.coordinates) :]
    return np.repeat(np.stack(np.meshgrid(*axes, indexing="ij"), -1)[..., None], 2, axis=-1)


@each_kind
def test_poses_round_trip_through_motor_angles_and_feet(legs: Legs):
    poses = grid(legs)
    angles = legs.to_motors(poses)
    np.testing.assert_allclose(legs.to_pose(angles), poses, atol=1e-9)
    np.testing.assert_allclose(np.stack(legs.plane_pose(legs.foot_in_plane(angles)), -2), poses[..., -2:, :], atol=1e-9)
    np.testing.assert_allclose(legs.foot_pose(legs.foot_position(angles)), poses, atol=1e-9)
    assert legs.is_feasible(angles).all()


@given(st.sampled_from(sorted(KINDS)), *map(partial(st.floats, -1.0), (1.0, 1.0, 1.0)))
def test_pose_round_trip_within_range(kind: str, abduction: float, swing: float, extension: float):
    legs = KINDS[kind]
    low, high = (0.6, 2.7) if legs is MINITAUR else (0.35, 0.97)
    pose = pose_of(legs, abduction / 2, swing, low + (high - low) * (extension + 1) / 2)
    angles = legs.to_motors(pose)
    np.testing.assert_allclose(legs.to_pose(angles), pose, atol=1e-9)
    np.testing.assert_allclose(legs.plane_pose(legs.foot_in_plane(angles)), pose[-2:], atol=1e-9)


@each_kind
def test_positive_swing_moves_the_foot_backward_and_extension_makes_the_leg_longer(legs: Legs):
    poses = grid(legs)
    # The foot of a five-bar leg moves backward for swings up to 0.5 rad, unless the leg is short.
    poses = poses[2:-2, 3:] if legs is MINITAUR else poses
    foot = legs.foot_in_plane(legs.to_motors(poses))
    assert np.all(np.diff(foot[..., 0], axis=-3) < 0)
    assert np.all(np.diff(np.linalg.norm(foot, axis=-1), axis=-2) > 0)


@each_kind
def test_the_jacobian_is_the_derivative_of_the_foots_position(legs: Legs):
    angles, step = legs.to_motors(grid(legs)), 1e-6
    motors = angles.shape[-1]
    jacobian = legs.foot_kinematics(angles).jacobian
    assert jacobian.shape == (*angles.shape[:-1], 3, motors)
    for motor, turn in enumerate(step * np.eye(motors)):
        moved = (legs.foot_position(angles + turn) - legs.foot_position(angles - turn)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., motor], moved, atol=1e-8)


@each_kind
def test_foot_kinematics_have_the_position_and_the_forces_that_balance_torques(legs: Legs):
    angles = legs.to_motors(grid(legs))
    feet = legs.foot_kinematics(angles)
    np.testing.assert_allclose(feet.pose[..., :3], legs.foot_position(angles), atol=1e-12)
    force = np.array([3.0, -2.0 if len(legs.coordinates) == 3 else 0.0, 11.0])
    torque = -force @ legs.foot_kinematics(angles).jacobian
    np.testing.assert_allclose(feet.force(torque), np.broadcast_to(force, feet.pose[..., :3].shape), atol=1e-8)


def test_a_straight_leg_has_no_force_along_itself():
    feet = serial_legs().foot_kinematics(np.zeros((2, 3)))
    # Hip and knee turn by 0.45 and 0.25 m of backward speed a radian: least squares for the force backward.
    force = feet.force(np.array([[0.0, 1.0, 1.0]] * 2))
    np.testing.assert_allclose(force[..., ::2], [[(0.45 + 0.25) / (0.45**2 + 0.25**2), 0.0]] * 2, atol=1e-12)
    # Legs do not affect each other.
    feet = serial_legs().foot_kinematics(np.array([[0.0, 0.0, 0.0], [np.nan, 0.0, 0.0]]))
    np.testing.assert_allclose(feet.force(np.array([[0.0, 1.0, 1.0]] * 2))[0], force[0], atol=1e-12)


@pytest.mark.parametrize(
    ("legs", "feet"),
    [
        # Straight down it reaches 0.101 + 0.240 m; nearer than 0.240 - 0.101 m, motor 2 could not reach it.
        (MINITAUR, [(0.0, -0.342), (0.0, -0.138), (0.4, -0.1), (np.nan, 0.0), (10.0, -10.0)]),
        # Straight it reaches 0.45 m; folded, 0.25 - 0.2 = 0.05 m.
        (serial_legs(), [(0.0, -0.4501), (0.0, -0.0499), (0.4, -0.3), (np.nan, 0.0)]),
    ],
)
def test_a_foot_out_of_reach_has_no_pose(legs: Legs, feet: list[tuple[float, float]]):
    for foot in feet:
        assert np.isnan(legs.plane_pose([foot, foot])).all()


@pytest.mark.parametrize(
    ("legs", "coordinates", "units", "length"),
    [
        (MINITAUR, ("swing", "extension"), ("rad", "rad"), 0.341),
        (serial_legs(), ("abduction", "swing", "extension"), ("rad", "rad", "1"), UPPER + LOWER),
        (serial_legs(abducts=False), ("swing", "extension"), ("rad", "1"), UPPER + LOWER),
    ],
)
def test_coordinates_units_and_length(legs: Legs, coordinates: tuple, units: tuple, length: float):
    assert (legs.coordinates, legs.units) == (coordinates, units)
    assert legs.length == pytest.approx(length)


# --- five-bar legs: theta_1 = e + s, theta_2 = e - s ---


def test_motor_angles_of_a_five_bar_leg_are_extension_plus_and_minus_swing():
    np.testing.assert_array_equal(MINITAUR.to_motors([[0.25, 0.0], [2.0, 1.0]]), [(2.25, 1.75), (1.0, 1.0)])


# theta = pi/2 is horizontal, motor 1 forward and motor 2 backward; at pi both point straight down and meet.
@pytest.mark.parametrize(
    ("theta", "front", "back"), [(np.pi / 2, (0.101, 0), (-0.101, 0)), (np.pi, (0, -0.101), (0, -0.101))]
)
def test_knees_are_at_the_ends_of_the_upper_links(theta: float, front: tuple, back: tuple):
    np.testing.assert_allclose(MINITAUR.knees([theta, theta]), (front, back), atol=1e-15)


# At e = pi/2 the knees are at x = +-0.101, z = 0, a distance d = 0.202 apart. From knee 2 the pin lies
#   (d^2 + 0.208^2 - 0.200^2) / 2d = 0.044068 / 0.404 = 0.109079 along, sqrt(0.208^2 - 0.109079^2) = 0.177104 down,
# and the foot 0.240 / 0.208 times as far along the same link.
# With equal links of 0.2: knees at +-0.1, pin sqrt(0.04 - 0.01) = 0.173205 below the axis, foot 0.3 from knee 2
# along a link at 60 degrees: x = -0.1 + 0.3 cos 60 = 0.05, z = -0.3 sin 60 = -0.259808.
@pytest.mark.parametrize(
    ("leg", "pin", "foot"),
    [
        (MINITAUR, (-0.101 + 0.109079, -0.177104), (-0.101 + 0.125860, -0.204350)),
        (EQUAL, (0, -0.173205), (0.05, -0.259808)),
    ],
)
def test_pin_and_foot_at_a_right_angle(leg: FiveBar, pin: tuple[float, float], foot: tuple[float, float]):
    np.testing.assert_allclose(leg.pin(RIGHT), pin, atol=1e-6)
    np.testing.assert_allclose(leg.foot_in_plane(RIGHT), foot, atol=1e-6)
    np.testing.assert_allclose(leg.foot_position(RIGHT), (foot[0], 0.0, foot[1]), atol=1e-6)


def test_the_loop_keeps_every_length_and_knee_angles_lead_to_the_pin():
    theta = MINITAUR.to_motors(grid(MINITAUR))
    knees, pin, foot = np.stack(MINITAUR.knees(theta), -2), MINITAUR.pin(theta), MINITAUR.foot_in_plane(theta)
    lengths = [*np.moveaxis(knees, -2, 0), *np.moveaxis(pin[..., None, :] - knees, -2, 0), foot - knees[..., 1, :]]
    for link, length in zip(lengths, (0.101, 0.101, 0.200, 0.208, 0.240), strict=True):
        np.testing.assert_allclose(np.linalg.norm(link, axis=-1), length, rtol=1e-12)
    # Absolute angles from straight up about +y: theta_1 for motor 1, -theta_2 for motor 2.
    angles = theta * [1.0, -1.0] + MINITAUR.knee_angles(theta)
    ends = knees + np.array(MINITAUR.lower)[:, None] * np.stack([np.sin(angles), np.cos(angles)], axis=-1)
    np.testing.assert_allclose(ends, np.stack([pin, pin], -2), atol=1e-12)


def test_knees_bend_to_either_side():
    # Lower link 1 runs from (0.101, 0) to the pin at (0.008079, -0.177104):
    # pi + atan(0.092921 / 0.177104) = 3.62478 from straight up, less the upper link's pi/2.
    # Link 2, from (-0.101, 0): -(pi + atan(0.109079 / 0.177104)) + pi/2.
    np.testing.assert_allclose(MINITAUR.knee_angles(RIGHT), (2.05398, -2.12283), atol=1e-5)


def test_swing_turns_the_whole_leg_about_the_motor_axis():
    # Both upper links turn about +y by the swing, so the leg turns as a rigid body.
    at_rest, swung = MINITAUR.foot_in_plane(MINITAUR.to_motors([[0.0, 0.3], [2.0, 2.0]]))
    turn = np.array([(np.cos(0.3), np.sin(0.3)), (-np.sin(0.3), np.cos(0.3))])
    np.testing.assert_allclose(swung, turn @ at_rest, atol=1e-12)


# Equal links 0.1 and 0.2 at theta = pi/2: knees (+-0.1, 0), pin p (0, -0.173205), foot 0.3 along link 2. Motor 1 moves
# knee 1 by (0, -0.1) m/rad. With u_i = p - k_i, i.e. (-0.1, -0.173205) and (0.1, -0.173205):
#   u_1 . dp = u_1 . (0, -0.1) = 0.0173205,   u_2 . dp = 0   so   dp = (-0.0866025, -0.05);
# the foot moves 1.5 times as far, for knee 2 rests: (-0.1299038, -0.075). A turn of motor 2 moves knee 2 by (0, -0.1):
# dp = (0.0866025, -0.05), and the foot by 1.5 dp - 0.5 (0, -0.1) = (0.1299038, -0.025).
def test_jacobian_of_a_five_bar_leg_by_hand():
    expected = [(-0.1299038, 0.0, -0.075), (0.1299038, 0.0, -0.025)]
    np.testing.assert_allclose(EQUAL.foot_kinematics(RIGHT).jacobian.T, expected, atol=1e-7)


def test_foot_and_jacobian_are_nan_if_the_loop_can_not_close():
    assert not SHORT.is_feasible(RIGHT)
    assert SHORT.is_feasible(1.8 * RIGHT)
    assert np.isnan(SHORT.foot_in_plane(RIGHT)).all()
    assert np.isnan(SHORT.foot_kinematics(RIGHT).jacobian[[0, 2]]).all()


# --- serial legs ---


def test_a_straight_leg_reaches_its_length():
    legs, angles = serial_legs(), np.zeros((2, 3))
    np.testing.assert_allclose(legs.foot_position(angles), [(0.0, 0.08, -0.45), (0.0, -0.08, -0.45)], atol=1e-15)
    np.testing.assert_allclose(legs.to_pose(angles), pose_of(legs, 0.0, 0.0, 1.0), atol=1e-15)
    np.testing.assert_allclose(legs.to_motors(pose_of(legs, 0.0, 0.0, 1.0)), angles, atol=1e-9)


# The upper link points straight down and the lower one to the back (knee forward) or to the front (knee backward):
# r = sqrt(0.2^2 + 0.25^2) = 0.3201562 of 0.45 m is 0.7114583, the swing atan(0.25 / 0.2) = 0.8960554.
@pytest.mark.parametrize(("knee", "bend", "x"), [(1.0, np.pi / 2, -0.25), (-1.0, -np.pi / 2, 0.25)])
@pytest.mark.parametrize("abducts", [True, False])
def test_a_knee_at_a_right_angle(knee: float, bend: float, x: float, abducts: bool):
    legs = serial_legs(knee=knee, abducts=abducts)
    angles = np.tile([0.0, 0.0, bend][-legs.turn.shape[1] :], (2, 1))
    np.testing.assert_allclose(legs.foot_in_plane(angles), [(x, -0.2)] * 2, atol=1e-15)
    pose = pose_of(legs, 0.0, knee * 0.8960554, 0.7114583)
    np.testing.assert_allclose(legs.to_pose(angles), pose, atol=1e-7)
    np.testing.assert_allclose(legs.to_motors(pose), angles, atol=1e-6)


# Straight legs turn by 0.3 rad about the base's x axis: on the left, the foot is at
# y = 0.08 cos 0.3 + 0.45 sin 0.3 = 0.2094111, z = 0.08 sin 0.3 - 0.45 cos 0.3 = -0.4062598; the right leg is mirrored.
def test_abduction_moves_feet_outward_on_both_sides():
    legs = serial_legs()
    angles = legs.to_motors(pose_of(legs, 0.3, 0.0, 1.0))
    np.testing.assert_allclose(angles[:, 0], [0.3, -0.3])
    feet = [(0.0, 0.2094111, -0.4062598), (0.0, -0.2094111, -0.4062598)]
    np.testing.assert_allclose(legs.foot_position(angles), feet, atol=1e-7)


def test_a_hip_that_is_not_at_the_height_of_the_abduction_axis():
    legs = serial_legs()
    legs.hip[:, 1] = -0.05
    # The quarter turn brings the left foot, 0.08 to the left and 0.05 + 0.45 below, to 0.5 to the left and 0.08 above.
    feet = legs.foot_position([[np.pi / 2, 0.0, 0.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose(feet, [(0.0, 0.5, 0.08), (0.0, -0.08, -0.5)], atol=1e-15)


def test_links_with_an_angle_at_zero():
    # Upper link forward by 0.4, lower link back by 0.9: with motors at zero they stay so.
    legs = serial_legs(knee=1.0, angles=(-0.4, 0.9))
    x, z = 0.2 * np.sin(0.4) - 0.25 * np.sin(0.9), -0.2 * np.cos(0.4) - 0.25 * np.cos(0.9)
    np.testing.assert_allclose(legs.foot_in_plane(np.zeros((2, 3))), [(x, z)] * 2, atol=1e-15)
    # Straight down: the hip turns by 0.4, and the knee by -1.3, the angle between both links.
    np.testing.assert_allclose(legs.to_motors(pose_of(legs, 0.0, 0.0, 1.0)), [[0.0, 0.4, -1.3]] * 2, atol=1e-9)


def test_reversed_motors_have_opposite_angles():
    poses = grid(serial_legs())
    np.testing.assert_array_equal(serial_legs(turn=-1.0).to_motors(poses), -serial_legs().to_motors(poses))


def test_a_pose_out_of_reach_has_no_motor_angles():
    legs = serial_legs()
    # Folded, the leg is 0.25 - 0.2 = 0.05 m long, a ninth of 0.45 m.
    for extension, reached in ((1.001, False), (0.11, False), (1.0, True), (0.112, True)):
        angles = legs.to_motors(pose_of(legs, 0.0, 0.0, extension))
        assert np.isfinite(angles[:, 1:]).all() == legs.is_feasible(angles).all() == reached
    # Results of the legs are independent.
    swing, extension = legs.plane_pose([(0.0, -0.5), (0.0, -0.225)])
    np.testing.assert_allclose([swing, extension], [(np.nan, 0.0), (np.nan, 0.5)])


# A straight left leg, 0.08 m to the side and 0.45 m long: abduction moves the foot by (0, 0.45, 0.08) m/rad, the hip by
# 0.45 and the knee by 0.25 m/rad backward.
def test_jacobian_of_a_serial_leg_by_hand():
    expected = [(0.0, 0.45, 0.08), (-0.45, 0.0, 0.0), (-0.25, 0.0, 0.0)]
    np.testing.assert_allclose(serial_legs().foot_kinematics(np.zeros((2, 3))).jacobian[0].T, expected, atol=1e-15)


def test_every_joint_of_a_serial_leg_has_a_motor():
    assert serial_legs().knee_angles(np.zeros((7, 2, 3))).shape == (7, 2, 0)
