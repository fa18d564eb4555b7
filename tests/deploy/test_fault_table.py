"""Every row of the safety table, with the emulator and `surefoot deploy` over pseudo-terminals.

A cable between the two records the packets of both, and triggers events. If possible the robot runs in lockstep in
this process, so that all times are exact on a busy computer. In tests of real time, both are processes, and a test that
fails on a busy computer is repeated.

Times are on the robot's or the host's clock, as in the frames. Rows are rows of `docs/safety.md` (ways to stop, faults
of the serial link); only these tests number them.
"""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from compiled_firmware import compiled, needs_gcc
from processes import Emulator, EmulatorHere, emulators
from shipped_variants import modified_policy

from surefoot.deploy.messages import Arm, Bye, Damp, Disarm, Fault, Hello, Mode, Position, Reason, State
from surefoot.deploy.poses import sitting_pose
from surefoot.robot import RobotDescription
from surefoot.task.partial_trace import SUFFIX, recover

pytest.importorskip("mujoco")
pytest.importorskip("onnx")

from fault_bench import (
    OTHER_SESSION,
    PATIENCE,
    QUICK_UP,
    RUNNING,
    SCENARIOS,
    STEP,
    Cable,
    Client,
    DeployResult,
    Host,
    Record,
    deploy_words,
    in_this_process,
    play,
)

pytestmark = pytest.mark.timeout(900)
MINITAUR = RobotDescription.load("minitaur")
DAMPED_WITHIN = 0.100
"""Maximum time from a host's last command to damped motors, from the table [s]."""
SUNK_WITHIN = 1.5
"""Maximum time from damped motors to a robot at rest [s]; 0.35 and 0.7 s were measured."""
LEAN = 0.03
"""Roll or pitch that counts as a fall for one of the policies [rad]; the trot tilts further in every stride."""
AT_EASE = Mode.DISARMED, Reason.NONE


def target(extension: float) -> np.ndarray:
    """Motor angles of legs with this extension."""
    return MINITAUR.pose_angles(0.0, extension)


# Clients of the test itself.


@pytest.fixture(scope="module")
def operators() -> Iterator[Callable[[], Client]]:
    """A robot in lockstep, and a factory of operators, one after another, whose commands it follows."""
    robot, sessions = EmulatorHere("--lockstep", "--rack"), itertools.count(700)

    def make() -> Client:
        client = Client(robot.port, next(sessions))
        client.send(Hello(client.session, 0.010))
        client.talk(0.6)
        assert client.arm() == []
        client.command(target(0.9), 20)
        assert client.state.mode == Mode.POSITION
        return client

    yield make
    robot.stop()


@pytest.fixture
def client(operators: Callable[[], Client]) -> Iterator[Client]:
    """An operator whose commands the robot follows."""
    one = operators()
    yield one
    one.send(Bye(one.session))
    one.pass_time(0.0)
    os.close(one.file)


# Runs in lockstep.


