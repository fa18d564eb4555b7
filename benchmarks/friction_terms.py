"""Benefit of each friction term: errors on held-out logs [rad], for logs of a Pupper and of a Go2.

    python benchmarks/friction_terms.py --go2 air.npz --rows Coulomb "and presliding"
    python benchmarks/friction_terms.py --pupper

The Go2's log is a trace of `surefoot identify import` of a suspended robot, including its gains. Each half is predicted
by a fit to the other half. Each of the Pupper's logs is predicted by a fit to the other two.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.identify.motion.priors import default_names
from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.motion.replay_errors import replay_motion
from surefoot.identify.motion.robot_fit import fit_robot
from surefoot.identify.motion.robot_model import GROUND_SECONDS
from surefoot.identify.motion.traces import read_motion
from surefoot.identify.replay import Replayer
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import GAINS
from surefoot.tables import print_table, read_csv, write_csv

DATA = Path(__file__).parents[1] / "data" / "pupper_v2"
LOGS = ("right_side_1khz", "one_hip_200hz", "front_200hz")
RACKED = ("one_hip_200hz",)
FRICTION = (
    "motor_friction",
    "friction_ratio",
    "load_friction",
    "presliding",
    "motor_viscous_friction",
    "viscous_ratio",
)
ROWS: dict[str, tuple[str, ...]] = {
    "no friction": (),
    "viscous": ("motor_viscous_friction",),
    "Coulomb": ("motor_viscous_friction", "motor_friction"),
    "of each motor": ("motor_viscous_friction", "motor_friction", "friction_ratio", "viscous_ratio"),
    "and load-dependent": (
        *("motor_viscous_friction", "motor_friction", "friction_ratio", "viscous_ratio", "load_friction"),
    ),
    "and presliding": ("motor_viscous_friction", "motor_friction", "friction_ratio", "viscous_ratio", "presliding"),
}
"""Friction terms that are fitted; the others are 0, or 1 if they are ratios."""


def held_out_error(
    robot: RobotDescription, terms: tuple[str, ...], fitted: list[RecordedMotion], held: RecordedMotion
) -> float:
    """Return the error on a held-out log [rad] with some of the friction terms."""
    rack = all(motion.rack for motion in fitted)
    off = {name: 0.0 for name in FRICTION if name not in terms and not name.endswith("ratio")}
    prior = PhysicalParams.nominal(robot).with_values(robot, **off, **held.gains)
    names = [*(name for name in default_names(robot, rack) if name not in FRICTION), *terms]
    seconds = None if rack else GROUND_SECONDS
    known = [name for name in GAINS if name in held.gains]
    params = fit_robot(robot, fitted, [], names, prior, seconds, known=known).params(robot, prior)
    replayer = Replayer(robot, 1, held.rack, torques=False)
    return replay_motion(held, robot, params.rows(np.zeros(1, np.int64)), replayer).rms


def main() -> None:
    """Write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--go2", type=Path, help="trace of a suspended Go2")
    parser.add_argument("--pupper", action="store_true")
    parser.add_argument("--rows", nargs="*", choices=[[], *ROWS], default=[])
    parser.add_argument("--out", type=Path, default=Path("results/identification/friction_terms.csv"))
    options = parser.parse_args()
    table: dict[str, dict[str, Any]] = {name: {"friction": name} for name in ROWS}
    table |= {row["friction"]: row for row in read_csv(options.out)}
    cases: list[tuple[str, RobotDescription, list[RecordedMotion], RecordedMotion]] = []
    if options.go2 is not None:
        go2 = RobotDescription.load("go2")
        log = replace(read_motion(options.go2, go2), rack=True)
        middle, end = float(np.ptp(log.time)) / 2, float(np.ptp(log.time))
        first, second = log.crop(0.0, middle), log.crop(middle, end)
        cases += [("go2, first half", go2, [second], first), ("go2, second half", go2, [first], second)]
    if options.pupper:
        pupper = RobotDescription.load("pupper_v2")
        runs = {name: replace(read_motion(DATA / f"{name}.npz", pupper), rack=name in RACKED) for name in LOGS}
        for name, run in runs.items():
            cases.append((f"pupper, {name}", pupper, [other for key, other in runs.items() if key != name], run))
    for what in options.rows or ROWS:
        for case, robot, fitted, held in cases:
            table[what][case] = held_out_error(robot, ROWS[what], fitted, held)
        columns = list(dict.fromkeys(key for row in table.values() for key in row))
        write_csv(options.out, [{key: row.get(key) for key in columns} for row in table.values()])
        print_table([{key: f"{x:.4f}" if isinstance(x, float) else x for key, x in table[what].items()}])


if __name__ == "__main__":
    main()
