"""`surefoot study tune`: find a handcrafted gait for a robot and a speed."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path

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
    """Tune foot trajectories for the least power at a speed, with CMA-ES, and measure them.

    The file is a task too: `surefoot train FILE` learns feedback on top of the trajectories.
    """

    start_from: Path | None = None
    """Handcrafted gait (.yaml) to begin with, such as one of another speed, or one without Raibert's controller."""
    out: Path | None = None
    """File (.yaml) that the gait is written to, the best so far after every generation; GAIT-SPEED.yaml here, if not
    given. GAIT-SPEED-tuning.csv beside it has the least cost of each generation, those of the gait to begin with
    first."""
    episodes: Count = 20
    """Episodes of 6 s in which the gait is measured at the end."""


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
