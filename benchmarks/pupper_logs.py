"""Fit Pupper v2's logs, each held out in turn, with parts of the model left out: how far the log held out is off.

python benchmarks/pupper_logs.py                 every part, every log held out
python benchmarks/pupper_logs.py --only whole --bullet
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from surefoot.identify.logs.errors import replay_log
from surefoot.identify.logs.fit import fit_logs
from surefoot.identify.logs.model import PRIORS, LogRun
from surefoot.identify.logs.robot_log import read_log
from surefoot.identify.replay import Replayer
from surefoot.robot import PhysicalParams, RobotDescription

DATA = Path(__file__).parents[1] / "data" / "pupper_v2"
RACKED = ("one_hip_200hz",)
PUBLISHED = {"right_side_1khz": 0.0725, "one_hip_200hz": 0.0191, "front_200hz": 0.0588}
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=LEFT_OUT, help="one row of the table")
    parser.add_argument("--bullet", action="store_true", help="replay the log held out in Bullet too")
    options = parser.parse_args()
    robot = RobotDescription.load("pupper_v2")
    logs = {name: read_log(DATA / f"{name}.npz", robot) for name in PUBLISHED}
    runs = {name: LogRun(log, name in RACKED) for name, log in logs.items()}
    for what in [options.only] if options.only else LEFT_OUT:
        without, values = LEFT_OUT[what]
        nominal = PhysicalParams.nominal(robot).with_values(robot, **values)
        names = [name for name in PRIORS if name not in without]
        cells = []
        for held in runs:
            result = fit_logs(robot, [run for name, run in runs.items() if name != held], [], names, nominal)
            params = result.params(robot, nominal)
            for world in ("mujoco", "bullet")[: 1 + options.bullet]:
                replayer = Replayer(robot, 1, runs[held].rack, world, torques=False)
                error = replay_log(logs[held], robot, params.rows(np.zeros(1, np.int64)), replayer).rms
                cells.append(f"{held} {world} {error:.4f} (1/{PUBLISHED[held] / error:.1f})")
        print(f"{what:<36} {'   '.join(cells)}", flush=True)


if __name__ == "__main__":
    main()
