"""Success rate at a command of 0.5 m/s on terrain, by kind and size; writes a table and a figure.

    python benchmarks/terrain.py go2-terrain go2-steer
    python benchmarks/terrain.py go2-terrain --world bullet
    python benchmarks/terrain.py go2-terrain --table1
    python benchmarks/terrain.py go2-terrain-seeing --table1 --but control_step
    python benchmarks/terrain.py go2-terrain --world boxes --kinds stairs --episodes 32
    python benchmarks/terrain.py go2-terrain --gains 40 1 --kinds flat slope stairs

In the world `boxes`, stairs are box geoms with MuJoCo's own contacts (benchmarks/box_stairs.py).

64 robots, 10 s. Success: no fall, and 0.7 to 1.25 times the commanded path. Rows are written to
results/terrain/success.csv, and replace rows of the same case; `--missing` measures only missing ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.api.policies import find_policy, load_gait
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.policy_table import measure
from surefoot.evaluation.rollout import run_episodes
from surefoot.report.figures.terrain import success_figure
from surefoot.robot.params import GAINS
from surefoot.robot.randomization import load_ranges
from surefoot.tables import read_csv, write_csv
from surefoot.world.registry import WORLDS, find_world

RESULTS = Path(__file__).parents[1] / "results" / "terrain"
SIZES: dict[str, tuple[float, ...]] = {
    "stairs": (0.05, 0.08, 0.10, 0.12, 0.15),
    "stairs_down": (0.08, 0.12, 0.15, 0.18),
    "slope": (10, 20, 25),
    "slope_down": (10, 20, 25),
    "rough": (0.05, 0.10, 0.12, 0.15),
    "blocks": (0.05, 0.08, 0.12, 0.15),
    "gaps": (0.10, 0.15, 0.20, 0.25),
    "stones": (0.50, 0.35, 0.25),
}
WORLDS["boxes"] = replace(WORLDS["mujoco"], engine="box_stairs:BoxEngine")
KEYS = ("policy", "world", "robots", "kind", "size")


@dataclass(frozen=True)
class Command:
    """Measure, print and write."""

    policies: Annotated[tuple[str, ...], tyro.conf.Positional] = ("go2-terrain",)
    world: str = "mujoco"
    table1: bool = False
    """Randomize physical parameters in the paper's ranges (table I)."""
    but: tuple[str, ...] = ()
    """Parameters of table I that stay nominal; the difference shows their effect."""
    gains: tuple[float, float] | None = None
    """Servo gains [N m/rad, N m s/rad]. Defaults to the policy's."""
    kinds: tuple[str, ...] = ("flat", *SIZES)
    episodes: int = 64
    threads: int = 0
    missing: bool = False
    command: tuple[float, float, float] = (0.5, 0.0, 0.0)
    out: Path = RESULTS


def main(command: Command) -> None:
    """Measure every selected terrain."""
    path = command.out / "success.csv"
    table = {tuple(row[key] for key in KEYS): row for row in read_csv(path)}
    for name in command.policies:
        policy, robot, task, _ = load_gait(find_policy(name), None)
        ranges = load_ranges("table1", robot=robot.folder)
        if unknown := set(command.but) - set(ranges):
            raise SystemExit(f"--but {unknown.pop()} is not a parameter of table I; choose from {', '.join(ranges)}")
        ranges = {row: limits for row, limits in ranges.items() if row not in command.but}
        gains = dict(zip(GAINS, command.gains, strict=True)) if command.gains else {}
        condition = Condition(
            randomize=ranges if command.table1 else {},
            params=gains,
            command_rows=(command.command,),
            duration=10.0,
            curricula=True,
        )
        robots = " but ".join(["table1", *command.but]) if command.table1 else "nominal"
        robots += "".join([" gains", *(f" {value:g}" for value in gains.values())]) if gains else ""
        for kind in command.kinds:
            for size in SIZES.get(kind, (0.0,)):
                key = (Path(name).stem, command.world, robots, kind, f"{size:g}")
                if command.missing and key in table:
                    continue
                terrain = kind if kind == "flat" else f"{kind}:{size:g}"
                run = replace(condition, terrain=terrain).apply(task, robot)
                traces = run_episodes(policy, run, command.episodes, find_world(command.world), threads=command.threads)
                metrics = measure(traces, robot.weight)
                wanted = ("success", "falls", "episodes", "rmse_forward", "rmse_stride_forward", "power")
                table[key] = dict(zip(KEYS, key, strict=True)) | {
                    item: f"{value:.3g}" if isinstance(value := metrics[item], float) else value for item in wanted
                }
                print(*table[key].values(), flush=True)
                write_csv(path, [table[key] for key in sorted(table, key=lambda key: (*key[:4], float(key[4])))])
    success_figure(list(table.values()), command.out / "success.png")


if __name__ == "__main__":
    main(tyro.cli(Command))
