"""One training: checks before it, its run with a progress display, and what is made of it at its end."""

from __future__ import annotations

import json
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from surefoot.api.episodes import draw_episode, film
from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import LoggerName, TrainConfig
from surefoot.progress import ProgressBar
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals
from surefoot.world.registry import find_world

if TYPE_CHECKING:
    from surefoot.learn.evaluation import TrainingEvaluation
    from surefoot.learn.rollout_statistics import UpdateMetrics
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

EPISODE_FILE = "episode.npz"
"""File of the median episode's trace among the figures of a run."""
_LISTED = 4
"""Changes that a note names."""
_EPISODES = 20
_RANDOMIZED_EPISODES = 100
"""Episodes with randomized parameters: falls are rare there, and robots differ."""


def check_config(config: TrainConfig) -> None:
    """Refuse an invalid task, or an invalid run to start from, before a run folder is made."""
    from surefoot.learn.run_folder import RunFolder
    from surefoot.robot.mirror import is_symmetric
    from surefoot.task.env import LocomotionEnv

    env = LocomotionEnv(config.task, 1, find_world(config.world), threads=1)
    if config.ppo.symmetry and is_symmetric(env.robot):
        from surefoot.learn.symmetry import MirrorSamples

        MirrorSamples(env)
    if config.start_from is not None:
        RunFolder.open(Path(config.start_from))
    elif config.task.reference.over_holes is not None:
        raise SurefootError(
            "reference.over_holes is given, and start_from is not: what learns is the gait over holes; name the run "
            "whose policy walks elsewhere: --start-from RUN"
        )


def symmetry_note(config: TrainConfig) -> str | None:
    """Return in one line why a robot does not learn from mirrored samples although it is asked to; None: it does."""
    if not config.ppo.symmetry:
        return None
    from surefoot.learn.symmetry import mirror_note

    return mirror_note(RobotDescription.load(config.task.robot))


def start_note(config: TrainConfig) -> str | None:
    """Return in one line what lets actions have other effects than in the run to start from; None: nothing does."""
    from surefoot.learn.run_folder import RunFolder

    if config.start_from is None:
        return None
    former, now = RunFolder.open(Path(config.start_from))[1].task, config.task
    changes = [
        change
        for table in ("params", "reference")
        for change in _changes(to_mapping(getattr(former, table)), to_mapping(getattr(now, table)), table)
    ]
    if not changes:
        return None
    more = f" and {len(changes) - _LISTED} more" if len(changes) > _LISTED else ""
    return (
        f"the policy of {config.start_from} learned with another reference or other parameters, so its actions had "
        f"other effects: {', '.join(changes[:_LISTED])}{more}"
    )


def _changes(former: Any, now: Any, name: str) -> Iterator[str]:
    """Yield the values of a table that differ from those of a former one."""
    if isinstance(former, dict) and isinstance(now, dict):
        for key in former | now:
            yield from _changes(former.get(key), now.get(key), f"{name}.{key}")
    elif former != now:
        before, after = (
            "not set" if value is None else "given" if isinstance(value, dict) else value for value in (former, now)
        )
        yield f"{name} {after} (was {before})"


class TrainingProgress(ProgressBar):
    """Bar of a run with steps a second, speed or errors of commands, and return; a line for each evaluation.

    Args:
        config: the run.
        console: where to show it.
        done: control steps done before, if the run is resumed.
    """

    def __init__(self, config: TrainConfig, console: Console, done: int = 0) -> None:
        self._steps, self._done = config.updates * config.samples_per_update, done
        super().__init__(config.task.name, console, self._steps, done)
        self._start = time.monotonic()
        self._means = ""

    def report(self, figures: UpdateMetrics, evaluation: TrainingEvaluation | None) -> None:
        """Show the figures of an update."""
        if not math.isnan(figures.return_mean):
            self._means = f"  return {figures.return_mean:.2f}"
            if figures.rmse is None:
                self._means = f"  speed {figures.speed_mean:.2f} m/s{self._means}"
        errors = "" if figures.rmse is None else f"  error {error_text(figures.rmse)}"
        rate = (figures.steps - self._done) / (time.monotonic() - self._start)
        text = f"{rate:,.0f} steps/s{errors}{self._means}"
        left = (self._steps - figures.steps) / rate
        line = f"{figures.steps:>9,} of {self._steps:,} steps  {text}  {left:.0f} s left"
        self.advance(figures.steps, text, line)
        if evaluation is not None:
            followed = f"{evaluation.speed_mean:.2f} m/s"
            if evaluation.rmse is not None:
                followed = f"error {error_text(evaluation.rmse)}"
            pushed = f", {evaluation.pushed_falls} with pushes" if evaluation.pushed_falls else ""
            self.print(
                f"{evaluation.steps:>9,} steps, evaluated: {followed}, "
                f"return {evaluation.return_mean:.2f}, {evaluation.power_mean:.0f} W, {evaluation.falls} falls{pushed}",
                "evaluation",
            )


