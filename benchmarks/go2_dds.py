"""Deploy a policy on simulated Go2s over DDS in real time: walking speed, timing of commands, response to faults.

    python benchmarks/go2_dds.py runs emulated vendor fitted --count 10 [--busy 2] [--speed 1.0] [--policy FILE]
    python benchmarks/go2_dds.py faults [NAME ...] [--phase run ...]

`emulated` is surefoot's own robot; `vendor` and `fitted` are two variants of an independent simulator
(`tests/vendor_go2.py`). Rows are written to results/go2_dds/runs.csv and faults.csv, and replace rows of the same case.

A run: stand up, walk forward from 0.5 s on, sit. `speed` is the mean from 3 s on. Gaps are the times between commands
when they were written, from the first command to the last that was not damping; `bare` gaps are from an idle loop that
wakes up every 2 ms at the same time. Loads are in percent of one core while the policy runs.

A fault begins while the robot stands up, while the policy runs, or while it sits. `damped_ms` is the time after it at
which the robot received a damping command, with no later command that has a gain. `loop`, `supervisor` and `watchdog`
are killed; with `-hangs` they are suspended for a second.
"""

from __future__ import annotations

import argparse
import csv
import os
import signal
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bare_loop import BareLoop
from go2_runs import (
    ROBOTS,
    Deploy,
    Robot,
    Witness,
    busy_programs,
    cpu_time,
    measure_capture,
    steer_forward,
    watch,
)

from surefoot.deploy.motion_runner import STARTUP_TIME
from surefoot.tables import read_csv

POLICY = "go2-steer"
"""Policy of rows that name none."""
RESULTS = Path(__file__).parents[1] / "results" / "go2_dds"
SETTLED = 3.0
"""Time [s] after which the speed of a run counts."""
PATIENCE = 60.0
FAULT_RUN = 1.5
"""Duration [s] of the policy in a run that a fault ends."""
PHASES = {"stand up": STARTUP_TIME - 1.2, "run": STARTUP_TIME + 0.8, "sit": STARTUP_TIME + FAULT_RUN + 0.12}
"""When a fault begins [s after arming]."""
PROCESSES = ("loop", "keeper", "watcher")
KILLS = (*PROCESSES, "loop-hangs", "keeper-hangs")
HANG = 1.0
"""Time [s] for which a process is suspended."""
FAULTS = (
    *("late=0.3", "frozen", "damaged", "nan", "restart", "motor-off", "lost", "hot", "battery", "tilt"),
    *("stop", "stick", "controller", "writer"),
)


def percentile(values: np.ndarray, percent: float) -> float:
    """Return a percentile; NaN without values."""
    return float(np.percentile(values, percent)) if len(values) else float("nan")


def walk(kind: str, speed: float, busy: int, number: int, duration: float, domain: int, policy: str) -> dict[str, Any]:
    """Return the metrics of one run."""
    loads: dict[str, list[float]] = {}

    def read_loads() -> None:
        pids = {"robot": robot.process.pid, "loop": deploy.process.pid, **deploy.helpers()}
        for name, pid in pids.items():
            loads.setdefault(name, []).extend((cpu_time(pid), time.monotonic()))

    with tempfile.TemporaryDirectory() as name, busy_programs(busy):
        folder = Path(name)
        robot = Robot(kind, domain, folder)
        witness = Witness(domain)
        bare = BareLoop()
        steering = steer_forward(folder, speed)
        deploy = Deploy(domain, folder, "--duration", duration, "--commands", steering, policy=policy)
        try:
            actions = [(STARTUP_TIME + 0.5, read_loads), (STARTUP_TIME + duration - 0.5, read_loads)]
            watch(deploy, witness, actions, PATIENCE + duration)
            code, report, errors = deploy.result()
            _, commands, _ = robot.end()
        finally:
            deploy.kill()
            robot.kill()
            bare_metrics = bare.end()
        seen = witness.commands()
        run = (report.get("runs") or [{}])[0]
        row: dict[str, Any] = {"policy": Path(policy).stem, "robot": kind, "command": speed, "busy": busy}
        row |= {"number": number, "exit_code": code}
        row["ended"] = run.get("ended", errors.strip()[:200])
        row["what"] = run.get("what", "")
        if kind == "emulated":
            row["speed"] = measure_capture(robot.capture_file, SETTLED)
        else:
            armed = commands["time"][commands["kp"] > 0]
            began = float(armed[0]) + 1e9 * (STARTUP_TIME + SETTLED) if len(armed) else np.nan
            walking = (commands["time"] > began) & (commands["time"] < began + 1e9 * (duration - SETTLED))
            row["speed"] = float(commands["forward"][walking].mean()) if walking.any() else float("nan")
        row |= command_metrics(seen) | bare_metrics
        for who, (before, then, after, now) in ((k, v) for k, v in loads.items() if len(v) == 4):
            row[f"{who}_load"] = (after - before) / (now - then)
        timing = run.get("timing", {})
        row |= {"missed": timing.get("missed"), "lateness_p99_9_ms": timing.get("lateness_p99_9_ms")}
    return row


