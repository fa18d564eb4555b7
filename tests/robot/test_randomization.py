"""Randomization: what is drawn, that it is measured in physics, servo and sensors, and when it is drawn anew."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy import stats

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params
from surefoot.robot.randomization import (
    ROWS,
    RandomizeConfig,
    Randomizer,
    _ranges_of_intervals,
    check_ranges,
    load_ranges,
    range_names,
)
from surefoot.seeding import generators
from surefoot.task.config import FeedbackConfig, TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.pushes import PushConfig
from surefoot.world.mujoco_model import build_model
from surefoot.world.registry import WORLDS
from surefoot.world.sim_world import SimWorld

SET = {row: what for row, what in ROWS.items() if what.how == "set"}
"""Rows whose numbers are the parameters; the others are tried below."""
TABLE_1 = {
    "mass": (0.80, 1.20),
    "motor_friction": (0.0, 0.05),
    "inertia": (0.50, 1.50),
    "motor_strength": (0.80, 1.20),
    "control_step": (0.003, 0.020),
    "latency": (0.0, 0.040),
    "voltage": (14.0, 16.8),
    "contact_friction": (0.5, 1.25),
    "imu_bias": (-0.05, 0.05),
    "imu_noise": (0.0, 0.05),
}
"""Tan et al. 2018, table I, in SI units."""
MORE = {
    "torque_constant": (0.08, 0.11),
    "resistance": (0.15, 0.22),
    "servo_latency": (0.0, 0.010),
    "contact_stiffness": (1500.0, 6000.0),
    "spinning_friction": (0.002, 0.006),
    "knee_friction": (0.0, 0.02),
    "knee_play": (0.0001, 0.0005),
    "floor_unevenness": (0.001, 0.004),
    "imu_mount": (-0.02, 0.02),
    "imu_yaw_drift": (-0.02, 0.02),
}
FULL = RandomizeConfig(**TABLE_1, **MORE)
NUMBERS = {
    **{row: 1 for row in SET},
    "mass": 2,  # base, legs
    "inertia": 2,  # base, legs
    "motor_strength": 8,  # each motor
    "imu_bias": 2,  # roll, pitch
    "imu_mount": 3,  # roll, pitch, yaw
}
"""How many numbers an episode draws from each row."""


def numbers(params: PhysicalParams, row: str) -> np.ndarray:
    """The numbers (N, k) of one row; one that all motors share counts once."""
    if row == "motor_friction":
        return params.motor_friction[:, :1]
    return np.concatenate([getattr(params, name).reshape(params.num_envs, -1) for name in ROWS[row].params], axis=1)


def same(first: PhysicalParams, second: PhysicalParams) -> bool:
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in PhysicalParams.names())


@pytest.fixture
def make_randomizer(robot):
    def make(num_envs: int = 4, config: RandomizeConfig = FULL, seed: int = 5, **nominal: float) -> Randomizer:
        return Randomizer(config, robot, PhysicalParams.nominal(robot, num_envs).with_values(robot, **nominal), seed)

    return make


# --- what is drawn ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(robot) -> list[PhysicalParams]:
    """Forty episodes of each of 100 robots."""
    randomizer = Randomizer(FULL, robot, PhysicalParams.nominal(robot, 100), seed=11)
    return [randomizer.draw(np.arange(100)) for _ in range(40)]


@pytest.mark.parametrize("row", SET)
def test_draws_are_uniform_over_the_range(many, row):
    drawn = np.concatenate([numbers(params, row) for params in many])
    low, high = FULL.ranges[row]
    assert drawn.shape == (4000, NUMBERS[row])
    assert drawn.min() >= low
    assert drawn.max() <= high
    for column in drawn.T:
        assert stats.kstest(column, "uniform", (low, high - low)).pvalue > 0.005


def test_all_numbers_are_independent(many):
    drawn = np.array([np.concatenate([numbers(params, row) for row in SET], axis=1) for params in many])
    assert drawn.shape == (40, 100, 32)
    assert np.all(many[0].motor_friction == many[0].motor_friction[:, :1])  # all motors share one
    between = np.corrcoef(drawn.reshape(4000, 32), rowvar=False) - np.eye(32)
    # The standard error of a correlation of 4000 pairs is .016; this is four of them.
    assert np.abs(between).max() < 0.064
    for first, second in ((drawn[:-1], drawn[1:]), (drawn[:, :-1], drawn[:, 1:])):  # episodes, and robots, in a row
        for k in range(32):
            assert abs(np.corrcoef(first[..., k].ravel(), second[..., k].ravel())[0, 1]) < 0.064


def test_what_has_no_row_or_no_range_stays_nominal(make_randomizer, robot):
    randomizer = make_randomizer(3, RandomizeConfig(mass=(0.8, 1.2)), servo_kp=1.5, voltage=15.0)
    drawn = randomizer.draw(np.array([2, 0]))
    expected = PhysicalParams.nominal(robot, 2).with_values(robot, servo_kp=1.5, voltage=15.0)
    for name in set(PhysicalParams.names()) - {"base_mass_ratio", "leg_mass_ratio"}:
        assert np.array_equal(getattr(drawn, name), getattr(expected, name)), name
    assert np.all(randomizer.nominal.base_mass_ratio == 1.0)  # a draw leaves the nominal values alone
    assert np.all(drawn.base_mass_ratio != 1.0)


# --- on what a draw depends -------------------------------------------------------------------------------


@pytest.mark.parametrize("i", [0, 3, 40])
def test_a_robot_draws_the_same_in_any_batch(make_randomizer, i):
    few, lots = make_randomizer(i + 1), make_randomizer(64)
    for _ in range(3):
        assert same(few.draw(np.array([i])), lots.draw(np.arange(64)).rows([i]))


def test_the_order_of_resets_does_not_matter(make_randomizer):
    one, other = make_randomizer(), make_randomizer()
    assert same(one.draw(np.array([3, 1])).rows([1, 0]), other.draw(np.array([1, 3])))
    # Robots 0 and 2 have not drawn yet, and 1 and 3 have drawn once, whatever the order.
    one.draw(np.array([0])), one.draw(np.array([2]))
    other.draw(np.array([2, 0]))
    assert same(one.draw(np.arange(4)), other.draw(np.arange(4)))


@pytest.mark.parametrize("row", SET)
def test_a_row_dropped_or_narrowed_leaves_the_others_draws(make_randomizer, row):
    low, high = FULL.ranges[row]
    width = high - low
    narrow = (low + 0.25 * width, low + 0.5 * width)
    full, dropped, narrowed = (
        make_randomizer(config=replace(FULL, **change)) for change in ({}, {row: None}, {row: narrow})
    )
    for _ in range(2):
        drawn = [randomizer.draw(np.arange(4)) for randomizer in (full, dropped, narrowed)]
        for other in set(SET) - {row}:
            for params in drawn[1:]:
                assert np.array_equal(numbers(drawn[0], other), numbers(params, other)), other
        for name in ROWS[row].params:
            was, now = getattr(drawn[0], name), getattr(drawn[2], name)
            # The same number from 0 to 1, over a quarter of the range.
            np.testing.assert_allclose((now - narrow[0]) / (narrow[1] - narrow[0]), (was - low) / width, atol=1e-12)


def test_rows_that_draw_apart_leave_the_stream_as_it_was(make_randomizer):
    randomizer, streams = make_randomizer(), generators(5, "randomize", 4)
    for _ in range(3):
        params = randomizer.draw(np.arange(4))
        # In the rows' order: mass 2, motor friction 1, inertia 2, strength 8, control step, latency, voltage, ...
        unit = np.array([stream.uniform(size=23) for stream in streams])
        np.testing.assert_array_equal(params.base_mass_ratio, 0.8 + (1.2 - 0.8) * unit[:, 0])
        np.testing.assert_array_equal(params.voltage, 14.0 + (16.8 - 14.0) * unit[:, 15])
        np.testing.assert_array_equal(params.servo_latency, 0.010 * unit[:, 22])


# --- drawn values, measured -------------------------------------------------------------------------------

STILL: dict[str, Any] = {
    "feedback": FeedbackConfig(swing=(-0.5, 0.5), extension=(1.5, 2.5)),
    "start_linear_speed": 0.0,
    "start_angular_speed": 0.0,
}


def make_env(ranges: dict[str, Any], num_envs: int = 4, seed: int = 1, **task: Any) -> LocomotionEnv:
    """Robots that stand still at first, with these ranges."""
    config = TaskConfig(**{**STILL, "randomize": RandomizeConfig(**ranges), **task})
    return LocomotionEnv(config, num_envs, SimWorld, seed, threads=1)


FINE = {"control_step": 0.001}
"""A command for every servo step, so that the truth of every servo step is known."""


def wave(env: LocomotionEnv, k: int) -> np.ndarray:
    """Motor angles that keep all legs busy, for the servo step k."""
    phase = 2 * np.pi * 2.0 * 0.001 * k + np.array([0, np.pi, np.pi, 0])
    return env.robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))


def test_what_robots_weigh_and_how_deep_their_feet_stand_is_as_drawn(robot):
    env = make_env({"mass": (0.8, 1.2), "contact_stiffness": (1500.0, 6000.0)}, num_envs=12)
    for _ in range(450):
        env.world.step(env.world.resting_angles)
    depth, params = robot.five_bar.foot_radius - env.world.foot_positions()[:, :, 2], env.world.params
    weighed = params.contact_stiffness * depth.sum(axis=1) / 9.81
    assert params.contact_stiffness.max() > 2 * params.contact_stiffness.min()
    ratios = np.stack([params.base_mass_ratio, params.leg_mass_ratio], axis=1)
    base = sum(robot.urdf.links[name].mass for name in robot.urdf.fixed_to(robot.base))
    expected = base, robot.urdf.total_mass - base
    assert expected == pytest.approx((5.993, 1.48))
    np.testing.assert_allclose(weighed, ratios @ expected, rtol=1e-3)


def own_model(env: LocomotionEnv, i: int, without: str = "") -> mujoco.MjModel:
    """A model apart from the engine's with robot i's drawn masses and inertias; `without` one of them."""
    model, params = build_model(env.robot), env.world.params
    for body in range(1, model.nbody):
        part = "base" if model.body(body).name == env.robot.base else "leg"
        for quantity, array in (("mass", model.body_mass), ("inertia", model.body_inertia)):
            name = f"{part}_{quantity}_ratio"
            if name != without:
                array[body] *= getattr(params, name)[i]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return model


def own_motion(model: mujoco.MjModel, start: np.ndarray, forces: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Coordinates after each servo step under the forces given, from a state of another MuJoCo."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_INTEGRATION)
    path = []
    for joint_force, body_force in forces:
        data.qfrc_applied[:], data.xfrc_applied[:] = joint_force, body_force
        mujoco.mj_step(model, data)
        path.append(data.qpos.copy())
    return np.array(path)


def test_mass_and_inertia_move_as_in_a_model_of_our_own():
    env = make_env({row: FULL.ranges[row] for row in ("mass", "inertia")}, num_envs=3, params=FINE)
    engine = env.world.engine
    size = mujoco.mj_stateSize(build_model(env.robot), mujoco.mjtState.mjSTATE_INTEGRATION)
    start = engine.get_state(np.arange(3))[:, :size]
    forces: list[list[Any]] = [[], [], []]
    path: list[list[np.ndarray]] = [[], [], []]
    for k in range(80):
        env.world.step(wave(env, k))
        for i, data in enumerate(engine.datas):
            forces[i].append((data.qfrc_applied.copy(), data.xfrc_applied.copy()))
            path[i].append(data.qpos.copy())
    for i in range(3):
        assert np.array_equal(own_motion(own_model(env, i), start[i], forces[i]), path[i])
        for name in ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio"):
            other = own_motion(own_model(env, i, without=name), start[i], forces[i])
            assert np.abs(other - path[i]).max() > 1e-6


def torques_by_hand(env: LocomotionEnv, target: np.ndarray, angle: np.ndarray, speed: np.ndarray, **changed: Any):
    """Torque on each motor's shaft (steps, N, M) by eq. 5 to 7 of the paper; `changed` parameters for all."""
    params = env.world.params.with_values(env.robot, **changed)
    time = 0.001 * np.arange(len(angle))
    expected = np.empty_like(angle)
    for i, m in np.ndindex(*angle.shape[1:]):
        seen, turning = (np.interp(time - params.servo_latency[i], time, x[:, i, m]) for x in (angle, speed))
        duty = params.servo_kp[i, m] * (target[:, m] - seen) - params.servo_kd[i, m] * turning
        now = speed[:, i, m]
        net = np.clip(duty, -1, 1) * params.voltage[i] - params.torque_constant[i] * now
        current = net / params.resistance[i]
        torque = np.sign(current) * np.interp(np.abs(current), *env.robot.torque_table) * params.motor_strength[i, m]
        expected[:, i, m] = torque - params.motor_friction[i, m] * np.tanh(now / 0.1)
    return expected