def error_text(rmse: Mapping[str, float | None]) -> str:
    """Return errors of commands as text, such as `0.05, 0.02 m/s, 0.11 rad/s`."""
    *speeds, rate = ("-" if value is None else f"{value:.2f}" for value in rmse.values())
    return f"{', '.join(speeds)} m/s, {rate} rad/s"


def run_training(
    folder: RunFolder,
    console: Console,
    *,
    resume: bool = False,
    logger: LoggerName = "tensorboard",
    watch: Callable[[TrainingLoop], AbstractContextManager[Callable[[], None]]] | None = None,
    figures: bool = True,
) -> dict[str, dict[str, Any]] | None:
    """Train in a run's folder with a progress display, and evaluate the policy at the end.

    SIGINT or SIGTERM stops after the present update, a second one at once.

    Args:
        folder: the run's folder.
        console: where to show it.
        resume: continue from the folder's last checkpoint, else train from the beginning.
        logger: see `open_writer`.
        watch: shows the training; gives what is called after every update.
        figures: evaluate the policy and write table, figures and video, see `finish_run`.

    Returns:
        what `finish_run` returns, empty without figures; None if the training was stopped.
    """
    from surefoot.learn.folder_lock import folder_lock
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

    # Configurations name copies in the folder: what they were copied from may change or go.
    folder, config = RunFolder.open(folder.path)

    def stop(count: int) -> None:
        if count == 2:
            raise KeyboardInterrupt
        if count == 1:
            console.print("Stopping after this update; once more stops at once, back at the last checkpoint.")

    with folder_lock(folder.path):
        make_loop = TrainingLoop.resume if resume else TrainingLoop.create
        loop = make_loop(config, folder, find_world(config.world), logger)
        console.print(f"{'Going on with' if resume else 'Training'} {config.task.name} in {folder.path}")
        with ExitStack() as stack:
            progress = stack.enter_context(TrainingProgress(config, console, loop.learner.steps))
            # Only the main thread has signals.
            signals = ("SIGINT", "SIGTERM") if threading.current_thread() is threading.main_thread() else ()
            stops = stack.enter_context(StopSignals(signals, stop))
            show = stack.enter_context(watch(loop)) if watch else None

            def report(update: UpdateMetrics, evaluation: TrainingEvaluation | None) -> None:
                progress.report(update, evaluation)
                if show is not None:
                    show()

            try:
                loop.run(report, lambda: stops.count > 0)
            except KeyboardInterrupt:
                console.print("Stopped at once; what was saved last remains.")
                return None
            if not loop.finished:
                console.print(f"Stopped and saved at {loop.learner.steps:,} steps.")
                return None
        if not figures:
            loop.export(folder.policy)
            return {}
        return finish_run(loop, folder, console.print)


def finish_run(loop: TrainingLoop, folder: RunFolder, report: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Export the best policy and evaluate it: on the nominal robot, and with randomization and pushes if the task has.

    Tables, figures and a video of the median episode go to the run folder.

    Args:
        loop: the training that is over.
        folder: its run folder.
        report: called with a line before each long step.

    Returns:
        what `summarize` returns, by kind of evaluation.
    """
    from surefoot.evaluation.conditions import Condition
    from surefoot.evaluation.rollout import run_episodes
    from surefoot.evaluation.runs import summarize
    from surefoot.policy.runtime import PolicyRuntime
    from surefoot.report.figures.learning import learning_curve, learning_curves
    from surefoot.robot import RobotDescription

    loop.export(folder.policy)
    task, policy, world = loop.config.task, PolicyRuntime.load(folder.policy), loop.config.world
    robot, figures = RobotDescription.load(task.robot), folder.path / "figures"
    report(f"Evaluating over {_EPISODES} episodes ...")
    conditions = [Condition("without_pushes")]
    if task.randomize:
        conditions.append(Condition("randomized", randomize=task.randomize))
    if task.pushes.enabled:
        conditions.append(Condition("with_pushes", pushes=True))
    traces = {}
    for condition in conditions:
        run = replace(condition, terrain=None, curricula=True).apply(task, robot)
        options = (_RANDOMIZED_EPISODES if condition.randomize else _EPISODES, find_world(world))
        traces[condition.name] = run_episodes(
            policy, run, *options, seed=0, world_name=world, policy_name=policy.contract.name
        )
    summaries = {kind: summarize(episodes, robot.urdf.total_mass) for kind, episodes in traces.items()}
    (folder.path / "evaluation.json").write_text(json.dumps(summaries, indent=2) + "\n", encoding="utf-8")
    report("Drawing figures and video ...")
    figures.mkdir(exist_ok=True)
    rows = folder.rows()
    if any(row["return_mean"] is not None for row in rows):
        unit = task.return_unit(robot)
        learning_curves({task.name: [learning_curve(rows)]}, figures / "learning_curve.png", unit)
    episodes = sorted(traces["without_pushes"], key=lambda trace: trace.base_position_world[-1, 0])
    median = episodes[len(episodes) // 2]
    draw_episode(figures, median, robot)
    # That of the median's environment, whose seed it has.
    film(robot, median, figures / "video.mp4", task.terrain.build(0).ground)
    median.save(figures / EPISODE_FILE)
    return summaries
