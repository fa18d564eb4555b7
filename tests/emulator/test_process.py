"""The emulator as a process, on a real pseudo-terminal: in real time where time is the point, else in lockstep."""

from __future__ import annotations

import itertools
import os
import signal
import time

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.poses import pose
from surefoot.deploy.wire.messages import Arm, Fault, Handshake, Hello, Mode, Ping, Pong, Position, Pwm, Reason, State
from surefoot.emulator.hardware import PowerConfig, SensorConfig
from surefoot.emulator.plant import Plant
from surefoot.world.drive import set_drive_params
from surefoot.world.interface import WorldConfig
from surefoot.world.sim_world import SimWorld

ME, OTHER = 7, 8
STEP = 0.006


def follow(host, robot, seconds: float, extension: float = 1.2, period: float = STEP) -> list[float]:
    """Go from the angles that the robot has to others, in real time; times of the states that came, on its clock."""
    first = host.of(State).message.motor_angle
    last = pose(robot, 0.0, extension)
    start, came = host.now(), []
    for step in itertools.count():
        at = start + step * period
        share = min(step * period / max(seconds - 0.2, 0.1), 1.0)
        while (left := at - host.now()) > 0:
            came += [frame.time for frame in host.look(left) if isinstance(frame.message, State)]
        if at - start > seconds:
            return came
        host.send(Position(ME, first + (last - first) * share))
    raise AssertionError


@pytest.mark.realtime
def test_a_session_in_real_time(emulate, robot, tmp_path):
    process = emulate("--rack")
    host = process.host()
    host.send(Hello(ME, 0.010))
    said = host.of(Handshake).message
    assert (said.session, said.robot) == (ME, "minitaur")
    assert said.firmware.startswith("surefoot emulator ")

    # States come at the period that was asked for, on the robot's clock.
    times = [host.of(State).time for _ in range(50)]
    np.testing.assert_allclose(np.diff(times), 0.010, atol=0.0021)

    # Armed, it follows.
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP - 0.003))
    host.of(State, lambda state: state.mode == Mode.POSITION)
    came = follow(host, robot, 1.0)
    assert np.median(np.diff(came)) == pytest.approx(STEP, abs=0.0015)
    newest = [frame.message for frame in host.frames if isinstance(frame.message, State)][-1]
    assert newest.mode == Mode.POSITION
    np.testing.assert_allclose(newest.motor_angle, 1.2, atol=0.05)
    assert 15.0 < newest.voltage < 16.1

    # The host hangs: within 100 ms the motors are damped, on the robot's clock.
    commanded = host.bytes.number
    fault = host.of(Fault)
    assert (fault.message.session, fault.message.reason) == (ME, Reason.TIMEOUT)
    state = host.of(State, lambda state: state.mode == Mode.FAULT)
    assert state.message.command == commanded
    assert state.message.command_age < 0.100
    last = [frame for frame in host.frames if isinstance(frame.message, State) and frame.message.mode == Mode.POSITION]
    assert state.time - last[-1].time < 0.100

    # It stays so, however long, and arms again once the link has been clean for 500 ms.
    time.sleep(0.3)
    host.look()
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP - 0.003))
    refused = host.of(Fault)
    assert refused.message.reason == Reason.NOT_CLEAN
    armed = None
    while armed is None:
        host.send(Arm(ME, int(Mode.POSITION), STEP, STEP - 0.003))
        for frame in host.look(0.04):
            if isinstance(frame.message, State) and frame.message.mode == Mode.POSITION:
                armed = armed or frame
        assert host.now() < 60
    assert armed.time - refused.time > 0.49

    code, said = process.stop()
    assert code == 0
    assert "of robot time" in said


@pytest.mark.realtime
def test_a_second_operator_is_refused(emulate):
    process = emulate()
    first, second = process.host(), process.host()
    first.send(Hello(ME, 1.0))
    first.of(Handshake)
    second.send(Hello(OTHER, 1.0))
    busy = first.of(Fault).message  # both read the same line: the first to look has it
    assert (busy.session, busy.reason) == (OTHER, Reason.BUSY)


@pytest.mark.realtime
def test_a_cable_that_is_pulled_damps_the_motors(emulate, tmp_path, robot):
    file = tmp_path / "seen.csv"
    process = emulate("--fault", "unplug=0.5", "--motion-capture", str(file))
    host = process.host()
    host.send(Hello(ME, 0.010))
    host.of(Handshake)
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP - 0.003))
    follow(host, robot, 0.8)
    host.look(0.05)
    assert host.look(0.2) == []
    code, said = process.stop()
    assert code == 0
    assert "mode FAULT, reason TIMEOUT" in said


