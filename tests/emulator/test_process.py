"""The emulator on a real pseudo-terminal, as a process, in real time and in lockstep."""

from __future__ import annotations

import itertools
import os
import signal
import time

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc

pytest.importorskip("mujoco")

from surefoot.cli.main import main
from surefoot.deploy.board.signals import MotorCommand
from surefoot.deploy.links import open_link
from surefoot.deploy.messages import Arm, Fault, Handshake, Hello, Mode, Ping, Pong, Position, Reason, State
from surefoot.deploy.robot_link import RobotLink
from surefoot.emulator.hardware import PowerConfig, SensorConfig
from surefoot.emulator.plant import Plant
from surefoot.errors import SurefootError
from surefoot.world.actuation import set_actuation_params
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

ME, OTHER = 7, 8
STEP = 0.006


def follow(host, robot, seconds: float) -> list[float]:
    """Move the robot to other angles in real time; return the times of its states on its clock [s]."""
    first = host.wait_for(State).message.motor_angle
    last = robot.pose_angles(0.0, 1.2)
    start, times = host.now(), []
    for step in itertools.count():
        at = start + step * STEP
        share = min(step * STEP / (seconds - 0.2), 1.0)
        while (left := at - host.now()) > 0:
            times += [frame.time for frame in host.receive(left) if isinstance(frame.message, State)]
        if at - start > seconds:
            return times
        host.send(Position(ME, first + (last - first) * share))
    raise AssertionError


@pytest.mark.realtime
def test_a_session_in_real_time(emulate, robot):
    process = emulate("--rack")
    host = process.host()
    host.send(Hello(ME, 0.010))
    handshake = host.wait_for(Handshake).message
    assert (handshake.session, handshake.robot) == (ME, "minitaur")
    assert handshake.firmware.startswith("surefoot emulator ")

    # States have the requested period on the robot's clock.
    times = [host.wait_for(State).time for _ in range(30)]
    np.testing.assert_allclose(np.diff(times), 0.010, atol=0.0021)

    # Armed, it follows.
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP - 0.003))
    host.wait_for(State, lambda state: state.mode == Mode.POSITION)
    times = follow(host, robot, 0.6)
    assert np.median(np.diff(times)) == pytest.approx(STEP, abs=0.0015)
    newest = [frame.message for frame in host.frames if isinstance(frame.message, State)][-1]
    assert newest.mode == Mode.POSITION
    np.testing.assert_allclose(newest.motor_angle, 1.2, atol=0.05)
    assert 15.0 < newest.voltage < 16.1

    code, output = process.stop()
    assert code == 0
    assert "of robot time" in output


def test_hosts_connect_and_leave_and_the_robot_never_blocks(emulate_here):
    emulator = emulate_here("--baud", "0", "--rack")
    for _ in range(3):
        emulator.host().send(Hello(ME, 0.001))
        time.sleep(0.02)
    while not emulator.unread:  # no host reads the states at 1 kHz
        time.sleep(0.01)
    # Once there is room, states arrive again.
    reader = emulator.host()
    while reader.receive():
        pass
    reader.send(Ping(99))
    reader.wait_for(Pong, lambda pong: pong.token == 99)


@pytest.mark.parametrize(("number", "words"), [(signal.SIGINT, ["--lockstep"]), (signal.SIGHUP, ["--rack"])])
def test_a_signal_ends_the_emulator_and_removes_its_link(emulate, tmp_path, number, words):
    link, seen = tmp_path / "robot", tmp_path / "seen.csv"
    # Without a terminal, hangups may be ignored, and child processes inherit that.
    before = signal.signal(number, signal.SIG_DFL)
    try:
        process = emulate("--symlink", str(link), "--out", str(seen), *words)
    finally:
        signal.signal(number, before)
    assert os.path.realpath(link) == process.port
    if "--lockstep" in words:
        host = process.host()
        host.send(Hello(ME, 0.010), 0.0)
        host.run_to(0.5)
        assert len(seen.read_text().splitlines()) == 101  # each row is written immediately
    process.process.send_signal(number)
    process.process.wait(timeout=20)
    code, output = process.stop()
    assert code == 0
    assert not link.is_symlink()
    assert "Traceback" not in output


