"""Domain randomization in environments: effects on physics and motors, and when parameters are drawn."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from surefoot.robot import PhysicalParams
from surefoot.robot.randomization import Ranges, load_ranges
from surefoot.task.config import FeedbackConfig, TaskConfig
from surefoot.task.env import LocomotionEnv
from surefoot.task.pushes import PushConfig
from surefoot.task.randomized_params import RandomizedParams
from surefoot.world.mujoco_model import build_model
from surefoot.world.sim_world import SimWorld

TABLE_1 = load_ranges("table1")
FULL: Ranges = {
    **TABLE_1,
    **{"torque_constant": (0.08, 0.11), "resistance": (0.15, 0.22), "servo_latency": (0.0, 0.010)},
    **{"voltage_clip": (3.0, 5.0)},
    **{"contact_stiffness": (1500.0, 6000.0), "contact_spinning_friction": (0.002, 0.006), "imu_mount": (-0.02, 0.02)},
}
STILL: dict[str, Any] = {
    "feedback": FeedbackConfig(swing=(-0.5, 0.5), extension=(1.5, 2.5)),
    "start_linear_speed": 0.0,
    "start_angular_speed": 0.0,
}


def make_env(ranges: Ranges, num_envs: int = 4, seed: int = 1, autoreset: bool = True, **task: Any) -> LocomotionEnv:
    """Make an environment with these ranges and no initial velocity."""
    config = TaskConfig(**{**STILL, "randomize": ranges, **task})
    return LocomotionEnv(config, num_envs, SimWorld, seed, autoreset, threads=1)


RATIOS = ("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio")
FINE = {"control_step": 0.001}
"""One command per servo step, so that the true state of every servo step is available."""


def wave(env: LocomotionEnv, k: int) -> np.ndarray:
    """Return motor angles that move all legs, for the servo step k."""
    phase = 2 * np.pi * 2.0 * 0.001 * k + np.array([0, np.pi, np.pi, 0])
    return env.robot.pose_angles(0.3 * np.sin(phase), 2.0 + 0.35 * np.sin(phase))


def test_weight_and_foot_penetration_follow_the_randomized_parameters(robot):
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
    """Return a separate model with the randomized masses and inertias of robot i, except `without`."""
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
    """Return the coordinates after each servo step with the given forces, from a state of the engine."""
    data = mujoco.MjData(model)
    mujoco.mj_setState(model, data, start, mujoco.mjtState.mjSTATE_INTEGRATION)
    path = []
    for joint_force, body_force in forces:
        data.qfrc_applied[:], data.xfrc_applied[:] = joint_force, body_force
        mujoco.mj_step(model, data)
        path.append(data.qpos.copy())
    return np.array(path)


def test_motion_equals_that_of_a_separate_model():
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
    """Return the torque on each motor's shaft (steps, N, M) by eq. 5 to 7 of the paper, with `changed` parameters."""
    params = env.world.params.with_values(env.robot, **changed)
    time = 0.001 * np.arange(len(angle))
    expected = np.empty_like(angle)
    for i, m in np.ndindex(*angle.shape[1:]):
        seen, turning = (np.interp(time - params.servo_latency[i], time, x[:, i, m]) for x in (angle, speed))
        duty = params.servo_kp[i, m] * (target[:, m] - seen) - params.servo_kd[i, m] * turning
        now = speed[:, i, m]
        net = np.clip(duty, -1, 1) * params.voltage[i] - params.torque_constant[i] * now
        current = np.clip(net, -params.voltage_clip[i], params.voltage_clip[i]) / params.resistance[i]
        torque = np.sign(current) * np.interp(np.abs(current), *env.robot.torque_table) * params.motor_strength[i, m]
        expected[:, i, m] = torque - params.motor_friction[i, m] * np.tanh(now / 0.1)
    return expected


