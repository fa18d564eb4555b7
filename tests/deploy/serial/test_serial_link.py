"""The link on a real pseudo-terminal: no call blocks, all frames are counted, one program at a time."""

from __future__ import annotations

import contextlib
import os
import threading
import time
import tty
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest

from surefoot.deploy.board.firmware import Firmware
from surefoot.deploy.board.host_frames import HostFrames
from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.deploy.board.signals import Sensors
from surefoot.deploy.clock import LockstepClock, MonotonicClock
from surefoot.deploy.links import open_link
from surefoot.deploy.messages import Handshake, Hello, Ping, Pong, Position, State
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.serial.codec import Codec
from surefoot.deploy.serial.frames import Decoder, encode_frame
from surefoot.deploy.serial.port import SerialPort
from surefoot.deploy.serial.serial_link import SerialLink
from surefoot.errors import SurefootError

CODEC = Codec(8)


@pytest.fixture
def pty():
    """The robot's end of a pseudo-terminal, and the name of the other end."""
    master, slave = os.openpty()
    tty.setraw(slave)
    os.set_blocking(master, False)
    yield master, os.ttyname(slave)
    for file in (master, slave):
        with contextlib.suppress(OSError):
            os.close(file)


def frame(sequence: int, token: int = 0) -> bytes:
    return encode_frame(CODEC, Pong(token), sequence, 1.0)


def receive(link: SerialLink, count: int) -> list[int]:
    """Return the numbers of arriving frames: at least `count`, or all within 30 s."""
    sequences: list[int] = []
    end = time.monotonic() + 30.0
    while len(sequences) < count and time.monotonic() < end:
        link.port.wait(0.05)
        sequences += [arrival.packet.sequence for arrival in link.receive()]
    return sequences


def test_frames_go_both_ways(pty):
    master, name = pty
    link = SerialLink(SerialPort(name), CODEC, MonotonicClock(), 7)
    link.send(Position(5, np.arange(8.0)))
    assert link.next_number == 2
    assert link.ping() == 1
    decoder, frames = Decoder(CODEC), []
    while len(frames) < 2:
        frames += decoder.feed(os.read(master, 4096))
    assert [one.sequence for one in frames] == [1, 2]
    assert frames[0].message.target.tolist() == list(range(8))
    assert frames[1].message == Ping(1)
    os.write(master, frame(1))
    assert receive(link, 1) == [1]
    link.close()


def test_backward_repeated_and_missing_numbers_are_counted_and_dropped(pty):
    link = SerialLink(SerialPort(pty[1]), CODEC, MonotonicClock(), 7)
    os.write(pty[0], b"".join(frame(number) for number in (1, 2, 2, 5, 4, 6)))
    assert receive(link, 4) == [1, 2, 5, 6]
    assert (link.statistics.repeated, link.statistics.missing) == (2, 2)


def handshake_frame(toy, session: int, sequence: int) -> bytes:
    handshake: Handshake = replace(toy.firmware.handshake, session=session)
    return encode_frame(CODEC, handshake, sequence, 0.0)


def test_a_handshake_resets_the_sequence_numbers_once(pty, toy):
    link = SerialLink(SerialPort(pty[1]), CODEC, MonotonicClock(), 7)
    link.awaits_handshake = True
    # A handshake for another operator is an ordinary frame, and a repeated or late one lets no old frame pass.
    other, own = handshake_frame(toy, 8, 1), handshake_frame(toy, 7, 1)
    os.write(pty[0], frame(900) + other + own + frame(2) + frame(3) + own + frame(2) + frame(4))
    assert receive(link, 5) == [900, 1, 2, 3, 4]
    assert link.statistics.repeated == 3


def test_garbage_between_frames_costs_no_frame(pty):
    link = SerialLink(SerialPort(pty[1]), CODEC, MonotonicClock(), 7)
    os.write(pty[0], b"\x07garbage" + frame(1) + b"\xff\x00\x13" + frame(2))
    assert receive(link, 2) == [1, 2]
    assert link.decoder.statistics.damaged == 3


def test_a_full_port_drops_frames_and_does_not_block(pty):
    link = SerialLink(SerialPort(pty[1]), CODEC, MonotonicClock(), 7)
    started = time.monotonic()
    for _ in range(2000):
        link.send(Position(1, np.zeros(8)))
    assert time.monotonic() - started < 10.0
    assert link.statistics.sent == 2000
    assert link.statistics.unsent > 0


def test_a_port_is_lost_when_its_other_end_closes(pty):
    master, name = pty
    port = SerialPort(name)
    os.close(master)

    def use() -> None:
        for _ in range(50):
            port.read()
            port.write(b"x")
            time.sleep(0.01)

    with pytest.raises(LinkLostError, match="is gone"):
        use()


def test_a_second_program_is_rejected(pty):
    port = SerialPort(pty[1])
    with pytest.raises(SurefootError, match=r"another program uses it; only one operator at a time$"):
        SerialPort(pty[1])
    port.close()
    SerialPort(pty[1]).close()