def test_the_emulator_reports_when_it_cannot_keep_real_time(capsys):
    assert main(["emulate", "--fault", "overload=2", "--duration", "0.5"]) == 0
    lines = capsys.readouterr().err.splitlines()
    assert "behind real time (it used " in lines[0]
    assert "slipped 0 times" not in lines[-1]


@pytest.mark.parametrize("clock", [["--lockstep"], ["--baud", "0"]])
def test_a_board_with_an_accelerometer_sends_its_readings_to_hosts_that_know_it(emulate_here, clock):
    emulator = emulate_here("--accelerometer", "--rack", "--ideal-sensors", *clock)
    link = open_link(emulator.port, 8, lockstep="--lockstep" in clock)
    with pytest.raises(SurefootError, match=r"schema 0xb3aaea90 .* schema 0x160c5d1c \(for 8 motors\)"):
        RobotLink.connect(link)  # as hosts do that do not know it
    assert link.connect(10.0).robot == "minitaur"
    assert link.wait_for(lambda: link.state is not None, 10.0)
    np.testing.assert_allclose(link.last_state().accelerometer, [0.0, 0.0, 9.81], atol=1e-6)
    assert link.wait_for(lambda: link.states > 3, 10.0)
    link.close()


def test_options_that_exclude_an_accelerometer(capsys):
    assert main(["emulate", "--accelerometer", "--firmware", "board"]) == 2
    assert "can't be combined with --firmware; the firmware in C sends no accelerometer" in capsys.readouterr().err
    assert main(["emulate", "--accelerometer", "--robot", "go2", "--link", "dds", "--interface", "lo"]) == 2
    assert "accelerometer applies to the serial link; it can't be combined with --link dds" in capsys.readouterr().err


def test_in_lockstep_time_follows_the_frames(emulate_here):
    host = emulate_here("--lockstep").host()
    # Robot time starts with the first frame.
    host.send(Hello(ME, 0.010), 5.0)
    output = host.run_to(6.0)
    assert isinstance(output[0].message, Handshake)
    np.testing.assert_allclose(
        [f.time for f in output if isinstance(f.message, State)], np.arange(1, 101) / 100, atol=1e-9
    )
    assert output[-1].time == 1.0
    # A decreasing time does not change robot time.
    assert host.run_to(5.5)[-1].time == 1.0
    assert [f.time for f in host.run_to(6.012, State)] == [1.01]


def test_in_lockstep_the_robot_moves_as_a_simulation_does(emulate_here, robot):
    host = emulate_here("--lockstep", "--ideal-sensors").host()
    plant = Plant(robot, sensors=SensorConfig.ideal(), power=PowerConfig.ideal())
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(0.030)
    for _ in range(30):
        plant.step(MotorCommand(Mode.DISARMED, np.zeros(8)))
    world = SimWorld(robot, 1, config=WorldConfig(rest=(0.0, 0.9)))
    world.set_state(plant.world.get_state())
    set_actuation_params(world.actuation, np.arange(1), world.params)
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.030)
    rng = np.random.default_rng(1)
    target = robot.pose_angles(0.0, 1.5)
    for step in range(60):
        target = np.clip(target + rng.uniform(-0.05, 0.05, 8), 1.0, 2.2).astype(np.float32).astype(np.float64)
        readings = world.step(target)
        host.send(Position(ME, target), 0.030 + STEP * step)
        (state,) = host.run_to(0.030 + STEP * (step + 1), State)
        assert state.time == pytest.approx(0.030 + STEP * (step + 1), abs=1e-9)
        for name in ("motor_angle", "motor_velocity", "roll_pitch_yaw", "angular_velocity_base"):
            np.testing.assert_array_equal(
                getattr(state.message, name), getattr(readings, name)[0].astype(np.float32), err_msg=f"{name} {step}"
            )


