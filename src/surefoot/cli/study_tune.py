"""`surefoot study tune`: optimize a handcrafted gait for a robot and a speed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated

import tyro

from surefoot.api.episodes import print_summaries
from surefoot.api.policies import run_policy
from surefoot.cli.helpers.options import Count, check_suffix
from surefoot.cli.helpers.parsing import parse
from surefoot.errors import SurefootError
from surefoot.progress import ProgressBar
from surefoot.studies.tune import TuneConfig, Tuner, curve_path, has_converged, read_curve
from surefoot.tables import write_csv
from surefoot.task.handcrafted import HandcraftedGait


@dataclass(frozen=True)
class TuneCommand(TuneConfig):
    """Optimize the foot trajectories of a handcrafted gait for minimum power at a given speed, with CMA-ES.

    The file that is written is also a task: `surefoot train FILE` learns feedback on top of the gait.
    """

    start_from: Path | None = None
    """Handcrafted gait (.yaml) to start from, such as for another speed or without Raibert's controller."""
    out: Annotated[
        Path | None,
        tyro.conf.arg(
            help="File (.yaml) for the best gait so far, updated after each generation. Defaults to GAIT-SPEED.yaml. "
            "Next to it, GAIT-SPEED-tuning.csv contains the minimum cost of each generation, including the history of "
            "--start-from.",
        ),
    ] = None
    episodes: Count = 20
    """Number of episodes of 6 s in which the final gait is measured."""


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(TuneCommand, argv, "surefoot study tune")
    check_suffix("gait", command.out, ".yaml")
    config = TuneConfig(**{item.name: getattr(command, item.name) for item in fields(TuneConfig)})
    start = {} if command.start_from is None else HandcraftedGait.load(command.start_from).about.get("parameters")
    if not isinstance(start, dict):
        raise SurefootError(f"{command.start_from}: handcrafted.about.parameters is missing; the gait was not tuned")
    from surefoot.evaluation.runs import summarize
    from surefoot.world.sim_world import SimWorld

    tuner = Tuner(config, SimWorld, start)
    path = command.out or Path(f"{tuner.gait().task.name}.yaml")
    earlier = [] if command.start_from is None else read_curve(command.start_from)
    settings = {"gait": path.stem, "starts": config.starts, "duration": config.duration, "control_steps": tuner.steps}
    with ProgressBar(f"{config.generations} generations") as bar:
        for generation in range(config.generations):
            tuner.step()
            tuner.gait().save(path)
            curve = [{**settings, "cost": cost} for cost in tuner.curve]
            write_csv(curve_path(path), [*earlier, *curve])
            bar.advance((generation + 1) / config.generations)
            if config.patience and has_converged(tuner.curve, config.patience):
                break
    tuner.finish()
    gait = tuner.gait()
    gait.save(path)
    name, title, episodes = gait.task.name, f"{command.episodes} episodes", command.episodes
    traces = run_policy(gait.policy(), gait.task, episodes, "mujoco", config.seed + 1, config.threads, name, title)
    print_summaries({f"{name} in mujoco": summarize(traces, tuner.robot.urdf.total_mass)})
    print(f"wrote {path}")
    return 0
