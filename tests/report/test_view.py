"""Port of viser's server: invalid input does not flood the terminal."""

from __future__ import annotations

import socket
import subprocess
import sys

import pytest

pytest.importorskip("viser")

SERVER = """
import sys
from surefoot.report.pages.view import RobotView
view = RobotView()
print(view.port, flush=True)
sys.stdin.read()
view.stop()
"""
GARBAGE = (b"\x00\xff" * 100, b"hello\r\n\r\n", b"GET / HTTP/9\r\n\r\n", b"", b"GET " + b"a" * 100_000, b"\x16\x03\x01")


def test_invalid_input_to_the_port_of_the_view_is_reported_once():
    process = subprocess.Popen([sys.executable, "-c", SERVER], stdin=-1, stdout=-1, stderr=-1, text=True)
    assert process.stdout is not None
    port = int(process.stdout.readline())
    for _ in range(2):
        for data in GARBAGE:
            with socket.create_connection(("127.0.0.1", port)) as line:
                line.settimeout(10)
                try:
                    line.sendall(data)
                    line.shutdown(socket.SHUT_WR)
                    while line.recv(1000):
                        pass
                except OSError:  # it was rejected
                    pass
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert errors.splitlines() == [
        "surefoot: the port of the 3D view received invalid input, not from a browser; it is ignored, also in future"
    ]
