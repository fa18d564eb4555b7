"""Randomization: what is drawn, that it is measured in physics, servo and sensors, and when it is drawn anew."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from scipy import stats

from surefoot.configuration import from_mapping
from surefoot.errors import SurefootError
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.params_file import read_params
from surefoot.robot.randomization import (
    Randomizer,
    Ranges,
    RelativeRange,
    check_ranges,
    load_ranges,
    range_names,
    ranges_from_mapping,
)
from surefoot.seeding import generators
from surefoot.task.config import FeedbackConfig, TaskConfig, load_task
from surefoot.task.env import LocomotionEnv
from surefoot.task.pushes import PushConfig
from surefoot.world.mujoco_model import build_model
from surefoot.world.sim_world import SimWorld

TABLE_1: Ranges = {
    "base_mass_ratio": (0.80, 1.20),
    "leg_mass_ratio": (0.80, 1.20),
    "motor_friction": (0.0, 0.05),
    "base_inertia_ratio": (0.50, 1.50),
    "leg_inertia_ratio": (0.50, 1.50),
    "motor_strength": (0.80, 1.20),
    "control_step": (0.003, 0.020),
    "control_latency": (0.0, 0.040),
    "voltage": (14.0, 16.8),
    "contact_friction": (0.5, 1.25),
    "imu_bias": (-0.05, 0.05),
    "imu_noise": (0.0, 0.05),
}
"""Tan et al. 2018, table I, in SI units."""
FULL: Ranges = {
    **TABLE_1,
    "torque_constant": (0.08, 0.11),
    "resistance": (0.15, 0.22),
    "servo_latency": (0.0, 0.010),
    "contact_stiffness": (1500.0, 6000.0),
    "contact_spinning_friction": (0.002, 0.006),
    "knee_friction": (0.0, 0.02),
    "knee_play": (0.0001, 0.0005),
    "floor_unevenness": (0.001, 0.004),
    "imu_mount": (-0.02, 0.02),
    "servo_kp": (0.9, 1.1),
    "imu_yaw_drift": (-0.02, 0.02),
    "contact_shear_ratio": (0.5, 1.5),
}
COUNT = len(FULL) + 7 + 1 + 2
"""Numbers that an episode draws: motor_strength, imu_bias and imu_mount have one for each motor or axis."""


def numbers(params: PhysicalParams, name: str) -> np.ndarray:
    """The numbers (N, k) of one parameter; one that all motors share counts once."""
    values = getattr(params, name).reshape(params.num_envs, -1)
    return values if PARAMETERS[name].independent else values[:, :1]


def same(first: PhysicalParams, second: PhysicalParams) -> bool:
    return all(np.array_equal(getattr(first, name), getattr(second, name)) for name in PhysicalParams.names())


@pytest.fixture
def make_randomizer(robot):
    def make(num_envs: int = 4, config: Ranges = FULL, seed: int = 5, **nominal: float) -> Randomizer:
        return Randomizer(config, robot, PhysicalParams.nominal(robot, num_envs).with_values(robot, **nominal), seed)

    return make


# --- what is drawn ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(robot) -> list[PhysicalParams]:
    """Forty episodes of each of 100 robots."""
    randomizer = Randomizer(FULL, robot, PhysicalParams.nominal(robot, 100), seed=11)
    return [randomizer.draw(np.arange(100)) for _ in range(40)]


@pytest.mark.parametrize("name", FULL)
def test_draws_are_uniform_over_the_range(many, name):
    drawn = np.concatenate([numbers(params, name) for params in many])
    low, high = FULL[name]
    assert drawn.min() >= low
    assert drawn.max() <= high
    for column in drawn.T:
        assert stats.kstest(column, "uniform", (low, high - low)).pvalue > 0.005


def test_all_numbers_are_independent(many):
    drawn = np.array([np.concatenate([numbers(params, name) for name in FULL], axis=1) for params in many])
    assert drawn.shape == (40, 100, COUNT)
    assert np.all(many[0].motor_friction == many[0].motor_friction[:, :1])  # all motors share one
    between = np.corrcoef(drawn.reshape(4000, COUNT), rowvar=False) - np.eye(COUNT)
    # The standard error of a correlation of 4000 pairs is .016; this is four of them.
    assert np.abs(between).max() < 0.064
    for first, second in ((drawn[:-1], drawn[1:]), (drawn[:, :-1], drawn[:, 1:])):  # episodes, and robots, in a row
        for k in range(COUNT):
            assert abs(np.corrcoef(first[..., k].ravel(), second[..., k].ravel())[0, 1]) < 0.064


def test_a_parameter_without_a_range_stays_nominal(make_randomizer, robot):
    randomizer = make_randomizer(3, {"base_mass_ratio": (0.8, 1.2)}, servo_kp=1.5, voltage=15.0)
    drawn = randomizer.draw(np.array([2, 0]))
    expected = PhysicalParams.nominal(robot, 2).with_values(robot, servo_kp=1.5, voltage=15.0)
    for name in set(PhysicalParams.names()) - {"base_mass_ratio"}:
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


@pytest.mark.parametrize("name", FULL)
def test_a_range_dropped_or_narrowed_leaves_the_other_draws(make_randomizer, name):
    low, high = FULL[name]
    width = high - low
    narrow = (low + 0.25 * width, low + 0.5 * width)
    without = {other: given for other, given in FULL.items() if other != name}
    full, dropped, narrowed = (make_randomizer(config=ranges) for ranges in (FULL, without, {**FULL, name: narrow}))
    for _ in range(2):
        drawn = [randomizer.draw(np.arange(4)) for randomizer in (full, dropped, narrowed)]
        for other in without:
            for params in drawn[1:]:
                assert np.array_equal(numbers(drawn[0], other), numbers(params, other)), other
        was, now = getattr(drawn[0], name), getattr(drawn[2], name)
        # The same number from 0 to 1, over a quarter of the range.
        np.testing.assert_allclose((now - narrow[0]) / (narrow[1] - narrow[0]), (was - low) / width, atol=1e-12)


def test_later_parameters_leave_the_stream_as_it_was(make_randomizer):
    randomizer, streams = make_randomizer(), generators(5, "randomize", 4)
    for _ in range(3):
        params = randomizer.draw(np.arange(4))
        # In the parameters' order: mass 2, motor friction 1, inertia 2, strength 8, control step, latency, voltage, ...
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
    config = TaskConfig(**{**STILL, "randomize": ranges, **task})
    return LocomotionEnv(config, num_envs, SimWorld, seed, threads=1)


RATIOS = ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio")
FINE = {"control_step": 0.001}
"""A command for every servo step, so that the truth of every servo step is known."""


def wave(env: LocomotionEnv, k: int) -> np.ndarray:
    """Motor angles that keep all legs busy, for the servo step k."""
    phase = 2 * np.pi * 2.0 * 0.001 * k + np.array([0, np.pi, np.pi, 0])
    return env.robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))


def test_what_robots_weigh_and_how_deep_their_feet_stand_is_as_drawn(robot):
    env = make_env({name: FULL[name] for name in (*RATIOS[:2], "contact_stiffness")}, num_envs=12)
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
    env = make_env({name: FULL[name] for name in RATIOS}, num_envs=3, params=FINE)
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
        for name in RATIOS:
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
    names = ("motor_strength", "motor_friction", "voltage", "torque_constant", "resistance", "servo_latency")
    env = make_env({name: FULL[name] for name in names}, num_envs=3, params=FINE)
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
    for name in names:
        apart = np.abs(applied - torques_by_hand(env, *went, **{name: robot.nominal_params()[name]})).max(axis=0)
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
    """Whether each parameter of the table differs from before, (N, parameters)."""
    now = env.world.params
    return np.array(
        [[np.any(getattr(now, name)[i] != getattr(before, name)[i]) for name in TABLE_1] for i in range(env.num_envs)]
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
    task = TaskConfig(**{**STILL, "randomize": TABLE_1, "max_steps": 2})
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
    table = {name: given for name, given in FULL.items() if not PARAMETERS[name].engines}
    env, other = (make_env(table, num_envs=2, seed=seed, **PUSHED) for seed in (1, 2))
    run(env, 30)
    state = env.get_state()
    path = run(env, 45)  # over the ends of several episodes, whose parameters are drawn after the state was taken
    for one in (other, env):
        one.set_state(state)
        assert same_path(path, run(one, 45))


# --- nothing to draw --------------------------------------------------------------------------------------


def test_a_range_of_the_nominal_value_is_as_no_range(robot):
    ranges = {name: (value, value) for name, value in robot.nominal_params().items() if name in FULL}
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
    assert TaskConfig().randomize == load_ranges("none") == {}


# --- what a critic may know -------------------------------------------------------------------------------


def test_scaled_is_from_minus_one_to_one(make_randomizer, many):
    randomizer = make_randomizer(100)
    scaled = np.concatenate([randomizer.scaled(params) for params in many])
    assert scaled.shape == (4000, COUNT)
    assert np.abs(scaled).max() <= 1 + 1e-12
    assert np.all(scaled.min(axis=0) < -0.99)
    assert np.all(scaled.max(axis=0) > 0.99)


def test_scaled_by_hand(robot, make_randomizer):
    config = {
        **{"base_mass_ratio": (0.8, 1.2), "leg_mass_ratio": (0.8, 1.2), "voltage": (14.0, 16.0)},
        **{"imu_bias": (-0.05, 0.05), "resistance": (0.2, 0.2)},
    }
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
        ({"imu_bias": (-0.05, 0.05), "control_latency": (0.01, 0.01)}, 2),
        (TABLE_1, 20),
    ):
        env = make_env(ranges)
        grown = env.privileged()
        assert grown.shape[1] - plain == width
        np.testing.assert_allclose(grown[:, -width:], env.randomizer.scaled(env.world.params), atol=1e-6)


# --- ranges as data ---------------------------------------------------------------------------------------


def test_table1_is_the_papers():
    assert load_ranges("table1") == TABLE_1
    assert range_names() == ["ensemble", "none", "table1"]


@pytest.mark.parametrize(
    ("ranges", "pieces"),
    [
        (
            {"control_latency": [0.03, 0.01]},
            ["randomize.control_latency is [0.03, 0.01]", "lower bound must"],
        ),
        ({"control_latency": [0.0, 15]}, ["randomize.control_latency is [0, 15]", "from 0 to 0.1 (unit: s)"]),
        ({"control_latency": [-0.01, 0.02]}, ["randomize.control_latency is [-0.01, 0.02]", "from 0 to 0.1 (unit: s)"]),
        ({"control_latency": [[0, 0.01], [0, 0.02]]}, ["randomize.control_latency has 2 intervals; it must have one"]),
        ({"control_step": [3, 20]}, ["randomize.control_step is [3, 20]", "from 0.001 to 0.05 (unit: s)"]),
        (
            {"leg_mass_ratio": [80, 120]},
            ["randomize.leg_mass_ratio is [80, 120]", "minitaur allows leg_mass_ratio"],
        ),
        ({"imu_noise": [-0.05, 0.05]}, ["randomize.imu_noise", "imu_noise from 0 to 0.5 (unit: rad)"]),
        ({"voltage": [14.0, float("inf")]}, ["randomize.voltage"]),
        ({"voltage": [14.0, float("nan")]}, ["randomize.voltage"]),
        ({"voltage": 0.8}, ["randomize.voltage is 0.8; it must be a list of 2 values, each a number or"]),
        ({"voltage": ["low", "high"]}, ["randomize.voltage is ['low', 'high']"]),
        ({"voltage": {}}, ["randomize.voltage must have one of scale and add"]),
        ({"voltage": {"scale": [0.9, 1.1], "add": [0, 1]}}, ["randomize.voltage must have one of scale and add"]),
        (
            {"voltage": {"factor": [0.9, 1.1]}},
            ["randomize.voltage.factor is not a key; choices: scale, add"],
        ),
        ({"voltage": {"add": [1, -1]}}, ["randomize.voltage.add is [1, -1]; the lower bound must come first"]),
        ({"servo_kp": {"scale": [-0.5, 1.0]}}, ["randomize.servo_kp.scale is [-0.5, 1]; factors are 0 or more"]),
        (
            {"knee_play": {"scale": [0, 2]}},
            ["randomize.knee_play.scale is given; write add, as knee_play"],
        ),
        (
            {"imu_mount": [[0, 0.1], [0, 0.1]]},
            ["2 intervals; it must have one, or one for each of roll, pitch"],
        ),
        ({"colour": [0, 1]}, ["'colour' is not a physical parameter; choices: base_mass_ratio,"]),
        ({"rotor_inertia": [0, 1]}, ["rotor_inertia belongs to motors of kind joint; the motors of minitaur are dc"]),
        (
            {"mass": [0.8, 1.2]},
            ["randomize.mass is not a", "; write base_mass_ratio and leg_mass_ratio"],
        ),
        ({"friction": [0.8, 1.2]}, ["write motor_friction: {scale: [LOW, HIGH], independent: true}"]),
    ],
)
def test_ranges_that_cannot_be_are_refused(robot, ranges, pieces):
    feedback = {"extension": [1.5, 2.5]}
    for make in (
        lambda: check_ranges(ranges_from_mapping(ranges), robot),
        lambda: LocomotionEnv(from_mapping(TaskConfig, {"feedback": feedback, "randomize": ranges}), 1, SimWorld),
    ):
        with pytest.raises(SurefootError) as caught:
            make()
        assert "\n" not in str(caught.value)
        for piece in pieces:
            assert piece in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("tabel1", "randomize 'tabel1' does not exist; choices: ensemble, none, table1, or the path of a YAML file"),
        (".", "does not exist"),
        ("order.yaml", "order.yaml: randomize.voltage is [16, 15]; the lower bound must come first"),
        ("cut.yaml", "cut.yaml: is not YAML"),
        ("scaled.yaml", "scaled.yaml: randomize.scaled is not a physical parameter; write NAME: {scale: [LOW, HIGH]}"),
    ],
)
def test_a_table_that_is_missing_or_wrong_is_refused(tmp_path: Path, name: str, message: str):
    (tmp_path / "order.yaml").write_text("voltage: [16, 15]\n")
    (tmp_path / "cut.yaml").write_text("voltage: [16,\n")
    (tmp_path / "scaled.yaml").write_text("scaled: {voltage: [0.9, 1.1]}\n")
    with pytest.raises(SurefootError, match=re.escape(message)):
        load_ranges(name, tmp_path)


OTHERS = {name: given for name, given in TABLE_1.items() if name != "control_latency"}


@pytest.mark.parametrize(
    ("randomize", "expected"),
    [
        ("", {}),
        ("randomize: none", {}),
        ("randomize: table1", TABLE_1),
        ("randomize: mine.yaml", {"voltage": (15.0, 16.0)}),  # the path counts from the task's file
        ("randomize: {control_latency: [0, 0.02], voltage: null}", {"control_latency": (0.0, 0.02)}),
        (
            "randomize: {table: table1, control_latency: null, contact_stiffness: [3000, 30000]}",
            OTHERS | {"contact_stiffness": (3e3, 3e4)},
        ),
        ("randomize: {servo_kp: {scale: [0.9, 1.1]}}", {"servo_kp": RelativeRange(scale=(0.9, 1.1))}),
        ("randomize: {imu_bias: [[0, 0.1], [0, 0]]}", {"imu_bias": ((0.0, 0.1), (0.0, 0.0))}),
    ],
)
def test_a_task_names_a_table_or_has_its_own(tmp_path: Path, monkeypatch, randomize: str, expected: Ranges):
    (tmp_path / "mine.yaml").write_text("voltage: [15, 16]\n")
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    assert load_task(task_file(tmp_path, randomize))[0].randomize == expected


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ("tabel1", "tabel1' does not exist; choices: ensemble, none"),
        ("3", "randomize is 3; it must be a table"),
        ("{table: tabel1}", "tabel1' does not exist; choices: ensemble, none, table1"),
        ("{table: table1, speed: [1, 2]}", "'speed' is not a physical parameter; choices: base_mass_ratio"),
    ],
)
def test_a_task_with_ranges_that_do_not_fit_is_refused(tmp_path: Path, randomize: str, message: str):
    with pytest.raises(SurefootError, match=rf"task\.yaml: .*{message}"):
        load_task(task_file(tmp_path, f"randomize: {randomize}"))


def task_file(folder: Path, randomize: str) -> str:
    path = folder / "task.yaml"
    path.write_text(f"feedback: {{extension: [1.5, 2.5]}}\n{randomize}\n")
    return str(path)


# --- ranges around nominal values -------------------------------------------------------------------------


def test_relative_ranges_are_factors_or_summands_of_nominal_values():
    robot = RobotDescription.load("pupper_v2")
    offsets = np.linspace(-0.02, 0.02, 12)
    nominal = PhysicalParams.nominal(robot, 40).with_values(robot, motor_offset=offsets[None])
    ranges: Ranges = {
        "motor_friction": RelativeRange(scale=(0.0, 2.0), independent=True),
        "servo_kp": RelativeRange(scale=(0.9, 1.1)),
        "motor_offset": RelativeRange(add=(-0.01, 0.01)),
    }
    randomizer = Randomizer(ranges, robot, nominal, 3)
    drawn = randomizer.draw(np.arange(40))
    factors = drawn.servo_kp / nominal.servo_kp
    assert np.ptp(factors, axis=1).max() < 1e-12
    assert 0.9 <= factors.min() < 0.92
    assert 1.08 < factors.max() <= 1.1
    assert np.ptp(drawn.motor_friction / nominal.motor_friction, axis=1).min() > 0.5
    assert np.abs(drawn.motor_offset - offsets).max() <= 0.01
    scaled = randomizer.scaled(drawn)
    assert scaled.shape == (40, 12 + 1 + 12) == (40, len(randomizer.columns))
    np.testing.assert_allclose(scaled[:, 12], 10 * (factors[:, 0] - 1))
    assert np.abs(scaled).max() <= 1.0 + 1e-9
    # Draws of other parameters do not depend on these.
    friction: Ranges = {"contact_friction": (0.5, 1.0)}
    first, second = (Randomizer(one, robot, nominal, 3).draw(np.arange(40)) for one in (ranges | friction, friction))
    np.testing.assert_array_equal(first.contact_friction, second.contact_friction)


def test_a_shared_draw_scales_every_motor_by_one_factor(robot):
    nominal = PhysicalParams.nominal(robot, 5)
    strength = RelativeRange(scale=(0.8, 1.2), independent=False)
    randomizer = Randomizer({"motor_strength": strength, "voltage": (14.0, 15.0)}, robot, nominal, 3)
    drawn = randomizer.draw(np.arange(5))
    assert np.ptp(drawn.motor_strength, axis=1).max() == 0
    assert randomizer.columns == ["motor_strength", "voltage"]
    # The first motor's number, where each draws its own.
    each = Randomizer({"motor_strength": (0.8, 1.2)}, robot, nominal, 3).draw(np.arange(5))
    np.testing.assert_array_equal(drawn.motor_strength[:, 0], each.motor_strength[:, 0])


def test_relative_draws_are_cut_to_what_the_robot_allows(robot):
    ranges: Ranges = {"imu_noise": RelativeRange(add=(-0.2, -0.1)), "control_step": RelativeRange(scale=(100.0, 200.0))}
    drawn = Randomizer(ranges, robot, PhysicalParams.nominal(robot, 5), 3).draw(np.arange(5))
    assert np.all(drawn.imu_noise == 0.0)
    assert np.all(drawn.control_step == 0.05)


def test_each_axis_draws_from_its_own_interval(robot):
    ranges: Ranges = {"imu_mount": ((0.0, 0.0), (-0.2, -0.1), (0.1, 0.2))}
    randomizer = Randomizer(ranges, robot, PhysicalParams.nominal(robot, 50), 3)
    drawn = randomizer.draw(np.arange(50)).imu_mount
    assert np.all(drawn[:, 0] == 0.0)
    assert np.all((drawn[:, 1] >= -0.2) & (drawn[:, 1] <= -0.1))
    assert np.all((drawn[:, 2] >= 0.1) & (drawn[:, 2] <= 0.2))
    assert abs(np.corrcoef(drawn[:, 1], drawn[:, 2])[0, 1]) < 0.5


# --- ranges of an identified robot ------------------------------------------------------------------------


def test_ranges_of_an_identified_robot_are_its_intervals():
    robot = RobotDescription.load("pupper_v2")
    file = read_params(robot.folder / "identified.toml", robot)
    intervals, ranges = file.tables["intervals"], load_ranges("identified", robot="pupper_v2")
    assert ranges.keys() == intervals.keys()
    for name in ("contact_friction", "servo_kp", "contact_shear_ratio"):
        assert ranges[name] == tuple(intervals[name])
    for name in ("motor_friction", "motor_offset"):
        assert ranges[name] == tuple(map(tuple, intervals[name]))
    # An axis without an interval keeps its value.
    assert ranges["imu_mount"] == ((0.0, 0.0), (0.0, 0.0), tuple(intervals["imu_mount"][2]))
    drawn = Randomizer(ranges, robot, file.params.rows([0] * 20), 1).draw(np.arange(20))
    assert np.all(drawn.imu_mount[:, :2] == 0.0)
    assert np.ptp(drawn.contact_shear_ratio) > 0.1
    low, high = np.transpose(intervals["motor_friction"])
    assert np.all((drawn.motor_friction >= low) & (drawn.motor_friction <= high))
    with pytest.raises(SurefootError, match="randomize 'identified' does not exist"):
        load_ranges("identified", robot="minitaur")


@pytest.mark.parametrize(
    ("intervals", "message"),
    [
        ("", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = [nan, nan]", "has no intervals to draw from"),
        ("[intervals]\ncontact_friction = 0.5", r"intervals\.contact_friction: must be a pair of numbers"),
        ('[intervals]\ncontact_friction = ["low", "high"]', r"intervals\.contact_friction: must be a pair of numbers"),
        ("[intervals]\ncontact_friction = [[0.4, 0.5, 0.6]]", r"intervals\.contact_friction: must be a pair"),
        ("[intervals]\nimu_mount = [[0.0, 0.1]]", r"fit\.toml: randomize\.imu_mount has 1 intervals; it must have one"),
    ],
)
def test_a_file_without_intervals_is_refused(tmp_path: Path, intervals: str, message: str):
    folder = tmp_path / "pupper_v2"
    shutil.copytree(RobotDescription.load("pupper_v2").folder, folder)
    (folder / "fit.toml").write_text(f"[params]\ncontact_friction = 0.5\n{intervals}\n")
    with pytest.raises(SurefootError, match=message):
        load_ranges("fit", robot=folder)
