"""How punctual the control loop is, with the emulator on the same computer: lateness, inference, missed steps.

    bare      a loop that only sleeps until each control step is due: what the computer gives
    deployed  `surefoot deploy` in real time: readings in, checks, policy, command out, recording

Both run for the same number of control steps, one after the other, beside the same emulator, whose robot hangs on its
rack: on the ground its motors would be too hot after a minute. Lateness is how long after its due moment a step begins;
`sent` is when its command was on its way. The deployed loop looks at the clock for the last part of a wait.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

STEP = 0.006


def bare_loop(steps: int) -> dict[str, float]:
    """Lateness of a loop of sleeps [ms]."""
    late = np.empty(steps)
    start = time.monotonic()
    for k in range(steps):
        due = start + STEP * (k + 1)
        time.sleep(max(due - time.monotonic(), 0.0))
        late[k] = time.monotonic() - due
    return figures(late)


def figures(late: np.ndarray) -> dict[str, float]:
    """Median, 99.9th percentile and maximum [ms], and steps that began after the next one was due."""
    return {
        "median_ms": 1e3 * float(np.median(late)),
        "p999_ms": 1e3 * float(np.percentile(late, 99.9)),
        "max_ms": 1e3 * float(late.max()),
        "missed": int((late > STEP).sum()),
    }


def run(world: str, policy: str, steps: int) -> dict[str, Any]:
    """Both loops beside an emulator in one world."""
    surefoot = [sys.executable, "-m", "surefoot"]
    with tempfile.TemporaryDirectory() as folder:
        emulator = subprocess.Popen(
            [*surefoot, "emulate", "--world", world, "--rack"],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            port = re.match(r"robot on (\S+)", emulator.stdout.readline() if emulator.stdout else "")
            if port is None:
                raise SystemExit(f"no emulator: {emulator.communicate()[1]}")
            bare = bare_loop(steps)
            words = ["deploy", policy, "--port", port[1], "--duration", str(steps * STEP), "--json"]
            done = subprocess.run(
                [*surefoot, *words, "--out", str(Path(folder) / "runs")], capture_output=True, text=True, check=False
            )
        finally:
            emulator.send_signal(signal.SIGINT)
            output = emulator.communicate(timeout=20)[1]
    if not done.stdout:
        raise SystemExit(f"deploy ended with {done.returncode}: {done.stderr}")
    deployed = json.loads(done.stdout)["runs"][0]
    return {"world": world, "bare": bare, "deployed": deployed, "emulator": output.strip().splitlines()[-1]}


def print_result(result: dict[str, Any]) -> None:
    """Print one world's figures."""
    bare, run = result["bare"], result["deployed"]
    timing = run["timing"]
    print(f"{result['world']}, robot on its rack; {run['steps']} steps, ended: {run['ended']} ({run['what']})")
    print(f"  {'':10}{'median':>11}{'99.9 %':>11}{'max':>11}   missed")
    rows = (
        ("bare", bare["median_ms"], bare["p999_ms"], bare["max_ms"], bare["missed"]),
        ("deployed", *(timing[f"lateness_{key}_ms"] for key in ("median", "p99_9", "max")), timing["missed"]),
        ("sent", *(timing[f"sent_{key}_ms"] for key in ("median", "p99_9", "max")), ""),
        ("inference", *(timing[f"inference_{key}_ms"] for key in ("median", "p99_9", "max")), ""),
    )
    for name, median, high, worst, missed in rows:
        times = (f"{1e3 * number:>8.1f} us" if number is not None else f"{'-':>11}" for number in (median, high, worst))
        print(f"  {name:10}{''.join(times)}   {missed}")
    share = timing["lateness_p99_9_ms"] / bare["p999_ms"]
    print(f"  deployed to bare, 99.9 %: {share:.2f}")
    print(f"  steps without a new state: {timing['stale']}; emulator: {result['emulator'].removeprefix('surefoot: ')}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=10_000)
    parser.add_argument("--policy", default="trot-robust")
    parser.add_argument("--worlds", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = [run(world, options.policy, options.steps) for world in options.worlds]
    if options.json:
        print(json.dumps(results))
        return
    for result in results:
        print_result(result)


if __name__ == "__main__":
    main()
