"""Leg space and the five-bar leg against figures worked by hand."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.errors import SurefootError
from surefoot.robot import FiveBar, leg_to_motor, motor_to_leg

MINITAUR = FiveBar(upper=0.101, lower=(0.200, 0.208), foot=0.240, foot_radius=0.0085)
ANGLE = st.floats(-10, 10)


def test_motor_angles_are_extension_plus_and_minus_swing():
    theta_1, theta_2 = leg_to_motor(0.25, 2.0)
    assert (theta_1, theta_2) == (2.25, 1.75)


@given(swing=ANGLE, extension=ANGLE)
def test_motor_to_leg_undoes_leg_to_motor(swing: float, extension: float):
    back = motor_to_leg(*leg_to_motor(swing, extension))
    np.testing.assert_allclose(back, (swing, extension), atol=1e-12)


def test_leg_space_broadcasts():
    theta_1, theta_2 = leg_to_motor(np.zeros((5, 4)), 2.0)
    assert theta_1.shape == theta_2.shape == (5, 4)


# theta = pi/2 is horizontal, motor 1 forward and motor 2 backward; at pi both point straight down and meet.
@pytest.mark.parametrize(
    ("theta", "front", "back"),
    [(np.pi / 2, (0.101, 0), (-0.101, 0)), (np.pi, (0, -0.101), (0, -0.101))],
)
def test_upper_links(theta: float, front: tuple[float, float], back: tuple[float, float]):
    np.testing.assert_allclose(MINITAUR.knees(theta, theta), (front, back), atol=1e-15)


# At e = pi/2 the knees are at x = +-.101, z = 0, a distance d = .202 apart. From knee 2 the pin lies
#   (d^2 + .208^2 - .200^2) / 2d = .044068 / .404 = .109079 along, sqrt(.208^2 - .109079^2) = .177104 down,
# and the foot .240 / .208 times as far along the same link.
# With equal links of .2: knees at +-.1, pin sqrt(.04 - .01) = .173205 below the axis, foot .3 from knee 2
# along a link at 60 degrees: x = -.1 + .3 cos 60 = .05, z = -.3 sin 60 = -.259808.
@pytest.mark.parametrize(
    ("leg", "pin", "foot"),
    [
        (MINITAUR, (-0.101 + 0.109079, -0.177104), (-0.101 + 0.125860, -0.204350)),
        (FiveBar(upper=0.1, lower=(0.2, 0.2), foot=0.3, foot_radius=0.0), (0, -0.173205), (0.05, -0.259808)),
    ],
)
def test_pin_and_foot_at_a_right_angle(leg: FiveBar, pin: tuple[float, float], foot: tuple[float, float]):
    np.testing.assert_allclose(leg.pin([np.pi / 2, np.pi / 2]), pin, atol=1e-6)
    np.testing.assert_allclose(leg.foot_in_plane([np.pi / 2, np.pi / 2]), foot, atol=1e-6)


@pytest.mark.parametrize("extension", np.linspace(0.6, 2.7, 8))
@pytest.mark.parametrize("swing", [-0.5, 0.0, 0.5])
def test_loop_keeps_every_length_and_knee_angles_lead_to_the_pin(swing: float, extension: float):
    theta = leg_to_motor(swing, extension)
    (knee_1, knee_2), pin, foot = MINITAUR.knees(*theta), MINITAUR.pin(theta), MINITAUR.foot_in_plane(theta)
    lengths = [np.linalg.norm(x) for x in (knee_1, knee_2, pin - knee_1, pin - knee_2, foot - knee_2)]
    np.testing.assert_allclose(lengths, (0.101, 0.101, 0.200, 0.208, 0.240), rtol=1e-12)
    # Absolute angle from straight up, about +y: motor 1 turns by theta_1, motor 2 by -theta_2.
    angles = np.array([theta[0], -theta[1]]) + MINITAUR.knee_angles(theta)
    ends = [knee_1, knee_2] + np.array([MINITAUR.lower] * 2).T * np.stack([np.sin(angles), np.cos(angles)], axis=1)
    np.testing.assert_allclose(ends, [pin, pin], atol=1e-12)


def test_knees_bend_to_either_side():
    # Lower link 1 runs from (.101, 0) to the pin at (.008079, -.177104):
    # pi + atan(.092921 / .177104) = 3.62478 from straight up, less the upper link's pi/2.
    # Link 2, from (-.101, 0): -(pi + atan(.109079 / .177104)) + pi/2.
    knee_1, knee_2 = MINITAUR.knee_angles([np.pi / 2, np.pi / 2])
    assert knee_1 == pytest.approx(2.05398, abs=1e-5)
    assert knee_2 == pytest.approx(-2.12283, abs=1e-5)


def test_more_extension_makes_the_leg_longer():
    extension = np.linspace(0.6, 2.7, 100)
    height = MINITAUR.foot_in_plane(np.stack([extension, extension], -1))[:, 1]
    assert np.all(np.diff(height) < 0)


@pytest.mark.parametrize("extension", [1.2, 1.6, 2.0, 2.4])
def test_positive_swing_moves_the_foot_backward(extension: float):
    forward = MINITAUR.foot_in_plane(np.stack(leg_to_motor(np.linspace(-0.5, 0.5, 50), extension), -1))[:, 0]
    assert np.all(np.diff(forward) < 0)


def test_swing_turns_the_whole_leg_about_the_motor_axis():
    # Both upper links turn about +y by the swing, so the leg turns as one rigid body.
    at_rest, swung = (MINITAUR.foot_in_plane(leg_to_motor(s, 2.0)) for s in (0.0, 0.3))
    turned = [
        np.cos(0.3) * at_rest[0] + np.sin(0.3) * at_rest[1],
        -np.sin(0.3) * at_rest[0] + np.cos(0.3) * at_rest[1],
    ]
    np.testing.assert_allclose(swung, turned, atol=1e-12)


def test_short_lower_links_do_not_close():
    leg = FiveBar(upper=0.2, lower=(0.1, 0.1), foot=0.15, foot_radius=0.0)
    assert not leg.closes([np.pi / 2, np.pi / 2])
    assert leg.closes([0.9 * np.pi, 0.9 * np.pi])


@pytest.mark.parametrize(
    ("upper", "lower", "foot", "radius", "key"),
    [
        (0.0, (0.2, 0.2), 0.2, 0.0, "upper"),
        (0.1, (0.2, -0.2), 0.2, 0.0, "lower"),
        (0.1, (0.2, 0.2), 0.0, 0.0, "foot"),
        (0.1, (0.2, 0.2), 0.2, 0.3, "foot_radius"),
        (0.1, (0.2, 0.2), 0.2, -0.1, "foot_radius"),
        (float("nan"), (0.2, 0.2), 0.2, 0.0, "upper"),
    ],
)
def test_lengths_that_are_none_are_refused(upper, lower, foot, radius, key):
    with pytest.raises(SurefootError, match=rf"leg_geometry\.{key} is "):
        FiveBar(upper, lower, foot, radius)


@given(swing=st.floats(-1.0, 1.0), extension=st.floats(0.6, 2.7))
def test_plane_pose_undoes_foot_in_plane(swing: float, extension: float):
    foot = MINITAUR.foot_in_plane(leg_to_motor(swing, extension))
    np.testing.assert_allclose(MINITAUR.plane_pose(foot), (swing, extension), atol=1e-9)


# Straight down it reaches .101 + .240 m; motor 2 alone would reach closer than .240 - .101 m only through its link.
@pytest.mark.parametrize("foot", [(0.0, -0.342), (0.0, -0.138), (0.4, -0.1), (np.nan, 0.0), (10.0, -10.0)])
def test_plane_pose_out_of_reach_is_not_a_number(foot: tuple[float, float]):
    assert np.isnan(MINITAUR.plane_pose(foot)).all()


def test_poses_of_legs_go_to_pairs_of_motors_and_back(rng: np.random.Generator):
    pose = np.stack([rng.uniform(-0.5, 0.5, (7, 4)), rng.uniform(1.0, 2.0, (7, 4))], -2)
    angles = MINITAUR.to_motors(pose)
    assert (pose.shape, angles.shape) == ((7, 2, 4), (7, 4, 2))
    np.testing.assert_array_equal(angles[..., 0], pose[:, 1] + pose[:, 0])
    np.testing.assert_array_equal(angles[..., 1], pose[:, 1] - pose[:, 0])
    np.testing.assert_allclose(MINITAUR.to_pose(angles), pose, atol=1e-15)


def test_a_five_bar_leg_has_two_coordinates_and_is_as_long_as_its_links():
    assert MINITAUR.coordinates == ("swing", "extension")
    assert MINITAUR.units == ("rad", "rad")
    assert MINITAUR.length == pytest.approx(0.341)


def test_the_foot_stays_in_the_plane_of_its_leg(rng: np.random.Generator):
    angles = MINITAUR.to_motors(np.stack([rng.uniform(-0.5, 0.5, (7, 4)), rng.uniform(1.0, 2.0, (7, 4))], -2))
    foot, plane = MINITAUR.foot_position(angles), MINITAUR.foot_in_plane(angles)
    assert foot.shape == (7, 4, 3)
    np.testing.assert_array_equal(foot[..., [0, 2]], plane)
    np.testing.assert_array_equal(foot[..., 1], 0.0)


def test_jacobian_is_how_the_foot_moves_with_each_motor():
    swing, extension = np.meshgrid(np.linspace(-1.0, 1.0, 5), np.linspace(0.6, 2.7, 8))
    angles = MINITAUR.to_motors(np.stack([swing, extension], -2))
    jacobian, step = MINITAUR.jacobian(angles), 1e-6
    assert jacobian.shape == (8, 5, 3, 2)
    for motor, turn in enumerate(step * np.eye(2)):
        moved = (MINITAUR.foot_position(angles + turn) - MINITAUR.foot_position(angles - turn)) / (2 * step)
        np.testing.assert_allclose(jacobian[..., motor], moved, atol=1e-8)


# Equal links .1 and .2 at theta = pi/2: knees (+-.1, 0), pin p (0, -.173205), foot .3 along link 2. A turn of motor 1
# moves knee 1 by (0, -.1) a radian. With u_i = p - k_i, i.e. (-.1, -.173205) and (.1, -.173205):
#   u_1 . dp = u_1 . (0, -.1) = .0173205,   u_2 . dp = 0   so   dp = (-.0866025, -.05);
# the foot moves 1.5 times as far, for knee 2 rests: (-.1299038, -.075). A turn of motor 2 moves knee 2 by (0, -.1):
# dp = (.0866025, -.05), and the foot by 1.5 dp - .5 (0, -.1) = (.1299038, -.025).
def test_jacobian_by_hand():
    leg = FiveBar(upper=0.1, lower=(0.2, 0.2), foot=0.3, foot_radius=0.0)
    jacobian = leg.jacobian([np.pi / 2, np.pi / 2])
    np.testing.assert_allclose(jacobian.T, [(-0.1299038, 0.0, -0.075), (0.1299038, 0.0, -0.025)], atol=1e-7)


def test_where_no_loop_closes_there_is_no_foot_and_no_jacobian():
    leg = FiveBar(upper=0.2, lower=(0.1, 0.1), foot=0.15, foot_radius=0.0)
    assert np.isnan(leg.foot_in_plane([np.pi / 2, np.pi / 2])).all()
    assert np.isnan(leg.jacobian([np.pi / 2, np.pi / 2])[[0, 2]]).all()
