"""A training run: updates, evaluations, checkpoints, figures; resuming gives exactly the same result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

from surefoot.learn.config import TrainConfig
from surefoot.learn.run_folder import RunFolder, write_checkpoint
from surefoot.learn.trainer import Trainer, UpdateFigures
from surefoot.task.env import LocomotionEnv, SimulationFactory
from surefoot.task.pushes import PushConfig

EVALUATION_SEED = 1_000_003


@dataclass(frozen=True)
class Evaluation:
    """The deterministic policy over some episodes, without pushes."""

    steps: int
    """Control steps of training behind it."""
    speed_mean: float
    """Distance over time of each episode, averaged [m/s]."""
    return_mean: float
    """Mean return."""
    falls: int
    """Episodes that ended before their time."""
    pushed_falls: int
    """The same with pushes, where the task has them; else 0."""
    power_mean: float
    """Mean mechanical power [W]."""

    @property
    def rank(self) -> tuple[float, float]:
        """Rank; greater is better: fewest falls, then fewest falls under pushes weighed against the return."""
        return -self.falls, self.return_mean - 0.25 * self.pushed_falls


def evaluate_policy(trainer: Trainer, make_world: SimulationFactory, episodes: int) -> Evaluation:
    """Run the deterministic policy for whole episodes, always from the same seed."""
    config = trainer.config
    task = replace(config.task, pushes=replace(config.task.pushes, enabled=False))
    speed, returns, falls, power = _run(trainer, make_world, task.pushes, episodes)
    pushed = 0
    if config.task.pushes.enabled:
        pushed = _run(trainer, make_world, config.task.pushes, episodes)[2]
    return Evaluation(trainer.steps, speed, returns, falls, pushed, power)


def _run(
    trainer: Trainer, make_world: SimulationFactory, pushes: PushConfig, episodes: int
) -> tuple[float, float, int, float]:
    config = trainer.config
    task = replace(config.task, pushes=pushes)
    env = LocomotionEnv(
        task, episodes, make_world, EVALUATION_SEED + config.seed, autoreset=False, threads=config.threads
    )
    observation, _ = env.reset()
    alive = np.ones(episodes, bool)
    returns, energy, distance, duration = (np.zeros(episodes) for _ in range(4))
    for _ in range(task.max_steps):
        observation, reward, terminated, _, _ = env.step(trainer.act(observation))
        returns += reward * alive
        energy += env.truth.energy * alive
        forward = env.truth.base_position_world[:, 0] - env.start_position[:, 0]
        # A diverged robot stands at its start again; its distance is that of the step before.
        moved = alive & ~env.truth.diverged
        distance[moved], duration[moved] = forward[moved], env.readings.time[moved]
        alive &= ~terminated
        if not alive.any():
            break
    duration = np.maximum(duration, 1e-9)
    return (
        float(np.mean(distance / duration)),
        float(np.mean(returns)),
        int(np.sum(~alive)),
        float(np.sum(energy) / np.sum(duration)),
    )


class TrainingRun:
    """A run in its folder.

    Args:
        config: the run.
        folder: its run folder.
        make_world: makes the simulation.
        resume: continue from the folder's last checkpoint.

    Raises:
        SurefootError: a task that does not fit, or a checkpoint that can't be read.
    """

    def __init__(
        self, config: TrainConfig, folder: RunFolder, make_world: SimulationFactory, resume: bool = False
    ) -> None:
        self.config, self.folder, self._make_world = config, folder, make_world
        self.trainer = Trainer(config, make_world)
        if config.start_from is not None and not resume:
            self.trainer.start_with(RunFolder.open(Path(config.start_from))[0].load()["trainer"]["algorithm"])
        self.best: Evaluation | None = None
        self.best_actor: dict[str, Any] = {}
        self.seconds = 0.0
        self._saved_steps = -1
        if resume:
            self._load()
        self._writer = SummaryWriter(str(folder.path), purge_step=self.trainer.steps if resume else None)

    def _load(self) -> None:
        state = self.folder.load()
        self.trainer.set_state(state["trainer"])
        self.best = Evaluation(**state["best"]) if state["best"] else None
        self.best_actor, self.seconds = state["best_actor"], state["seconds"]
        self._saved_steps = self.trainer.steps
        self.folder.drop_rows_after(self.trainer.steps)

    def save(self) -> None:
        """Save everything that the run needs to continue."""
        if self._saved_steps == self.trainer.steps:
            return
        self.folder.save(
            {
                "steps": self.trainer.steps,
                "trainer": self.trainer.get_state(),
                "best": asdict(self.best) if self.best else None,
                "best_actor": self.best_actor,
                "seconds": self.seconds,
            }
        )
        self._saved_steps = self.trainer.steps

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.trainer.update_count >= self.config.updates

    def run(
        self,
        on_update: Callable[[UpdateFigures, Evaluation | None], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train until all steps are done, or until a stop is requested; then save.

        Args:
            on_update: called after every update with its figures and the evaluation, if one was due.
            should_stop: called between two updates, where the run can be saved and resumed without a difference.
        """
        try:
            while not self.finished and not should_stop():
                start = time.perf_counter()
                figures = self.trainer.update()
                evaluation = self._evaluate_if_due()
                self.seconds += time.perf_counter() - start
                self._log(figures, evaluation)
                on_update(figures, evaluation)
                if self._due(self.config.checkpoint_every):
                    self.save()
                    write_checkpoint(
                        self.folder.checkpoints / f"steps_{self.trainer.steps:09d}.ckpt",
                        {"steps": self.trainer.steps, "actor": self.trainer.policy.state_dict()},
                    )
            self.save()
        finally:
            self._writer.close()

    def _due(self, every: int) -> bool:
        """Return whether a multiple of `every` steps was passed in the last update, or the run is over."""
        before = self.trainer.steps - self.config.samples_per_update
        return self.trainer.steps // every > before // every or self.finished

    def _evaluate_if_due(self) -> Evaluation | None:
        if not self._due(self.config.evaluate_every):
            return None
        evaluation = evaluate_policy(self.trainer, self._make_world, self.config.evaluation_episodes)
        if self.best is None or evaluation.rank > self.best.rank:
            self.best = evaluation
            self.best_actor = {key: value.clone() for key, value in self.trainer.policy.state_dict().items()}
        return evaluation

    def _log(self, figures: UpdateFigures, evaluation: Evaluation | None) -> None:
        row = {
            key: None if isinstance(value, float) and math.isnan(value) else value
            for key, value in asdict(figures).items()
        }
        row["seconds"] = self.seconds
        if evaluation is not None:
            row["evaluation"] = asdict(evaluation)
        self.folder.log(row)
        for key, value in row.items():
            if isinstance(value, int | float) and key != "steps":
                self._writer.add_scalar(f"train/{key}", value, figures.steps)
        if evaluation is not None:
            for key, value in asdict(evaluation).items():
                self._writer.add_scalar(f"evaluation/{key}", value, figures.steps)

    def use_best(self) -> None:
        """Put the best evaluated policy's weights into the trainer's network, for export."""
        self.trainer.policy.load_state_dict(self.best_actor)
