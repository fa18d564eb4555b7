"""Deploy a trained gait on an emulated robot: emulator and host in two processes, connected by a serial line.

1. `surefoot emulate` is the robot: a microcontroller and a Minitaur, in another engine than the training's.
2. `surefoot doctor` checks link, contract and computer before a motor moves.
3. `surefoot deploy` makes the robot stand up, run the gait for a whole episode, and sit down; three times.
4. `surefoot gap` evaluates simulated and deployed runs with the same functions, and draws both.

    python examples/deploy_on_emulator.py                    # trot-robust, in Bullet if PyBullet is installed
    python examples/deploy_on_emulator.py gallop --episodes 1
"""

from __future__ import annotations

import argparse
import importlib.util
import shutil
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

REFUSED, LATE = 2, 3
"""Exit codes: rejected (a policy for another robot, or a robot whose states arrive too late to arm it), and ended by a
safety rule. A busy computer may cause both."""


@contextmanager
def emulator(*words: str | Path) -> Iterator[str]:
    """Run an emulator; yield the name of its port."""
    command = [sys.executable, "-m", "surefoot", "emulate", *map(str, words)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        line = process.stdout.readline() if process.stdout else ""
        if not line.startswith("robot on "):
            raise SystemExit(process.wait() or 1)
        print(f"$ surefoot emulate {' '.join(map(str, words))}\n{line}", end="", flush=True)
        yield line.removeprefix("robot on ").split()[0]
    finally:
        process.send_signal(signal.SIGINT)
        process.wait(timeout=20)


def surefoot(*words: str | Path) -> int:
    """Run a command in its own process, as a user would; return its exit code."""
    print(f"\n$ surefoot {' '.join(map(str, words))}", flush=True)
    return subprocess.run([sys.executable, "-m", "surefoot", *map(str, words)], check=False).returncode


def deploy(policy: str, world: str, runs: int, out: Path, lockstep: bool = False) -> int:
    """Deploy a policy on an emulator and measure its gap; return the exit code."""
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    capture, traces = out / "motion_capture.csv", out / "deployed"
    clock = ["--lockstep"] if lockstep else []
    with emulator("--world", world, "--out", capture, *clock) as port:
        # An emulator cannot be damaged: continue after a failed check, which a busy computer may cause.
        if surefoot("doctor", policy, "--port", port, *clock) == REFUSED:
            raise SystemExit(REFUSED)
        code = surefoot(
            *("deploy", policy, "--port", port, "--episodes", str(runs), "--motion-capture", capture, "--out", traces),
            *("--world-name", f"emulator ({world})", *clock),
        )
    return code or surefoot("gap", policy, "--from", "mujoco", "--to", "trace", traces, "--out", out / "gap")


def other_world() -> str:
    """Return another engine than the training's, if it is installed."""
    return "bullet" if importlib.util.find_spec("pybullet") is not None else "mujoco"


def show(policy: str, world: str, runs: int, out: Path, lockstep: bool = False) -> int:
    """Deploy a policy in real time, or in lockstep if the computer is too busy; return the exit code."""
    code = deploy(policy, world, runs, out, lockstep)
    if code in (REFUSED, LATE) and not lockstep:
        print("\nThe robot was not armed, or a safety rule ended the run; maybe the computer is too busy. In lockstep:")
        code = deploy(policy, world, runs, out, lockstep=True)
    return code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policy", nargs="?", default="trot-robust")
    parser.add_argument("--world", default=other_world())
    parser.add_argument("--episodes", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("out/deployed"))
    parser.add_argument("--lockstep", action="store_true", help="robot time follows the times in the host's frames")
    asked = parser.parse_args()
    return show(asked.policy, asked.world, asked.episodes, asked.out, asked.lockstep)


if __name__ == "__main__":
    raise SystemExit(main())
