"""Contact reflex: feet that hit an obstacle in swing are lifted higher for some strides."""

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
from surefoot.task.contact_reflex import ContactReflex
from surefoot.task.env import LocomotionEnv
from surefoot.task.reference import FollowingReference
from surefoot.world.sim_world import SimWorld

GO2 = RobotDescription.load("go2")
LENGTH, NATURAL = 0.426, (0.426 / 9.81) ** 0.5
FRONT_LEFT, FRONT_RIGHT = (GO2.leg_names.index(name) for name in ("front_left", "front_right"))
STEP = np.array([0.016])


def lifting_task(most: float = 0.3, clearance: float = 0.25) -> TaskConfig:
    """Return the task `terrain` of a Go2 with a maximum additional lift, in lengths of the leg."""
    reference = {"touch_clearance": most, "foot": {"clearance": clearance}}
    return from_mapping(TaskConfig, {"reference": reference}, base=load_task("terrain", "go2")[0])


@pytest.fixture
def reference() -> FollowingReference:
    made = lifting_task().gait(GO2).reference
    assert isinstance(made, FollowingReference)
    return made


def walking(phase: float, forward: float = 0.5) -> CommandState:
    """Return a state of walking forward; the left front foot swings from phase 0.6 to 1, the right from 0.1 to 0.5."""
    return CommandState(np.array([[forward, 0.0, 0.0]]), np.ones(1), np.array([phase]))


def angles(reference: FollowingReference, ahead: float = 0.0) -> np.ndarray:
    """Return motor angles (1, M) of feet at a distance [m] ahead of their neutral positions."""
    return GO2.to_motors(GO2.leg_geometry.foot_pose(reference.neutral_feet + np.array([ahead, 0.0, 0.0]))[None])


def hold_behind(reference: FollowingReference, behind: float, steps: int, **changes: float) -> ContactReflex:
    """Return the reflex after control steps in which swinging feet lag behind their commands by a distance [m]."""
    touch = ContactReflex(reference, 1)
    for _ in range(steps + 1):
        touch.update(angles(reference, behind), angles(reference), walking(0.8, **changes), STEP)
    return touch


def test_there_is_no_contact_reflex_over_holes(reference):
    # Feet swing to distant footholds and lag without contact.
    touch = ContactReflex(reference, 1)
    for _ in range(11):
        state = replace(walking(0.8), over_holes=np.array([0.1]))
        touch.update(angles(reference, 0.2), angles(reference), state, STEP)
    assert not touch.lift.any()


def test_a_blocked_foot_is_lifted_higher(reference):
    # A low-pass filter of 0.2 sqrt(l / g), in steps of 16 ms: the difference shrinks by a factor of 0.384 in each.
    share = 0.016 / (0.2 * NATURAL)
    seen = [hold_behind(reference, 0.08, steps) for steps in range(1, 5)]
    assert [float(touch.behind[0, FRONT_LEFT]) for touch in seen] == pytest.approx(
        [0.08 * (1 - (1 - share) ** steps) for steps in range(1, 5)]
    )
    # The threshold 0.12 l = 0.051 m is passed in the third step. The lift grows by 1.7 l in sqrt(l / g), up to 0.3 l.
    rise = 1.7 * LENGTH * 0.016 / NATURAL
    assert [float(touch.lift[0, FRONT_LEFT]) for touch in seen] == pytest.approx([0.0, 0.0, rise, 2 * rise])
    assert hold_behind(reference, 0.08, 40).lift[0, FRONT_LEFT] == pytest.approx(0.3 * LENGTH)
    assert not seen[-1].lift[0, FRONT_RIGHT].any()  # it stands
    assert not hold_behind(reference, 0.04, 40).lift.any()  # soft legs lag


def test_only_lag_along_the_stride_counts(reference):
    assert hold_behind(reference, -0.08, 40, forward=-0.3).lift[0, FRONT_LEFT] > 0.0
    assert not hold_behind(reference, 0.08, 40, forward=-0.3).lift.any()
    assert not hold_behind(reference, 0.08, 40, forward=0.0).lift.any()  # no contact is detected when stepping in place


