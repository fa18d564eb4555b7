"""`surefoot train gallop | trot | FILE.yaml`: learn a gait; `surefoot train --resume RUN`: resume a run."""

from __future__ import annotations

import json
import math
import shlex
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.cli.helpers.options import PAGE_PORT, PagePort
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import Simulator, SimulatorOptions, ranges_help, take_ranges
from surefoot.errors import SurefootError, choices
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.progress import ProgressBar
from surefoot.stop_signals import StopSignals
from surefoot.task.config import preset_names

if TYPE_CHECKING:
    from surefoot.learn.run import Evaluation, TrainingRun
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.trainer import UpdateFigures

_LINE_PERIOD = 10.0
"""Least time between two lines of progress, where there is no terminal [s]."""
_EPISODES = 20
_DRAWN_EPISODES = 100
"""Episodes with physical parameters drawn: falls are rare there, and worlds differ."""
_USAGE = """usage: surefoot train TASK [options]                 learn a gait
       surefoot train --resume RUN [--browser]         resume a run exactly where it stopped, with its own options
       surefoot train TASK --help                      every option, with the task's own values

TASK is {tasks}, or the path of a YAML file.

Besides the options that the last one lists:
{ranges}"""


def main(argv: list[str]) -> int:
    """Run the command; return its exit code."""
    if not argv or argv[0] in ("-h", "--help"):
        print(_USAGE.format(tasks=choices(preset_names()), ranges=ranges_help()))
        return 0 if argv else 2
    if argv[0] == "--resume":
        resumed = parse(ResumeCommand, argv, "surefoot train")
        return _train(None, resumed.resume, resumed.page)
    if argv[0].startswith("-"):
        raise SurefootError(f"'{argv[0]}' is not a task; choices: {choices(preset_names())}, or a YAML file")
    config, command = _parse(argv)
    check_config(config)
    return _train(config, command.runs, command.page)


@dataclass(frozen=True)
class PageOptions:
    """Options for the page of a training."""

    browser: bool = False
    """Show the newest policy on a page in the browser while it learns."""
    page_port: PagePort = PAGE_PORT

    @property
    def page(self) -> int | None:
        """The page's port; None: no page."""
        if self.browser:
            import_module("viser")  # what is not installed is told before there is a run
        return self.page_port if self.browser else None


@dataclass(frozen=True, kw_only=True)
class ResumeCommand(PageOptions):
    """Resume a run exactly where it stopped; the run's own options hold."""

    resume: Path
    """Folder of the run."""


@dataclass(frozen=True)
class TrainCommand(PageOptions, TrainConfig):
    """Learn a gait."""

    simulator: SimulatorOptions = Simulator()
    """Another simulator than the task's."""
    pushes: bool = False
    """Push the robot at random, as the task says how hard and how often."""
    runs: Path = Path("runs")
    """Folder for run folders."""


def _parse(argv: list[str]) -> tuple[TrainConfig, TrainCommand]:
    base = load_train_config(argv[0], _robot(argv))
    words, given_ranges = take_ranges(argv[1:])
    ranges = given_ranges.apply(base.task.robot, base.task.randomize)
    preset = TrainCommand(**vars(base) | {"task": replace(base.task, randomize=ranges)})
    command = parse(TrainCommand, words, f"surefoot train {argv[0]}", preset)
    # What is given by name goes over a file of parameters, which takes the place of the task's own.
    given = {name: value for name, value in command.task.params.items() if base.task.params.get(name) != value}
    task = command.simulator.of(replace(command.task, params=base.task.params), given)
    task = replace(task, pushes=replace(task.pushes, enabled=task.pushes.enabled or command.pushes))
    return TrainConfig(**{name: getattr(command, name) for name in vars(base)} | {"task": task}), command


def _robot(argv: list[str]) -> str | None:
    """Return the robot that the words name, which decides where the task's own values come from."""
    for word, after in zip(argv, [*argv[1:], ""], strict=True):
        name, _, value = word.partition("=")
        if name == "--task.robot":
            return value or after
    return None


class TrainingProgress(ProgressBar):
    """Bar of a run with steps a second, speed and return; a line for each evaluation.

    Args:
        config: the run.
        console: where to show it.
        done: control steps done before, if the run is resumed.
    """

    def __init__(self, config: TrainConfig, console: Console, done: int = 0) -> None:
        self._steps, self._done = config.updates * config.samples_per_update, done
        super().__init__(config.task.name, console, self._steps, done, _LINE_PERIOD, transient=False)
        self._start = time.monotonic()
        self._return = self._speed = math.nan

    def report(self, figures: UpdateFigures, evaluation: Evaluation | None) -> None:
        """Show the figures of an update."""
        if not math.isnan(figures.return_mean):
            self._return, self._speed = figures.return_mean, figures.speed_mean
        rate = (figures.steps - self._done) / (time.monotonic() - self._start)
        text = f"{rate:,.0f} steps/s  speed {self._speed:.2f} m/s  return {self._return:.2f}"
        left = (self._steps - figures.steps) / rate
        line = f"{figures.steps:>9,} of {self._steps:,} steps  {text}  {left:.0f} s left"
        self.advance(figures.steps, text, line)
        if evaluation is not None:
            pushed = f", {evaluation.pushed_falls} with pushes" if evaluation.pushed_falls else ""
            self.print(
                f"{evaluation.steps:>9,} steps, evaluated: {evaluation.speed_mean:.2f} m/s, "
                f"return {evaluation.return_mean:.2f}, {evaluation.power_mean:.0f} W, {evaluation.falls} falls{pushed}",
                "evaluation",
            )


