"""A robot at a Unix socket: bytes in both directions, one host at a time, and the socket is removed."""

from __future__ import annotations

import re
import socket
from pathlib import Path
from typing import Any

import pytest

from surefoot.deploy.dds.socket_port import SocketPort, connect
from surefoot.deploy.robot_link import LinkLostError
from surefoot.emulator.serial.socket_server_port import SocketServerPort
from surefoot.errors import SurefootError


@pytest.fixture
def robot(tmp_path: Path) -> Any:
    port = SocketServerPort(tmp_path / "robot")
    yield port
    port.close()


def host(robot: SocketServerPort) -> SocketPort:
    """A connected host; the robot runs in the same thread, so its greeting is read explicitly."""
    end = socket.socket(socket.AF_UNIX)
    end.connect(robot.path)
    assert robot.wait(1.0)
    robot.read()
    port = SocketPort(end, "robot")
    port.wait(1.0)
    return port


def test_bytes_go_both_ways_and_a_host_can_reconnect(robot: SocketServerPort) -> None:
    assert robot.has_no_host()
    for _ in range(2):
        port = host(robot)
        assert port.read() == b"\0"
        assert not robot.has_no_host()
        assert not robot.wait(0.0)
        port.write(b"command")
        assert robot.wait(1.0)
        assert robot.read() == b"command"
        robot.write(b"state")
        port.wait(1.0)
        assert port.read() == b"state"
        port.close()
        assert robot.wait(1.0)
        assert robot.read() == b""
        assert robot.has_no_host()
        robot.write(b"to nobody")


def read_on(port: SocketPort) -> None:
    """Read until the port is lost."""
    while True:
        port.read()


def test_a_second_host_is_rejected_and_the_first_one_stays(robot: SocketServerPort) -> None:
    first, second = host(robot), socket.socket(socket.AF_UNIX)
    second.connect(robot.path)
    robot.read()
    assert second.recv(1) == b""
    second.close()
    first.write(b"still here")
    assert robot.wait(1.0)
    assert robot.read() == b"still here"
    robot.close()
    with pytest.raises(LinkLostError, match="robot is gone"):
        read_on(first)


def test_a_host_that_does_not_read_loses_frames_and_does_not_block(robot: SocketServerPort) -> None:
    port = host(robot)
    for _ in range(1000):
        robot.write(bytes(1000))
    assert robot.unread > 100
    port.close()


def test_hosts_are_rejected_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "robot"
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    with pytest.raises(SurefootError, match=f"port {re.escape(str(path))}: can't be opened: Connection refused"):
        connect(str(path))
    listener.listen()
    monkeypatch.setattr("surefoot.deploy.dds.socket_port._ACCEPT_TIMEOUT", 0.05)
    with pytest.raises(SurefootError, match="can't be opened: timed out"):
        connect(str(path))
    listener.close()


def test_a_socket_of_a_killed_emulator_is_replaced_and_other_paths_are_rejected(tmp_path: Path) -> None:
    path = tmp_path / "robot"
    dead = socket.socket(socket.AF_UNIX)
    dead.bind(str(path))
    dead.close()
    robot = SocketServerPort(path)
    with pytest.raises(SurefootError, match="Address already in use; give another name"):
        SocketServerPort(path)
    robot.close()
    assert not path.exists()
    path.touch()
    with pytest.raises(SurefootError, match="Address already in use; give another name"):
        SocketServerPort(path)