def test_lag_is_relative_to_the_second_to_last_command(reference):
    touch = ContactReflex(reference, 1)
    for k in range(20):
        touch.update(angles(reference, 0.01 * k), angles(reference, 0.01 * (k - 1)), walking(0.8), STEP)
    assert touch.behind[0, FRONT_LEFT] == pytest.approx(0.0, abs=1e-5)


def test_the_lift_decays_in_stance(reference):
    touch = hold_behind(reference, 0.08, 40)
    for _ in range(10):
        touch.update(angles(reference), angles(reference), walking(0.3), STEP)
    assert touch.lift[0, FRONT_LEFT] == pytest.approx(0.3 * LENGTH * np.exp(-0.16 / (15 * NATURAL)))
    touch.reset(np.arange(1), SimpleNamespace(gait_state=walking(0.0)))
    assert not touch.lift.any()
    assert not touch.behind.any()


def test_lift_rises_early_in_swing_and_ends_with_it(reference):
    legs, heights = GO2.leg_geometry, []
    for phase in (0.3, 0.6 + 0.4 * 0.1, 0.8, 1.0 - 1e-9):
        pair = []
        for lift in (np.zeros((1, 4)), np.full((1, 4), 0.1)):
            foot = legs.foot_position(legs.to_motors(reference.pose(0.0, replace(walking(phase), lift=lift))))
            pair.append(foot[0, FRONT_LEFT, 2])
        heights.append(pair[1] - pair[0])
    assert heights == pytest.approx([0.0, 0.05, 0.1, 0.0], abs=1e-6)


def test_lifted_feet_move_below_their_hips(reference):
    lift = np.full((1, 4), 0.3 * LENGTH)
    offsets = []
    for phase in (0.65, 0.95):
        state = replace(walking(phase), command=np.array([[0.0, 0.3, 0.0]]))
        pair = [reference.pose(0.0, one) for one in (state, replace(state, lift=lift), replace(state, lift=lift / 3))]
        feet = [GO2.leg_geometry.foot_position(GO2.leg_geometry.to_motors(pose))[0, FRONT_LEFT, 1] for pose in pair]
        offsets.append(np.array(feet) - reference.neutral_feet[FRONT_LEFT, 1])
    for (free, high, low), share in zip(offsets, (0.125 / 0.2, 0.125 / 0.25), strict=True):
        assert abs(free) > 0.01
        assert high == pytest.approx((1 - share) * free, abs=1e-5)
        assert low == pytest.approx((1 - share / 3) * free, abs=1e-5)


def test_all_strides_with_high_lift_are_in_reach():
    made = lifting_task(0.44).gait(GO2).reference
    count = 500
    random = np.random.default_rng(0)
    state = CommandState(
        random.uniform(made.limits.low, made.limits.high, (count, 3)), np.ones(count), random.uniform(size=count)
    )
    assert np.isfinite(made.pose(0.0, replace(state, lift=random.uniform(0, 0.44 * LENGTH, (count, 4))))).all()


def test_a_lift_up_to_the_motors_is_rejected():
    with pytest.raises(
        SurefootError, match=r"lifts feet by 0\.192 m, up to their motors: .* less than height, 0\.298 m"
    ):
        lifting_task(0.45).gait(GO2)


def on(ground: str, steps: int) -> LocomotionEnv:
    """Return robots after some control steps without feedback."""
    task = lifting_task(clearance=0.12)
    task = replace(task, randomize={}, terrain=replace(task.terrain, sizes={}, shares={}, ground=ground))
    env = LocomotionEnv(task, 4, SimWorld, seed=3, threads=1)
    action = env.gait.action(np.zeros((4, len(env.gait.action_names))))
    for _ in range(steps):
        env.step(action)
    return env


def test_robots_hit_steps_and_resume_exactly():
    env = on("stairs:0.1", 250)
    action = np.zeros((4, len(env.gait.action_names)))
    assert_resumes_exactly(env, [action] * 20)
    assert env.component(ContactReflex).lift.any()


def test_robots_detect_no_contact_on_level_ground():
    env = on("flat", 250)
    assert not env.component(ContactReflex).lift.any()


def test_a_gait_without_touch_clearance_has_no_reflex():
    env = LocomotionEnv(lifting_task(0.0), 1, SimWorld, threads=1)
    assert not any(isinstance(component, ContactReflex) for component in env.components)
    assert env.state.gait_state.lift is None
