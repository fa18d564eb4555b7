"""Record a walking Go2 in real time over the loopback interface, as a ROS 2 bag of /lowstate and /lowcmd.

    python benchmarks/go2_recording.py fitted FOLDER [--speed 0.5] [--duration 8]
    surefoot identify import FOLDER/bag --robot go2 --out FOLDER/runs/walk.npz
    surefoot identify --trace FOLDER/runs --robot go2 --out FOLDER/identified

Robots are as in benchmarks/go2_dds.py. `identified/robot.toml` of `fitted` is results/go2_dds/identified.toml.
"""

from __future__ import annotations

import argparse
import runpy
import sys
import time
from pathlib import Path

from go2_runs import ROBOTS, VENDOR_GO2, Deploy, Robot, steer_forward, take_stamped

from surefoot.deploy.dds import bus, types

write_bag = runpy.run_path(str(VENDOR_GO2.with_name("go2_bag.py")))["write_bag"]


def record(kind: str, folder: Path, speed: float, duration: float, domain: int) -> int:
    """Write the bag; return the exit code of `surefoot deploy`."""
    listener = bus.Bus("lo", domain)
    readers = {
        "/lowstate": listener.reader(bus.LOW_STATE_TOPIC, types.LowState, 4096),
        "/lowcmd": listener.reader(bus.LOW_COMMAND_TOPIC, types.LowCmd, 4096),
    }
    messages: list[tuple[str, int, bytes]] = []
    robot = Robot(kind, domain, folder)
    deploy = Deploy(domain, folder, "--duration", duration, "--commands", steer_forward(folder, speed))
    try:
        while not deploy.ended:
            for topic, reader in readers.items():
                messages += [(topic, *message) for message in take_stamped(reader)]
            time.sleep(0.002)
    finally:
        deploy.kill()
        robot.kill()
    write_bag(folder / "bag", sorted(messages, key=lambda message: message[1]))
    return deploy.result()[0]


def main() -> int:
    """Record a run."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("robot", choices=ROBOTS)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--speed", type=float, default=0.5)
    parser.add_argument("--duration", type=float, default=8.0)
    parser.add_argument("--domain", type=int, default=91)
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    return record(options.robot, options.folder, options.speed, options.duration, options.domain)


if __name__ == "__main__":
    sys.exit(main())
