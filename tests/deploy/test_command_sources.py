"""Sources of commands: a file, a real socket, a real pseudo-terminal, a gamepad's events."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import select
import socket
import struct
import termios
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import pytest
from scripted_world import COMMAND_LIMITS as LIMITS

from surefoot.deploy.command_sources import (
    MAX_COMMAND_AGE,
    ChannelCommands,
    GamepadCommands,
    KeyboardCommands,
    open_commands,
    send_command,
)
from surefoot.errors import SurefootError

STAND = [0.0, 0.0, 0.0]


def wait_for(source: ChannelCommands | KeyboardCommands, expected: list[float]) -> None:
    """Wait until a source returns a command; the system may deliver it with a delay."""
    deadline = time.monotonic() + 30.0
    while (command := source.read(0.0).tolist()) != pytest.approx(expected) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert command == pytest.approx(expected)


@pytest.fixture
def channel() -> Iterator[ChannelCommands]:
    channel = ChannelCommands(0, clock=lambda: 10.0)  # independent of delays of a busy computer
    yield channel
    channel.close()


@pytest.fixture
def terminal() -> Iterator[tuple[int, int]]:
    """The two ends of a pseudo-terminal: the keyboard, and the input of a program."""
    ends = pty.openpty()
    yield ends
    for end in ends:
        with contextlib.suppress(OSError):
            os.close(end)


def event(value: int, number: int, kind: int = 2) -> bytes:
    """An event of a gamepad."""
    return struct.pack("<IhBB", 0, value, kind, number)


def test_commands_from_the_channel_expire_and_then_the_robot_stands() -> None:
    now = [10.0]
    with contextlib.closing(ChannelCommands(0, clock=lambda: now[0])) as channel:
        assert channel.read(0.0).tolist() == STAND
        send_command(channel.port, forward=0.5, yaw_rate=-0.2)
        wait_for(channel, [0.5, 0.0, -0.2])
        now[0] += MAX_COMMAND_AGE - 0.01
        assert channel.read(0.0).tolist() == [0.5, 0.0, -0.2]
        now[0] += 0.02
        assert channel.read(0.0).tolist() == STAND


def test_a_run_starts_without_the_commands_that_other_programs_sent_before(channel: ChannelCommands) -> None:
    for speed in (0.5, 1.0):  # a run before, and a robot that is standing up
        send_command(channel.port, forward=speed)
        wait_for(channel, [speed, 0.0, 0.0])
        for _ in range(100):
            send_command(channel.port, forward=speed)
        channel.start()
        assert channel.read(0.0).tolist() == STAND


def test_a_run_starts_without_the_keys_that_were_pressed_before(terminal: tuple[int, int]) -> None:
    typing, reading = terminal
    keyboard = KeyboardCommands(LIMITS, reading)
    os.write(typing, b"ww")
    wait_for(keyboard, [0.4, 0.0, 0.0])
    os.write(typing, b"www")
    assert select.select([reading], [], [], 5.0)[0]
    keyboard.start()
    assert keyboard.read(0.0).tolist() == STAND
    os.write(typing, b"w")
    wait_for(keyboard, [0.2, 0.0, 0.0])


def test_the_newest_datagram_is_used_and_a_flood_does_not_block(channel: ChannelCommands) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(2000):
            sender.sendto(json.dumps({"forward": k / 1000}).encode(), ("127.0.0.1", channel.port))
    begin = time.thread_time()
    channel.read(0.0)
    assert time.thread_time() - begin < 0.05
    for _ in range(100):
        last = channel.read(0.0)[0]
    send_command(channel.port, forward=1.5)
    wait_for(channel, [1.5, 0.0, 0.0])
    assert last < 2.0


@pytest.mark.parametrize(
    "data",
    [
        *(b"", b"\xff\xfe", b"[1, 2, 3]", b"[" * 1000, b'{"speed": 1}', b'{"forward": 1}' + b" " * 2000),
        *(b'{"forward": %s}' % value for value in (b'"fast"', b"NaN", b"Infinity", b"true", b"1e999")),
    ],
)
def test_an_invalid_datagram_is_counted_and_ignored(channel: ChannelCommands, data: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data, ("127.0.0.1", channel.port))
    send_command(channel.port, forward=0.5)
    wait_for(channel, [0.5, 0.0, 0.0])
    assert channel.rejected == 1


def test_a_second_channel_on_the_same_port_is_rejected(channel: ChannelCommands) -> None:
    with pytest.raises(SurefootError, match=rf"port {channel.port} can't be listened on: Address already in use"):
        ChannelCommands(channel.port)


def test_keys_change_a_command_by_a_tenth_of_its_range(terminal: tuple[int, int]) -> None:
    typing, reading = terminal
    keyboard = KeyboardCommands(LIMITS, reading)
    for keys, expected in (
        (b"wwQ", [0.4, 0.0, 0.1]),
        (b"ssssss", [-0.2, 0.0, 0.1]),  # each decreases the speed by a tenth of 1 m/s
        (b"w" * 40, [2.0, 0.0, 0.1]),
        (b" ", STAND),
        # Up, left with shift, F1, then w: the sequences of three keys end in letters with another meaning.
        (b"\x1b[A\x1b[1;2D\x1bOSw", [0.2, 0.0, 0.0]),
    ):
        os.write(typing, keys)
        wait_for(keyboard, expected)
    os.close(typing)  # the robot stands when the terminal closes
    wait_for(keyboard, STAND)


def test_a_keyboard_needs_a_terminal(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w+") as file, pytest.raises(SurefootError, match="keyboard needs a terminal"):
        KeyboardCommands(LIMITS, file.fileno())


def test_sticks_give_fractions_of_the_range_and_a_lost_gamepad_means_stand(tmp_path: Path) -> None:
    device = tmp_path / "js0"
    os.mkfifo(device)
    reading = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
    writing = os.open(device, os.O_WRONLY)
    gamepad = GamepadCommands(LIMITS, device)
    os.close(reading)
    os.write(writing, event(-32767, 1, 0x82) + event(16384, 0) + event(2000, 3) + event(1, 0, 1))
    # Full deflection forward, half to the right, the other stick within its dead zone.
    assert gamepad.read(0.0) == pytest.approx([2.0, -0.25, 0.0], abs=1e-4)
    os.write(writing, event(32767, 1)[:5])
    assert gamepad.read(0.0)[0] == 2.0  # an incomplete event waits for its second half
    os.close(writing)
    assert gamepad.read(0.0).tolist() == STAND
    gamepad.close()


def test_the_robot_stands_when_the_gamepad_is_disconnected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "js0"
    device.write_bytes(event(-32767, 1))
    gamepad = GamepadCommands(LIMITS, device)
    assert gamepad.read(0.0)[0] == 2.0
    monkeypatch.setattr(os, "read", mock.Mock(side_effect=OSError(19, "No such device")))
    assert gamepad.read(0.0).tolist() == STAND
    gamepad.close()


@pytest.mark.parametrize(
    ("open_source", "message"),
    [
        (lambda: open_commands("80", LIMITS), "port is 80; it must be 1024 to 65535"),
        (lambda: open_commands("99999", LIMITS), "port is 99999"),
        (lambda: open_commands("nothing.csv", LIMITS), "nothing.csv"),
        (lambda: GamepadCommands(LIMITS, Path("none")), r"gamepad none: No such file or directory; is one connected"),
    ],
)
def test_an_unknown_source_is_rejected(open_source: Callable[[], object], message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        open_source()


def test_sources_are_opened_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, terminal: tuple[int, int], channel: ChannelCommands
) -> None:
    (tmp_path / "way.csv").write_text("time,forward,sideways,yaw_rate\n1,0.5,0,0\n2,9,0,0\n")
    file = open_commands(str(tmp_path / "way.csv"), LIMITS)
    assert [file.read(moment)[0] for moment in (0.99, 1.0, 2.5)] == [0.0, 0.5, 9.0]  # the loop clamps, and warns
    assert file.duration == 4.0  # the last command is followed for two seconds
    channel.close()
    with contextlib.closing(open_commands(str(channel.port), LIMITS)) as again:
        assert isinstance(again, ChannelCommands)
        assert again.port == channel.port
    before = termios.tcgetattr(terminal[1])
    with os.fdopen(terminal[1], closefd=False) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        keyboard = open_commands("keyboard", LIMITS)
        assert termios.tcgetattr(terminal[1]) != before
        keyboard.close()
        assert termios.tcgetattr(terminal[1]) == before