@pytest.mark.realtime
def test_hosts_come_and_go_and_the_robot_never_blocks(emulate, robot):
    process = emulate()
    for _ in range(3):
        host = process.host()
        host.send(Hello(ME, 0.001))  # more than anyone reads
        time.sleep(0.2)
        os.kill(process.process.pid, 0)
    reader = process.host()
    # A kilohertz of states for 0.6 s is far more than the pseudo-terminal holds; what comes now is fresh again.
    reader.look()
    reader.send(Ping(99))
    pong = reader.of(Pong, lambda message: message.token == 99)
    assert pong.time > 0.5


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("lockstep", [False, True])
def test_it_ends_cleanly_when_asked_to(emulate, tmp_path, number, lockstep):
    link = tmp_path / "robot"
    # Whoever runs the tests without a terminal may ignore hangups, and children inherit that.
    before = signal.signal(number, signal.SIG_DFL)
    try:
        process = emulate("--link", str(link), *(["--lockstep"] if lockstep else []))
    finally:
        signal.signal(number, before)
    assert os.path.realpath(link) == process.port
    process.process.send_signal(number)
    assert process.process.wait(timeout=20) == 0
    assert not link.is_symlink()
    assert "Traceback" not in process.process.communicate()[1]


@pytest.mark.realtime
def test_it_tells_when_it_cannot_keep_real_time(emulate):
    process = emulate("--fault", "overload=2", "--duration", "0.5")
    _, said = process.process.communicate(timeout=60)
    assert process.process.returncode == 0
    lines = said.splitlines()
    assert "behind real time (it used " in lines[0]
    assert "slipped 0 times" not in lines[-1]


def test_in_lockstep_time_is_the_frames(emulate, pick):
    host = emulate("--lockstep").host()
    # Robot time begins with the first frame.
    host.send(Hello(ME, 0.010), 5.0)
    said = host.run_to(6.0)
    assert isinstance(said[0].message, Handshake)
    np.testing.assert_allclose([f.time for f in pick["states"](said)], np.arange(1, 101) / 100, atol=1e-9)
    assert said[-1].time == 1.0
    # A time that goes back leaves the robot's where it is.
    assert host.run_to(5.5)[-1].time == 1.0
    assert [f.time for f in pick["states"](host.run_to(6.012))] == [1.01]


def test_in_lockstep_it_does_the_same_again_to_the_last_bit(emulate, robot):
    def run() -> list:
        host = emulate("--lockstep", "--fault", "drop=0.05", "corrupt=0.05", "--seed", "3").host()
        host.send(Hello(ME, 0.010), 0.0)
        host.run_to(0.05)
        host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.05)
        for step in range(100):
            host.send(Position(ME, pose(robot, 0.0, 0.9 + 0.005 * step)), 0.05 + STEP * step)
            host.token += 1
            host.send(Ping(host.token), 0.05 + STEP * (step + 1))
        host.look(0.5)
        end = host.now() + 1.0
        while host.now() < end:
            host.look(0.1)
        return [(f.sequence, f.time, repr(f.message)) for f in host.frames]

    first, second = run(), run()
    assert len(first) > 150
    assert first == second


def test_in_lockstep_the_robot_moves_as_a_simulation_does(emulate, robot, pick):
    host = emulate("--lockstep", "--ideal-sensors").host()
    plant = Plant(robot, sensors=SensorConfig.ideal(), power=PowerConfig.ideal())
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(0.030)
    from surefoot.emulator.signals import MotorOrder

    for _ in range(30):
        plant.step(MotorOrder(Mode.DISARMED, np.zeros(8)))
    world = SimWorld(robot, 1, config=WorldConfig(rest=(0.0, 0.9)))
    world.set_state(plant.world.get_state())
    set_drive_params(world.drive, np.arange(1), world.params)
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.030)
    rng = np.random.default_rng(1)
    target = pose(robot, 0.0, 1.5)
    for step in range(150):
        target = np.clip(target + rng.uniform(-0.05, 0.05, 8), 1.0, 2.2).astype(np.float32).astype(np.float64)
        readings = world.step(target)
        host.send(Position(ME, target), 0.030 + STEP * step)
        (state,) = pick["states"](host.run_to(0.030 + STEP * (step + 1)))
        assert state.time == pytest.approx(0.030 + STEP * (step + 1), abs=1e-9)
        for name in ("motor_angle", "motor_velocity", "roll_pitch_yaw", "angular_velocity_base"):
            np.testing.assert_array_equal(
                getattr(state.message, name), getattr(readings, name)[0].astype(np.float32), err_msg=f"{name} {step}"
            )


def test_in_lockstep_a_second_host_may_have_another_clock(emulate, pick):
    process = emulate("--lockstep")
    first = process.host()
    first.send(Hello(ME, 0.010), 0.0)
    first.run_to(3.0)
    second = process.host()
    second.send(Hello(OTHER, 0.010), 0.5)
    assert [fault.reason for fault in pick["faults"](second.run_to(0.5))] == [Reason.BUSY]
    # Its own clock goes on; after a second without the first one it has the robot.
    for at in (1.0, 1.5, 2.0):
        second.send(Hello(OTHER, 0.010), at)
    said = second.run_to(2.0)
    assert any(isinstance(frame.message, Handshake) for frame in second.frames), said
    times = [frame.time for frame in pick["states"](second.run_to(2.1))]
    np.testing.assert_allclose(np.diff(times), 0.010, atol=1e-9)


