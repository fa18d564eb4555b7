"""The supervisor between a control loop, a watchdog and a robot, on a simulated clock, so that all times are exact."""

from __future__ import annotations

import select
import socket
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any
from unittest import mock

import numpy as np
import pytest

from surefoot.deploy.dds import low_level, supervisor
from surefoot.deploy.dds.bus import LOW_COMMAND_TOPIC, LOW_STATE_TOPIC, SPORT_STATE_TOPIC
from surefoot.deploy.dds.dds_link import CODEC, FIRST_TORQUE, make_config
from surefoot.deploy.dds.socket_port import SocketPort
from surefoot.deploy.dds.state_monitor import MOTORS, STATE_TIMEOUT
from surefoot.deploy.dds.supervisor import DAMPING_TIME, PERIOD, WATCHDOG_SILENCE, Supervisor
from surefoot.deploy.messages import Arm, Fault, Hello, Message, Mode, Ping, Position, Reason, State
from surefoot.deploy.robot_link import LinkLostError
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.robot import RobotDescription

ME = 7
STEP = 10_000
"""Period of the loop's commands [us]."""
KP, KD = 40.0, 1.5
LYING = np.tile([0.0, 1.2, -2.6], 4)
ARMED = 100_000
"""Time at which the loop asks to arm [us]."""
EVENT = 500_000
"""Time of the tested event [us]."""
SLACK = 1000
"""Resolution of the simulated clock [us]."""


@dataclass
class Command:
    """Command to the robot."""

    time: int
    """Time at which it was written [us]."""
    kp: float
    kd: float
    target: np.ndarray

    @property
    def damps(self) -> bool:
        return self.kp == 0 and self.kd > 0


class Topic:
    """Topic with messages that the supervisor has not read yet."""

    def __init__(self) -> None:
        self.messages: list[bytes] = []

    def take(self, count: int = 16) -> list[bytes]:
        taken, self.messages = self.messages[:count], self.messages[count:]
        return taken