def _train(config: TrainConfig | None, path: Path, page_port: int | None) -> int:
    from surefoot.learn.run import TrainingRun
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.run_lock import alone
    from surefoot.world.registry import find_world

    console = Console()
    resume = config is None
    folder, config = RunFolder.open(path) if config is None else (RunFolder.create(config, path), config)
    with alone(folder.path):
        run = TrainingRun(config, folder, find_world(config.world), resume=resume)
        begun = "Going on with" if resume else "Training"
        console.print(f"{begun} {config.task.name} in {folder.path}", soft_wrap=True)
        with ExitStack() as stack:
            progress = stack.enter_context(TrainingProgress(config, console, run.trainer.steps))
            stop = stack.enter_context(_listen(console))
            after: Callable[..., None] = progress.report
            if page_port is not None:
                from surefoot.cli.helpers.train_page import TrainingPage

                page = TrainingPage(run, page_port)
                stack.callback(page.close)

                def after(*told: Any) -> None:
                    progress.report(*told)
                    page.update()

            run.run(after, lambda: stop.count > 0)
        if not run.finished:
            console.print(f"Stopped and saved at {run.trainer.steps:,} steps. To resume:", highlight=False)
            console.print(f"  surefoot train --resume {folder.path}", soft_wrap=True, highlight=False)
            return 130
        finish(run, folder, console)
    return 0


def _listen(console: Console) -> StopSignals:
    """Turn Ctrl-C and a request to terminate into a stop after the update under way; a second one stops at once."""

    def stop(count: int) -> None:
        if count > 1:
            raise KeyboardInterrupt
        console.print("Stopping after this update; once more stops at once, back at the last checkpoint.")

    return StopSignals(("SIGINT", "SIGTERM"), stop)


def check_config(config: TrainConfig) -> None:
    """Refuse an invalid task or an invalid run to start from, before a run folder is made."""
    from surefoot.task.env import LocomotionEnv
    from surefoot.world.registry import find_world

    LocomotionEnv(config.task, 1, find_world(config.world), threads=1)
    if config.start_from is not None:
        from surefoot.learn.run_folder import RunFolder

        RunFolder.open(Path(config.start_from))


def finish(run: TrainingRun, folder: RunFolder, console: Console) -> None:
    """Export the best policy; evaluate it on the nominal robot, on drawn ones and with pushes where the task has them.

    Tables, figures and a video of the median episode go to the run folder.
    """
    from surefoot.cli.evaluate import draw_episode, print_summaries
    from surefoot.cli.helpers.options import how_to_show
    from surefoot.cli.play import film
    from surefoot.evaluate.gap import home_task
    from surefoot.evaluate.rollout import run_episodes
    from surefoot.evaluate.runs import summarize
    from surefoot.learn.export import export_run
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.robot import RobotDescription
    from surefoot.studies.comparison import learning_curve
    from surefoot.studies.study_figures import learning_curves
    from surefoot.world.registry import find_world

    export_run(run, folder.policy)
    world, make_world = run.config.world, find_world(run.config.world)
    task, policy = run.config.task, PolicyRuntime.load(folder.policy)
    name = policy.contract.name
    robot, figures = RobotDescription.load(task.robot), folder.path / "figures"
    figures.mkdir(exist_ok=True)
    console.print(f"Evaluating over {_EPISODES} episodes ...")
    calm = home_task(task)
    wanted = {"without_pushes": (calm, _EPISODES)}
    if task.randomize:
        wanted["randomized"] = (replace(calm, randomize=task.randomize), _DRAWN_EPISODES)
    if task.pushes.enabled:
        wanted["with_pushes"] = (replace(calm, pushes=task.pushes.in_full(True)), _EPISODES)
    traces = {
        kind: run_episodes(policy, given, episodes, make_world, seed=0, world_name=world, policy_name=name)
        for kind, (given, episodes) in wanted.items()
    }
    results = {name: summarize(found, robot.urdf.total_mass) for name, found in traces.items()}
    (folder.path / "evaluation.json").write_text(json.dumps(results, indent=2) + "\n", encoding="utf-8")
    console.print("Drawing figures and video ...")
    rows = folder.rows()
    if any(row["return_mean"] is not None for row in rows):
        learning_curves({task.name: [learning_curve(rows)]}, figures / "learning_curve.png")
    nominal = traces["without_pushes"]
    median = sorted(nominal, key=lambda trace: trace.base_position_world[-1, 0])[len(nominal) // 2]
    draw_episode(figures, median, robot)
    film(robot, median, figures / "video.mp4")
    median.save(figures / "episode.npz")
    print_summaries({name.replace("_", " "): summary for name, summary in results.items()})
    console.print(f"Policy, table, figures and video are in {folder.path}", soft_wrap=True)
    console.print(how_to_show([figures / "episode.npz"]), soft_wrap=True, highlight=False, markup=False)
    drive = f"to drive it: surefoot drive {shlex.quote(str(folder.path / 'policy.onnx'))}"
    console.print(drive, soft_wrap=True, highlight=False, markup=False)
