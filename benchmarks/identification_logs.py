"""Coverage of the intervals of `surefoot identify --trace`, on logs of simulated suspended Go2s with hidden parameters.

    python benchmarks/identification_logs.py --logs 1-20             # half a minute each
    python benchmarks/identification_logs.py --logs 1-5 --known      # the fit knows the gains
    python benchmarks/identification_logs.py --summary               # the table of existing logs

The robots are simulated with MuJoCo's own actuators and joint friction and a step of 1 ms; of surefoot, they use only
the URDF. Gains, friction, damping, rotor inertia, delay and encoder offsets are random. A missing interval means that
the fit declared the value unidentifiable.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.robot_fit import fit_robot
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS
from surefoot.tables import print_table, read_csv, write_csv

OUT = Path("results/identification/hidden_logs.csv")
STEP, EVERY, SETTLE, LENGTH = 0.001, 5, 2.0, 12.0
LOW = np.array([-0.1, 1.2, -2.4, 0.1, 1.2, -2.4] * 2)
HIGH = np.array([-0.5, 0.6, -1.4, 0.5, 0.6, -1.4] * 2)
NOISE = 1e-4
"""Standard deviation of encoder noise [rad]."""
FACTORS = {"motor_friction": (0.5, 2.0), "motor_viscous_friction": (0.5, 2.0), "rotor_inertia": (0.5, 1.5)}
"""Factors of the data sheet's values, by kind of joint."""


def draw_truth(robot: RobotDescription, number: int) -> dict[str, Any]:
    """Return a robot's random hidden parameters, as arrays over its 12 motors or numbers."""
    draw, nominal = np.random.default_rng([64, number]), PhysicalParams.nominal(robot)
    truth: dict[str, Any] = {
        "servo_kp": draw.uniform(15, 60),
        "servo_kd": draw.uniform(0.5, 2.5),
        "control_latency": draw.uniform(0.0, 0.015),
        "motor_offset": draw.uniform(-0.02, 0.02, 12),
    }
    for name, (low, high) in FACTORS.items():
        truth[name] = getattr(nominal, name)[0] * np.tile(np.exp(draw.uniform(np.log(low), np.log(high), 3)), 4)
    return truth


def make_log(robot: RobotDescription, truth: dict[str, Any], number: int) -> RecordedMotion:
    """Return the log of a suspended robot that rests, then follows triangle waves of increasing frequency."""
    spec = mujoco.MjSpec.from_file(str(robot.folder / "go2.urdf"))
    spec.option.timestep, spec.option.integrator = STEP, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for name in robot.motor_names:
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        kp, kd = truth["servo_kp"], truth["servo_kd"]
        motor.gainprm[0], motor.biastype, motor.biasprm[:3] = kp, mujoco.mjtBias.mjBIAS_AFFINE, [0, -kp, -kd]
    model = spec.compile()
    dofs = [model.joint(name).dofadr[0] for name in robot.motor_names]
    places = [model.joint(name).qposadr[0] for name in robot.motor_names]
    model.dof_armature[dofs] = truth["rotor_inertia"]
    model.dof_damping[dofs], model.dof_frictionloss[dofs] = truth["motor_viscous_friction"], truth["motor_friction"]
    data = mujoco.MjData(model)
    data.qpos[places] = LOW
    ticks = int((SETTLE + LENGTH) / STEP)
    angles, times, commands = np.empty((ticks, 12)), [], []
    for tick in range(ticks):
        t = tick * STEP - SETTLE
        phase = max(t, 0.0) * (0.3 + 0.02 * max(t, 0.0))
        share = 1 - abs(2 * (phase % 1.0) - 1)
        angles[tick] = data.qpos[places]
        if tick % EVERY == 0:
            command = LOW + share * (HIGH - LOW)
            # The motor controller closes its loop with its own encoder.
            data.ctrl[:] = command - truth["motor_offset"]
            if t >= -1e-9:
                times.append(t)
                commands.append(command)
        mujoco.mj_step(model, data)
    draw = np.random.default_rng([65, number])
    at = (np.array(times) + SETTLE - truth["control_latency"]) / STEP
    readings = np.stack([np.interp(at, np.arange(ticks), column) for column in angles.T], axis=1)
    readings += truth["motor_offset"] + draw.normal(0, NOISE, readings.shape)
    # Times of rows jitter like a measured clock.
    stamps = np.array(times) + draw.uniform(0, 2e-4, len(times))
    return RecordedMotion(f"log {number}", stamps, np.array(commands), stamps, readings, rack=True)