def test_the_motors_answer_as_drawn():
    rows = ("motor_strength", "motor_friction", "voltage", "torque_constant", "resistance", "servo_latency")
    env = make_env({row: FULL.ranges[row] for row in rows}, num_envs=3, params=FINE)
    robot, datas, model = env.robot, env.world.engine.datas, build_model(env.robot)
    dofs = [model.joint(name).dofadr[0] for name in robot.motor_names]
    target = np.array([wave(env, k) for k in range(80)])
    angle, speed, applied = [], [], []
    for now in target:
        truth = env.world.truth()
        angle.append(truth.motor_angle)
        speed.append(truth.motor_velocity)
        env.world.step(now)
        applied.append([data.qfrc_applied[dofs] * robot.motor_sign for data in datas])
    went = target, np.array(angle), np.array(speed)
    np.testing.assert_allclose(applied, torques_by_hand(env, *went), rtol=1e-9, atol=1e-9)
    for row in rows:  # which is also the name of its parameter
        apart = np.abs(applied - torques_by_hand(env, *went, **{row: robot.nominal_params()[row]})).max(axis=0)
        assert np.all(apart > 1e-6)  # each motor of each robot


# --- when it is drawn -------------------------------------------------------------------------------------


def run(env: LocomotionEnv, steps: int, seed: int = 0) -> list[np.ndarray]:
    draw = np.random.default_rng(seed)
    path = []
    for _ in range(steps):
        observation, reward, terminated, truncated, _ = env.step(draw.uniform(-1, 1, (env.num_envs, 8)))
        path += [observation, reward, terminated, truncated, env.privileged()]
        path += [getattr(env.world.params, name).copy() for name in PhysicalParams.names()]
    return path


