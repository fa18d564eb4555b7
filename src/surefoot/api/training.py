"""Run of a training: checks, progress display, and evaluation of the trained policy."""

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
from surefoot.robot.archive import pack_robot
from surefoot.robot.params import CONTROLLER_PARAMETERS
from surefoot.robot.randomization import RelativeRange
from surefoot.stop_signals import StopSignals
from surefoot.world.registry import check_randomized, find_world

if TYPE_CHECKING:
    from surefoot.learn.evaluation import TrainingEvaluation
    from surefoot.learn.rollout_statistics import UpdateMetrics
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

EPISODE_FILE = "episode.npz"
"""Name of the median episode's trace in a run's folder of figures."""
_MAX_LISTED_CHANGES = 4
"""Maximum number of changes that a note lists."""
_EPISODES = 20
_RANDOMIZED_EPISODES = 100
"""Number of episodes with randomized parameters: more, because falls are rare and robots differ."""


def check_config(config: TrainConfig) -> None:
    """Check the task, and the run to start from, before a run folder is created."""
    from surefoot.learn.run_folder import RunFolder
    from surefoot.robot.mirror import is_symmetric
    from surefoot.task.env import LocomotionEnv

    check_randomized(config.world, config.task.randomize)
    env = LocomotionEnv(config.task, 1, find_world(config.world), threads=1)
    if config.evaluation_reward:
        LocomotionEnv(replace(config.task, reward=config.evaluation_reward), 1, find_world(config.world), threads=1)
    if config.ppo.symmetry and is_symmetric(env.robot):
        from surefoot.learn.symmetry import MirrorSamples

        MirrorSamples(env)
    if config.start_from is not None:
        RunFolder.open(Path(config.start_from))
    elif config.task.reference.over_holes is not None:
        raise SurefootError(
            "reference.over_holes is given, but start_from is not: only the gait over holes is learned; name the run "
            "with the policy for other terrain: --start-from RUN"
        )
    elif config.ppo.start_std:
        raise SurefootError(
            "ppo.start_std is given, but start_from is not; a policy that does not continue another run starts with "
            "ppo.init_std"
        )


def training_notes(config: TrainConfig) -> list[str]:
    """Return what a user may not expect of a training."""
    return [note for find in (start_note, symmetry_note, replaced_note) if (note := find(config)) is not None]


def symmetry_note(config: TrainConfig) -> str | None:
    """Return a note why mirrored samples are not used although they are requested, or None."""
    if not config.ppo.symmetry:
        return None
    from surefoot.learn.symmetry import mirror_note

    return mirror_note(RobotDescription.load(config.task.robot))


def start_note(config: TrainConfig) -> str | None:
    """Return a note on changes since the run to start from that change the effect of actions, or None."""
    from surefoot.learn.run_folder import RunFolder

    if config.start_from is None:
        return None
    previous, task = RunFolder.open(Path(config.start_from))[1].task, config.task
    before, now = (RobotDescription.load(one.robot) for one in (previous, task))
    changes = []
    if pack_robot(before.folder) != pack_robot(now.folder):
        was = f"was {before.name}" if before.name != now.name else "its files have changed"
        changes.append(f"robot {now.name} ({was})")
    changes += [
        change
        for table in ("params", "reference")
        for change in _changes(to_mapping(getattr(previous, table)), to_mapping(getattr(task, table)), table)
    ]
    if not changes:
        return None
    more = f" and {len(changes) - _MAX_LISTED_CHANGES} more" if len(changes) > _MAX_LISTED_CHANGES else ""
    return (
        f"the policy of {config.start_from} was trained with another robot, reference or parameters, so its actions "
        f"had other effects: {', '.join(changes[:_MAX_LISTED_CHANGES])}{more}"
    )


def replaced_note(config: TrainConfig) -> str | None:
    """Return a note on given physical parameters, such as identified ones, that absolute ranges replace, or None."""
    ranges, params = config.task.randomize, config.task.params
    given = set(params) - set(CONTROLLER_PARAMETERS)  # the task sets control step and gains
    replaced = [name for name, one in ranges.items() if name in given and not isinstance(one, RelativeRange)]
    if not replaced:
        return None
    option = replaced[0].replace("_", "-")
    return (
        f"ranges replace the given values of {', '.join(replaced)}; --randomize.{option} scale 0.9 1.1 is a range "
        f"around the given value, and --randomize.{option} none keeps it"
    )


