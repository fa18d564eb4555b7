"""Effects of each fault of an emulated Go2 on its messages and motors."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("cyclonedds")

from emulated_go2 import GO2, STANDING, Robot

from surefoot.deploy.dds.low_level import RemoteControl
from surefoot.emulator.fault_table import FAULTS

TESTED = {
    *("corrupt", "drop", "duplicate", "reorder", "unplug", "swap-motors", "flip-sign", "flip-encoder", "imu-flip"),
    *("stale-state", "repeat-sequence", "backward-sequence", "late-states", "battery-low", "motor-hot", "tilt"),
    *("reboot", "hang", "not-finite", "tick-restart", "slow-states", "other-layout", "motor-off", "motor-lost"),
    *("second-writer", "service-back", "remote-stop", "remote-stick"),
}


def run(fault: str, seconds: float = 0.3, **how: bool) -> Robot:
    """Return a robot that has run with a fault, with commands to hold a pose from 0.1 s on."""
    robot = Robot(fault, rack=True, **how)
    robot.run(0.1)
    for _ in range(round(seconds / 0.002)):
        robot.command(q=STANDING, kp=60, kd=5)
        robot.run(0.002)
    return robot


def ticks(robot: Robot) -> np.ndarray:
    return np.array([int(state["tick"]) for state in robot.wire.states])


def test_every_fault_of_this_link_is_tested_here_or_as_a_process() -> None:
    others = {"overload", "no-service"}
    assert {name for name, kind in FAULTS.items() if "dds" in kind.links} == TESTED | others


def test_faults_in_transit() -> None:
    healthy = run("drop=0")
    assert np.diff(ticks(healthy)).tolist() == [2] * 199
    dropped = len(run("drop=0.5").wire.sent)
    assert 60 < dropped < 140
    corrupt = run("corrupt=0.5")
    assert len(corrupt.wire.sent) == 200
    assert 60 < len(corrupt.wire.states) < 140
    assert 240 < len(run("duplicate=0.5").wire.sent) < 360
    assert (np.diff(ticks(run("reorder=0.3"))) < 0).any()
    assert ticks(run("unplug=0.1"))[-1] == pytest.approx(200, abs=4)
    late = run("late-states=0.02@0.1")
    assert {at - 1000 * int(tick) for (at, _), tick in zip(late.wire.sent, ticks(late), strict=True)} == {0, 20_000}
    assert np.diff(ticks(run("slow-states=100")))[1:].tolist() == [10] * 39
    layouts = run("other-layout@0.1").wire
    assert {len(data) for _, data in layouts.sent} == {1180, 1168}
    assert len(layouts.states) == pytest.approx(100, abs=3)


def test_faults_of_sequence_numbers() -> None:
    frozen = [data for _, data in run("stale-state=0.1").wire.sent]
    assert len(set(frozen[-90:])) == 1
    assert len(set(ticks(run("repeat-sequence=0.1"))[-90:])) == 1
    assert (np.diff(ticks(run("backward-sequence=0.1"))[-90:]) < 0).all()
    restarted = ticks(run("tick-restart=0.1"))
    assert np.diff(restarted).min() == pytest.approx(-202, abs=4)
    assert restarted[-1] == pytest.approx(200, abs=4)
    assert np.isnan(run("not-finite=0.1").wire.state["motor_state"]["q"][0])


def test_a_program_that_hangs_or_restarts() -> None:
    gaps = np.diff(ticks(run("hang=0.1@0.1")))
    assert (gaps.max(), np.sort(gaps)[-2]) == (102, 2)
    robot = run("reboot=0.05", 0.4)
    assert ticks(robot).max() == pytest.approx(150, abs=4)
    assert ticks(robot)[-1] == pytest.approx(1000 * (0.5 - 0.15 - 0.2), abs=4)
    # A restarted robot has lost its last command.
    restarted = Robot("reboot=0.05", rack=True)
    restarted.command(q=STANDING, kp=60, kd=5)
    assert abs(restarted.run(1.0)["motor_state"]["tau_est"]).max() == 0


def test_faults_of_motors_and_wiring_act_on_joint_commands() -> None:
    q = run("drop=0", 0.6).wire.state["motor_state"]["q"][:12]
    np.testing.assert_allclose(q, STANDING, atol=0.03)
    swapped = run("swap-motors=1", 0.6).wire.state["motor_state"]["q"][:12]
    assert swapped[1] < 0
    turned = run("flip-sign=4", 0.6).wire.state["motor_state"]["q"][:12]
    assert turned[4] == pytest.approx(2 * GO2.resting_angles[4] - STANDING[4], abs=0.03)
    read = run("flip-encoder=4", 0.6).wire.state["motor_state"]["q"][:12]
    assert read[4] == pytest.approx(2 * GO2.resting_angles[4] - q[4], abs=0.01)
    off = run("motor-off=2@0.1").wire.state["motor_state"]
    assert (off["mode"][2], off["tau_est"][2], off["mode"][1]) == (0, 0, 1)
    assert off["lost"][2] > 90
    lost = run("motor-lost=2@0.1").wire.states
    assert lost[-1]["motor_state"]["lost"][2] - lost[-11]["motor_state"]["lost"][2] == 10
    assert lost[-1]["motor_state"]["q"][2] == lost[-90]["motor_state"]["q"][2]
    assert run("motor-hot=60@0.1", 1.2).wire.state["motor_state"]["temperature"][:12].tolist() == [60] + [25] * 11
    low = run("battery-low=22@0.1", 1.0).wire.states
    assert low[-1]["power_v"] < low[0]["power_v"] - 1.5
    assert low[-1]["bms_state"]["cell_vol"][0] < low[0]["bms_state"]["cell_vol"][0] - 180


def test_a_wrongly_mounted_imu_has_consistent_gravity_and_orientation() -> None:
    leaning = STANDING.copy()
    leaning[[2, 5, 8]] = -1.6, -1.45, -1.45  # front and right legs are shorter
    for way in range(4):
        robot = Robot(f"imu-flip={way}")
        robot.run(0.1)
        robot.move(leaning, 0.5)
        imu = robot.run(1.0)["imu_state"]
        roll, pitch, _ = imu["rpy"]
        assert min(abs(roll), abs(pitch)) > 0.03
        gravity = 9.81 * np.array([-np.sin(pitch), np.sin(roll) * np.cos(pitch), np.cos(roll) * np.cos(pitch)])
        np.testing.assert_allclose(imu["accelerometer"], gravity, atol=0.1)


def test_other_programs_and_the_remote_control() -> None:
    writer = run("second-writer=0.1")
    assert len(writer.wire.published) == pytest.approx(100, abs=3)
    assert writer.wire.published[-1]["motor_cmd"]["kp"][:12].tolist() == [5] * 12
    # From the start, if it must act before the first command.
    silent = Robot("second-writer=0", rack=True)
    silent.run(0.1)
    assert len(silent.wire.published) == 50
    back = run("service-back=0.1")
    assert back.controller.name == "mcf"
    assert len(back.wire.published) == pytest.approx(100, abs=3)
    stop = RemoteControl.decode(run("remote-stop=0.1").wire.state["wireless_remote"])
    assert stop.buttons == {"L2", "B"}
    assert RemoteControl.decode(run("remote-stick=0.1").wire.state["wireless_remote"]).left_y == pytest.approx(0.8)
    assert not run("remote-stick=9").wire.state["wireless_remote"].any()


def test_a_push_topples_it() -> None:
    robot = Robot("tilt=0.1")
    robot.run(0.01)
    robot.move(STANDING, 1.0)
    assert abs(robot.run(1.0)["imu_state"]["rpy"][0]) > 1