def same_path(first: list[np.ndarray], second: list[np.ndarray]) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


def changed(env: LocomotionEnv, before: PhysicalParams) -> np.ndarray:
    """Whether each number of each row of the table differs from before, (N, rows)."""
    now = env.world.params
    return np.array(
        [
            [np.any(getattr(now, name)[i] != getattr(before, name)[i]) for row in TABLE_1 for name in ROWS[row].params]
            for i in range(env.num_envs)
        ]
    )


def kept(env: LocomotionEnv) -> PhysicalParams:
    return env.world.params.rows(np.arange(env.num_envs))


def test_every_reset_draws_anew_for_the_robots_that_restart():
    env = make_env(TABLE_1)
    assert changed(env, PhysicalParams.nominal(env.robot, 4)).all()
    env.reset()
    before = kept(env)
    env.reset(options={"reset_mask": np.array([False, True, False, True])})
    assert changed(env, before).all(axis=1).tolist() == [False, True, False, True]
    assert changed(env, before).any(axis=1).tolist() == [False, True, False, True]
    before = kept(env)
    env.reset()
    assert changed(env, before).all()


def test_a_robot_that_starts_anew_by_itself_draws_alone():
    env = make_env(TABLE_1)
    env.reset()
    before, strength = kept(env), env.world.actuation.strength.copy()
    env.step(np.zeros((4, 8)))
    assert not changed(env, before).any()
    env.world.engine.datas[2].qpos[3:7] = np.cos(0.5), np.sin(0.5), 0.0, 0.0  # rolled by 1 rad
    *_, terminated, _, _ = env.step(np.zeros((4, 8)))
    assert terminated.tolist() == [False, False, True, False]
    assert changed(env, before).all(axis=1).tolist() == [False, False, True, False]
    assert changed(env, before).any(axis=1).tolist() == [False, False, True, False]
    # It arrived where the motors are computed.
    assert np.array_equal(env.world.actuation.strength != strength, np.repeat([[False, False, True, False]], 8, 0).T)


