"""Contact force on one foot."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from surefoot.world.contact import TANGENTIAL_DAMPING, foot_force_kernel, spinning_torque_kernel

STIFFNESS, DAMPING, STEP = 3000.0, 100.0, 0.001
SPEED = st.floats(-5, 5)


def on_ground(depth: float, velocity=(0.0, 0.0, 0.0), stretch=(0.0, 0.0, 0.0), friction=1.0, normal=(0.0, 0.0, 1.0)):
    """Return the ground's force on a foot (3,) and the new shear of the sole (3,)."""
    force, after = np.zeros(3), np.array(stretch, float)
    law = (friction, STIFFNESS, STIFFNESS, DAMPING, STEP)
    load = foot_force_kernel(depth, normal, np.array(velocity, float), after, *law, force)
    assert load == pytest.approx(force @ normal)
    return force, after


@pytest.mark.parametrize(
    ("depth", "sinking", "normal"),
    [
        (0.006, 0.0, 18.0),  # 3000 x 0.006
        (0.006, 0.1, 28.0),  # + 100 x 0.1
        (0.006, -0.1, 8.0),
        (0.006, -0.2, 0.0),  # 18 - 20 would pull
        (0.0, 1.0, 0.0),  # the damper acts only in contact
        (-0.001, 1.0, 0.0),
    ],
)
def test_normal_force(depth: float, sinking: float, normal: float):
    force, _ = on_ground(depth, (0, 0, -sinking))
    np.testing.assert_allclose(force, (0, 0, normal), atol=1e-12)


def test_the_sole_shears_with_the_foot():
    # In 1 ms at 0.02 m/s the sole shears by 0.02 mm: 3000 x 0.00002 + 50 x 0.02 = 1.06 N against it.
    force, stretch = on_ground(0.01, (0.02, 0, 0))
    np.testing.assert_allclose(stretch, (2e-5, 0, 0))
    np.testing.assert_allclose(force, (-(0.06 + TANGENTIAL_DAMPING * 2.0), 0, 30.0))


def test_forces_on_a_slope_are_along_its_normal_and_its_surface():
    normal, down = np.array([0.6, 0.0, 0.8]), np.array([0.8, 0.0, -0.6])
    still, _ = on_ground(0.01, normal=normal)
    np.testing.assert_allclose(still, 30.0 * normal)
    sliding, stretch = on_ground(0.01, 0.1 * down, normal=normal)
    assert sliding @ normal == pytest.approx(30.0)
    assert sliding @ down < -1.0
    np.testing.assert_allclose(stretch, [0.1 * 0.8 * STEP, 0.0, 0.0], atol=1e-15)


@pytest.mark.parametrize("normal", [(-1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0)])
def test_wall_friction_opposes_a_sliding_foot(normal: tuple[float, float, float]):
    # Upward at 0.02 m/s as in the test above: 1.06 N downward, and 30 N away from the wall.
    force, stretch = on_ground(0.01, (0.0, 0.0, 0.02), normal=normal)
    np.testing.assert_allclose(force, 30.0 * np.array(normal) - [0, 0, 1.06], atol=1e-12)
    np.testing.assert_allclose(stretch, [0, 0, 2e-5], atol=1e-15)
    # 3000 x 0.05 in the direction (0.6, 0.8) of the wall, bounded by mu 30 = 15 N.
    side = np.cross(normal, (0.0, 0.0, 1.0))
    force, _ = on_ground(0.01, stretch=0.03 * side + [0, 0, 0.04], friction=0.5, normal=normal)
    np.testing.assert_allclose(force, 30.0 * np.array(normal) - 9.0 * side - [0, 0, 12.0], atol=1e-12)


def test_friction_has_a_bound():
    # 30 N on the foot, mu 0.5: 15 N at most, in any direction.
    force, _ = on_ground(0.01, (0, 0, 0), stretch=(0.03, 0.04, 0.0), friction=0.5)
    np.testing.assert_allclose(force, (-9.0, -12.0, 30.0))


def test_a_foot_in_the_air_resets_its_shear():
    _, stretch = on_ground(-0.001, stretch=(0.01, 0.01, 0.01))
    assert stretch.tolist() == [0, 0, 0]


@given(
    depth=st.floats(-0.05, 0.05),
    velocity=st.tuples(SPEED, SPEED, SPEED),
    stretch=st.tuples(st.floats(-0.05, 0.05), st.floats(-0.05, 0.05), st.floats(-0.05, 0.05)),
    friction=st.floats(0.05, 3),
)
def test_ground_never_pulls_and_friction_stays_in_its_cone(depth, velocity, stretch, friction):
    force, after = on_ground(depth, velocity, stretch, friction)
    assert force[2] >= 0
    assert np.hypot(force[0], force[1]) <= friction * force[2] * (1 + 1e-9)
    assert STIFFNESS * np.linalg.norm(after) <= friction * force[2] * (1 + 1e-9)


@given(velocity=st.tuples(SPEED, SPEED), friction=st.floats(0.05, 3))
def test_friction_of_a_fresh_foot_opposes_its_motion(velocity, friction):
    force, _ = on_ground(0.01, (*velocity, 0.0), friction=friction)
    assert force[0] * velocity[0] <= 0
    assert force[1] * velocity[1] <= 0


def drag(pull: float, seconds: float, speed: float = 0.0):
    """Return position and speed at every step of 2 kg, pressed on the ground with 20 N and pulled by a growing force.

    The pull grows for half a second, so that the spring does not overshoot.
    """
    position, stretch, path = 0.0, np.zeros(3), []
    for k in range(round(seconds / STEP)):
        force, stretch = on_ground(20.0 / STIFFNESS, (speed, 0, 0), stretch, friction=0.5)
        speed += STEP * (pull * min(1.0, 2 * k * STEP) + force[0]) / 2.0
        position += STEP * speed
        path.append((position, speed))
    return np.array(path)


@pytest.mark.parametrize("pull", [1.0, 5.0, 9.5, -9.5])
def test_below_the_bound_the_foot_sticks(pull: float):
    # mu N = 10 N. The sole shears by pull / K, without creep.
    path = drag(pull, 5.0)
    np.testing.assert_allclose(path[-2000:, 0], pull / STIFFNESS, rtol=1e-6)
    np.testing.assert_allclose(path[-2000:, 1], 0, atol=1e-9)


@pytest.mark.parametrize("pull", [10.5, 12.0, 20.0, -20.0])
def test_a_contact_slides_above_the_friction_bound(pull: float):
    # Acceleration (pull - mu N) / m over the second second.
    speed = drag(pull, 2.0)[:, 1]
    assert speed[-1] - speed[-1001] == pytest.approx((pull - np.sign(pull) * 10.0) / 2.0, rel=1e-6)


def test_a_sliding_foot_comes_to_rest():
    # From 1 m/s at 10 N / 2 kg = 5 m/s2: v^2 / 2a = 0.1 m, and it stays there.
    position, speed = drag(0.0, 2.0, speed=1.0).T
    assert position.max() == pytest.approx(0.1, rel=0.05)
    assert abs(speed[-1]) < 1e-9
    assert position[-1] == pytest.approx(0.1, rel=0.06)


@pytest.mark.parametrize(
    ("normal", "spin", "torque"),
    [(20.0, 3.0, -0.08), (20.0, -3.0, 0.08), (20.0, 0.05, -0.04), (0.0, 3.0, 0.0)],  # below 0.1 rad/s it decreases
)
def test_spinning_friction_is_a_length_times_the_normal_force(normal: float, spin: float, torque: float):
    assert spinning_torque_kernel(normal, spin, 0.004) == pytest.approx(torque)
