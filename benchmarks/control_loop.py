r"""Timing of the control loop with the emulator on the same computer: lateness, inference time, age of states.

    bare      a loop that only sleeps until each control step is due, as a reference for the computer
    deployed  `surefoot deploy` in real time: readings in, checks, policy, command out, recording

Both run for the same time, one after the other, with the same emulator running. Lateness is the delay of a step's start
after its due time; `sent` is the delay of its command; `state age` is the age of the newest state when a step uses it.
The deployed loop polls the clock for the last part of a wait. `--busy` programs keep processors busy meanwhile. A robot
on its rack does not heat up; with `--ground` it walks.

    python benchmarks/control_loop.py                                   # one run of a minute in each world
    python benchmarks/control_loop.py trot-robust go2-steer --worlds bullet --lines pty socket --busy 3 --runs 8 \
        --seconds 10 --ground --out results/control_loop.csv

The table has one row per policy, world and line (pseudo-terminal or socket): the number of runs, how many reached their
end, and the maximum times over all runs [ms].
"""

from __future__ import annotations

import argparse
import contextlib
import itertools
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from emulated import gain_options

from surefoot.api.policies import find_policy, open_policy
from surefoot.studies.robot_identification import SUREFOOT_COMMAND
from surefoot.tables import write_csv


@contextlib.contextmanager
def busy_programs(count: int) -> Iterator[None]:
    """Run programs that keep processors busy; they exit if this process is killed."""
    program = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100_000))"
    programs = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(count)]
    try:
        yield
    finally:
        for process in programs:
            process.kill()
            process.wait()


def bare_loop(seconds: float, step: float) -> dict[str, float]:
    """Return the lateness of a loop that only sleeps [ms]."""
    late = np.empty(max(round(seconds / step), 1))
    start = time.monotonic()
    for k in range(len(late)):
        due = start + step * (k + 1)
        time.sleep(max(due - time.monotonic(), 0.0))
        late[k] = 1e3 * (time.monotonic() - due)
    names, shares = ("median", "p99_9", "max"), (50, 99.9, 100)
    parts = zip(names, np.percentile(late, shares).tolist(), strict=True)
    metrics = {f"lateness_{name}_ms": part for name, part in parts}
    return metrics | {"missed": int((late > 1e3 * step).sum())}


def run(policy: str, world: str, line: str, options: argparse.Namespace) -> dict[str, Any]:
    """Run both loops with an emulator in one world; return the deployment's report and the emulator's summary."""
    runtime, robot = open_policy(find_policy(policy))
    with tempfile.TemporaryDirectory() as folder:
        words = ["--robot", str(robot.folder), "--world", world, *([] if options.ground else ["--rack"])]
        words += gain_options(policy)
        emulator = subprocess.Popen(
            [*SUREFOOT_COMMAND, "emulate", *words, *(["--socket", f"{folder}/robot"] if line == "socket" else [])],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            port = re.match(r"robot on (\S+)", emulator.stdout.readline() if emulator.stdout else "")
            if port is None:
                raise SystemExit(f"no emulator: {emulator.communicate()[1]}")
            bare = bare_loop(options.seconds, runtime.contract.control_step)
            words = ["deploy", policy, "--port", port[1], "--duration", str(options.seconds), "--json"]
            done = subprocess.run(
                [*SUREFOOT_COMMAND, *words, "--out", folder], capture_output=True, text=True, check=False
            )
        finally:
            emulator.send_signal(signal.SIGINT)
            output = emulator.communicate(timeout=20)[1]
    if not done.stdout:
        refusal = done.stderr.strip().splitlines()[-1]
        return {"ended": "refused", "what": refusal, "bare": bare, "emulator": output.splitlines()[-1]}
    return {**json.loads(done.stdout)["runs"][0], "bare": bare, "emulator": output.splitlines()[-1]}


def print_run(result: dict[str, Any]) -> None:
    """Print the metrics of one run."""
    print(f"  {result['ended']} ({result['what']}); {result['emulator'].removeprefix('surefoot: ')}")
    rows = [("bare", "lateness", result["bare"])]
    if "timing" in result:
        names = ("lateness", "sent", "inference", "state_age")
        rows += [(name.replace("_", " "), name, result["timing"]) for name in names]
        print(f"  {result['steps']} steps, {result['timing']['stale']} without a new state")
    print(f"  {'':10}{'median':>11}{'99.9 %':>11}{'max':>11}   missed")
    for title, name, metrics in rows:
        numbers = (metrics[f"{name}_{key}_ms"] for key in ("median", "p99_9", "max"))
        times = (f"{number:>8.3f} ms" if number is not None else f"{'-':>11}" for number in numbers)
        print(f"  {title:10}{''.join(times)}   {metrics['missed'] if name == 'lateness' else ''}", flush=True)


def summary(case: str, busy: int, results: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the row of a case."""
    timings = [result["timing"] for result in results if "timing" in result]
    steps = sum(timing["steps"] for timing in timings)
    return {
        **{"case": case, "busy_programs": busy, "runs": len(results)},
        "ended_well": sum(result["ended"] == "time" for result in results),
        "steps": steps,
        "missed": sum(timing["missed"] for timing in timings),
        "without_new_state": sum(timing["stale"] for timing in timings) / max(steps, 1),
        "bare_max_ms": max(result["bare"]["lateness_max_ms"] for result in results),
        **{
            f"{name}_max_ms": max((timing[f"{name}_max_ms"] for timing in timings), default=None)
            for name in ("lateness", "sent", "state_age")
        },
    }


def main() -> None:
    """Run all cases; print each run, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("policies", nargs="*", default=["trot-robust"])
    parser.add_argument("--worlds", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--lines", nargs="+", default=["pty"], choices=["pty", "socket"])
    parser.add_argument("--seconds", type=float, default=60.0, help="duration of each run [s]")
    parser.add_argument("--runs", type=int, default=1)
    parser.add_argument("--busy", type=int, default=0, help="programs that keep processors busy")
    parser.add_argument("--ground", action="store_true", help="let the robot walk")
    parser.add_argument("--out", type=Path, help="table of the cases (.csv)")
    options = parser.parse_args()
    rows = []
    for policy, world, line in itertools.product(options.policies, options.worlds, options.lines):
        results, case = [], f"{policy}/{world}/{line}"
        for number in range(options.runs):
            with busy_programs(options.busy):
                results.append(run(policy, world, line, options))
            print(f"{case}, run {number + 1} of {options.runs}")
            print_run(results[-1])
        rows.append(summary(case, options.busy, results))
        print(rows[-1], flush=True)
        if options.out is not None:
            write_csv(options.out, rows)


if __name__ == "__main__":
    main()