def test_the_end_of_an_episode_draws_anew():
    env = make_env(TABLE_1, max_steps=3)
    env.reset()
    before = kept(env)
    for _ in range(2):
        env.step(np.zeros((4, 8)))
    assert not changed(env, before).any()
    env.step(np.zeros((4, 8)))
    assert changed(env, before).all()


def test_without_autoreset_an_episode_that_is_over_keeps_its_parameters():
    task = TaskConfig(**{**STILL, "randomize": RandomizeConfig(**TABLE_1), "max_steps": 2})
    env = LocomotionEnv(task, 2, SimWorld, 1, autoreset=False, threads=1)
    env.reset()
    before = kept(env)
    for _ in range(4):
        env.step(np.zeros((2, 8)))
    assert env.over.all()
    assert not changed(env, before).any()


PUSHED: dict[str, Any] = {
    "max_steps": 20,
    "start_linear_speed": 0.05,
    "history": 2,
    "pushes": PushConfig(enabled=True, period=0.05, duration=0.02),
}


def test_a_seeded_reset_repeats_all_draws():
    env = make_env(TABLE_1, num_envs=2, seed=8, **PUSHED)
    first, _ = env.reset(seed=3)
    path = run(env, 30)
    again, _ = env.reset(seed=3)
    assert np.array_equal(first, again)
    assert same_path(path, run(env, 30))
    assert same_path(path, run(make_env(TABLE_1, num_envs=2, seed=3, **PUSHED), 30))
    env.reset(seed=4)
    assert not same_path(path, run(env, 30))