def identify(robot: RobotDescription, number: int, known: bool) -> list[dict[str, Any]]:
    """Return one row per hidden value of a log: true value, estimate and interval."""
    truth = draw_truth(robot, number)
    motion, prior, begin = make_log(robot, truth, number), PhysicalParams.nominal(robot), time.process_time()
    gains = GAINS if known else ()
    prior = prior.with_values(robot, **{name: truth[name] for name in gains})
    result = fit_robot(robot, [motion], [], None, prior, known=gains)
    seconds = time.process_time() - begin
    print(f"log {number}: {seconds:.0f} s, {result.checks[0].after:.5f} rad", file=sys.stderr, flush=True)
    rows = []
    for name in truth:
        if name in gains:
            continue
        # The first joint of each kind: the robot's others have the same values.
        for index in range(12) if name == "motor_offset" else range(3) if np.ndim(truth[name]) else [None]:
            hidden = float(truth[name] if index is None else truth[name][index])
            found = [item for item in result.estimates if item.name == name and item.index in (index, None)]
            item = found[0] if found else None
            identified = item is not None and item.identifiable
            low, high = item.interval if item is not None and identified else (-np.inf, np.inf)
            middle = item.value if item is not None and identified else hidden
            half = (high - low) / 2
            off = abs(middle - hidden) / half if np.isfinite(half) else 0.0
            rows.append({
                "log": number, "known": int(known), "name": name, "index": index, "true": hidden,
                "estimate": middle if identified else None, "low": low, "high": high, "identifiable": int(identified),
                "inside": int(low <= hidden <= high), "half_widths_off": off, "seconds": seconds,
            })  # fmt: skip
    return rows


def summary(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return one row per parameter and one for all: intervals that contain the true value, and missing intervals."""
    table = []
    for known in sorted({row["known"] for row in rows}):
        for name in [*dict.fromkeys(row["name"] for row in rows), "all"]:
            some = [row for row in rows if row["known"] == known and name in (row["name"], "all")]
            if not some:
                continue
            identifiable = [row for row in some if row["identifiable"] == "1"]
            table.append({
                "gains": "known" if known == "1" else "unknown", "parameter": name, "values": len(some),
                "declared": len(some) - len(identifiable), "intervals": len(identifiable),
                "hold": sum(row["inside"] == "1" for row in identifiable),
                "inside_or_declared": sum(row["inside"] == "1" for row in some),
                "worst_half_widths": max((float(row["half_widths_off"]) for row in identifiable), default=0.0),
            })  # fmt: skip
    return table


def main() -> None:
    """Fit logs, and write the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--logs", default="1-20", help="numbers of the logs, such as 1-20")
    parser.add_argument("--known", action="store_true", help="the fit knows the gains")
    parser.add_argument("--summary", action="store_true", help="no fits; print the table of existing logs")
    parser.add_argument("--out", type=Path, default=OUT)
    options = parser.parse_args()
    robot = RobotDescription.load("go2")
    rows = read_csv(options.out)
    first, _, last = options.logs.partition("-")
    for number in [] if options.summary else range(int(first), int(last or first) + 1):
        key = str(number), str(int(options.known))
        rows = [row for row in rows if (row["log"], row["known"]) != key]
        rows += [{name: "" if value is None else str(value) for name, value in row.items()}
                 for row in identify(robot, number, options.known)]  # fmt: skip
        rows.sort(key=lambda row: (row["known"], int(row["log"])))
        write_csv(options.out, rows)
    table = summary(rows)
    write_csv(options.out.with_name("hidden_logs_summary.csv"), table)
    print_table([{key: f"{x:.2f}" if isinstance(x, float) else x for key, x in row.items()} for row in table])


if __name__ == "__main__":
    main()