def command_metrics(seen: np.ndarray) -> dict[str, Any]:
    """Return rate and gaps of commands up to the last one with a gain, and the number of later ones."""
    active = np.flatnonzero(seen["kp"] > 0)
    if not len(active):
        return {"frames": 0}
    times = seen["written"][: active[-1] + 1].astype(np.int64)
    gaps = 1e-6 * np.diff(times)
    rest = seen[active[-1] + 1 :]
    return {
        "frames": len(times),
        "rate": 1e9 * len(gaps) / float(times[-1] - times[0]),
        "gap_p99_ms": percentile(gaps, 99),
        "gap_p99_9_ms": percentile(gaps, 99.9),
        "gap_max_ms": float(gaps.max()),
        "damping_frames": int(((rest["kp"] == 0) & (rest["kd"] > 0)).sum()),
    }


def inject(fault: str, phase: str, domain: int) -> dict[str, Any]:
    """Return the response to a fault of the `vendor` robot."""
    began: list[int] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        robot = Robot("vendor", domain, folder)
        witness = Witness(domain)
        deploy = Deploy(domain, folder, "--duration", FAULT_RUN)

        def begin() -> None:
            if fault not in KILLS:
                began.append(robot.inject(fault))
                return
            name, _, hangs = fault.partition("-")
            pid = {"loop": deploy.process.pid, **deploy.helpers()}[name]
            began.append(time.monotonic_ns())
            os.kill(pid, signal.SIGSTOP if hangs else signal.SIGKILL)
            if hangs:
                actions.append((PHASES[phase] + HANG, partial(os.kill, pid, signal.SIGCONT)))

        actions: list[tuple[float, Callable[[], object]]] = [(PHASES[phase], begin)]
        try:
            watch(deploy, witness, actions, PATIENCE)
            code, report, errors = deploy.result()
            _, commands, _ = robot.end()
        finally:
            deploy.kill()
            robot.kill()
    row: dict[str, Any] = {"fault": fault.partition("=")[0], "phase": phase, "exit_code": code}
    run = (report.get("runs") or [{}])[0]
    row |= {"ended": run.get("ended", ""), "what": run.get("what", errors.strip().splitlines()[-1:])}
    active = np.flatnonzero(commands["kp"] > 0)
    row["armed"] = bool(len(active))
    if began and len(active):
        rest = commands[active[-1] + 1 :]
        damping = rest["time"][(rest["kp"] == 0) & (rest["kd"] > 0) & (rest["time"] > began[0])]
        row["damped_ms"] = 1e-6 * (int(damping[0]) - began[0]) if len(damping) else float("nan")
        row["damping_frames"] = len(damping)
    return row


def save(name: str, keys: tuple[str, ...], rows: list[dict[str, Any]]) -> None:
    """Write rows to a table of the results; they replace rows with the same keys."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    path = RESULTS / f"{name}.csv"
    table = {tuple(row.get(key) or POLICY for key in keys): row for row in read_csv(path)}
    for row in rows:
        row = {key: f"{value:.5g}" if isinstance(value, float) else value for key, value in row.items()}
        table[tuple(str(row[key]) for key in keys)] = row
    columns = list(dict.fromkeys(key for row in table.values() for key in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        writer.writeheader()
        writer.writerows(table.values())


def main() -> None:
    """Measure, print and save."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="what")
    runs = commands.add_parser("runs")
    runs.add_argument("robots", nargs="*", metavar="ROBOT", help=", ".join(ROBOTS))
    runs.add_argument("--count", type=int, default=1)
    runs.add_argument("--busy", type=int, default=0, help="additional programs that each need a processor")
    runs.add_argument("--speed", type=float, default=0.5)
    runs.add_argument("--duration", type=float, default=10.0)
    runs.add_argument("--policy", default=POLICY, help="name or file")
    faults = commands.add_parser("faults")
    faults.add_argument("names", nargs="*", metavar="FAULT")
    faults.add_argument("--phase", nargs="*", metavar="PHASE", default=[*PHASES])
    for command in (runs, faults):
        command.add_argument("--domain", type=int, default=90)
    options = parser.parse_args()
    if options.what == "faults":
        for fault in options.names or (*FAULTS, *KILLS):
            for phase in options.phase:
                row = inject(fault, phase, options.domain)
                print(row, flush=True)
                save("faults", ("fault", "phase"), [row])
        return
    if options.what is None:
        options = parser.parse_args(["runs"])
    for kind in options.robots or ROBOTS:
        for number in range(options.count):
            row = walk(kind, options.speed, options.busy, number, options.duration, options.domain, options.policy)
            print(row, flush=True)
            save("runs", ("policy", "robot", "command", "busy", "number"), [row])


if __name__ == "__main__":
    main()