def test_a_robots_episodes_do_not_depend_on_the_batch():
    few, lots = (make_env(TABLE_1, num_envs=n, max_steps=10) for n in (3, 11))
    draw = np.random.default_rng(2)
    for _ in range(35):
        action = draw.uniform(-1, 1, (11, 8))
        (one, reward, *_), (other, rewards, *_) = few.step(action[:3]), lots.step(action)
        assert np.array_equal(one, other[:3])
        assert np.array_equal(reward, rewards[:3])


def test_a_state_taken_and_given_back_goes_on_alike():
    table = {row: bounds for row, bounds in {**TABLE_1, **MORE}.items() if row not in WORLDS["bullet"].models}
    env, other = (make_env(table, num_envs=2, seed=seed, **PUSHED) for seed in (1, 2))
    run(env, 30)
    state = env.get_state()
    path = run(env, 45)  # over the ends of several episodes, whose parameters are drawn after the state was taken
    for one in (other, env):
        one.set_state(state)
        assert same_path(path, run(one, 45))


# --- nothing to draw --------------------------------------------------------------------------------------


def test_a_range_of_the_nominal_value_is_as_no_range(robot):
    nominal = robot.nominal_params()
    ranges = {row: (nominal[what.params[0]],) * 2 for row, what in SET.items()}
    values = {"max_steps": 15, "start_linear_speed": 0.05}
    env, plain = make_env(ranges, **values), make_env({}, **values)
    assert env.randomizer.enabled
    assert not plain.randomizer.enabled
    assert same_path(run(env, 40), run(plain, 40))


