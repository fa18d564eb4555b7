"""Robots of different masses in one batch, changing masses, and inactive robots."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np
import pytest

from surefoot.world.interface import SensorReadings, SimState
from surefoot.world.mujoco_engine import MASS_FIELDS
from surefoot.world.mujoco_model import build_model
from surefoot.world.sim_world import SimWorld

MASS_RATIOS = ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio")
NUM = 20
"""Enough robots that two threads share them and change the masses of their models repeatedly."""


def masses(num_envs: int = NUM) -> dict[str, np.ndarray]:
    """Return different masses and inertias for each robot; every fourth is nominal."""
    draw = np.random.default_rng(12)
    values = {name: draw.uniform(0.5, 1.5, num_envs) for name in MASS_RATIOS}
    for value in values.values():
        value[::4] = 1.0
    return values


Motion = list[SensorReadings | SimState]


@pytest.fixture
def motion(trot) -> Callable[..., Motion]:
    """Return a function with the readings of a world over control steps of the trot, and its final true state."""

    def run(world: SimWorld, steps: int = 40, first: int = 0) -> Motion:
        return [*(world.step(trot(k)) for k in range(first, first + steps)), world.truth()]

    return run


@pytest.fixture
def assert_same_motion(assert_same) -> Callable[..., None]:
    def compare(one: Motion, other: Motion, rows: Any = slice(None), other_rows: Any = slice(None)) -> None:
        for a, b in zip(one, other, strict=True):
            assert_same(a, b, rows, other_rows)

    return compare


def set_ratios(world: SimWorld, rows: list[int], **values: Any) -> None:
    params = world.params.rows(rows).with_values(world.robot, **values)
    world.set_params(rows, params)


# --- masses that change -----------------------------------------------------------------------------------


def test_masses_set_later_equal_masses_set_at_the_start(make_world, motion, assert_same_motion):
    values = masses()
    world, second = make_world(NUM, config={"threads": 2}), make_world(NUM, config={"threads": 2}, **values)
    motion(world, 5)
    set_ratios(world, list(range(NUM)), **values)
    world.reset()
    assert_same_motion(motion(world), motion(second))


def test_masses_can_change_during_a_motion(make_world, motion, assert_same_motion):
    # The state is unchanged; from then on the robot moves like a robot of that mass from that state.
    world, heavy = make_world(1), make_world(1, **{name: 1.3 for name in MASS_RATIOS})
    motion(world, 15)
    state = world.get_state()
    before = world.truth()
    set_ratios(world, [0], **{name: 1.3 for name in MASS_RATIOS})
    for name, value in vars(before).items():
        assert np.array_equal(getattr(world.truth(), name), value), name
    state["params"] = heavy.get_state()["params"]
    heavy.set_state(state)
    assert_same_motion(motion(world, 20, 15), motion(heavy, 20, 15))


# --- back to nominal --------------------------------------------------------------------------------------


def test_a_ratio_of_one_is_the_nominal_robot_again(make_world, motion, assert_same_motion):
    world = make_world(NUM, config={"threads": 2}, **masses())
    motion(world, 10)
    set_ratios(world, list(range(NUM)), **{name: 0.3 for name in MASS_RATIOS})
    motion(world, 10)
    set_ratios(world, list(range(NUM)), **{name: 1.0 for name in MASS_RATIOS})
    world.reset()
    nominal = motion(make_world(1))
    now = motion(world)
    for i in range(NUM):
        assert_same_motion(now, nominal, slice(i, i + 1))


def test_masses_and_rotors_change_only_what_mujoco_derives_from_them(robot):
    # The engine copies only these arrays between robots, so mj_setConst must not change any others.
    model, nominal = build_model(robot), build_model(robot)
    model.body_mass[1:] *= 1.2
    model.body_inertia[1:] *= 1.3
    model.dof_armature[6:] += 0.01
    model.body_ipos[1] += 0.01
    mujoco.mj_setConst(model, mujoco.MjData(model))
    names = [name for name in dir(model) if isinstance(getattr(model, name), np.ndarray)]
    differ = {
        name for name in names if not np.array_equal(getattr(model, name), getattr(nominal, name), equal_nan=True)
    }
    assert len(names) > 200
    # A centre of mass that moves also shifts what is only for pairs of many shapes (bounding boxes) and for sleeping.
    assert differ - {"bvh_aabb", "dof_length"} == set(MASS_FIELDS)
    assert options_of(model.opt) == options_of(nominal.opt)


def options_of(options: Any) -> dict[str, Any]:
    """Return the options of a model by name."""
    names = [name for name in dir(options) if not name.startswith("_")]
    return {name: np.asarray(getattr(options, name)).tolist() for name in names if not callable(getattr(options, name))}


def test_mujocos_constants_of_nominal_masses_are_those_compiled(robot):
    model, nominal = build_model(robot), build_model(robot)
    for name in ("body_mass", "body_inertia"):
        getattr(model, name)[1:] *= 0.7
    mujoco.mj_setConst(model, mujoco.MjData(model))
    model.body_mass[:], model.body_inertia[:] = nominal.body_mass, nominal.body_inertia
    mujoco.mj_setConst(model, mujoco.MjData(model))
    for name in MASS_FIELDS:
        assert np.array_equal(getattr(model, name), getattr(nominal, name)), name


# --- robots that are not active ---------------------------------------------------------------------------

BUSY: dict[str, Any] = {
    "imu_noise": 0.02,
    "control_step": [0.003, 0.0045, 0.006, 0.0115],
    "control_latency": [0.0, 0.013, 0.02, 0.04],
}


def same_state(one: dict[str, Any], other: dict[str, Any], rows: list[int], without: tuple[str, ...] = ()) -> bool:
    """Return whether two states of a world of four robots are equal to the last bit for some robots."""
    equal = [one["streams"][k] == other["streams"][k] for i in rows for k in (i, 4 + i)]
    for part in ("engine", "control_steps", "noise"):
        equal.append(np.array_equal(one[part][rows], other[part][rows]))
    for part in ("actuation", "params"):
        for name, array in one[part].items():
            if name not in without:
                equal.append(np.array_equal(array[rows], other[part][name][rows]))
    return all(equal)


@pytest.mark.parametrize("steps", [0, 20, 256])
def test_inactive_robots_are_frozen(make_world, trot, assert_same, steps):
    # Noise is drawn in blocks of 256 control steps: nor is it drawn while a robot waits at a block's first one.
    world = make_world(4, **BUSY)
    for k in range(steps):
        world.step(trot(k))
    state, readings, truth = world.get_state(), world.readings(), world.truth()
    active = np.array([True, False, True, False])
    for k in range(steps, steps + 30):
        second = world.step(trot(k), active)
        assert_same(readings, second, ~active, ~active)
    now = world.get_state()
    # Sums over a control step are from their last control step.
    summed = ("energy", "contact_ticks", "limit_ticks")
    assert same_state(state, now, [1, 3], without=summed)
    assert not same_state(state, now, [0, 2], without=summed)
    for name in set(vars(truth)) - {"energy", "foot_contact", "motor_saturation"}:
        assert np.array_equal(getattr(truth, name)[[1, 3]], getattr(world.truth(), name)[[1, 3]]), name
    assert np.all(second.time[[0, 2]] > readings.time[[0, 2]])


def test_active_robots_move_as_if_all_were_active(make_world, trot, assert_same):
    world, all_go = make_world(4, **BUSY), make_world(4, **BUSY)
    for k in range(320):
        active = np.array([True, k % 3 == 0, True, False])
        second, expected = world.step(trot(k), active), all_go.step(trot(k))
        assert_same(second, expected, [0, 2], [0, 2])
        assert_same(world.truth(), all_go.truth(), [0, 2], [0, 2])
    assert same_state(world.get_state(), all_go.get_state(), [0, 2])


def test_an_inactive_robot_later_continues_unchanged(make_world, trot, assert_same):
    waits, goes = make_world(4, **BUSY), make_world(4, **BUSY)
    for k in range(15):
        waits.step(trot(k))
        goes.step(trot(k))
    for k in range(50):
        waits.step(trot(k), np.array([True, True, False, True]))
    for k in range(15, 300):
        assert_same(waits.step(trot(k)), goes.step(trot(k)), [2], [2])
    assert same_state(waits.get_state(), goes.get_state(), [2])


def test_an_inactive_robot_ignores_its_target(make_world, trot, assert_same):
    # Not even if it is not a number.
    world, other = make_world(4, **BUSY), make_world(4, **BUSY)
    active = np.array([True, False, True, True])
    for k in range(10):
        target = np.tile(trot(k), (4, 1))
        target[1] = np.nan
        second = world.step(target, active)
        assert_same(second, other.step(trot(k), active))
    assert world.divergences == 0
    assert not world.truth().diverged.any()
    assert_same(world.step(trot(10)), other.step(trot(10)))
