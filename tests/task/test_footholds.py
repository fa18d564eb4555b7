"""Foothold choice next to gaps and edges of the map, and learned landing errors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from exact_resume import assert_resumes_exactly

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.task.commands import CommandState
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.footholds import Footholds
from surefoot.task.height_scan import POLICY_GRID
from surefoot.task.reference import FollowingReference
from surefoot.task.stepping_kinematics import SteppingKinematics
from surefoot.world.interface import SensorReadings
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")
SPACING = 0.426 / 8
FRONT_LEFT, FRONT_RIGHT = (GO2.leg_names.index(name) for name in ("front_left", "front_right"))


def seeing_task() -> TaskConfig:
    """Return the task `terrain` with a height map and footholds within half a leg length."""
    task = load_task("terrain", "go2")[0]
    reference = replace(task.reference, foothold_radius=0.5)
    return replace(task, reference=reference, observations=(*task.observations, "height_scan"))


@pytest.fixture
def reference() -> FollowingReference:
    made = seeing_task().gait(GO2).reference
    assert isinstance(made, FollowingReference)
    return made


STEP = np.array([0.016])


def on_the_spot(phase: float) -> CommandState:
    """Return the state of a robot that steps in place; the left front foot swings from phase 0.6 to 1."""
    return CommandState(np.zeros((1, 3)), np.ones(1), np.array([phase]))


def standing(reference: FollowingReference, ahead: float = 0.0) -> SensorReadings:
    """Return the readings of a level robot with feet at a distance [m] ahead of their neutral positions."""
    legs = GO2.leg_geometry
    motors = GO2.to_motors(legs.foot_pose(reference.neutral_feet + np.array([ahead, 0.0, 0.0]))[None])
    zero = np.zeros((1, 3))
    return SensorReadings(np.zeros(1), zero, zero, motors, np.zeros_like(motors))


def level_map() -> np.ndarray:
    return np.full((len(POLICY_GRID.ahead), len(POLICY_GRID.left)), -0.3)


def row_under(reference: FollowingReference, leg: int) -> int:
    """Return the row of the map under a foot at its neutral position."""
    x = (GO2.leg_mounts + reference.neutral_feet)[leg, 0]
    return int(np.argmin(np.abs(np.array(POLICY_GRID.scale(GO2)[0]) - x)))


def to_point(reference: FollowingReference, leg: int, rows: int = 0) -> list[float]:
    """Return the offset [m] from a neutral foot position to the nearest point of the map, or to rows ahead of it."""
    x, y = (GO2.leg_mounts + reference.neutral_feet)[leg, :2]
    ahead, left = (np.array(places) for places in POLICY_GRID.scale(GO2))
    return [float(ahead[row_under(reference, leg) + rows] - x), float(left[np.argmin(np.abs(left - y))] - y)]


def test_footholds_are_nominal_on_level_ground(reference):
    feet = Footholds(reference, 1)
    feet.choose(level_map().reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert not feet.landing.any()
    state = on_the_spot(0.65)
    with_places = replace(state, lift_off=feet.lift_off, landing=feet.landing)
    np.testing.assert_array_equal(reference.pose(0.0, with_places), reference.pose(0.0, state))


def test_a_foot_lands_on_the_nearest_point_next_to_a_gap(reference):
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    # Four points are low, and one more on either side is too close: three points back is a foothold, four ahead is not.
    heights[row - 1 : row + 3] = -1.3
    feet, back = Footholds(reference, 1), to_point(reference, FRONT_LEFT, rows=-3)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(back)
    assert not feet.landing[0, FRONT_RIGHT].any()  # in stance
    # Late in swing and in stance, the foothold does not change.
    for phase in (0.95, 0.0, 0.3):
        feet.choose(level_map().reshape(1, -1), on_the_spot(phase), standing(reference), STEP)
        assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(back)
    # The foot lifts off there, and returns to its nominal stride.
    feet.choose(level_map().reshape(1, -1), on_the_spot(0.7), standing(reference), STEP)
    assert feet.lift_off[0, FRONT_LEFT].tolist() == pytest.approx(back)
    assert not feet.landing[0, FRONT_LEFT].any()


def test_a_foothold_is_nominal_only_if_no_point_around_it_is_next_to_a_hole(reference):
    # The stride ends 2 cm behind a point (less than half of the spacing, so that it is the nearest), whose next one
    # is a hole: the point behind is next to a point that is next to the hole.
    ahead, _ = to_point(reference, FRONT_LEFT)
    assert 0.0 < ahead < SPACING / 2
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row + 1 : row + 4] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(to_point(reference, FRONT_LEFT, rows=-1))


def test_a_foot_lands_in_the_middle_of_a_stone(reference):
    # Five points of ground between two gaps: points next to holes are excluded, the next ones cost as much as
    # a distance of 1.4 points. The stride ends 2 cm behind the fourth of the five, 3 cm ahead of the third.
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row - 6 : row - 3] = heights[row + 2 : row + 5] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(to_point(reference, FRONT_LEFT, rows=-1))


def test_a_foot_without_a_foothold_lands_next_to_a_hole(reference):
    # Holes of three points with two points between them: all points are holes or next to one.
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    for first in range(row % 5, len(heights), 5):
        heights[first : first + 3] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(to_point(reference, FRONT_LEFT, rows=-1))


def test_a_single_hole_of_the_map_is_no_gap(reference):
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row + 1, 8] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert not feet.landing.any()


def test_a_gap_that_is_one_point_wide_is_a_hole_and_two_wrong_points_are_none(reference):
    row = row_under(reference, FRONT_LEFT)
    # The stride ends next to the gap: the nearest points that are not lie two rows behind it.
    heights = level_map()
    heights[row + 1] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(to_point(reference, FRONT_LEFT, rows=-1))
    wrong = level_map()
    wrong[row : row + 2, 8] = -1.3
    feet = Footholds(reference, 1)
    feet.choose(wrong.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert not feet.landing.any()


def test_a_gap_whose_other_side_is_beyond_the_map_is_a_hole(reference):
    # More than 0.6 of a leg below the ground three points away is a hole; a step down of half of it is not.
    row, feet = row_under(reference, FRONT_LEFT), Footholds(reference, 1)
    for depth, back in ((0.3, to_point(reference, FRONT_LEFT, rows=-2)), (0.15, [0.0, 0.0])):
        heights = level_map()
        heights[row:] -= depth
        feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
        assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(back)
        feet.reset(np.arange(1), SimpleNamespace(gait_state=on_the_spot(0.0)))


def test_feet_may_land_on_edges_of_steps(reference):
    # A step of 0.15 m every six points, up and down.
    heights = level_map() + 0.149 * (np.arange(len(POLICY_GRID.ahead)) // 6)[:, None]
    for stairs in (heights, heights[::-1]):
        feet = Footholds(reference, 1)
        feet.choose(stairs.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
        assert not feet.landing.any()


def test_a_wide_hollow_is_no_hole(reference):
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row - 4 : row + 5] -= 0.2
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert not feet.landing.any()


def test_a_slanted_step_at_the_border_is_no_hole(reference):
    # Down to the right at several angles; the ground beyond the border is unknown.
    x, y = np.meshgrid(*(np.array(places) for places in POLICY_GRID.scale(GO2)), indexing="ij")
    for angle in np.radians([0.0, 20.0, 45.0, 70.0, 90.0]):
        for edge in (-0.2, 0.0, 0.2):
            heights = np.where(x * np.sin(angle) + y * np.cos(angle) > edge, -0.3, -0.5)
            feet = Footholds(reference, 1)
            feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
            assert not feet.landing.any()
            assert feet.over_holes[0] == 0.0


def test_stairs_that_meet_in_a_corner_are_no_hole(reference):
    # Steps of 0.2 m rise ahead to the left and ahead to the right: between them is a valley, at the level of the robot.
    x, y = np.meshgrid(*(np.array(places) for places in POLICY_GRID.scale(GO2)), indexing="ij")
    heights = -0.3 + 0.2 * np.maximum(np.floor((np.maximum(x + y, x - y) - 0.3) / 0.3) + 1.0, 0.0)
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.over_holes[0] == 0.0


def test_unknown_points_in_a_corner_of_the_map_are_no_hole(reference):
    heights = level_map()
    heights[0, 0] = heights[-1, -1] = heights[0, -1] = 1.0
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.over_holes[0] == 0.0


def test_the_gait_over_holes_blends_in_fast_and_out_slowly(reference):
    # In 1 and 3 sqrt(l / g).
    feet, gap = Footholds(reference, 1), level_map()
    gap[13:17] = -1.3
    natural = (0.426 / 9.81) ** 0.5
    feet.choose(gap.reshape(1, -1), on_the_spot(0.1), standing(reference), STEP)
    assert feet.over_holes[0] == pytest.approx(0.016 / natural)
    for _ in range(20):
        feet.choose(gap.reshape(1, -1), on_the_spot(0.1), standing(reference), STEP)
    assert feet.over_holes[0] == 1.0
    feet.choose(level_map().reshape(1, -1), on_the_spot(0.1), standing(reference), STEP)
    assert feet.over_holes[0] == pytest.approx(1.0 - 0.016 / (3.0 * natural))


def test_landing_errors_over_holes_are_learned_only_there():
    task = load_task("terrain-seeing", "go2")[0]
    reference = task.gait(GO2).reference
    assert isinstance(reference, FollowingReference)
    assert reference.over_holes is not None
    gap = level_map()
    gap[-3:-1] = -1.3
    for over_holes, missed in ((0.5, 0.0), (1.0, 2 * SPACING)):
        feet, level = Footholds(reference, 1), gap.reshape(1, -1)
        for phase in (0.95, 0.02):
            feet.over_holes[:] = over_holes
            feet.choose(level, on_the_spot(phase), standing(reference.over_holes, ahead=2 * SPACING), STEP)
        assert feet.missed[0, FRONT_LEFT].tolist() == pytest.approx([missed, 0.0], abs=1e-6)


def test_deep_ground_of_any_width_is_no_foothold(reference):
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row - 2 :] = -0.3 - 1.55 * 0.426
    feet = Footholds(reference, 1)
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx(to_point(reference, FRONT_LEFT, rows=-4))


def test_feet_move_from_lift_off_to_landing(reference):
    lift_off, landing = np.zeros((2, 1, 4, 2))
    lift_off[..., 0], landing[..., 0] = -0.05, 0.1
    legs, places = GO2.leg_geometry, []
    for phase in (0.0, 0.3, 0.6 + 1e-9, 0.76, 1.0 - 1e-9):
        state = replace(on_the_spot(phase), lift_off=lift_off, landing=landing)
        foot = legs.foot_position(legs.to_motors(reference.pose(0.0, state)))
        places.append(foot[0, FRONT_LEFT, 0] - reference.neutral_feet[FRONT_LEFT, 0])
    # Without a stride: in stance 0.1 m ahead, halfway at 0.4 of the swing, and at the foothold after 0.8 of it.
    assert places == pytest.approx([0.1, 0.1, -0.05, 0.025, 0.1], abs=1e-6)


def test_landing_errors_are_learned_from_the_first_landing(reference):
    feet, level = Footholds(reference, 1), level_map().reshape(1, -1)
    for phase in (0.95, 0.02):
        feet.choose(level, on_the_spot(phase), standing(reference, ahead=2 * SPACING), STEP)
    assert feet.missed[0, FRONT_LEFT].tolist() == pytest.approx([2 * SPACING, 0.0], abs=1e-6)
    assert not feet.missed[0, FRONT_RIGHT].any()  # no landing yet
    # From now on, the map is evaluated where the foot actually lands.
    heights, row = level_map(), row_under(reference, FRONT_LEFT)
    heights[row + 3 :] = -1.3
    feet.choose(heights.reshape(1, -1), on_the_spot(0.65), standing(reference), STEP)
    # One row back from the landing, two rows ahead of its neutral position.
    there = to_point(reference, FRONT_LEFT, rows=1)
    assert feet.landing[0, FRONT_LEFT].tolist() == pytest.approx([there[0] - 2 * SPACING, there[1]])
    feet.reset(np.arange(1), SimpleNamespace(gait_state=on_the_spot(0.0)))
    assert not feet.missed.any()
    assert not feet.landing.any()


def test_steps_stay_within_the_legs_reach(reference):
    everywhere = np.random.default_rng(0).uniform(-1, 1, (400, 4, 2))
    state = CommandState(np.tile([1.0, 0.4, 0.5], (400, 1)), np.ones(400), np.arange(400) / 400)
    poses = reference.pose(0.0, replace(state, lift_off=everywhere, landing=-everywhere))
    assert np.isfinite(poses).all()


def test_steps_of_lifted_feet_stay_within_the_legs_reach():
    task = load_task("terrain-seeing", "go2")[0]
    reference, rng = task.gait(GO2).reference, np.random.default_rng(0)
    assert isinstance(reference, FollowingReference)
    turn = rng.uniform(0, 2 * np.pi, (2, 4000, 4))
    beside = rng.uniform(0, reference.foothold_radius, turn.shape)[..., None] * np.stack(
        [np.cos(turn), np.sin(turn)], -1
    )
    lift = rng.uniform(0, reference.touch_clearance, (4000, 4))
    command = rng.uniform(-1, 1, (4000, 3)) * [0.6, 0.2, 0.5]
    poses = reference.pose(0.0, CommandState(command, np.ones(4000), rng.uniform(size=4000), *beside, lift))
    assert np.isfinite(poses).all()


def test_a_reference_whose_feet_are_lifted_out_of_reach_is_rejected(monkeypatch):
    task = load_task("terrain-seeing", "go2")[0]
    # No leg reaches a full leg length ahead of its neutral position without the limit of its reach.
    monkeypatch.setattr(SteppingKinematics, "reach_ratio", lambda self, step: np.zeros(step.shape[:-1]))
    with pytest.raises(SurefootError, match=r"foothold_radius and reference.touch_clearance together move feet out"):
        replace(task, reference=replace(task.reference, foothold_radius=1.0)).gait(GO2)


def test_a_policy_observes_footholds():
    task = replace(seeing_task(), observations=("roll", "footholds"))
    env = LocomotionEnv(task, 1, SimWorld, seed=0, threads=1)
    assert env.observer.columns[1:] == [f"foothold_{axis}.{leg}" for axis in "xy" for leg in GO2.leg_names]
    env.component(Footholds).landing[0, FRONT_LEFT] = [0.213, -0.0426]
    observation = env.step(np.zeros((1, len(env.gait.action_names))))[0]
    assert observation[0, 1 + FRONT_LEFT] == pytest.approx(1.0)  # half a leg: the radius
    assert observation[0, 1 + len(GO2.legs) + FRONT_LEFT] == pytest.approx(-0.2)
    with pytest.raises(SurefootError, match=r"'footholds' needs reference.foothold_radius; it is 0"):
        LocomotionEnv(replace(task, reference=replace(task.reference, foothold_radius=0.0)), 1, SimWorld, threads=1)


def test_a_robot_with_a_height_map_resumes_exactly():
    task = replace(seeing_task(), terrain=replace(seeing_task().terrain, sizes={}, shares={}, ground="gaps:0.1"))
    env = LocomotionEnv(task, 2, SimWorld, seed=3, threads=1)
    action = np.zeros((2, len(env.gait.action_names)))
    for _ in range(30):
        env.step(action)
    assert_resumes_exactly(env, [action] * 40)
    assert env.component(Footholds).landed.any()


def test_legs_without_abduction_land_ahead_or_behind():
    robot = RobotDescription.load("minitaur")
    task = load_task("steer", "minitaur")[0]
    task = replace(
        task,
        reference=replace(task.reference, foothold_radius=0.5),
        observations=(*task.observations, "height_scan"),
    )
    reference = task.gait(robot).reference
    assert isinstance(reference, FollowingReference)
    leg = robot.leg_names.index("front_left")
    under = (robot.leg_mounts + reference.neutral_feet)[leg]
    heights = np.full((len(POLICY_GRID.ahead), len(POLICY_GRID.left)), under[2])
    # The foot is over the middle of a longitudinal groove, which it could only avoid sideways.
    x, y = (np.array(places) for places in POLICY_GRID.scale(robot))
    heights[np.abs(x - under[0]) < 2.5 * (x[1] - x[0])] = np.where(np.abs(y - under[1]) < y[1] - y[0], -1.0, under[2])
    heights = heights.reshape(1, -1)
    feet, motors = Footholds(reference, 1), robot.resting_angles[None]
    zero = np.zeros((1, 3))
    feet.choose(heights, on_the_spot(0.7), SensorReadings(np.zeros(1), zero, zero, motors, np.zeros_like(motors)), STEP)
    assert feet.landing[..., 0].any()
    assert not feet.landing[..., 1].any()


def test_footholds_need_a_reference_that_follows_commands():
    task = seeing_task()
    with pytest.raises(SurefootError, match=r"reference.foothold_radius is not a key of kind foot, but of follow"):
        from_mapping(TaskConfig, {"reference": {"kind": "foot", "foothold_radius": 0.5}}, base=task)
