"""Sources of commands: a file, a real socket, a real pseudo-terminal, a gamepad's events."""

from __future__ import annotations

import json
import os
import pty
import socket
import struct
import termios
import time
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
from scripted import COMMAND_LIMITS as LIMITS

from surefoot.deploy.command_sources import (
    FRESH,
    ChannelCommands,
    GamepadCommands,
    KeyboardCommands,
    open_commands,
    parse_command,
    send_command,
)
from surefoot.errors import SurefootError


def until(read: Callable[[], np.ndarray], wanted: list[float]) -> None:
    """Wait until a source gives what is wanted: the system may take a moment to deliver."""
    deadline = time.monotonic() + 2.0
    while (found := read().tolist()) != pytest.approx(wanted) and time.monotonic() < deadline:
        time.sleep(0.002)
    assert found == pytest.approx(wanted)


def test_a_command_of_the_channel_holds_for_a_while_and_then_means_stand() -> None:
    now = [10.0]
    channel = ChannelCommands(0, clock=lambda: now[0])
    assert channel.read(0.0).tolist() == [0.0, 0.0, 0.0]
    send_command(channel.port, forward=0.5, yaw_rate=-0.2)
    until(lambda: channel.read(0.0), [0.5, 0.0, -0.2])
    now[0] += FRESH - 0.01
    assert channel.read(0.0).tolist() == [0.5, 0.0, -0.2]
    now[0] += 0.02
    assert channel.read(0.0).tolist() == [0.0, 0.0, 0.0]
    channel.close()


def test_the_newest_datagram_counts_and_a_flood_takes_no_time() -> None:
    channel = ChannelCommands(0)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for k in range(2000):
            sender.sendto(json.dumps({"forward": k / 1000}).encode(), ("127.0.0.1", channel.port))
    begin = time.perf_counter()
    channel.read(0.0)
    assert time.perf_counter() - begin < 0.05
    for _ in range(100):
        last = channel.read(0.0)[0]
    send_command(channel.port, forward=1.5)
    until(lambda: channel.read(0.0), [1.5, 0.0, 0.0])
    assert last < 2.0
    channel.close()


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\xff\xfe",
        b"[1, 2, 3]",
        b'{"forward": "fast"}',
        b'{"forward": NaN}',
        b'{"forward": Infinity}',
        b'{"forward": true}',
        b'{"speed": 1}',
        b'{"forward": 1e999}',
        b"[" * 1000,
        b'{"forward": 1}' + b" " * 2000,
    ],
)
def test_what_is_no_command_is_ignored(data: bytes) -> None:
    assert parse_command(data) is None


def test_a_datagram_that_is_no_command_changes_nothing_and_is_counted() -> None:
    channel = ChannelCommands(0)
    send_command(channel.port, forward=0.5)
    until(lambda: channel.read(0.0), [0.5, 0.0, 0.0])
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(b'{"forward": NaN}', ("127.0.0.1", channel.port))
    deadline = time.monotonic() + 2.0
    while not channel.refused and time.monotonic() < deadline:
        channel.read(0.0)
    assert channel.refused == 1
    channel.close()


def test_the_channel_listens_on_this_computer_only_and_to_one_program() -> None:
    channel = ChannelCommands(0)
    with pytest.raises(SurefootError, match=rf"port {channel.port} can't be listened on: Address already in use"):
        ChannelCommands(channel.port)
    channel.close()


def test_keys_change_a_command_by_a_tenth_of_its_range_and_space_stands() -> None:
    ours, theirs = pty.openpty()
    keyboard = KeyboardCommands(LIMITS, theirs)
    os.write(ours, b"wwQ")
    until(lambda: keyboard.read(0.0), [0.4, 0.0, 0.1])
    os.write(ours, b"ssssss")
    until(lambda: keyboard.read(0.0), [-0.2, 0.0, 0.1])  # down by a tenth of 1 m/s each
    os.write(ours, b"w" * 40)
    until(lambda: keyboard.read(0.0), [2.0, 0.0, 0.1])
    os.write(ours, b" ")
    until(lambda: keyboard.read(0.0), [0.0, 0.0, 0.0])
    keyboard.close()
    os.close(ours)
    os.close(theirs)