def test_a_port_that_does_not_exist_is_an_error(tmp_path):
    with pytest.raises(SurefootError, match="can't be opened: No such file"):
        SerialPort(str(tmp_path / "nothing"))


# Boards with and without an accelerometer.

FORCE = [0.5, -0.25, 9.75]


@pytest.fixture
def start_board(pty, robot) -> Iterator[Callable[[bool], None]]:
    """Start a board of 8 motors at the pseudo-terminal, with or without an accelerometer, in real time."""
    master, _ = pty
    ends, zeros = threading.Event(), np.zeros(8)
    threads = []

    def run(accelerometer: bool) -> None:
        frames, limits = HostFrames(8, accelerometer), Limits.from_robot(robot)
        firmware = Firmware(make_handshake(robot, limits, "test", 0.001), limits)
        # A board without one does not send the reading even if it were there.
        seen = Sensors(zeros, zeros, zeros, zeros[:3], zeros[:3], 0.0, 16.0, zeros, np.array(FORCE))
        while not ends.wait(0.001):
            now = time.monotonic_ns() // 1000
            with contextlib.suppress(OSError):  # no data, no host, or a host that does not read
                frames.receive(now, os.read(master, 4096), firmware)
            firmware.report(now, lambda: seen)
            for packet in firmware.take():
                with contextlib.suppress(OSError):
                    os.write(master, frames.encode(packet))

    def start(accelerometer: bool) -> None:
        threads.append(threading.Thread(target=run, args=(accelerometer,)))
        threads[0].start()

    yield start
    ends.set()
    for thread in threads:
        thread.join()


@pytest.mark.parametrize("accelerometer", [False, True])
def test_a_host_uses_boards_with_and_without_an_accelerometer(pty, start_board, accelerometer):
    start_board(accelerometer)
    link = open_link(pty[1], 8)
    for _ in range(2):  # a session is also continued
        assert link.connect().robot == "minitaur"
    assert link.wait_for(lambda: link.state is not None, 10.0)
    force = link.last_state().accelerometer
    assert force.tolist() == FORCE if accelerometer else force is None
    assert link.statistics.foreign == 0
    assert link.protocol_error() is None
    link.close()


def test_a_host_that_knows_no_accelerometer_rejects_a_board_with_one(pty, start_board):
    start_board(True)
    link = open_link(pty[1], 8)
    new, old = Codec(8, accelerometer=True).schema, CODEC.schema
    with pytest.raises(
        SurefootError, match=rf"version 1 and schema {new:#010x} .* schema {old:#010x} \(for 8 motors\)"
    ):
        RobotLink.connect(link)  # `SerialLink.connect` tries the other schema
    link.close()


def test_a_board_with_other_motors_is_rejected_also_if_it_has_an_accelerometer(pty, start_board):
    start_board(True)
    link = open_link(pty[1], 12)
    with pytest.raises(
        SurefootError, match=rf"schema {Codec(8, accelerometer=True).schema:#010x} .* \(for 12 motors\)"
    ):
        link.connect()
    link.close()


def test_await_pong_waits_for_the_pong_and_keeps_other_packets(toy):
    link = SerialLink(toy, CODEC, MonotonicClock(), 7)
    assert link.await_pong((1.0,))
    assert [type(arrival.packet.message) for arrival in link.receive()] == [Pong]
    toy.silent = True
    assert not link.await_pong((0.01,))


def test_in_lockstep_packets_are_received_only_when_time_advances(toy):
    """Otherwise it would depend on chance whether an answer has arrived at the first check."""
    clock = LockstepClock()
    link = SerialLink(toy, CODEC, clock, 7)
    link.send(Hello(7, 0.01))
    assert link.receive() == []
    clock.wait_until(0.01)
    taken = link.receive()
    assert [type(arrival.packet.message) for arrival in taken] == [Handshake, State, Pong]
    assert {arrival.time for arrival in taken} == {0.01}


def test_in_lockstep_a_command_goes_with_the_next_ping(toy):
    clock = LockstepClock()
    link = SerialLink(toy, CODEC, clock, 7)
    link.send(Position(7, np.zeros(8)))
    assert toy.received == []
    clock.wait_until(0.01)
    assert [(time, type(message)) for time, message in toy.received] == [(0.0, Position), (0.01, Ping)]
    link.send(Position(7, np.zeros(8)))
    link.close()
    assert toy.received[-1][0] == 0.01


def test_a_repeated_ping_has_the_same_sequence_number(toy):
    link = SerialLink(toy, CODEC, LockstepClock(), 7)
    toy.silent = True
    assert not link.await_pong((0.01, 0.01, 0.01))
    assert [message for _, message in toy.received] == 3 * [Ping(1)]
    assert link.statistics.sent == 1
    toy.silent = False
    assert link.await_pong((1.0,))
    assert link.statistics.sent == 2
