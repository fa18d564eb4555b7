"""Identify emulated robots with hidden parameters, and compare estimates and true values.

    python benchmarks/identification.py --seeds 1-5 --worlds mujoco bullet

Each robot is a separate process (`surefoot emulate --hidden-seed`), on its rack and then on the ground; experiments and
fits use only the data that the link transmits. The hidden values are read after all fits. Results of each robot are
stored in --draws, and the tables contain all of them. --out has estimates.csv, one row per value, and accuracy.csv, one
row per parameter: how many values lie within their 95 % intervals, errors, and how many values were not identifiable,
which count as neither. Its last rows are sums over the hidden parameters, and the time for experiments and fits.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from surefoot.actuator.motor import motor_torque
from surefoot.deploy.links import open_link
from surefoot.deploy.loop import RunMonitor
from surefoot.identify.experiment_runner import COMMAND_PERIOD, run_plan
from surefoot.identify.recording import COMPLETE
from surefoot.identify.registry import EXPERIMENTS
from surefoot.identify.result import Identification
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import read_params
from surefoot.studies.robot_identification import emulated_robot
from surefoot.tables import print_table, write_csv

HIDDEN = (
    *("base_mass_ratio", "leg_mass_ratio", "base_inertia_ratio", "leg_inertia_ratio", "motor_strength"),
    *("motor_friction", "torque_constant", "resistance", "voltage", "servo_latency", "control_latency"),
    *("contact_friction", "imu_bias", "imu_noise"),
)
"""Parameters that `--hidden-seed` randomizes: the paper's table I without the control step, which belongs to the host,
and in addition K_t, R and the servo latency."""
WORLDS = ("mujoco", "bullet")
CURVE = "saturation_curve"
"""Name of the rows for strength, R and saturation combined, whose error is relative."""
ORDER = ("motor", "mass", "contact", "latency")
"""The motor experiment comes first, because the battery then has the voltage of a robot just switched on."""


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
            options = ("--world", world, "--hidden-seed", seed, "--out", hidden, "--seed", seed)
            with emulated_robot(*options, *(["--rack"] if experiment.rack else [])) as port:
                link = open_link(port, robot.num_motors, lockstep=True)
                link.connect(state_period=COMMAND_PERIOD)
                recording = run_plan(link, experiment.plan(robot), robot, RunMonitor())
                link.close()
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
    """Return each hidden value with its estimate."""
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
    rows.append({"name": CURVE, "experiment": "motor", "index": None, **curve(robot, results["motor"], truth)})
    return rows


def body_mass(robot: RobotDescription) -> float:
    """Return the mass of the base and everything that is fixed to it [kg]."""
    return sum(robot.urdf.links[name].mass for name in robot.urdf.fixed_to(robot.base))


def curve(robot: RobotDescription, motor: Identification, truth: PhysicalParams) -> dict[str, Any]:
    """Return the mean relative error of the torque at 0.2 to 8 V net voltage over all motors.

    It combines the errors of strength, R and the torque-current curve.
    """
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


def estimates(draws: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per value of all robots, with its error relative to the true value."""
    rows = []
    for draw in draws:
        for value in draw.get("values", ()):
            error = abs(value["estimate"] - value["true"])
            relative = error / max(abs(value["true"]), 1e-12) if value["name"] != CURVE else error
            inside = None if value["low"] is None else value["low"] <= value["true"] <= value["high"]
            errors = {"error": error, "relative": relative, "inside": inside} if value["identifiable"] else {}
            empty = dict.fromkeys(("error", "relative", "inside"))
            rows.append({"world": draw["world"], "seed": draw["seed"], **value, **empty, **errors})
    return rows


def accuracy(rows: list[dict[str, Any]], draws: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per parameter, and rows for all hidden parameters and for times [s]."""
    table = []
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[f"{row['name']}/{row['experiment']}"].append(row)
    hidden = [row for row in rows if row["name"] in HIDDEN]
    groups |= {"hidden": hidden, **{f"hidden/{w}": [r for r in hidden if r["world"] == w] for w in WORLDS}}
    for name, group in groups.items():
        known = [row for row in group if row["identifiable"]]
        counts = {"values": len(group), "identifiable": len(known), "inside": sum(bool(row["inside"]) for row in known)}
        table.append({"parameter": name, **counts, **errors(known, name)})
    for k, name in enumerate(("robot_seconds", "fit_seconds")):
        spent = [sum(times[k] for times in draw["times"].values()) for draw in draws if "times" in draw]
        if spent:
            table.append({"parameter": name, "values": len(spent), "median": median(spent), "worst": max(spent)})
    return table


def errors(rows: list[dict[str, Any]], name: str) -> dict[str, float]:
    """Return median and maximum of absolute and relative errors; empty for several parameters or without values."""
    if not rows or name.startswith("hidden"):
        return {}
    values: dict[str, float] = {}
    for kind, column in (("", "error"), ("_percent", "relative")):
        scale = 100.0 if kind else 1.0
        everywhere = [scale * row[column] for row in rows]
        bullet = [scale * row[column] for row in rows if row["world"] == "bullet"]
        values |= {f"median{kind}": median(everywhere), f"worst{kind}": max(everywhere)}
        values |= {f"median_bullet{kind}": median(bullet)} if bullet else {}
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", default="1-5", help="first and last hidden seed")
    parser.add_argument("--worlds", nargs="+", default=WORLDS)
    parser.add_argument(
        "--draws", type=Path, default=Path("build/identification.jsonl"), help="results, one robot per line"
    )
    parser.add_argument("--out", type=Path, default=Path("results/identification"), help="folder of the tables")
    args = parser.parse_args()
    first, last = (int(part) for part in (args.seeds.split("-") * 2)[:2])
    robot = RobotDescription.load("minitaur")
    args.draws.parent.mkdir(parents=True, exist_ok=True)
    done = [json.loads(line) for line in args.draws.read_text().splitlines()] if args.draws.exists() else []
    for seed in range(first, last + 1):
        for world in args.worlds:
            if not any((draw["world"], draw["seed"]) == (world, seed) for draw in done):
                start = time.perf_counter()
                draw = one_draw(robot, world, seed)
                with args.draws.open("a") as file:
                    file.write(json.dumps(draw) + "\n")
                print(f"{world} {seed}: {draw.get('failed', 'done')} ({time.perf_counter() - start:.0f} s)", flush=True)
                done.append(draw)
    rows = estimates(done)
    write_csv(args.out / "estimates.csv", rows)
    table = accuracy(rows, done)
    write_csv(args.out / "accuracy.csv", table)
    shown = ("parameter", "identifiable", "inside", "median", "median_percent", "worst")
    print_table([{name: _short(row.get(name)) for name in shown} for row in table])


def _short(value: object) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value if value is not None else "")


if __name__ == "__main__":
    main()
