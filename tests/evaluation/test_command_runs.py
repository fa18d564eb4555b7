"""Driven robots: commands, parameters and pushes in a running simulation, recordings, and rejected input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.api.policies import find_policy, load_gait
from surefoot.errors import SurefootError
from surefoot.evaluation.command_runs import FIXED_PARAMETERS, DrivenRobot
from surefoot.evaluation.recorded import ground_for_trace
from surefoot.robot.params import PARAMETERS, PhysicalParams
from surefoot.task.randomized_params import RandomizedParams


def driven(name: str, world: str = "mujoco", **changes: object) -> DrivenRobot:
    policy, _, task, _ = load_gait(find_policy(name), None)
    return DrivenRobot(policy, replace(task, **changes), world)


@pytest.fixture(scope="module")
def go2() -> DrivenRobot:
    return driven("go2-steer")


@pytest.fixture
def robot(go2: DrivenRobot) -> DrivenRobot:
    go2.restart()
    return go2


def run(robot: DrivenRobot, seconds: float) -> np.ndarray:
    """Run for some time [s] and return the velocities."""
    return np.array([robot.step().velocity for _ in range(round(seconds / robot.step_time))])


def test_robot_and_recording_have_the_chosen_terrain():
    policy, _, task, _ = load_gait(find_policy("go2-steer"), None)
    robot = DrivenRobot(policy, task, "mujoco", "blocks:0.03")
    recording = robot.record("go2-steer")
    robot.step()
    trace = recording.trace()
    assert trace.meta["terrain"] == "blocks:0.03"
    np.testing.assert_array_equal(ground_for_trace(trace).corners, robot.env.state.ground.corners)
    assert robot.env.state.ground.corners.max() > 0.02


def test_a_command_is_clamped_to_the_limits_and_followed(robot: DrivenRobot):
    assert robot.limits is not None
    top = robot.limits.forward[1]
    robot.command([10.0, 0.0, 0.0])
    run(robot, 2.0)
    assert robot.rows[-1].command[0] == pytest.approx(top)
    assert run(robot, 1.0)[:, 0].mean() == pytest.approx(top, rel=0.2)
    # An episode begins with standing.
    robot.restart()
    assert robot.step().command[0] == 0.0


def test_the_third_command_is_the_yaw_rate(robot: DrivenRobot):
    robot.command([0.0, 0.0, 0.8])
    run(robot, 1.5)
    before = robot.env.state.truth.roll_pitch_yaw[0, 2]
    turned = run(robot, 1.0)[:, 2]
    after = robot.env.state.truth.roll_pitch_yaw[0, 2]
    assert turned.sum() * robot.step_time == pytest.approx((after - before) % (2 * np.pi), abs=1e-9)
    assert turned.mean() == pytest.approx(0.8, abs=0.15)


def test_a_push_lasts_its_duration_in_the_heading_frame(robot: DrivenRobot):
    robot.command([0.0, 0.0, 1.0])
    run(robot, 1.6)
    robot.command([0.0, 0.0, 0.0])
    run(robot, 1.0)
    yaw = robot.env.state.truth.roll_pitch_yaw[0, 2]
    assert abs(yaw) > 0.8
    robot.push([0.0, 100.0, 0.0], 0.1)
    speed = run(robot, 0.1)[-1]
    # 100 N for 0.1 s give 16 kg a sideways speed of 0.6 m/s, minus the effect of feet on the ground.
    assert 0.2 < speed[1] < 0.65
    assert abs(speed[0]) < 0.15
    # After the push the feet stop the robot.
    assert np.abs(run(robot, 1.5)[-20:, 1]).mean() < 0.1


@pytest.mark.parametrize("force", [[np.nan, 0, 0], [0, 0, 1e9], [1, 2]])
def test_push_rejects_forces_and_durations_out_of_bounds(robot: DrivenRobot, force: list[float]):
    with pytest.raises(SurefootError, match="push: must be up to 2000 N"):
        robot.push(force, 0.1)
    with pytest.raises(SurefootError, match="up to 10 s"):
        robot.push([1.0, 0.0, 0.0], 11.0)


def test_every_live_parameter_returns_the_value_that_was_set(robot: DrivenRobot):
    parameters = robot.live_parameters()
    assert not {parameter.name for parameter in parameters} & set(FIXED_PARAMETERS)
    for parameter in parameters:
        value = float(np.clip(1.1 * parameter.value + 1e-3, parameter.low, parameter.high))
        robot.set(parameter.name, value)
        now = next(one.value for one in robot.live_parameters() if one.name == parameter.name)
        assert now == pytest.approx(value, rel=1e-9), parameter.name
        robot.set(parameter.name, parameter.value)
    robot.step()


def names(robot: DrivenRobot) -> set[str]:
    return {parameter.name.partition(".")[0] for parameter in robot.live_parameters()}


def test_live_parameters_are_those_of_motors_and_engine(robot: DrivenRobot):
    bullet_only = {name for name, declared in PARAMETERS.items() if declared.engines}
    assert bullet_only == {"knee_friction", "knee_play", "floor_unevenness"}
    joint = {"voltage", "torque_constant", "resistance", "voltage_clip"}
    assert names(robot) == set(PARAMETERS) - set(FIXED_PARAMETERS) - bullet_only - joint
    assert {parameter.group for parameter in robot.live_parameters()} == {"body", "motors", "contact", "sensors"}
    units = {parameter.name: parameter.unit for parameter in robot.live_parameters()}
    assert [units[name] for name in ("servo_kp", "base_mass_ratio", "contact_friction", "imu_bias.roll")] == [
        *("N m/rad", "x nominal", "", "rad")
    ]
    with pytest.raises(SurefootError, match="'knee_play' is not a parameter of go2 that can be set"):
        robot.set("knee_play", 0.0)


def test_constraint_motors_have_no_servo_parameters():
    robot = driven("steer", actuator="constraint")
    assert not names(robot) & {"servo_latency", "load_friction", "speed_filter", "presliding"}
    assert {parameter.name: parameter.unit for parameter in robot.live_parameters()}["servo_kp"] == "1/rad"


def test_bullet_has_parameters_of_its_own():
    pytest.importorskip("pybullet")
    assert {"knee_friction", "knee_play", "floor_unevenness"} < names(driven("go2-steer", "bullet"))


@pytest.mark.parametrize(("name", "value"), [("speed", 1.0), ("control_step", 0.01), ("base_mass_ratio", 99.0)])
def test_set_rejects_an_unknown_parameter_and_a_value_out_of_bounds(robot: DrivenRobot, name: str, value: float):
    before = robot.env.world.params.rows(np.array([0]))  # a copy
    with pytest.raises(SurefootError, match=name):
        robot.set(name, value)
    now = robot.env.world.params
    for parameter in PhysicalParams.names():
        np.testing.assert_array_equal(getattr(now, parameter)[:1], getattr(before, parameter), err_msg=parameter)


def test_different_motors_keep_their_ratios():
    robot = driven("pupper_v2-trot")
    kp = robot.env.nominal.servo_kp[0]
    robot.set("servo_kp", 2.0 * float(kp.mean()))
    assert robot.env.world.params.servo_kp[0] == pytest.approx(2.0 * kp)


def test_a_fallen_robot_is_reset_after_a_while(robot: DrivenRobot):
    falls, restarts = robot.falls, robot.restarts
    robot.push([0.0, 1500.0, 0.0], 0.3)
    run(robot, 1.2)
    assert robot.falls == falls + 1
    assert robot.restarts == restarts
    run(robot, 2.0)
    assert robot.restarts == restarts + 1
    assert np.abs(robot.env.state.truth.roll_pitch_yaw[0, :2]).max() < 0.2


def test_pushes_and_randomization_of_the_task_are_off():
    robot = driven("go2-trot-robust")
    run(robot, 1.0)
    assert not any(isinstance(one, RandomizedParams) for one in robot.env.components)
    assert not np.any(robot.env.state.push_force)


def test_a_policy_without_commands_rejects_commands():
    robot = driven("go2-trot")
    assert robot.limits is None
    with pytest.raises(SurefootError, match="this policy follows no commands"):
        robot.command([0.0, 0.0, 0.0])
    assert np.isnan(robot.step().command).all()


def test_a_recording_is_a_trace_with_its_pushes_and_ends_with_a_restart(robot: DrivenRobot):
    robot.command([0.5, 0.0, 0.0])
    run(robot, 0.5)
    recording, begin, step = robot.record("go2-steer"), robot.rows[-1].position, robot.step_time
    run(robot, 10 * step)
    robot.push([0.0, 60.0, 0.0], 4 * step)
    force = np.linalg.norm(robot.push_force_world)
    run(robot, 20 * step)
    robot.restart()
    run(robot, 0.2)
    trace = recording.trace()
    assert (trace.num_steps, trace.duration) == (30, pytest.approx(30 * step))
    assert trace.base_position_world[0] == pytest.approx(begin)
    assert trace.meta["ended"] == "stopped"
    assert (trace.command[:, 0] == 0.5).all()
    pushed = np.linalg.norm(trace.push_force_world, axis=1)
    assert force == pytest.approx(60.0)
    assert np.flatnonzero(pushed > 0.0).tolist() == [10, 11, 12, 13]
    assert pushed.max() == pytest.approx(force)


def test_a_recording_ends_with_a_fall_and_at_its_maximum_length(robot: DrivenRobot, monkeypatch: pytest.MonkeyPatch):
    recording = robot.record("go2-steer")
    with pytest.raises(SurefootError, match="no control step was recorded"):
        recording.trace()
    robot.push([0.0, 1500.0, 0.0], 0.3)
    run(robot, 1.2)
    assert recording.ended == "fall"
    assert recording.duration < 1.2
    robot.restart()
    monkeypatch.setattr("surefoot.evaluation.command_runs.MAX_RECORDING", 10 * robot.step_time)
    recording = robot.record("go2-steer")
    run(robot, 0.4)
    assert (recording.ended, recording.duration) == ("time", pytest.approx(10 * robot.step_time))