def test_motor_torques_follow_the_randomized_parameters():
    names = ("motor_strength", "motor_friction", "voltage", "torque_constant", "resistance", "servo_latency")
    names = (*names, "voltage_clip")
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
        differs = apart > 1e-6
        # It differs for each motor of each robot; the limit only for motors with high currents.
        assert np.all(differs.any(axis=1) if name == "voltage_clip" else differs)


# --- when parameters are drawn -------------------------------------------------------------------------------------


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


def drawn_anew(env: LocomotionEnv, before: PhysicalParams) -> list[bool]:
    """Return whether each robot has new parameters: all of the table, or none."""
    now = env.world.params
    columns = [np.reshape(getattr(now, name) != getattr(before, name), (env.num_envs, -1)).any(1) for name in TABLE_1]
    assert np.array_equal(np.all(columns, axis=0), np.any(columns, axis=0))
    return np.all(columns, axis=0).tolist()


def copy_params(env: LocomotionEnv) -> PhysicalParams:
    return env.world.params.rows(np.arange(env.num_envs))


def test_every_reset_randomizes_the_robots_that_restart():
    env = make_env(TABLE_1)
    assert drawn_anew(env, PhysicalParams.nominal(env.robot, 4)) == [True] * 4
    for mask in ([True] * 4, [False, True, False, True]):
        before = copy_params(env)
        env.reset(options={"reset_mask": np.array(mask)})
        assert drawn_anew(env, before) == mask


def test_only_a_robot_that_falls_is_randomized_again():
    env = make_env(TABLE_1)
    env.reset()
    before, strength = copy_params(env), env.world.actuation.strength.copy()
    env.step(np.zeros((4, 8)))
    assert drawn_anew(env, before) == [False] * 4
    env.world.engine.datas[2].qpos[3:7] = np.cos(0.5), np.sin(0.5), 0.0, 0.0  # rolled by 1 rad
    *_, terminated, _, _ = env.step(np.zeros((4, 8)))
    assert drawn_anew(env, before) == terminated.tolist() == [False, False, True, False]
    # The new parameters have reached the actuation.
    assert np.array_equal(env.world.actuation.strength != strength, np.repeat([[False, False, True, False]], 8, 0).T)


@pytest.mark.parametrize("autoreset", [True, False])
def test_the_end_of_an_episode_randomizes_with_autoreset(autoreset: bool):
    env = make_env(TABLE_1, max_steps=3, autoreset=autoreset)
    env.reset()
    before = copy_params(env)
    for step in range(4):
        assert drawn_anew(env, before) == [autoreset and step == 3] * 4
        env.step(np.zeros((4, 8)))


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


def test_an_environment_continues_exactly_from_a_state():
    env, other = (make_env(FULL, num_envs=2, seed=seed, **PUSHED) for seed in (1, 2))
    run(env, 30)
    state = env.get_state()
    path = run(env, 45)  # includes several resets, whose parameters are drawn after the state was saved
    for one in (other, env):
        one.set_state(state)
        assert same_path(path, run(one, 45))


def test_a_range_of_the_nominal_value_equals_no_range(robot):
    ranges = {name: (value, value) for name, value in robot.nominal_params().items() if name in FULL}
    values = {"max_steps": 15, "start_linear_speed": 0.05}
    env, plain = make_env(ranges, **values), make_env({}, **values)
    has_ranges = [any(isinstance(part, RandomizedParams) for part in one.components) for one in (env, plain)]
    assert has_ranges == [True, False]
    assert same_path(run(env, 40), run(plain, 40))


def test_privileged_observations_include_the_randomized_parameters():
    plain = make_env({}).privileged().shape[1]
    for ranges, width in (
        ({"motor_friction": (0.0, 0.05)}, 1),
        ({"imu_bias": (-0.05, 0.05), "control_latency": (0.01, 0.01)}, 2),
        (TABLE_1, 20),
    ):
        env = make_env(ranges)
        grown = env.privileged()
        assert grown.shape[1] - plain == width
        scaled = env.component(RandomizedParams).randomizer.normalize(env.world.params)
        np.testing.assert_allclose(grown[:, -width:], scaled, atol=1e-6)