def test_in_lockstep_a_second_host_may_have_another_clock(emulate_here):
    process = emulate_here("--lockstep")
    first = process.host()
    first.send(Hello(ME, 0.010), 0.0)
    first.run_to(3.0)
    second = process.host()
    second.send(Hello(OTHER, 0.010), 0.5)
    assert [frame.message.reason for frame in second.run_to(0.5, Fault)] == [Reason.BUSY]
    # Its own clock advances; after a second of silence of the first operator, it gets the robot.
    for at in (1.0, 1.5, 2.0):
        second.send(Hello(OTHER, 0.010), at)
    output = second.run_to(2.0)
    assert any(isinstance(frame.message, Handshake) for frame in second.frames), output
    times = [frame.time for frame in second.run_to(2.1, State)]
    np.testing.assert_allclose(np.diff(times), 0.010, atol=1e-9)


def armed_in_lockstep(process):
    host = process.host()
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(0.010)
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.010)
    assert host.run_to(0.020, State)[-1].message.mode == Mode.POSITION
    return host


@pytest.fixture(params=["Python", pytest.param("C", marks=needs_gcc)])
def program(request, robot) -> list[str]:
    """Return options of the emulator for a program of the microcontroller."""
    return ["--firmware", str(compiled(robot))] if request.param == "C" else []


def test_in_lockstep_a_host_that_has_left_loses_the_robot(emulate_here, program):
    process = emulate_here("--lockstep", *program)
    first = armed_in_lockstep(process)
    process.hosts.remove(first)
    first.send(Ping(9), 0.030)  # its last message is received
    first.close()
    while process.board.firmware.has_operator(process.board.now):
        time.sleep(0.005)
    second = process.host()
    second.send(Hello(OTHER, 0.010), 7.0)
    second.run_to(7.010)
    (handshake,) = (frame for frame in second.frames if isinstance(frame.message, Handshake))
    # In robot time, the watchdog damped the motors, and a second of silence ended the session.
    assert handshake.time == pytest.approx(0.030 + 1.0, abs=0.011)
    state = second.run_to(7.020, State)[-1].message
    assert (state.session, state.mode, state.reason) == (OTHER, Mode.DISARMED, Reason.TIMEOUT)


def test_in_lockstep_a_slow_host_keeps_the_robot(emulate_here, program):
    process = emulate_here("--lockstep", *program)
    first = armed_in_lockstep(process)
    second = process.host()
    for at in (50.0, 50.1, 60.0):
        second.send(Hello(OTHER, 0.010), at)
        assert second.wait_for(Fault).message.reason == Reason.BUSY
    second.close()
    process.hosts.remove(second)
    # Robot time follows neither the other operator's clock nor real time.
    (state,) = first.run_to(0.026, State)
    assert (state.time, state.message.session, state.message.mode) == (0.022, ME, Mode.POSITION)


def test_the_plant_also_runs_in_bullet(emulate_here, robot):
    pytest.importorskip("pybullet")
    host = emulate_here("--lockstep", "--world", "bullet").host()
    host.send(Hello(ME, 0.010), 0.0)
    first = host.run_to(0.1, State)[-1].message.motor_angle
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.1)
    last = robot.pose_angles(0.0, 2.0)
    for step in range(150):
        host.send(Position(ME, first + (last - first) * min(step / 120, 1.0)), 0.1 + STEP * step)
        (state,) = host.run_to(0.1 + STEP * (step + 1), State)
    assert state.message.mode == Mode.POSITION
    np.testing.assert_allclose(state.message.motor_angle, 2.0, atol=0.3)
    assert abs(state.message.roll_pitch_yaw[:2]).max() < 0.2
    assert not any(isinstance(frame.message, Fault) for frame in host.frames)
