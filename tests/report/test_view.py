"""Port of viser's server: invalid input does not flood the terminal; ground that is drawn around a robot."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from typing import Any

import numpy as np
import pytest

from surefoot.world.terrain import make_terrain

pytest.importorskip("viser")
pytest.importorskip("trimesh")
from surefoot.report.pages.view import GroundParts

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


class Scene:
    """Stands for viser's scene."""

    def __init__(self) -> None:
        self.nodes: list[str] = []

    def add_glb(self, name: str, model: bytes, **_: Any) -> None:
        assert model[:4] == b"glTF"
        self.nodes.append(name)


def test_the_part_that_the_robot_leaves_stays_until_another_is_needed():
    scene = Scene()
    parts = GroundParts(scene, make_terrain("slope:10"))  # type: ignore[arg-type]

    def go(x: float, count: int) -> list[str]:
        parts.follow(np.array([x, 0.0]))
        deadline = time.monotonic() + 60.0
        while len(scene.nodes) < count and time.monotonic() < deadline:
            time.sleep(0.01)
            parts.follow(np.array([x, 0.0]))
        return scene.nodes

    try:
        assert go(0.5, 1) == ["/world/ground0"]
        assert go(4.5, 2) == ["/world/ground0", "/world/ground1"]
        assert go(0.5, 2) == ["/world/ground0", "/world/ground1"]
        assert go(-4.0, 3) == ["/world/ground0", "/world/ground1", "/world/ground1"]
        assert go(-8.0, 4)[3:] == ["/world/ground0"]
    finally:
        parts.stop()