def test_without_ranges_nothing_is_drawn(robot):
    env = make_env({}, max_steps=5, params={"voltage": 15.0})
    run(env, 12)
    expected = PhysicalParams.nominal(robot, 4).with_values(robot, voltage=15.0)
    assert same(kept(env), expected)
    assert TaskConfig().randomize == RandomizeConfig() == load_ranges("none")
    assert load_ranges("none").ranges == {}


# --- what a critic may know -------------------------------------------------------------------------------


def test_scaled_is_from_minus_one_to_one(make_randomizer, many):
    randomizer = make_randomizer()
    scaled = np.concatenate([randomizer.scaled(params) for params in many])
    assert scaled.shape == (4000, 32)
    assert np.abs(scaled).max() <= 1 + 1e-12
    assert np.all(scaled.min(axis=0) < -0.99)
    assert np.all(scaled.max(axis=0) > 0.99)


def test_scaled_by_hand(robot, make_randomizer):
    config = RandomizeConfig(mass=(0.8, 1.2), voltage=(14.0, 16.0), imu_bias=(-0.05, 0.05), resistance=(0.2, 0.2))
    params = PhysicalParams.nominal(robot, 2).with_values(
        robot,
        base_mass_ratio=[0.8, 1.2],
        leg_mass_ratio=[1.0, 1.1],
        voltage=[14.5, 16.0],
        imu_bias=[[0.05, 0], [0, -0.025]],
    )
    # Base, legs, voltage, roll, pitch; a range without width tells nothing.
    expected = [[-1, 0, -0.5, 1, 0], [1, 0.5, 1, 0, -0.5]]
    np.testing.assert_allclose(make_randomizer(2, config).scaled(params), expected, atol=1e-12)


def test_the_critics_state_grows_by_what_is_drawn():
    plain = make_env({}).privileged().shape[1]
    for ranges, width in (
        ({"motor_friction": (0.0, 0.05)}, 1),
        ({"imu_bias": (-0.05, 0.05), "latency": (0.01, 0.01)}, 2),
        (TABLE_1, 20),
    ):
        env = make_env(ranges)
        grown = env.privileged()
        assert grown.shape[1] - plain == width
        np.testing.assert_allclose(grown[:, -width:], env.randomizer.scaled(env.world.params), atol=1e-6)


# --- ranges as data ---------------------------------------------------------------------------------------


def test_table1_is_the_papers():
    assert load_ranges("table1").ranges == TABLE_1
    assert range_names() == ["ensemble", "none", "table1"]


@pytest.mark.parametrize(
    ("ranges", "pieces"),
    [
        ({"latency": [0.03, 0.01]}, ["randomize.latency is [0.03, 0.01]", "the lower bound must come first"]),
        ({"latency": [0.0, 15]}, ["randomize.latency is [0, 15]", "control_latency from 0 to 0.1 (unit: s)"]),
        ({"latency": [-0.01, 0.02]}, ["randomize.latency is [-0.01, 0.02]", "from 0 to 0.1 (unit: s)"]),
        ({"control_step": [3, 20]}, ["randomize.control_step is [3, 20]", "from 0.001 to 0.05 (unit: s)"]),
        ({"mass": [80, 120]}, ["randomize.mass is [80, 120]", "minitaur allows base_mass_ratio from 0.2 to 5"]),
        ({"voltage": [14.0, 168.0]}, ["randomize.voltage is [14, 168]", "voltage from 5 to 30 (unit: V)"]),
        ({"imu_noise": [-0.05, 0.05]}, ["randomize.imu_noise", "imu_noise from 0 to 0.5 (unit: rad)"]),
        ({"voltage": [14.0, float("inf")]}, ["randomize.voltage is [14, inf]", "finite"]),
        ({"voltage": [14.0, float("nan")]}, ["randomize.voltage is [14, nan]"]),
        ({"mass": 0.8}, ["randomize.mass is 0.8", "2 values, each a number"]),
        ({"mass": ["light", "heavy"]}, ["randomize.mass is ['light', 'heavy']"]),
        ({"colour": [0, 1]}, ["randomize.colour is not a key", "choices: mass, motor_friction", "servo_latency"]),
    ],
)
def test_ranges_that_cannot_be_are_refused(robot, ranges, pieces):
    feedback = {"extension": [1.5, 2.5]}
    for make in (
        lambda: check_ranges(from_mapping(RandomizeConfig, ranges, "randomize"), robot),
        lambda: LocomotionEnv(from_mapping(TaskConfig, {"feedback": feedback, "randomize": ranges}), 1, SimWorld),
    ):
        with pytest.raises(SurefootError) as caught:
            make()
        assert "\n" not in str(caught.value)
        for piece in pieces:
            assert piece in str(caught.value)