def _changes(old: Any, new: Any, name: str) -> Iterator[str]:
    """Yield descriptions of the values in a table that have changed."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in old | new:
            yield from _changes(old.get(key), new.get(key), f"{name}.{key}")
    elif old != new:
        before, after = (
            "not set" if value is None else "set" if isinstance(value, dict) else value for value in (old, new)
        )
        yield f"{name} {after} (was {before})"


class TrainingProgress(ProgressBar):
    """Progress bar of a training with steps per second, speed or tracking errors, and return; one line per evaluation.

    Args:
        config: configuration of the run.
        console: console of the display.
        done: control steps done before a resumed run.
    """

    def __init__(self, config: TrainConfig, console: Console, done: int = 0) -> None:
        self._steps, self._done = config.updates * config.samples_per_update, done
        super().__init__(config.task.name, console, self._steps, done)
        self._start = time.monotonic()
        self._means = ""

    def report(self, metrics: UpdateMetrics, evaluation: TrainingEvaluation | None) -> None:
        """Show the metrics of an update, and print an evaluation if there was one."""
        if not math.isnan(metrics.return_mean):
            self._means = f"  return {metrics.return_mean:.2f}"
            if metrics.rmse is None:
                self._means = f"  speed {metrics.speed_mean:.2f} m/s{self._means}"
        errors = "" if metrics.rmse is None else f"  error {error_text(metrics.rmse)}"
        rate = (metrics.steps - self._done) / (time.monotonic() - self._start)
        text = f"{rate:,.0f} steps/s{errors}{self._means}"
        left = (self._steps - metrics.steps) / rate
        line = f"{metrics.steps:>9,} of {self._steps:,} steps  {text}  {left:.0f} s left"
        self.advance(metrics.steps, text, line)
        if evaluation is not None:
            speed_or_error = f"{evaluation.speed_mean:.2f} m/s"
            if evaluation.rmse is not None:
                speed_or_error = f"error {error_text(evaluation.rmse)}"
            pushed = f", {evaluation.pushed_falls} with pushes" if evaluation.pushed_falls else ""
            self.print(
                f"{evaluation.steps:>9,} steps, evaluated: {speed_or_error}, "
                f"return {evaluation.return_mean:.2f}, {evaluation.power_mean:.0f} W, {evaluation.falls} falls{pushed}",
                "evaluation",
            )


def error_text(rmse: Mapping[str, float | None]) -> str:
    """Return tracking errors as text, such as `0.05, 0.02 m/s, 0.11 rad/s`."""
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
    """Train in a run folder with a progress display, and evaluate the policy at the end.

    SIGINT or SIGTERM stops the training after the present update, a second one immediately.

    Args:
        folder: run folder.
        console: console of the display.
        resume: continue from the folder's last checkpoint instead of the beginning.
        logger: see `open_writer`.
        watch: context manager that shows the training, and yields a function to call after every update.
        figures: evaluate the policy and write table, figures and video, see `finish_run`.

    Returns:
        Result of `finish_run`, empty without figures; None if the training was stopped.
    """
    from surefoot.learn.folder_lock import folder_lock
    from surefoot.learn.run_folder import RunFolder
    from surefoot.learn.training_loop import TrainingLoop

    # The folder's configuration refers to copies in the folder, since the original files may change or disappear.
    folder, config = RunFolder.open(folder.path)

    def stop(count: int) -> None:
        if count == 2:
            raise KeyboardInterrupt
        if count == 1:
            console.print("Stopping after this update; press Ctrl-C again to stop immediately, at the last checkpoint.")

    with folder_lock(folder.path):
        make_loop = TrainingLoop.resume if resume else TrainingLoop.create
        loop = make_loop(config, folder, find_world(config.world), logger)
        console.print(f"{'Resuming' if resume else 'Training'} {config.task.name} in {folder.path}")
        with ExitStack() as stack:
            progress = stack.enter_context(TrainingProgress(config, console, loop.learner.steps))
            # Only the main thread receives signals.
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
                console.print("Stopped immediately; the last checkpoint is kept.")
                return None
            if not loop.finished:
                console.print(f"Stopped and saved at {loop.learner.steps:,} steps.")
                return None
        if not figures:
            loop.export(folder.policy)
            return {}
        return finish_run(loop, folder, console.print)


def finish_run(loop: TrainingLoop, folder: RunFolder, report: Callable[[str], None]) -> dict[str, dict[str, Any]]:
    """Export the best policy; evaluate it on the nominal robot, and with the task's randomization and pushes, if any.

    Tables, figures and a video of the median episode are written to the run folder.

    Args:
        loop: finished training.
        folder: its run folder.
        report: function that is called with a line before each long step.

    Returns:
        Metrics (see `summarize`), by kind of evaluation.
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
    # The ground of the median episode's environment.
    film(robot, median, figures / "video.mp4", task.terrain.build(0).ground)
    median.save(figures / EPISODE_FILE)
    return summaries