def armed_in_lockstep(process, pick):
    host = process.host()
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(0.010)
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.010)
    assert pick["states"](host.run_to(0.020))[-1].message.mode == Mode.POSITION
    return host


def test_in_lockstep_a_host_that_is_gone_loses_the_robot(emulate, pick):
    process = emulate("--lockstep")
    first = armed_in_lockstep(process, pick)
    process.hosts.remove(first)
    first.send(Ping(9), 0.030)  # its last words are heard
    first.close()
    time.sleep(1.0)
    second = process.host()
    second.send(Hello(OTHER, 0.010), 7.0)
    second.run_to(7.010)
    (greeting,) = (frame for frame in second.frames if isinstance(frame.message, Handshake))
    # The watchdog saw to the motors, and a second of silence to the operator, in robot time.
    assert greeting.time == pytest.approx(0.030 + 1.0, abs=0.011)
    state = pick["states"](second.run_to(7.020))[-1].message
    assert (state.session, state.mode, state.reason) == (OTHER, Mode.DISARMED, Reason.TIMEOUT)


def test_in_lockstep_a_host_that_is_slow_keeps_the_robot(emulate, pick):
    process = emulate("--lockstep")
    first = armed_in_lockstep(process, pick)
    second = process.host()
    for at in (50.0, 50.1, 60.0):
        second.send(Hello(OTHER, 0.010), at)
        assert second.of(Fault).message.reason == Reason.BUSY
    second.close()
    process.hosts.remove(second)
    # Neither the stranger's clock nor that on the wall is the robot's.
    (state,) = pick["states"](first.run_to(0.026))
    assert (state.time, state.message.session, state.message.mode) == (0.022, ME, Mode.POSITION)


def test_motors_take_a_duty(emulate, pick):
    host = emulate("--lockstep", "--rack", "--ideal-sensors").host()
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(0.010)
    host.send(Arm(ME, int(Mode.PWM), 0.010, 0.010), 0.010)
    for step in range(5):
        host.send(Pwm(ME, np.array([0.1, *[0.0] * 7])), 0.010 * (step + 1))
        said = host.run_to(0.010 * (step + 2))
    state = pick["states"](said)[-1].message
    assert state.mode == Mode.PWM
    assert state.motor_velocity[0] > 2.0
    assert state.energy > 0.0


def test_motion_capture_is_written_as_it_happens(emulate, tmp_path):
    file = tmp_path / "seen.csv"
    host = emulate("--lockstep", "--motion-capture", str(file)).host()
    host.send(Hello(ME, 0.010), 0.0)
    host.run_to(1.0)
    header, *rows = file.read_text().splitlines()
    assert header == (
        "time,x,y,z,qw,qx,qy,qz,contact_front_left,contact_back_left,contact_front_right,contact_back_right"
    )
    numbers = np.array([[float(x) for x in row.split(",")] for row in rows])
    np.testing.assert_allclose(numbers[:, 0], 0.005 * np.arange(1, len(rows) + 1), atol=1e-12)
    assert len(rows) == 200
    np.testing.assert_allclose(np.linalg.norm(numbers[:, 4:8], axis=1), 1.0, atol=1e-12)
    assert ((numbers[:, 8:] >= 0) & (numbers[:, 8:] <= 1)).all()
    assert numbers[0, 3] > 0.15  # it sits


@pytest.mark.realtime
def test_states_come_in_batches_as_some_adapters_hand_them_over(emulate):
    host = emulate("--fault", "batching=0.016").host()
    host.send(Hello(ME, 0.002))
    host.of(State)
    reads, end = [], host.now() + 0.8
    while host.now() < end:
        if found := host.look(0.1):
            reads.append(len(found))
            time.sleep(0.002)  # what comes in one batch may be written in pieces
    # 400 states in 50 batches; one at a time there would be 200 reads or more.
    assert sum(reads) > 300
    assert len(reads) < 100


def test_in_bullet_too(emulate, robot, pick):
    pytest.importorskip("pybullet")
    host = emulate("--lockstep", "--world", "bullet").host()
    host.send(Hello(ME, 0.010), 0.0)
    first = pick["states"](host.run_to(0.5))[-1].message.motor_angle
    host.send(Arm(ME, int(Mode.POSITION), STEP, STEP), 0.5)
    last = pose(robot, 0.0, 2.0)
    for step in range(300):
        host.send(Position(ME, first + (last - first) * min(step / 250, 1.0)), 0.5 + STEP * step)
        said = host.run_to(0.5 + STEP * (step + 1))
    (state,) = pick["states"](said)
    assert state.message.mode == Mode.POSITION
    np.testing.assert_allclose(state.message.motor_angle, 2.0, atol=0.3)
    assert abs(state.message.roll_pitch_yaw[:2]).max() < 0.2
    assert pick["faults"](host.frames) == []