def test_a_terminal_that_closes_means_stand() -> None:
    ours, theirs = pty.openpty()
    keyboard = KeyboardCommands(LIMITS, theirs)
    os.write(ours, b"w")
    until(lambda: keyboard.read(0.0), [0.2, 0.0, 0.0])
    os.close(ours)
    until(lambda: keyboard.read(0.0), [0.0, 0.0, 0.0])
    os.close(theirs)


def test_a_keyboard_needs_a_terminal(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w+") as file, pytest.raises(SurefootError, match="keyboard needs a terminal"):
        KeyboardCommands(LIMITS, file.fileno())


def test_sticks_give_shares_of_the_range_and_a_lost_gamepad_means_stand(tmp_path: Path) -> None:
    device = tmp_path / "js0"
    os.mkfifo(device)
    reading = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
    writing = os.open(device, os.O_WRONLY)
    gamepad = GamepadCommands(LIMITS, device)
    os.close(reading)

    def event(value: int, number: int, kind: int = 2) -> bytes:
        return struct.pack("<IhBB", 0, value, kind, number)

    os.write(writing, event(-32767, 1, 0x82) + event(16384, 0) + event(2000, 3) + event(1, 0, 1))
    found = gamepad.read(0.0)
    # Forward in full, right by half, the other stick within its dead zone.
    assert found == pytest.approx([2.0, -0.25, 0.0], abs=1e-4)
    os.write(writing, event(32767, 1)[:5])
    assert gamepad.read(0.0)[0] == 2.0  # half an event waits for its rest
    os.close(writing)
    assert gamepad.read(0.0).tolist() == [0.0, 0.0, 0.0]
    gamepad.close()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("80", "port is 80; it must be 1024 to 65535"),
        ("99999", "port is 99999"),
        ("nothing.csv", "nothing.csv"),
    ],
)
def test_a_source_that_is_none_is_refused(given: str, message: str) -> None:
    with pytest.raises(SurefootError, match=message):
        open_commands(given, LIMITS)


def test_arrows_are_no_letters() -> None:
    ours, theirs = pty.openpty()
    keyboard = KeyboardCommands(LIMITS, theirs)
    # Up, left with shift, F1, then w: three keys that end in letters which mean something by themselves.
    os.write(ours, b"\x1b[A\x1b[1;2D\x1bOSw")
    until(lambda: keyboard.read(0.0), [0.2, 0.0, 0.0])
    keyboard.close()
    os.close(ours)
    os.close(theirs)


def test_sources_are_opened_by_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "way.csv").write_text("time,forward,sideways,yaw_rate\n1,0.5,0,0\n2,9,0,0\n")
    file = open_commands(str(tmp_path / "way.csv"), LIMITS)
    assert [file.read(moment)[0] for moment in (0.99, 1.0, 2.5)] == [0.0, 0.5, 9.0]  # clamped, and told, by the loop
    file.close()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        free = taken.getsockname()[1]
    channel = open_commands(str(free), LIMITS)
    assert isinstance(channel, ChannelCommands)
    assert channel.port == free
    channel.close()
    with pytest.raises(SurefootError, match=r"gamepad .*none: No such file or directory; is one connected"):
        GamepadCommands(LIMITS, tmp_path / "none")
    ours, theirs = pty.openpty()
    with os.fdopen(theirs) as terminal:
        before = termios.tcgetattr(theirs)
        monkeypatch.setattr("sys.stdin", terminal)
        keyboard = open_commands("keyboard", LIMITS)
        assert termios.tcgetattr(theirs) != before
        keyboard.close()
        # The terminal is as it was.
        assert termios.tcgetattr(theirs) == before
    os.close(ours)


def test_a_gamepad_that_is_pulled_out_means_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = tmp_path / "js0"
    device.write_bytes(struct.pack("<IhBB", 0, -32767, 2, 1))
    gamepad = GamepadCommands(LIMITS, device)
    assert gamepad.read(0.0)[0] == 2.0
    os.lseek(gamepad._file, 0, os.SEEK_SET)
    monkeypatch.setattr(os, "read", mock.Mock(side_effect=OSError(19, "No such device")))
    assert gamepad.read(0.0).tolist() == [0.0, 0.0, 0.0]
    gamepad.close()