@pytest.fixture(scope="module")
def policies(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Trots that fail when the body pitches faster than 0.5 rad/s, and one for which a small tilt is a fall."""
    from onnx import helper, numpy_helper

    folder = tmp_path_factory.mktemp("policies")
    numbers = {"pitch_rate": [[0.0, 0.0, 0.0, -1.0]], "limit": [0.5], "zero": [0.0], "tiny": [1e-30]}
    nodes: dict[str, list[tuple[str, str, str]]] = {
        "nan": [("Div", "left_only left_only", "ratio"), ("Mul", "ratio zero", "extra")],
        "infinite": [("Sigmoid", "left", "some"), ("Div", "some left_only", "large"), ("Mul", "large tiny", "extra")],
    }
    for name, added in nodes.items():

        def extend(graph: Any, added: list[tuple[str, str, str]] = added) -> None:
            graph.node[-1].output[0] = "plain"
            for key, value in numbers.items():
                graph.initializer.append(numpy_helper.from_array(np.array(value, np.float32), key))
            graph.node.append(helper.make_node("Gemm", ["observation", "pitch_rate", "limit"], ["left"], transB=1))
            for kind, inputs, output in (("Relu", "left", "left_only"), *added, ("Add", "plain extra", "feedback")):
                graph.node.append(helper.make_node(kind, inputs.split(), [output]))

        modified_policy(folder / f"{name}.onnx", policy="trot", graph=extend)
    modified_policy(folder / "leaning.onnx", lambda contract: contract["task"].update(fall_angle=LEAN), "trot")
    return folder


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory, policies: Path) -> Callable[[str], DeployResult]:
    """Return the result of a scenario by its name; each is run once."""
    folder = tmp_path_factory.mktemp("lockstep")
    return functools.cache(lambda name: play(SCENARIOS[name], folder / name, policies))


@pytest.fixture
def ended(scenario: str, played: Callable[[str], DeployResult]) -> DeployResult:
    """Result of the test's scenario."""
    return played(scenario)


def scenarios(*names: str) -> pytest.MarkDecorator:
    return pytest.mark.parametrize("scenario", names)


# Runs in real time.


@pytest.fixture(scope="module")
def robot_process() -> Iterator[Emulator]:
    with emulators() as start:
        robot = start()
        yield robot
        robot.process.send_signal(signal.SIGCONT)


@pytest.fixture
def living_robot(robot_process: Emulator) -> Iterator[Emulator]:
    """A robot in real time without faults, whose hosts fail one after another; it is stopped while no test uses it."""
    robot_process.process.send_signal(signal.SIGCONT)
    yield robot_process
    time.sleep(1.1)  # its operator must be silent for a second before another one can connect
    robot_process.process.send_signal(signal.SIGSTOP)


@contextlib.contextmanager
def deployed(robot: Emulator, folder: Path, quick: bool = True) -> Iterator[tuple[Cable, Host]]:
    """A policy on a robot in real time."""
    cable = Cable(robot.port)
    host = Host(cable.path, folder, quick)
    try:
        yield cable, host
    finally:
        host.popen.kill()
        host.popen.wait()
        cable.close()


def wait_for(event: threading.Event, host: Host) -> None:
    """Wait for a moment of a run."""
    end = time.monotonic() + PATIENCE
    while not event.wait(0.05):
        if host.popen.poll() is not None or time.monotonic() > end:
            pytest.fail(f"the run ended before its time: {(host.folder / 'stderr').read_text()}")


def damped_after(record: Record) -> float:
    """Wait until the robot has sunk; return the time from its last command to damped motors, by its clock [s]."""
    end = time.monotonic() + PATIENCE
    while True:
        faults = [frame for frame in record.robot_packets(Fault) if frame.message.reason == Reason.TIMEOUT]
        since = record.robot_packets(State, faults[-1].time) if faults else []
        is_later = len(since) > 1 and since[-1].time - since[0].time > 0.3
        if is_later and np.abs(since[-1].message.motor_velocity).max() < 2.0:
            break
        assert time.monotonic() < end, "the robot never missed its host, or it never came to rest"
        time.sleep(0.05)
    assert since[-1].time - since[0].time < SUNK_WITHIN
    # It stays damped.
    assert {(state.message.mode, state.message.reason) for state in since} == {(Mode.FAULT, Reason.TIMEOUT)}
    after = since[0].message.command_age - (since[0].time - faults[-1].time)
    print(f"damped {1e3 * after:.1f} ms after the last command")
    return float(after)


def assert_damped_at_once(record: Record) -> float:
    """Check that the host damped and sent no later command; return the time on its clock [s]."""
    damped = record.host_packets(Damp)[0].time
    assert record.host_packets(Position, damped) == []
    return float(damped)


def assert_sat_and_disarmed(record: Record) -> None:
    """Check that the last command was the sitting pose, and that the robot was disarmed then."""
    last = record.host_packets(Position)[-1]
    np.testing.assert_allclose(last.message.target, sitting_pose(MINITAUR), atol=1e-6)
    assert record.host_packets(Disarm)[0].time >= last.time
    assert record.host_packets(Position, record.host_packets(Disarm)[0].time + 1e-6) == []
    assert record.final_mode == AT_EASE


# 1: the host dies, hangs, or the cable is pulled.


@pytest.mark.realtime
def test_row_1_a_host_that_hangs_and_one_that_is_killed(living_robot, tmp_path):
    for number in (signal.SIGSTOP, signal.SIGKILL):
        with deployed(living_robot, tmp_path, quick=False) as (cable, host):
            wait_for(cable.moment(0.2), host)
            host.popen.send_signal(number)
            assert 0.045 < damped_after(cable.record) <= DAMPED_WITHIN
            if number == signal.SIGKILL:
                break
            count = len(cable.record.from_robot)
            host.popen.send_signal(signal.SIGCONT)
            assert host.end().code == 3
            # No message of a host that wakes up moves the robot.
            woken = [frame.message for frame in cable.record.from_robot[count:] if isinstance(frame.message, State)]
            assert {state.mode for state in woken} <= {Mode.FAULT, Mode.DISARMED}


@pytest.mark.realtime
def test_row_1_a_pulled_cable_while_both_ends_continue(living_robot, tmp_path):
    with deployed(living_robot, tmp_path) as (cable, host):
        wait_for(cable.moment(RUNNING), host)
        cable.pull()
        ended = host.end()
        assert ended.outcome == (3, "fault", "stale state")
        assert ended.saved_trace.num_steps > 20
        assert_damped_at_once(cable.record)  # the robot does not receive it
        assert 0.045 < damped_after(cable.record) <= DAMPED_WITHIN


@scenarios("unplug")
def test_row_1_the_trace_of_a_run_whose_cable_was_pulled_is_kept(ended):
    assert ended.outcome == (3, "fault", "link")
    assert ended.saved_trace.meta["ended"] == "fault"
    assert ended.saved_trace.num_steps > 20


def test_row_1_a_new_host_arms_it_after_500_ms_of_clean_link(client, tmp_path):
    client.pass_time(1.0)
    assert (client.state.mode, client.state.reason) == (Mode.FAULT, Reason.TIMEOUT)
    client.send(Bye(client.session))
    client.pass_time(0.0)
    cable = Cable(client.path)
    ended = in_this_process(deploy_words(cable.path, tmp_path, "--duration", "0.06"), tmp_path)
    cable.close()
    assert ended.outcome == (0, "time", "time")
    state = cable.record.robot_packets(State)[0].message
    assert (state.mode, state.reason) == (Mode.DISARMED, Reason.TIMEOUT)
    assert cable.record.armed - cable.record.host_packets(Hello)[0].time >= 0.5
    assert_sat_and_disarmed(cable.record)


# 2: old, repeated and backward states and commands.


@scenarios("stale-state", "repeat-sequence", "backward-sequence")
def test_row_2_states_that_are_old_repeated_or_backward(ended):
    assert ended.outcome == (3, "fault", "stale state")
    assert ended.saved_trace.meta["ended"] == "fault"
    assert ended.saved_trace.num_steps > 20
    damped = assert_damped_at_once(ended.record)
    highest, fresh = 0, 0.0
    for frame in ended.record.from_robot:
        if frame.sequence > highest and frame.time < damped:
            highest = frame.sequence
            fresh = frame.time if isinstance(frame.message, State) else fresh
    # The step that finds the newest state older than three steps is the one that damps.
    assert 3 * STEP < damped - fresh <= 4 * STEP + 1e-6
    assert ended.record.reasons == [Reason.HOST]
    assert ended.record.robot_packets(Fault)[0].time == damped


@pytest.mark.realtime
def test_row_2_a_robot_that_stalls(living_robot, tmp_path):
    with deployed(living_robot, tmp_path) as (cable, host):
        wait_for(cable.moment(RUNNING), host)
        living_robot.process.send_signal(signal.SIGSTOP)
        ended = host.end()
        assert ended.outcome == (3, "fault", "stale state")
        assert ended.saved_trace.num_steps > 20
        assert_damped_at_once(cable.record)
        # When it wakes up, it first receives the request to damp.
        count = len(cable.record.from_robot)
        living_robot.process.send_signal(signal.SIGCONT)
        time.sleep(0.3)
        woken = [frame.message for frame in cable.record.from_robot[count:] if isinstance(frame.message, State)]
        assert {state.mode for state in woken} <= {Mode.FAULT, Mode.DISARMED}
        assert woken


# 3: values that are not finite, exceptions, a contract that does not match.


@pytest.mark.parametrize(
    ("scenario", "reason", "text"),
    [
        ("nan", "not finite", "gave feedback that is not finite"),
        ("infinite", "not finite", "gave feedback that is not finite"),
        ("exception", "exception", "out of data bounds"),
    ],
)
def test_row_3_a_policy_that_breaks(ended, reason, text):
    assert ended.outcome == (3, "fault", reason)
    assert text in ended.run["what"]
    trace = ended.saved_trace
    assert trace.meta["ended"] == "fault"
    assert trace.num_steps > 2
    damped = assert_damped_at_once(ended.record)
    # In the step that would have sent the command: one step after the last one.
    assert ended.record.host_packets(Position)[-1].time == pytest.approx(damped - STEP, abs=1e-6)
    at = damped + ended.record.clock_offset
    assert at == pytest.approx(trace.meta["robot_time_start"] + trace.num_steps * STEP, abs=1e-6)
    (fault,) = ended.record.robot_packets(Fault)
    assert (fault.message.reason, fault.time) == (Reason.HOST, pytest.approx(at, abs=1e-6))
    assert ended.record.final_mode == (Mode.FAULT, Reason.HOST)


@pytest.mark.parametrize(
    ("scenario", "text"),
    [
        ("other-robot", "it is 'not-minitaur'; the data sheet is for 'minitaur'"),
        ("other-order", "names and order must be the same"),
        ("other-gains", "the robot's servos have kp 1.5"),
        ("other-schema", "the robot has version 1 and schema"),
    ],
)
def test_row_3_a_robot_that_does_not_fit(ended, text):
    assert (ended.code, ended.output, ended.trace) == (2, {}, None)
    assert ended.messages[-1].startswith("surefoot: error: ")
    assert text in ended.messages[-1]
    assert ended.record.host_packets(Arm) + ended.record.host_packets(Position) == []
    assert {frame.message.mode for frame in ended.record.robot_packets(State)} <= {Mode.DISARMED}


@scenarios("reboot")
def test_row_3_a_robot_that_restarts(ended):
    assert ended.outcome == (3, "fault", "link")
    assert ended.saved_trace.num_steps > 20
    assert_damped_at_once(ended.record)
    assert "mode DISARMED, reason NONE" in ended.summary


# 4: roll or pitch over the limit.


@pytest.mark.parametrize(
    ("scenario", "limit", "after"),
    [("leaning", LEAN, "it has sat down"), ("tilt", 0.5, "it lies on its side and stays damped")],
)
def test_row_4_roll_or_pitch_over_the_limit(ended, scenario, limit, after):
    assert ended.outcome == (3, "fall", "tilt")
    assert ended.run["what"].endswith(after)
    assert ended.saved_trace.fell
    record = ended.record
    over = next(
        frame.time
        for frame in record.robot_packets(State, ended.saved_trace.meta["robot_time_start"] - 1e-6)
        if np.abs(frame.message.roll_pitch_yaw[:2]).max() > limit
    )
    damped = record.host_packets(Damp)[0].time
    assert damped + record.clock_offset == pytest.approx(over, abs=1e-6)
    if scenario == "tilt":
        assert_damped_at_once(record)
        assert len(record.host_packets(Arm)) == 1
        assert record.final_mode == (Mode.FAULT, Reason.HOST)
        return
    # It lies still on a clean link for half a second, is armed again, sits, and is disarmed.
    again = record.host_packets(Arm, damped)[0].time
    assert again - damped >= 0.5
    assert record.host_packets(Position, damped)[0].time >= again
    assert_sat_and_disarmed(record)


# 5: a late step.


@pytest.mark.realtime
def test_row_5_late_steps_are_held_and_counted_and_too_many_damp(living_robot, tmp_path):
    with deployed(living_robot, tmp_path) as (cable, host):
        wait_for(cable.moment(QUICK_UP + 0.2), host)
        for _ in range(4):
            stop_for(host, 0.013)
            time.sleep(0.15)
        assert host.popen.poll() is None, "a stop of 13 ms ended the run"
        stop_for(host, 0.032)
        ended = host.end()
        # Two steps of 6 ms pass in every short stop, so that at least one is missed, and five in the long one.
        assert ended.outcome == (3, "fault", "late")
        assert "consecutive control steps were missed; at most 2" in ended.run["what"]
        print(f"{ended.run['timing']['missed']} missed; {ended.run['what']}")
        assert ended.run["timing"]["missed"] >= 4 + 3
        # It held its target meanwhile, and continued.
        trace = ended.saved_trace
        held = [k for k in trace.meta["missed_steps"] if k < trace.num_steps - 20]
        assert len(held) >= 4
        for k in held:
            assert trace.target[k].tolist() == trace.target[k - 1].tolist()
        assert np.diff(trace.time) == pytest.approx(STEP)
        assert_damped_at_once(cable.record)
        assert Reason.HOST in cable.record.reasons


def stop_for(host: Host, seconds: float) -> None:
    """Stop a host for a while."""
    before = time.monotonic()
    host.popen.send_signal(signal.SIGSTOP)
    time.sleep(seconds)
    host.popen.send_signal(signal.SIGCONT)
    took = time.monotonic() - before
    assert took < seconds + 0.003, f"a stop of {1e3 * seconds:.0f} ms took {1e3 * took:.1f} ms"


# 6: the battery is low, a motor is hot.


@pytest.mark.parametrize(
    ("scenario", "reason", "warning", "worse"),
    [
        ("battery-low", "battery", "battery below 14.4 V; charge it soon", lambda state: state.voltage < 15),
        ("motor-hot", "temperature", "a motor is hotter than 70 degC", lambda state: state.temperature[0] > 45),
    ],
)
def test_row_6_battery_low_or_motor_hot(ended, reason, warning, worse):
    assert ended.outcome == (3, "stopped", reason)
    assert ended.messages.count(f"surefoot: warning: {warning}") == 1
    assert ended.saved_trace.num_steps > 50
    # 16 V fall by 2 V per second, 25 degC rise by 40 per second; in addition, the battery sags a little.
    began = ended.record.armed + ended.record.clock_offset + QUICK_UP - 0.5
    half = next(frame.time for frame in ended.record.robot_packets(State) if worse(frame.message)) - began
    assert 0.25 < half < 0.55
    assert_sat_and_disarmed(ended.record)
    assert ended.record.host_packets(Damp) == []


# 7: a second operator.


@scenarios("second")
def test_row_7_a_second_program_is_rejected_at_the_port(ended):
    assert ended.refusal.startswith("port /dev/")
    assert ended.refusal.endswith(": another program uses it; only one operator at a time")
    # The first run is complete: no frame was lost, and the robot followed only one operator.
    assert ended.outcome == (0, "stopped", "operator")
    assert {**ended.output["frames"], "received": 0} == dict.fromkeys(ended.output["frames"], 0)
    assert ended.saved_trace.num_steps > 20
    assert len(ended.record.host_packets(Hello)) == 1


@scenarios("stranger")
def test_row_7_a_second_operator_on_the_line_is_rejected_by_the_robot(ended, played):
    assert ended.outcome == (0, "time", "time")
    faults = [frame.message for frame in ended.record.robot_packets(Fault)]
    assert {message.session for message in faults} == {OTHER_SESSION}
    assert ended.record.reasons == [Reason.BUSY] + [Reason.SESSION] * 5
    assert_same_run(ended, played("whole"))


def assert_same_run(one: DeployResult, other: DeployResult) -> None:
    """Check that two runs are identical."""
    for name in ("observation", "feedback", "target", "motor_angle", "motor_torque", "energy", "time"):
        assert getattr(one.saved_trace, name).tolist() == getattr(other.saved_trace, name).tolist(), name


# 8: a bad line.


@scenarios("whole")
def test_row_8_a_good_line_loses_nothing(ended):
    assert ended.outcome == (0, "time", "time")
    assert ended.saved_trace.num_steps == 50
    frames = ended.output["frames"]
    assert frames == {**dict.fromkeys(frames, 0), "received": len(ended.record.from_robot)}
    assert f"frames received {len(ended.record.from_host)}, damaged 0" in ended.summary
    assert_sat_and_disarmed(ended.record)


@scenarios("corrupt", "cut-frames", "drop", "reorder", "duplicate", "garbage")
def test_row_8_a_bad_line_loses_only_damaged_frames(ended, scenario, played):
    assert ended.outcome == (0, "time", "time")
    assert ended.saved_trace.num_steps == 50
    assert_sat_and_disarmed(ended.record)
    frames, packets = ended.output["frames"], ended.record.from_robot
    # Every frame of the robot was received once, or counted as missing.
    assert frames["received"] == len(packets)
    counted = frames["received"] - frames["repeated"] + frames["missing"]
    sent = max(frame.sequence for frame in packets)
    assert sent - 3 <= counted <= sent  # losses before the handshake are not counted
    if scenario in ("corrupt", "cut-frames"):
        assert frames["missing"] > 10
        assert frames["damaged"] == pytest.approx(frames["missing"], rel=0.3)
    elif scenario == "drop":
        assert frames["missing"] > 10
        assert frames["damaged"] == frames["repeated"] == 0
    elif scenario == "reorder":
        # The overtaken frame is dropped.
        assert frames["missing"] == frames["repeated"] > 10
        assert frames["damaged"] == 0
    else:
        assert frames["missing"] == 0
        assert frames["repeated" if scenario == "duplicate" else "damaged"] > 20
        assert_same_run(ended, played("whole"))
    if scenario == "garbage":
        assert f"frames received {len(ended.record.from_host)}, " in ended.summary
    # The robot followed only commands of this run, and never an older one after a newer one.
    packets.sort(key=lambda frame: frame.sequence)
    followed = [frame.message.command for frame in ended.record.robot_packets(State) if frame.message.command]
    assert set(followed) <= {frame.sequence for frame in ended.record.host_packets(Position)}
    assert followed == sorted(followed)


@scenarios("in the middle")
def test_row_8_a_host_that_connects_in_the_middle_of_a_frame(ended, played):
    assert ended.outcome == (0, "time", "time")
    # It received the end of a frame, complete frames for another operator with higher numbers, and the start of one.
    assert ended.output["frames"]["damaged"] == 2
    assert ended.output["frames"]["received"] == 28 + len(ended.record.from_robot)
    assert_same_run(ended, played("whole"))


# 9: the operator stops the run.


@scenarios("SIGINT", "SIGTERM", "terminal")
def test_row_9_a_signal_or_a_terminal_that_closes(ended, scenario):
    assert ended.code == 0
    if scenario != "terminal":
        assert ended.outcome == (0, "stopped", "operator")
    assert (ended.saved_trace.meta["ended"], ended.saved_trace.meta["reason"]) == ("stopped", "operator")
    assert ended.saved_trace.num_steps > 20
    assert not list(ended.traces.glob(f"*{SUFFIX}"))
    assert_sat_and_disarmed(ended.record)
    assert ended.record.host_packets(Damp) == []


@scenarios("SIGINT while it arms", "SIGTERM while it lies", "SIGHUP while it lies")
def test_row_9_a_lying_robot_is_disarmed(ended):
    assert ended.outcome == (0, "stopped", "operator")
    assert ended.run["what"] == "stopped by the operator"
    assert ended.messages[-2:] == ["surefoot: lay legs flat (1.0 s)", "surefoot: disarm"]
    assert ended.record.final_mode == AT_EASE
    assert ended.record.host_packets(Damp) == []
    assert min(frame.message.voltage for frame in ended.record.robot_packets(State)) > 15.0


@scenarios("SIGINT twice")
def test_row_9_ctrl_c_twice(ended):
    assert ended.outcome == (3, "stopped", "operator")
    assert ended.saved_trace.num_steps > 20
    damped = assert_damped_at_once(ended.record)
    assert 0 <= damped - ended.record.armed - (RUNNING + 0.1) < 0.1
    assert ended.record.final_mode == (Mode.FAULT, Reason.HOST)


# 10: the disk is full.


@scenarios("disk full")
def test_row_10_a_full_disk(ended):
    assert (ended.run["ended"], ended.run["steps"], ended.run["trace"]) == ("time", 100, None)
    assert "surefoot: recording stopped: File too large; the robot continues" in ended.messages
    assert any(note.startswith("recording stopped") for note in ended.run["notes"])
    # The robot continued to the end; only the exit code reports the lost trace.
    assert_sat_and_disarmed(ended.record)
    assert ended.record.host_packets(Damp) == []
    assert ended.code == 3
    (partial,) = ended.traces.glob(f"*{SUFFIX}")
    assert recover(partial).num_steps > 5


# The same with the microcontroller's program in C.


@needs_gcc
def test_the_firmware_in_c_ends_a_run_like_the_program_in_python(played, policies, tmp_path):
    options = ("--firmware", str(compiled(MINITAUR)))
    one, other = played("tilt"), play(SCENARIOS["tilt"], tmp_path / "run", policies, options)
    assert other.outcome == one.outcome
    assert other.record.reasons == one.record.reasons
    assert other.record.final_mode == one.record.final_mode
