"""Errors of simulators on Pupper v2's logs [rad]: the published simulator, the released parameters, and held-out fits.

    python benchmarks/pupper_logs.py                        # all rows; three minutes per fit
    python benchmarks/pupper_logs.py whole published        # some rows; the others are kept

Rows: the published simulator; `data sheet` and `identified`, which ship (the latter is fitted to these logs); `whole`,
fitted to two logs and run on the third; and fits with parts of the model left out.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.identify.motion.priors import default_names
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import compare_motions, replay_motion
from surefoot.identify.motion.robot_fit import fit_robot
from surefoot.identify.motion.robot_model import GROUND_SECONDS
from surefoot.identify.motion.traces import read_motion
from surefoot.identify.replay import Replayer
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import load_params
from surefoot.tables import print_table, read_csv, write_csv

DATA = Path(__file__).parents[1] / "data" / "pupper_v2"
LOGS = ("right_side_1khz", "one_hip_200hz", "front_200hz")
RACKED = ("one_hip_200hz",)
LEFT_OUT: dict[str, tuple[tuple[str, ...], dict[str, float]]] = {
    "whole": ((), {}),
    "no load-dependent friction": (("load_friction",), {"load_friction": 0.0}),
    "no speed filter": (("speed_filter",), {"speed_filter": 0.0}),
    "no rotor inertia": (("rotor_inertia",), {"rotor_inertia": 1e-4}),
    "no offsets of encoders": (("motor_offset",), {}),
    "centre of mass as described": (("base_offset",), {}),
    "friction of all motors alike": (("friction_ratio",), {}),
    "shear of feet as stiff as they are": (("contact_shear_ratio",), {}),
}


ROWS = ("published", "data sheet", "identified", *LEFT_OUT)


def errors(what: str, robot: RobotDescription, runs: dict[str, RecordedMotion]) -> dict[str, Any]:
    """Return the row of a simulator: its error on each log [rad], in MuJoCo and in Bullet."""
    row: dict[str, Any] = {"simulator": what}
    for name, run in runs.items():
        if what == "published":
            row[name] = compare_motions(run, read_motion(DATA / "published_simulator" / f"{name}.npz", robot)).rms
            row[f"{name}_bullet"] = None
            continue
        if what in LEFT_OUT:
            without, values = LEFT_OUT[what]
            nominal = PhysicalParams.nominal(robot).with_values(robot, **values)
            names = [name for name in default_names(robot, False) if name not in without]
            others = [other for key, other in runs.items() if key != name]
            params = fit_robot(robot, others, [], names, nominal, GROUND_SECONDS).params(robot, nominal)
        else:
            params = load_params(robot, "identified" if what == "identified" else None, ())
        for world, ending in (("mujoco", ""), ("bullet", "_bullet")):
            replayer = Replayer(robot, 1, run.rack, world, torques=False)
            row[name + ending] = replay_motion(run, robot, params.rows(np.zeros(1, np.int64)), replayer).rms
    return row


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", choices=[[], *ROWS], help="defaults to all")
    parser.add_argument("--out", type=Path, default=Path("results/identification/pupper_logs.csv"))
    options = parser.parse_args()
    robot = RobotDescription.load("pupper_v2")
    runs = {name: replace(read_motion(DATA / f"{name}.npz", robot), rack=name in RACKED) for name in LOGS}
    table = {row["simulator"]: row for row in read_csv(options.out)}
    for what in options.rows or ROWS:
        table[what] = errors(what, robot, runs)
        write_csv(options.out, [table[name] for name in ROWS if name in table])
        print_table([{key: f"{x:.4f}" if isinstance(x, float) else x for key, x in table[what].items()}])


if __name__ == "__main__":
    main()
