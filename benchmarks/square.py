"""How far from its start a steered robot ends after a square of 2 m, steered by a file through `surefoot deploy`.

The robot is emulated behind a pseudo-terminal, with noise in its sensors; `surefoot deploy` runs the policy as on a
real one. Nothing but the policy and the held heading (the IMU's yaw) corrects the path. A corner is a stop, a quarter
of a turn in place, and a stop.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from surefoot.rotations import quat_yaw
from surefoot.task.trace import EpisodeTrace

SIDE = 2.0
"""Of the square [m]."""
REST = 0.6
"""How long the robot stands before a side and before a corner [s]."""
SUREFOOT = (sys.executable, "-m", "surefoot")


def square(forward: float, yaw_rate: float) -> tuple[list[tuple[float, float, float, float]], float]:
    """Return rows of time [s] and commands for a square to the left at some speeds [m/s, rad/s], and when it ends."""
    rows, time = [], 0.0
    for _ in range(4):
        for speed, rate, seconds in ((forward, 0.0, SIDE / forward), (0.0, yaw_rate, np.pi / 2 / yaw_rate)):
            rows += [(time + REST, speed, 0.0, rate), (time + REST + seconds, 0.0, 0.0, 0.0)]
            time += REST + seconds
    return rows, time + REST


def drive(policy: str, robot: str, world: str, forward: float, yaw_rate: float, seed: int) -> EpisodeTrace:
    """Emulate a robot, let it drive the square, and return the run."""
    rows, duration = square(forward, yaw_rate)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        table = ["time,forward,sideways,yaw_rate", *(",".join(f"{value:.6f}" for value in row) for row in rows)]
        (folder / "square.csv").write_text("\n".join(table))
        capture = str(folder / "capture.csv")
        options = ["--robot", robot, "--world", world, "--seed", str(seed), "--lockstep", "--out", capture]
        emulator = subprocess.Popen([*SUREFOOT, "emulate", *options], stdout=subprocess.PIPE, text=True)
        try:
            assert emulator.stdout is not None
            port = emulator.stdout.readline().split()[-1]
            words = [
                *SUREFOOT,
                "deploy",
                policy,
                "--port",
                port,
                "--lockstep",
                "--motion-capture",
                capture,
                "--out",
                name,
            ]
            words += ["--commands", str(folder / "square.csv"), "--duration", f"{duration:.3f}"]
            subprocess.run(words, check=True, stdout=sys.stderr, stderr=subprocess.DEVNULL)
        finally:
            emulator.terminate()
            emulator.wait()
        return EpisodeTrace.load(folder / "run_000.npz")


def main() -> int:
    """Drive squares and print where they end."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="go2-steer")
    parser.add_argument("--robot", default="go2", help="name or folder of the emulated robot")
    parser.add_argument("--world", default="mujoco", help="engine that emulates it")
    parser.add_argument("--forward", type=float, default=0.5, help="speed along the sides [m/s]")
    parser.add_argument("--yaw-rate", type=float, default=0.6, help="in the corners [rad/s]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="of the sensors' noise")
    options = parser.parse_args()
    for seed in options.seeds:
        trace = drive(options.policy, options.robot, options.world, options.forward, options.yaw_rate, seed)
        path, yaw = trace.base_position_world[:, :2], quat_yaw(trace.base_quat_world)
        result = {
            "seed": seed,
            "seconds": round(trace.duration, 2),
            "fell": trace.fell,
            "closing_error_m": round(float(np.linalg.norm(path[-1] - path[0])), 3),
            "closing_yaw_deg": round(float(np.degrees((yaw[-1] - yaw[0] + np.pi) % (2 * np.pi) - np.pi)), 1),
            "size_m": np.ptp(path, axis=0).round(2).tolist(),
        }
        print(json.dumps(result))
    return 0


if __name__ == "__main__":
    sys.exit(main())
