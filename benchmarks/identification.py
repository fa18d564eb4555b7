"""Identify emulated robots with hidden parameters, and compare estimates and true values.

    python benchmarks/identification.py --seeds 1-10 --worlds mujoco bullet --out build/identification.jsonl

Each draw is a process of its own (`surefoot emulate --hidden-seed`), on its rack and then on the ground; experiments
and fits see what comes over the link and nothing else. The hidden values are read after all fits.
Reported are the share of hidden values within their 95 % intervals, median errors, how many values were not
identifiable, which count as neither, and the time that robot and fits took.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.actuator.motor import motor_torque
from surefoot.deploy.links import open_link
from surefoot.deploy.loop import RunMonitor
from surefoot.identify.experiment_runner import PERIOD, run_plan
from surefoot.identify.recording import COMPLETE
from surefoot.identify.registry import EXPERIMENTS
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params

HIDDEN = (
    *("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio", "motor_strength"),
    *("motor_friction", "torque_constant", "resistance", "voltage", "servo_latency", "control_latency"),
    *("contact_friction", "imu_bias", "imu_noise"),
)
"""Parameters that `--hidden-seed` draws: all rows of Table I but the control step, which is the host's, and K_t, R and
the servo's latency."""
ORDER = ("motor", "mass", "contact", "latency")
"""The motor experiment first: the battery's voltage is that of a robot just switched on."""