def test_a_table_that_is_not_there_is_refused(tmp_path: Path):
    with pytest.raises(SurefootError) as caught:
        load_ranges("tabel1")
    assert (
        str(caught.value)
        == "randomize 'tabel1' does not exist; choices: ensemble, none, table1, or the path of a YAML file"
    )
    with pytest.raises(SurefootError, match="does not exist"):
        load_ranges(str(tmp_path))
    (tmp_path / "bad.yaml").write_text("mass: [1.2, 0.8]\n")
    with pytest.raises(SurefootError, match=r"bad.yaml: randomize.mass is \[1.2, 0.8\]; the lower bound must come"):
        load_ranges(str(tmp_path / "bad.yaml"))
    (tmp_path / "cut.yaml").write_text("mass: [1.2,\n")
    with pytest.raises(SurefootError, match=r"cut.yaml: is not YAML"):
        load_ranges(str(tmp_path / "cut.yaml"))


def task_file(folder: Path, randomize: str) -> str:
    path = folder / "task.yaml"
    path.write_text(f"feedback: {{extension: [1.5, 2.5]}}\n{randomize}\n")
    return str(path)


def test_a_task_names_a_table_or_has_its_own(tmp_path: Path):
    assert load_task(task_file(tmp_path, ""))[0].randomize.ranges == {}
    assert load_task(task_file(tmp_path, "randomize: none"))[0].randomize.ranges == {}
    assert load_task(task_file(tmp_path, "randomize: table1"))[0].randomize.ranges == TABLE_1
    own = "randomize:\n  mass: [0.9, 1.1]\n  latency: [0, 0.02]\n  voltage: null"
    assert load_task(task_file(tmp_path, own))[0].randomize.ranges == {"mass": (0.9, 1.1), "latency": (0.0, 0.02)}
    both = "randomize: {table: table1, latency: null, contact_stiffness: [3000, 30000]}"
    expected = {row: given for row, given in TABLE_1.items() if row != "latency"}
    assert load_task(task_file(tmp_path, both))[0].randomize.ranges == expected | {"contact_stiffness": (3e3, 3e4)}
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    by_path = load_task(task_file(tmp_path, f"randomize: {tmp_path / 'mine.yaml'}"))[0]
    assert by_path.randomize.ranges == {"voltage": (15.0, 16.0)}
    for given, said in (
        ("tabel1", "tabel1' does not exist; choices: ensemble, none"),
        ("3", "is 3; it must be a table"),
    ):
        with pytest.raises(SurefootError, match=rf"task\.yaml: randomize .*{said}"):
            load_task(task_file(tmp_path, f"randomize: {given}"))


def test_a_tables_path_counts_from_the_tasks_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # As that of a reference does, wherever surefoot is run.
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    task = task_file(tmp_path, "randomize: mine.yaml")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_task(task)[0].randomize.ranges == {"voltage": (15.0, 16.0)}


@pytest.mark.parametrize(
    ("randomize", "pieces"),
    [
        ("randomize: {table: tabel1}", ["tabel1' does not exist; choices: ensemble, none, table1"]),
        ("randomize: {table: table1, speed: [1, 2]}", ["randomize.speed is not a key; choices: mass"]),
    ],
)
def test_a_task_with_ranges_that_do_not_fit_is_refused(tmp_path: Path, randomize, pieces):
    with pytest.raises(SurefootError) as caught:
        load_task(task_file(tmp_path, randomize))
    for piece in pieces:
        assert piece in str(caught.value)


