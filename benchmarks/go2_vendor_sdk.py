"""Unitree's SDKs with the emulated Go2: rate of states, wrong checksums, stand-up, services, processor time.

    python benchmarks/go2_vendor_sdk.py --json > results/go2_vendor_sdk.json

Needs far-unitree-sdk and unitree-sdk2py-dimos, installed with --no-deps. The first supports only DDS domain 0, so no
other robot may run on the loopback interface meanwhile. It keeps only the last state: states that arrive while the
reader is not scheduled are not counted (`states`, `hz`), even though it has real-time priority if the system allows it.
The Python SDK calls a function for each state, so it counts all (`python_...`).
"""

from __future__ import annotations

import argparse
import csv
import json
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
CLIENTS = ROOT / "tests" / "vendor_clients.py"


def client(*words: object) -> dict[str, Any]:
    """Run one of the SDK programs; return its report, with the number of the C++ SDK's lines about wrong checksums."""
    done = subprocess.run([sys.executable, CLIENTS, *map(str, words)], capture_output=True, text=True, check=True)
    return {**json.loads(done.stdout.splitlines()[-1]), "crc_errors": (done.stdout + done.stderr).count("CRC Error")}


class Robot:
    """Emulated Go2 on the loopback interface, with motion capture."""

    def __init__(self, *words: object) -> None:
        self._folder = tempfile.TemporaryDirectory()
        self.capture = Path(self._folder.name) / "capture.csv"
        command = [sys.executable, "-m", "surefoot", "emulate", "--robot", "go2", "--link", "dds", "--interface", "lo"]
        self._process = subprocess.Popen(
            [*command, "--out", self.capture, *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        assert self._process.stdout.readline().startswith("robot on ")

    def heights(self) -> list[float]:
        """Return the base's heights so far [m], at 200 Hz."""
        with self.capture.open() as file:
            return [float(row["z"]) for row in list(csv.DictReader(file))[:-1]]  # the last one may be half written

    def stop(self) -> str:
        """End the emulator; return its summary line."""
        self._process.terminate()
        _, output = self._process.communicate(timeout=30)
        self._folder.cleanup()
        return output.splitlines()[-1]


def measure(count: int, world: str) -> dict[str, Any]:
    """Return all metrics; angles [rad], heights of the base [m]."""
    robot = Robot("--world", world)
    read = client("read", count)
    counted = client("count", 0, count)
    idle = processor_load(robot.stop())

    robot = Robot("--world", world)
    time.sleep(1.0)  # it sinks onto its belly
    lying = robot.heights()[-1]
    stood = client("stand")
    standing = robot.heights()[-1]
    bad = client("bad-crc", 0)
    ignored = re.findall(r"damaged (\d+)", robot.stop())[0]

    robot = Robot("--world", world, "--motion-service", "standing")
    example = client("stand-up", 0)
    heights = robot.heights()
    line = robot.stop()
    return {
        "world": world,
        **{name: read[name] for name in ("states", "seconds", "hz")},
        **{f"python_{name}": value for name, value in counted.items() if name != "crc_errors"},
        "gap_median_ms": read["gap_ms"]["median"],
        "gap_p99_ms": read["gap_ms"]["p99"],
        "gap_max_ms": read["gap_ms"]["max"],
        "crc_errors": read["crc_errors"] + stood["crc_errors"],
        "processor_idle_percent": idle,
        "height_lying": lying,
        "height_stood_up_cpp": standing,
        "bad_crc_sent": bad["sent"],
        "bad_crc_ignored": int(ignored),
        "bad_crc_motion": bad["moved"],
        "modes": example["modes"],
        "height_stood_up_python": max(heights),
        "height_laid_down_python": heights[-1],
        "states_damaged_python": example["damaged"],
        "processor_commanded_percent": processor_load(line),
        "summary": line,
    }


def processor_load(line: str) -> int:
    """Return the processor load [%] in a summary line."""
    return int(re.findall(r"(\d+) % of a processor", line)[0])


def main() -> int:
    """Print the metrics."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--count", type=int, default=15_000, help="states to read")
    parser.add_argument("--world", default="mujoco")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    metrics = measure(args.count, args.world)
    if args.json:
        print(json.dumps(metrics, indent=1))
        return 0
    for name, value in metrics.items():
        print(f"{name}: {value}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
