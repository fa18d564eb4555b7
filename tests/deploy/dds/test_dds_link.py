"""The link to a Go2 over DDS: supervisor and watchdog processes, with a robot in another process."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import time
from collections.abc import Callable, Iterator

import pytest

from surefoot.deploy.doctor.examination import check_foreign_commands
from surefoot.deploy.messages import Mode, Reason
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

pytest.importorskip("cyclonedds")
from go2_robot import Go2, worker_domain

from surefoot.deploy.dds.dds_link import DdsLink, check_priority, make_config
from surefoot.deploy.pacer import real_time_priority

DOMAIN = worker_domain(60)
STEP = 0.01
KP, KD = 40.0, 1.5
REACTION = 0.060
"""Maximum time from a fault to the first damping command [s]."""


@pytest.fixture(scope="module")
def go2() -> RobotDescription:
    return RobotDescription.load("go2")


@pytest.fixture(scope="module", autouse=True)
def punctual() -> Iterator[None]:
    """Give the operator real-time priority, as in a deployment, so that its commands are not late."""
    with real_time_priority():
        yield


@pytest.fixture(scope="module")
def body() -> Iterator[Go2]:
    body = Go2(DOMAIN)
    yield body
    body.close()


class Operator:
    """A control loop that holds the present pose."""

    def __init__(self, robot: RobotDescription) -> None:
        self.link = DdsLink(make_config(robot, "lo", DOMAIN, (KP, KD)))
        self.link.connect()
        assert self.link.wait_for(lambda: self.link.states > 1, 2.0)
        self.watchdog, self.supervisor = (child.pid for child in self.link.children)

    def arm(self) -> None:
        """Arm the robot as soon as possible."""
        end = time.monotonic() + 5.0
        while self.link.last_state().mode != Mode.POSITION:
            assert time.monotonic() < end, self.link.faults[-1:]
            self.link.ping()
            self.link.arm(Mode.POSITION, STEP)
            self.link.wait_for(lambda: self.link.last_state().mode == Mode.POSITION, 0.05)
        self.link.faults.clear()
        self.target = self.link.last_state().motor_angle

    def hold(self, condition: Callable[[], bool], timeout: float = 2.0) -> bool:
        """Command the same pose until a condition holds; return whether it did in time."""
        end = time.monotonic() + timeout
        while time.monotonic() < end:
            self.link.command(Mode.POSITION, self.target)
            time.sleep(STEP)
            self.link.update()
            if condition():
                return True
        return False

    def end(self) -> None:
        """Kill its processes, which would otherwise damp the motors for a while."""
        for child in self.link.children:
            with contextlib.suppress(ProcessLookupError):  # it has ended
                os.kill(child.pid, signal.SIGKILL)
        self.link.close()


@pytest.fixture
def operator(go2: RobotDescription, body: Go2) -> Iterator[Operator]:
    """Start an operator whose processes end with the test."""
    body.reset()
    operator = Operator(go2)
    yield operator
    operator.end()


@pytest.mark.realtime
def test_commands_carry_gains_and_begin_at_the_present_pose(operator: Operator, body: Go2) -> None:
    time.sleep(0.1)
    assert body.read() == []  # nothing before the motors are armed
    operator.link.update()
    assert operator.link.state_sent == pytest.approx(body.time, abs=0.1)  # recordings of the robot have the same time
    operator.arm()
    assert operator.hold(lambda: False, 0.5) is False
    frames = body.read()
    assert all((frame.kp, frame.kd) == (KP, KD) for frame in frames)
    assert max(frame.jump for frame in frames) < 0.1
    rate = len(frames) / (frames[-1].time - frames[0].time)
    assert 450 < rate < 550
    pids = [operator.watchdog, operator.supervisor]
    real_time = all(os.sched_getscheduler(pid) == os.SCHED_FIFO for pid in pids)
    assert check_priority(pids).passed is (True if real_time else None)
    assert check_priority([os.getppid()]).passed is None
    operator.link.disarm()
    body.wait_for(lambda frame: frame.damps)
    operator.link.close()
    frames = body.read()
    first = next(k for k, frame in enumerate(frames) if frame.damps)
    assert all(frame.damps for frame in frames[first:])
    assert frames[-1].time - frames[first].time > 0.4  # damped for half a second after the loop has ended
    time.sleep(0.1)
    assert len(body.read()) == len(frames)


@pytest.mark.realtime
@pytest.mark.parametrize("how", ["killed", "stands still"])
def test_the_motors_are_damped_if_the_supervisor_dies_or_hangs(operator: Operator, body: Go2, how: str) -> None:
    """`test_supervisor.py` tests the supervisor when other processes end."""
    operator.arm()
    operator.hold(lambda: False, 0.1)
    ended = time.monotonic()
    os.kill(operator.supervisor, signal.SIGKILL if how == "killed" else signal.SIGSTOP)
    first = body.wait_for(lambda frame: frame.damps, ended)
    assert first.time - ended < REACTION
    if how == "stands still":
        os.kill(operator.supervisor, signal.SIGCONT)
    time.sleep(0.2)
    frames = [frame for frame in body.read() if frame.time >= ended]
    held = [frame for frame in frames if frame.time >= first.time and not frame.damps]
    # If it was stopped while writing a command, it sends that as soon as it continues.
    assert len(held) <= (how == "stands still"), held
    assert max(b.time - a.time for a, b in itertools.pairwise(frames)) < REACTION


@pytest.mark.realtime
def test_commands_of_another_program_damp_the_motors(operator: Operator, body: Go2) -> None:
    from surefoot.deploy.dds import bus, types
    from surefoot.deploy.dds.low_level import encode, new_command

    writer = bus.Bus("lo", DOMAIN).writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
    time.sleep(0.3)
    operator.arm()
    operator.hold(lambda: False, 0.1)
    before = time.monotonic()
    writer.write(encode(new_command()))
    assert operator.hold(lambda: operator.link.last_state().mode == Mode.FAULT)
    assert body.wait_for(lambda frame: frame.damps, before).time - before < REACTION
    assert operator.link.last_state().reason == Reason.OTHER_PROGRAM


def test_the_command_timeout_covers_three_steps_of_a_slow_policy(go2: RobotDescription) -> None:
    assert make_config(go2, "lo", DOMAIN).limits.command_timeout == 0.055
    slow = make_config(go2, "lo", DOMAIN, silence=0.06)
    assert slow.limits.command_timeout == slow.handshake.command_timeout == 0.06


def test_another_robot_is_rejected(robot: RobotDescription) -> None:
    with pytest.raises(SurefootError, match="needs a Unitree Go2; minitaur must have joint actuators"):
        make_config(robot, "lo", DOMAIN)


def test_an_unknown_interface_is_rejected(go2: RobotDescription) -> None:
    with pytest.raises(SurefootError, match=r"there is no network interface 'eth9'; it must be one of .*lo"):
        DdsLink(make_config(go2, "eth9", DOMAIN))


@pytest.mark.realtime
def test_a_command_of_another_program_prevents_arming_later(
    operator: Operator, body: Go2, go2: RobotDescription
) -> None:
    from surefoot.deploy.dds import bus, types
    from surefoot.deploy.dds.low_level import encode, new_command

    writer = bus.Bus("lo", DOMAIN).writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
    time.sleep(0.3)
    link = operator.link
    assert link.detects_other_programs
    assert link.foreign_commands == []
    writer.write(encode(new_command()))
    assert link.wait_for(lambda: bool(link.foreign_commands), 2.0, link.ping)
    time.sleep(1.0)  # longer than other hazards are held
    assert link.listen().startswith("another program commands the motors: 1 message, the last ")
    check = check_foreign_commands(link)
    assert check.passed is False
    assert check.message.startswith("1 message of another program, the last 1.")
    with pytest.raises(SurefootError, match="another program commands the motors, on rt/lowcmd"):
        MotionRunner(link, go2, 0.02, StopSignals()).arm()
