"""Simulated computers of a Ray cluster: each is a group of processes on this machine with its own address."""

from __future__ import annotations

import os
import secrets
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

os.environ |= {
    "RAY_AUTH_MODE": "token",
    "RAY_AUTH_TOKEN": secrets.token_hex(32),
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_worker_niceness": "0",
    "RAY_health_check_period_ms": "300",  # A lost node is detected after five missed heartbeats: 1.5 s instead of 15 s.
}
"""Environment variables that Ray reads once at import, in this process and in processes started by tests."""


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


class Node:
    """Computer with one processor for workers."""

    def __init__(self, log: Path, *words: str, cpus: int = 1) -> None:
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", *words, "--num-cpus", str(cpus)]
        command += ["--include-log-monitor", "false"]
        with log.open("wb") as output:
            self._process = subprocess.Popen(
                [*command, "--object-store-memory", str(80 << 20)], stdout=output, stderr=output, start_new_session=True
            )
        deadline = time.monotonic() + 120
        while b"monitored and a message" not in log.read_bytes():
            assert self._process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.1)

    def kill(self) -> None:
        """Kill all its processes, as by a power failure."""
        # The processes of a node share a process group; workers end with the node's main process.
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()


class Cluster:
    """Cluster whose first computer runs until the end.

    `address` is the value for `--ray`.
    """

    def __init__(self, folder: Path, cpus: int) -> None:
        self._folder, port = folder, free_port()
        self.address, self.nodes = f"127.0.0.1:{port}", list[Node]()
        head = ("--head", "--node-ip-address", "127.0.0.1", "--port", str(port))
        # Unused services are disabled, because they take seconds to start.
        without = ("--no-monitor", "--ray-client-server-port", str(free_port()), "--include-dashboard", "false")
        self._start(*head, *without, cpus=cpus)

    def _start(self, *words: str, cpus: int) -> Node:
        self.nodes.append(Node(self._folder / f"node_{len(self.nodes)}.log", *words, cpus=cpus))
        return self.nodes[-1]

    def join(self) -> Node:
        """Start another computer."""
        host = f"127.0.0.{len(self.nodes) + 1}"
        return self._start("--address", self.address, "--node-ip-address", host, cpus=1)


@contextmanager
def cluster(folder: Path, cpus: int) -> Iterator[Cluster]:
    """Context manager that starts the first computer of a cluster, and stops all computers at the end."""
    nodes: list[Node] = []
    try:
        made = Cluster(folder, cpus)
        nodes = made.nodes
        yield made
    finally:
        for node in reversed(nodes):
            node.kill()
