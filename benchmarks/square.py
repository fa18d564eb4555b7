"""Distance between start and end after a square of 2 m, which a robot follows by a command file and `surefoot deploy`.

The robot is emulated behind a pseudo-terminal with noisy sensors; `surefoot deploy` runs the policy as on a real one.
Only the policy and the heading control (by the IMU's yaw) correct the path. A corner is a stop, a quarter turn on the
spot, and a stop. Writes one row per engine, with the worst of its runs.
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np
from emulated import deploy

from surefoot.rotations import quat_yaw
from surefoot.tables import write_csv
from surefoot.task.trace import EpisodeTrace

SIDE = 2.0
"""Side length of the square [m]."""
REST = 0.6
"""Standing time before each side and corner [s]."""


def square(forward: float, yaw_rate: float) -> tuple[list[tuple[float, float, float, float]], float]:
    """Return rows of time [s] and commands for a square to the left at speeds [m/s, rad/s], and the end time."""
    rows, time = [], 0.0
    for _ in range(4):
        for speed, rate, seconds in ((forward, 0.0, SIDE / forward), (0.0, yaw_rate, np.pi / 2 / yaw_rate)):
            rows += [(time + REST, speed, 0.0, rate), (time + REST + seconds, 0.0, 0.0, 0.0)]
            time += REST + seconds
    return rows, time + REST


def drive(policy: str, robot: str, world: str, forward: float, yaw_rate: float, seed: int) -> EpisodeTrace:
    """Emulate a robot, drive the square, and return the run."""
    rows, duration = square(forward, yaw_rate)
    with tempfile.TemporaryDirectory() as name:
        commands = Path(name) / "square.csv"
        table = ["time,forward,sideways,yaw_rate", *(",".join(f"{value:.6f}" for value in row) for row in rows)]
        commands.write_text("\n".join(table))
        words = ("--commands", commands, "--duration", f"{duration:.3f}")
        return deploy(policy, *words, robot=("--robot", robot, "--world", world, "--seed", seed))[0]


def main() -> None:
    """Drive squares, print where they end, and write the table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--policy", default="go2-steer")
    parser.add_argument("--robot", default="go2", help="name or folder of the emulated robot")
    parser.add_argument("--worlds", nargs="+", default=["mujoco", "bullet"], help="engines that emulate it")
    parser.add_argument("--forward", type=float, default=0.5, help="speed along the sides [m/s]")
    parser.add_argument("--yaw-rate", type=float, default=0.6, help="yaw rate in the corners [rad/s]")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2], help="seed of the sensor noise")
    parser.add_argument("--out", type=Path, default=Path("results/steer/square.csv"))
    options = parser.parse_args()
    rows = []
    for world in options.worlds:
        traces = [
            drive(options.policy, options.robot, world, options.forward, options.yaw_rate, seed)
            for seed in options.seeds
        ]
        paths = [trace.base_position_world[:, :2] for trace in traces]
        turns = [np.unwrap(quat_yaw(trace.base_quat_world)) for trace in traces]
        rows.append(
            {
                **{"world": world, "runs": len(traces), "falls": sum(trace.fell for trace in traces)},
                "seconds": max(trace.duration for trace in traces),
                "distance": max(np.linalg.norm(path[-1] - path[0]) for path in paths),
                "missing_yaw_deg": max(abs(360.0 - np.degrees(yaw[-1] - yaw[0])) for yaw in turns),
                "side_error": max(np.abs(np.ptp(path, axis=0) / SIDE - 1.0).max() for path in paths),
            }
        )
        print(rows[-1], flush=True)
    write_csv(options.out, rows)


if __name__ == "__main__":
    main()