def test_rows_around_the_nominal_values_are_factors_or_sums_of_them():
    robot = RobotDescription.load("pupper_v2")
    offsets = np.linspace(-0.02, 0.02, 12)
    nominal = PhysicalParams.nominal(robot, 40).with_values(robot, motor_offset=offsets[None])
    ranges = RandomizeConfig(servo_kp=(0.9, 1.1), friction=(0.0, 2.0), motor_offset=(-0.01, 0.01))
    randomizer = Randomizer(ranges, robot, nominal, 3)
    drawn = randomizer.draw(np.arange(40))
    factors = drawn.servo_kp / nominal.servo_kp
    assert np.ptp(factors, axis=1).max() < 1e-12
    assert 0.9 <= factors.min() < 0.92
    assert 1.08 < factors.max() <= 1.1
    assert np.ptp(drawn.motor_friction / nominal.motor_friction, axis=1).min() > 0.5
    assert np.abs(drawn.motor_offset - offsets).max() <= 0.01
    scaled = randomizer.scaled(drawn)
    assert scaled.shape == (40, 1 + 12 + 12) == (40, len(randomizer.columns))
    np.testing.assert_allclose(scaled[:, 0], 10 * (factors[:, 0] - 1))
    assert np.abs(scaled).max() <= 1.0 + 1e-9
    # The draws of rows that were there before do not depend on the new ones.
    both = replace(ranges, contact_friction=(0.5, 1.0))
    alone = RandomizeConfig(contact_friction=(0.5, 1.0))
    first, second = (Randomizer(one, robot, nominal, 3).draw(np.arange(40)) for one in (both, alone))
    np.testing.assert_array_equal(first.contact_friction, second.contact_friction)


def test_ranges_of_an_identified_robot_are_its_intervals():
    robot = RobotDescription.load("pupper_v2")
    found = read_params(robot.folder / "identified.toml", robot)
    ranges = load_ranges("identified", robot="pupper_v2").ranges
    low, high = found.tables["intervals"]["contact_friction"]
    assert ranges["contact_friction"] == (low, high)
    gain = float(found.params.servo_kp[0, 0])
    np.testing.assert_allclose(ranges["servo_kp"], np.array(found.tables["intervals"]["servo_kp"]) / gain)
    assert ranges["motor_offset"][0] < 0 < ranges["motor_offset"][1]
    check_ranges(RandomizeConfig(**ranges), robot)
    with pytest.raises(SurefootError, match="randomize 'identified' does not exist"):
        load_ranges("identified", robot="minitaur")


@pytest.mark.parametrize(
    ("robot", "ranges", "said"),
    [
        ("go2", {"voltage": (14.0, 16.0)}, "voltage is given; it belongs to motors of kind dc, those of go2 are joint"),
        ("pupper_v2", {"servo_kp": (-0.5, 1.0)}, r"randomize\.servo_kp is \[-0\.5, 1\]; factors are 0 or more"),
    ],
)
def test_ranges_that_a_robot_can_t_have_are_refused(robot: str, ranges: dict[str, Any], said: str):
    with pytest.raises(SurefootError, match=said):
        check_ranges(RandomizeConfig(**ranges), RobotDescription.load(robot))


@pytest.mark.parametrize(
    ("intervals", "said"),
    [
        ("", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = [nan, nan]", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = 0.5", r"intervals\.contact_friction: must be a pair of numbers"),
        ('[intervals]\ncontact_friction = ["low", "high"]', r"intervals\.contact_friction: must be a pair of numbers"),
        ("[intervals]\ncontact_friction = [[0.4, 0.5, 0.6]]", r"intervals\.contact_friction: must be a pair"),
    ],
)
def test_intervals_that_are_none_are_refused(tmp_path: Path, intervals: str, said: str):
    robot = RobotDescription.load("pupper_v2")
    (tmp_path / "found.toml").write_text(f"[params]\ncontact_friction = 0.5\n{intervals}\n")
    with pytest.raises(SurefootError, match=said):
        _ranges_of_intervals(tmp_path / "found.toml", robot)
