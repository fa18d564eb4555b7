"""Self-collisions of legs and joint limits in both engines; the Minitaur has neither."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from surefoot.robot import RobotDescription
from surefoot.robot.self_collision import collision_pairs
from surefoot.world.interface import WorldConfig
from surefoot.world.mujoco_model import build_model
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")


def pressed(engine: str, self_collision: bool) -> SimWorld:
    """Return Go2 on a rack, with its front left leg moved back and its back left leg forward until they would cross."""
    contact = replace(GO2.contact, self_collision=self_collision)
    world = SimWorld(replace(GO2, contact=contact), 1, config=WorldConfig(rack=True, threads=1), engine=engine)
    swing = np.array([{"front_left": 0.62, "back_left": -0.62}.get(name, 0.0) for name in GO2.leg_names])
    for share in np.linspace(0.0, 1.0, 60):
        world.step(GO2.pose_angles(np.zeros(4), share * swing, 0.9))
    for _ in range(40):
        world.step(GO2.pose_angles(np.zeros(4), swing, 0.9))
    return world


def test_crossing_legs_stop_each_other(engine: str) -> None:
    index = [GO2.leg_names.index(name) for name in ("front_left", "back_left")]
    apart = {}
    for on in (False, True):
        world = pressed(engine, on)
        front, back = world.foot_positions()[0, index]
        apart[on] = front[0] - back[0]
        assert abs(front[1] - back[1]) < 0.05
    # Without collisions the front foot goes behind the back one; with them it stays in front of it.
    assert apart[False] < -0.05
    assert apart[True] > -0.02


def test_joints_stop_at_their_limits(engine: str) -> None:
    world = SimWorld(GO2, 1, config=WorldConfig(rack=True, threads=1), engine=engine)
    knees = [GO2.motor_names.index(leg.motors[-1]) for leg in GO2.legs]
    target = np.array(world.resting_angles)
    low, high = GO2.urdf.joints[GO2.motor_names[knees[0]]].limits or (0.0, 0.0)
    for angle in (high + 0.5, low - 0.5):
        target[knees] = angle
        for _ in range(80):
            world.step(target[None])
        angles = world.truth().motor_angle[0, knees]
        # Limits are slightly compliant: some 0.01 rad for a servo error of 0.5 rad.
        np.testing.assert_allclose(angles, np.clip(angle, low, high), atol=0.06)


def test_collision_pairs_are_different_legs_that_can_touch() -> None:
    pairs = collision_pairs(RobotDescription.load("solo8"))
    # Solo's legs move in planes on both sides: left and right legs never touch, nor do feet touch the base.
    assert pairs
    for one, other in pairs:
        assert one.rpartition("_")[0] != other.rpartition("_")[0]
        assert one.split("_")[1] == other.split("_")[1]


def test_feet_collide_with_the_base_and_links_that_touch_at_rest_do_not() -> None:
    pairs = collision_pairs(GO2)
    assert ("base", "front_left_foot") in pairs
    # Coarse shapes of legs overlap while the robot sits.
    crossed = replace(GO2, poses=replace(GO2.poses, sit=(-0.34, 0.0, 0.9)))
    feet = {("front_left_foot", "front_right_foot"), ("back_left_foot", "back_right_foot")}
    assert feet <= set(pairs)
    assert not feet & set(collision_pairs(crossed))


def test_the_minitaur_collides_with_the_ground_only() -> None:
    robot = RobotDescription.load("minitaur")
    assert collision_pairs(robot) == []
    assert build_model(robot).npair == 0
    assert build_model(GO2).npair == len(collision_pairs(GO2))
