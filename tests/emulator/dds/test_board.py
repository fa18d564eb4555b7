"""The emulated Go2 without DDS: the vendor's PD law, motions and messages worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cyclonedds")

from emulated_go2 import FOLDED, GO2, STANDING, Robot, Wire

from surefoot.deploy.dds import low_level
from surefoot.deploy.dds.low_level import POS_STOP, VEL_STOP
from surefoot.emulator.dds.board import Go2Board, read_joint_command
from surefoot.emulator.plant import Plant


def joint_command(**fields: object) -> object:
    command = low_level.new_command()
    for name, value in fields.items():
        command["motor_cmd"][name][0] = value
    return read_joint_command(command, 12)


def test_the_vendors_special_values_switch_terms_off() -> None:
    usual = joint_command(q=0.5, dq=2.0, tau=3.0, kp=40.0, kd=1.0)
    assert (usual.angle[0], usual.speed[0], usual.feedforward[0], usual.kp[0], usual.kd[0]) == (0.5, 2, 3, 40, 1)
    assert joint_command(q=POS_STOP, dq=2.0, kp=40.0, kd=1.0).kp[0] == 0
    assert joint_command(q=0.5, dq=VEL_STOP, kp=40.0, kd=1.0).kd[0] == 0
    off = joint_command(q=0.5, dq=2.0, tau=3.0, kp=40.0, kd=1.0, mode=0)
    assert (off.feedforward[0], off.kp[0], off.kd[0]) == (0, 0, 0)
    assert joint_command(q=np.nan) is None
    assert joint_command(kd=np.inf) is None


def test_torques_follow_the_vendors_law_up_to_the_drives_limits() -> None:
    robot = Robot(rack=True)
    robot.run(0.002)
    q, dq, kp, kd, tau = 0.3, 1.5, 20.0, 2.0, -1.0
    robot.command(q=q, dq=dq, kp=kp, kd=kd, tau=tau)
    state = robot.run(0.004)
    # The torque of a step follows from the angles and speeds one `servo_latency` earlier: one step of 2 ms.
    before = robot.wire.states[-3]["motor_state"][:12]
    expected = tau + kp * (q - before["q"]) + kd * (dq - before["dq"])
    limits = np.tile([23.7, 23.7, 45.43], 4)
    torque = state["motor_state"]["tau_est"][:12]
    np.testing.assert_allclose(torque, np.clip(expected, -limits, limits), rtol=1e-5)
    robot.command(tau=[100.0, -100.0, 0.0] * 4)
    torque = robot.run(0.004)["motor_state"]["tau_est"][:12]
    np.testing.assert_allclose(torque, [23.7, -23.7, 0.0] * 4, rtol=1e-6)


def test_states_of_a_robot_at_rest_at_500_hz() -> None:
    robot = Robot()
    robot.run(2.0)
    states = robot.wire.states
    assert np.diff([int(state["tick"]) for state in states]).tolist() == [2] * 999
    state = states[-1]
    assert state["head"].tolist() == [0xFE, 0xEF]
    # A body at rest measures the upward reaction of the ground.
    np.testing.assert_allclose(state["imu_state"]["accelerometer"], [0, 0, 9.81], atol=0.1)
    np.testing.assert_allclose(np.abs(state["imu_state"]["quaternion"]), [1, 0, 0, 0], atol=0.02)
    motors = state["motor_state"]
    assert motors["mode"].tolist() == [1] * 12 + [0] * 8
    assert all(5 <= lost <= 12 for lost in motors["lost"][:12])
    assert not motors["q"][12:].any()
    assert motors["reserve"][:12].tolist() == [[0, 525]] * 12
    assert state["bms_state"]["cell_vol"][:8].sum() == pytest.approx(1000 * state["power_v"], abs=8)
    assert not state["bms_state"]["cell_vol"][8:].any()
    # Motors without torque: the robot lies on its belly, and its feet carry little.
    assert abs(motors["tau_est"][:12]).max() == 0
    assert robot.height < 0.15


@pytest.mark.parametrize("engine", ["mujoco", "bullet"])
def test_the_vendors_stand_up_raises_the_body_and_it_stays_when_commands_stop(engine: str) -> None:
    if engine == "bullet":
        pytest.importorskip("pybullet")
    robot = Robot(engine=engine)
    robot.run(0.2)
    low = robot.height
    robot.move(FOLDED, 1.0)
    robot.move(STANDING, 1.0)
    robot.command(q=STANDING, kp=60, kd=5)
    state = robot.run(1.5)  # without commands, motors hold the last one
    high = robot.height
    assert low < 0.13
    # Links of 0.213 m at these angles and feet of 0.022 m; soft motors yield a little.
    assert 0 < 0.213 * (np.cos(0.67) + np.cos(1.3 - 0.67)) + 0.022 - high < 0.03
    assert state["foot_force"].sum() == pytest.approx(GO2.weight, rel=0.15)
    np.testing.assert_allclose(state["imu_state"]["accelerometer"], [0, 0, 9.81], atol=0.3)
    np.testing.assert_allclose(state["imu_state"]["rpy"][:2], 0, atol=0.05)
    assert 3 < abs(state["motor_state"]["tau_est"][2:12:3]).max() < 12  # a recorded robot: 5 to 10 N m
    # Without gains it sinks.
    robot.command(mode=0)
    robot.run(1.0)
    assert robot.height < 0.15


def test_the_battery_agrees_with_a_recorded_robot() -> None:
    # 8 cells of 3.83 V at 63 %.
    plant = Plant(GO2, accelerometer=True)
    plant.start_voltage, wire = 8 * 3.83, Wire()
    Go2Board(plant, wire, 0.0).run_to(4_000)
    assert wire.state["bms_state"]["soc"] == 63
    assert wire.state["bms_state"]["cell_vol"][0] == pytest.approx(3830, abs=3)