class Bench:
    """A supervisor with a lying robot, a loop that arms it and holds its pose, and a watchdog that answers."""

    def __init__(self) -> None:
        self.now = 0
        self.topics: dict[str, Topic] = {}
        self.commands: list[Command] = []
        self.packets: list[Any] = []
        """Packets that the loop has received."""
        self.target = LYING
        """Target that the loop commands."""
        self.silent = self.loop_silent = self.watchdog_silent = False
        self.controller = ""
        """Name of the active controller, reported by the watchdog."""
        self.events: list[tuple[int, Callable[[], object]]] = []
        self.state = low_level.new_record(low_level.LOW_STATE)
        self.state["head"], self.state["tick"] = low_level.HEAD, 1000
        motors = self.state["motor_state"][:MOTORS]
        motors["mode"], motors["temperature"], motors["q"], motors["tau_est"] = low_level.SERVO, 40, LYING, 0.5
        self.state["imu_state"]["accelerometer"], self.state["bms_state"]["cell_vol"][:8] = (0, 0, 9.81), 3830
        self.state["power_v"] = 30.6
        self.lean(0.0)
        self._random = np.random.default_rng(0)
        (here, loop), (watch, beats) = socket.socketpair(), socket.socketpair()
        self.loop, self.watchdog = SocketPort(here, "the supervisor"), SocketPort(watch, "the supervisor")
        self._codec, self._number = CODEC, 0
        self._decoder = Decoder(self._codec)
        config = make_config(RobotDescription.load("go2"), "lo", 0, (KP, KD))
        ends = SocketPort(loop, "the loop"), SocketPort(beats, "the watchdog")
        self.supervisor = Supervisor(config, self, *ends)  # type: ignore[arg-type]

    # Interface of a bus and of a writer.

    def reader(self, name: str, kind: type, depth: int = 1, others: bool = False) -> Topic:
        return self.topics.setdefault(name, Topic())

    def writer(self, name: str, kind: type) -> Bench:
        assert name == LOW_COMMAND_TOPIC
        return self

    def write(self, data: bytes) -> bool:
        motors = low_level.decode(low_level.LOW_COMMAND, data)["motor_cmd"][:MOTORS]
        kp, kd = float(motors["kp"].max()), float(motors["kd"].max())
        self.commands.append(Command(self.now, kp, kd, motors["q"].astype(float)))
        return True

    # Interface of the supervisor's clock.

    def monotonic_ns(self) -> int:
        return 1000 * self.now

    def sleep(self, seconds: float) -> None:
        self.wait((), (), (), seconds)

    def wait(self, reads: Sequence[Any], _writes: object, _errors: object, seconds: float) -> tuple[Any, ...]:
        """Advance time until data can be read, like `select`."""
        end = self.now + round(1e6 * seconds)
        while not (ready := select.select(reads, (), (), 0) if reads else ((), (), ()))[0] and self.now < end:
            self.now = min(end, (self.now // SLACK + 1) * SLACK)
            if self.now % SLACK == 0:
                self._pass()
        return ready

    # Robot, loop and watchdog.

    def lean(self, roll: float) -> None:
        imu = self.state["imu_state"]
        imu["quaternion"], imu["rpy"] = (np.cos(roll / 2), np.sin(roll / 2), 0, 0), (roll, 0, 0)

    def send(self, message: Message) -> None:
        self._number += 1
        self.loop.write(encode_frame(self._codec, message, self._number, 1e-6 * self.now))

    def _pass(self) -> None:
        while self.events and self.now >= self.events[0][0]:
            self.events.pop(0)[1]()
        self.state["tick"] += 1
        if self.now % 2000 == 0 and not self.silent:
            speed = self.state["motor_state"]["dq"]
            speed[:MOTORS] = 0.05 * self._random.standard_normal(MOTORS)
            self.topics[LOW_STATE_TOPIC].messages.append(low_level.encode(self.state))
        if self.watchdog.is_open and not self.watchdog_silent:
            try:
                if self.watchdog.read():
                    self.watchdog.write(f"{self.controller}\n".encode())
            except LinkLostError:
                self.watchdog.close()
        if self.loop.is_open:
            self._run_loop()

    def _run_loop(self) -> None:
        try:
            self.packets += self._decoder.feed(self.loop.read())
            if self.now % STEP or self.loop_silent:
                return
            if self.now == STEP:
                self.send(Hello(ME, 0.002))
            elif self.now == ARMED:
                self.send(Arm(ME, int(Mode.POSITION), 1e-6 * STEP, 0.005))
            elif self.now > ARMED:
                self.send(Position(ME, self.target))
            else:
                self.send(Ping(self.now))
        except LinkLostError:
            self.loop.close()

    def at(self, time: int, action: Callable[[], object]) -> None:
        """Schedule an action at a time [us], later than the earlier ones."""
        self.events.append((time, action))

    def run(self, until: int = 1_000_000) -> None:
        """Run until the loop closes the link at `until` [us] and the supervisor has ended."""
        self.at(until, self.loop.close)
        with (
            mock.patch.object(supervisor, "time", self),
            mock.patch.object(supervisor, "select", mock.Mock(select=self.wait)),
        ):
            self.supervisor.run()

    def received(self, kind: type[Message]) -> list[Any]:
        """Return the loop's packets of a kind."""
        return [packet for packet in self.packets if isinstance(packet.message, kind)]

    @property
    def reasons(self) -> list[Reason]:
        return [Reason(packet.message.reason) for packet in self.received(Fault)]

    @property
    def damped(self) -> int:
        """Time at which the motors were damped for the rest of the run [us]."""
        first = next(k for k, command in enumerate(self.commands) if command.damps)
        assert all(command.damps for command in self.commands[first:])
        return self.commands[first].time

    def close(self) -> None:
        for port in (self.loop, self.watchdog):
            port.close()


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()


def test_commands_start_with_arming_and_damp_once_the_loop_has_ended(bench: Bench) -> None:
    bench.target = LYING + 0.02
    bench.run(until=EVENT)
    held = [command for command in bench.commands if not command.damps]
    assert ARMED <= held[0].time <= ARMED + PERIOD + SLACK
    np.testing.assert_allclose(held[0].target, LYING, atol=1e-6)  # the present pose until the first command
    np.testing.assert_allclose(held[-1].target, LYING + 0.02, atol=1e-6)
    assert {(command.kp, command.kd) for command in held} == {(KP, KD)}
    times = [command.time for command in bench.commands]
    assert set(np.diff(times)) == {PERIOD}
    assert EVENT <= bench.damped <= EVENT + PERIOD
    assert bench.commands[-1].time == pytest.approx(EVENT + DAMPING_TIME, abs=2 * PERIOD)
    assert bench.reasons == []


def test_a_robot_that_was_never_armed_gets_no_command(bench: Bench) -> None:
    bench.run(until=ARMED - STEP)
    assert bench.commands == []
    assert bench.now < ARMED + STEP


def test_time_follows_the_robots_tick(bench: Bench) -> None:
    bench.run(until=EVENT)
    last = bench.received(State)[-1]
    assert last.time == pytest.approx(1e-6 * EVENT + 1.0, abs=0.004)  # its tick began at a second


def test_the_accelerometer_of_the_robot_is_sent(bench: Bench) -> None:
    bench.state["imu_state"]["accelerometer"] = 0.5, -0.25, 9.75
    bench.run(until=EVENT)
    assert bench.received(State)[-1].message.accelerometer.tolist() == [0.5, -0.25, 9.75]


def test_duties_are_rejected(bench: Bench) -> None:
    bench.at(ARMED - STEP // 2, lambda: bench.send(Arm(ME, int(Mode.PWM), 1e-6 * STEP, 0.005)))
    bench.run(until=EVENT)
    assert bench.reasons == [Reason.MODE]


def test_a_first_command_with_a_jump_damps(bench: Bench) -> None:
    bench.target = LYING + 1.1 * FIRST_TORQUE / KP
    bench.run(until=EVENT)
    assert bench.reasons[0] == Reason.COMMAND
    assert "the first command would give 5.5 N m at once; at most 5" in bench.received(Fault)[0].message.text
    assert max(KP * np.abs(command.target - LYING).max() for command in bench.commands if not command.damps) < 0.1
    assert bench.damped <= ARMED + STEP + PERIOD + SLACK


def lean(bench: Bench) -> None:
    bench.lean(1.2)


def end_silently(bench: Bench) -> None:
    bench.silent = True


def hush_loop(bench: Bench) -> None:
    bench.loop_silent = True


def hush_watchdog(bench: Bench) -> None:
    bench.watchdog_silent = True


def kill_watchdog(bench: Bench) -> None:
    bench.watchdog.close()


def name_controller(bench: Bench) -> None:
    bench.controller = "mcf"


def publish_sport(bench: Bench) -> None:
    bench.topics[SPORT_STATE_TOPIC].messages.append(b"any")


def command_from_elsewhere(bench: Bench) -> None:
    bench.topics[LOW_COMMAND_TOPIC].messages.append(b"any")


def switch_motor_off(bench: Bench) -> None:
    bench.state["motor_state"]["mode"][0] = 0


@pytest.mark.parametrize(
    ("event", "reason", "text", "least", "most"),
    [
        # A command arrived at the event; the data sheet's timeout is 55 ms.
        (hush_loop, Reason.TIMEOUT, "", 55_000 - STEP, 55_000 + PERIOD + SLACK),
        (end_silently, Reason.STATES_LATE, "", STATE_TIMEOUT - PERIOD, STATE_TIMEOUT + 2 * PERIOD),
        (lean, Reason.TILT, "", 0, 3 * PERIOD),
        (switch_motor_off, Reason.MOTOR_OFF, "FR_hip_joint is off (mode 0)", 0, 3 * PERIOD),
        (publish_sport, Reason.OWN_CONTROLLER, "messages on rt/sportmodestate", 0, 6 * PERIOD),
        (name_controller, Reason.OWN_CONTROLLER, "the robot's own controller 'mcf' is active", 0, 6 * PERIOD),
        (command_from_elsewhere, Reason.OTHER_PROGRAM, "another program commands the motors", 0, 6 * PERIOD),
        (kill_watchdog, Reason.WATCHDOG, "the watchdog process has ended or hangs", 0, 4 * PERIOD),
        (hush_watchdog, Reason.WATCHDOG, "", WATCHDOG_SILENCE, WATCHDOG_SILENCE + 6 * PERIOD),
    ],
)
def test_a_fault_damps_in_time(
    bench: Bench, event: Callable[[Bench], None], reason: Reason, text: str, least: int, most: int
) -> None:
    bench.at(EVENT, lambda: event(bench))
    bench.run(until=2 * EVENT)
    assert bench.reasons[0] == reason
    assert text in bench.received(Fault)[0].message.text
    assert least <= bench.damped - EVENT <= most
    # Commands continue without a gap.
    assert set(np.diff([command.time for command in bench.commands])) == {PERIOD}


def test_the_stop_of_the_remote_control_is_announced_while_the_motors_are_damped(bench: Bench) -> None:
    pressed = low_level.RemoteControl(frozenset(("L2", "B")), 0.0, 0.0, 0.0, 0.0).encode()
    released = low_level.RemoteControl(frozenset(), 0.0, 0.0, 0.0, 0.0).encode()
    bench.at(EVENT, lambda: bench.lean(1.2))
    bench.at(EVENT + 100_000, lambda: bench.state.__setitem__("wireless_remote", pressed))
    bench.at(EVENT + 200_000, lambda: bench.state.__setitem__("wireless_remote", released))
    bench.run(until=2 * EVENT + 300_000)
    assert bench.reasons[0] == Reason.TILT
    assert Reason.REMOTE in bench.reasons


def test_a_stick_of_the_remote_control_asks_to_sit_and_does_not_damp(bench: Bench) -> None:
    stick = low_level.RemoteControl(frozenset(), 0.8, 0.0, 0.0, 0.0).encode()
    bench.at(EVENT, lambda: bench.state.__setitem__("wireless_remote", stick))
    bench.run(until=2 * EVENT)
    state = bench.received(State)[-1].message
    assert (state.mode, state.reason) == (Mode.POSITION, Reason.REMOTE)
    assert bench.damped >= 2 * EVENT