def one_draw(robot: RobotDescription, world: str, seed: int) -> dict[str, Any]:
    """Identify one robot."""
    params = PhysicalParams.nominal(robot)
    sensors: dict[str, Any] = {}
    results: dict[str, Any] = {}
    times: dict[str, tuple[float, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name in ORDER:
            experiment = EXPERIMENTS[name]
            hidden = Path(folder) / f"{name}.toml"
            command = [sys.executable, "-m", "surefoot", "emulate", "--world", world, "--lockstep"]
            command += ["--hidden-seed", str(seed), "--out", str(hidden), "--seed", str(seed)]
            process = subprocess.Popen(
                [*command, *(["--rack"] if experiment.rack else [])],
                stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True,
            )  # fmt: skip
            try:
                port = process.stdout.readline().split()[-1] if process.stdout is not None else ""
                link = open_link(port, robot.num_motors, lockstep=True)
                link.connect(state_period=PERIOD)
                recording = run_plan(link, experiment.plan(robot), robot, RunMonitor())
                link.close()
            finally:
                process.send_signal(signal.SIGINT)
                process.wait()
            if recording.meta["ended"] != COMPLETE:
                return {"world": world, "seed": seed, "failed": f"{name}: {recording.meta['ended']}"}
            start = time.perf_counter()
            result = experiment.fit(robot, recording, params, sensors)
            times[name] = (recording.duration, time.perf_counter() - start)
            results[name] = result
            if name != "latency":
                params, sensors = result.params(robot, params), sensors | result.sensors
        truth = read_params(Path(folder) / "motor.toml", robot).params
    return {"world": world, "seed": seed, "times": times, "values": compare(robot, results, truth)}


def compare(robot: RobotDescription, results: dict[str, Identification], truth: PhysicalParams) -> list[dict[str, Any]]:
    """Return each hidden value beside its estimate."""
    rows = []
    for name in HIDDEN:
        true = np.atleast_1d(getattr(truth, name)[0])
        for result in results.values():
            for item in result.estimates:
                if item.name == name:
                    low, high = item.interval
                    value = float(true[item.index or 0])
                    rows.append(
                        {
                            "name": name, "experiment": result.experiment, "index": item.index, "true": value,
                            "estimate": item.value, "low": low, "high": high, "identifiable": item.identifiable,
                        }
                    )  # fmt: skip
    legs = robot.urdf.total_mass - body_mass(robot)
    mass = truth.base_mass_ratio[0] * body_mass(robot) + truth.leg_mass_ratio[0] * legs
    total = results["mass"].estimate("total_mass")
    low, high = total.interval
    rows.append({"name": "total_mass", "experiment": "mass", "index": None, "true": float(mass),
                 "estimate": total.value, "low": low, "high": high, "identifiable": True})  # fmt: skip
    rows.append(
        {"name": "saturation_curve", "experiment": "motor", "index": None, **curve(robot, results["motor"], truth)}
    )
    return rows


def body_mass(robot: RobotDescription) -> float:
    """Mass of the base and all that is fixed to it [kg]."""
    return sum(robot.urdf.links[name].mass for name in robot.urdf.fixed_to(robot.base))


def curve(robot: RobotDescription, motor: Identification, truth: PhysicalParams) -> dict[str, Any]:
    """Mean relative error of torque over net voltage, .2 to 8 V, of all motors: strength, R and the curve together."""
    volts = np.linspace(0.2, 8.0, 40)[:, None]
    table = robot.torque_table
    strength = np.array([motor.estimate("motor_strength", m).value for m in range(robot.num_motors)])
    ours = motor_torque(volts / motor.estimate("resistance").value, strength, *table)
    true = motor_torque(volts / truth.resistance[0], truth.motor_strength[0], *table)
    return {
        "true": 0.0,
        "estimate": float(np.mean(np.abs(ours / true - 1))),
        "low": None,
        "high": None,
        "identifiable": True,
    }


def summary(draws: list[dict[str, Any]]) -> str:
    """A table of all draws."""
    lines, done = [], [draw for draw in draws if "failed" not in draw]
    lines += [f"{draw['world']} {draw['seed']}: {draw['failed']}" for draw in draws if "failed" in draw]
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for draw in done:
        for row in draw["values"]:
            groups[row["experiment"], row["name"]].append({**row, "world": draw["world"]})
    lines.append(
        f"{'parameter':<20} {'from':<8} {'n':>4} {'not identifiable':>8} {'inside':>7} {'median error':>14} "
        f"{'relative':>9}  worst"
    )
    for (experiment, name), rows in groups.items():
        identifiable = [row for row in rows if row["identifiable"]]
        line = f"{name:<20} {experiment:<8} {len(rows):>4} {len(rows) - len(identifiable):>8} "
        if not identifiable:
            lines.append(line.rstrip())
            continue
        errors = np.array([abs(row["estimate"] - row["true"]) for row in identifiable])
        if name == "saturation_curve":
            lines.append(line + f"{'':>7} {'':>14} {100 * np.median(errors):>8.2f}%  {100 * errors.max():.2f}%")
            continue
        relative = errors / np.maximum(np.abs([row["true"] for row in identifiable]), 1e-12)
        hits = sum(row["low"] <= row["true"] <= row["high"] for row in identifiable)
        lines.append(
            line + f"{hits:>7} {np.median(errors):>14.6f} {100 * np.median(relative):>8.2f}%  {errors.max():.6f}"
        )
    hidden = [row for rows in groups.values() for row in rows if row["name"] in HIDDEN]
    lines.append(f"hidden values within their 95 % intervals: {_inside(hidden)}")
    lines += [
        f"  {world}: {_inside([row for row in hidden if row['world'] == world])}"
        for world in sorted({row["world"] for row in hidden})
    ]
    for k, what in enumerate(("robot", "fits")):
        spent = [sum(times[k] for times in draw["times"].values()) for draw in done]
        if spent:
            lines.append(f"{what}: {np.mean(spent):.0f} s, at most {max(spent):.0f} s for a whole identification")
    return "\n".join(lines)


def _inside(rows: list[dict[str, Any]]) -> str:
    """Return how many identifiable values lie within their intervals, and how many were not identifiable."""
    identifiable = [row for row in rows if row["identifiable"]]
    hits = sum(row["low"] <= row["true"] <= row["high"] for row in identifiable)
    share = f", {100 * hits / len(identifiable):.1f} %" if identifiable else ""
    return f"{hits} of {len(identifiable)}{share}; {len(rows) - len(identifiable)} not identifiable"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1-10", help="first and last hidden seed")
    parser.add_argument("--worlds", nargs="+", default=["mujoco", "bullet"])
    parser.add_argument("--out", type=Path, default=Path("build/identification.jsonl"), help="draws, one a line")
    args = parser.parse_args()
    first, last = (int(part) for part in (args.seeds.split("-") * 2)[:2])
    robot = RobotDescription.load("minitaur")
    args.out.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in args.out.read_text().splitlines()] if args.out.exists() else []
    draws = []
    for seed in range(first, last + 1):
        for world in args.worlds:
            draw = next((d for d in done if (d["world"], d["seed"]) == (world, seed)), None)
            if draw is None:
                start = time.perf_counter()
                draw = one_draw(robot, world, seed)
                with args.out.open("a") as file:
                    file.write(json.dumps(draw) + "\n")
                print(f"{world} {seed}: {draw.get('failed', 'done')} ({time.perf_counter() - start:.0f} s)", flush=True)
            draws.append(draw)
    print(summary(draws))


if __name__ == "__main__":
    main()
