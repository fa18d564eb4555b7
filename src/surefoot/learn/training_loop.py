"""The training loop: updates, evaluations, checkpoints, figures. A resumed run gives exactly the same result."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from surefoot.errors import SurefootError
from surefoot.evaluation.rollout import run_to_end
from surefoot.learn.config import TrainConfig
from surefoot.learn.ppo_learner import PpoLearner, UpdateFigures
from surefoot.learn.run_folder import RunFolder, write_checkpoint
from surefoot.task.env import LocomotionEnv, SimulationFactory

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
        """Key of the order of policies, greater is better: fewest falls, then the return less falls under pushes."""
        return -self.falls, self.return_mean - 0.25 * self.pushed_falls


def evaluate_policy(learner: PpoLearner, make_world: SimulationFactory, episodes: int) -> Evaluation:
    """Run the deterministic policy for whole episodes, always from the same seed."""
    config, results = learner.config, []
    base = replace(config.task, reward=config.evaluation_reward or config.task.reward)
    base = replace(base, commands=replace(base.commands, ramp=0))
    for pushed in (False, True) if config.task.pushes.enabled else (False,):
        task = replace(base, pushes=replace(base.pushes, enabled=pushed, ramp=0))
        env = LocomotionEnv(task, episodes, make_world, EVALUATION_SEED + config.seed, False, config.threads)
        results.append(run_to_end(learner.act, env, env.reset()[0]))
    runs, falls = results[0], [int((~result.balanced).sum()) for result in results]
    speed, mean_return, power = (float(column.mean()) for column in (runs.speed, runs["return"], runs.power))
    return Evaluation(learner.steps, speed, mean_return, falls[0], sum(falls[1:]), power)


class TrainingLoop:
    """The training of a policy in a run folder.

    Args:
        config: configuration of the run.
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
        self.learner = PpoLearner(config, make_world)
        if config.start_from is not None and not resume:
            self.learner.load_networks(RunFolder.open(Path(config.start_from))[0].load()["learner"]["algorithm"])
        self.best: Evaluation | None = None
        self.best_actor: dict[str, Any] = {}
        self.seconds = 0.0
        self._saved_steps = -1
        if resume:
            state = folder.load()
            try:
                self.learner.set_state(state["learner"])
            except (SurefootError, LookupError, TypeError, ValueError) as error:
                raise SurefootError(
                    f"{folder.latest}: does not fit the run's config.yaml: {error}; restore the file with which the "
                    "run was started"
                ) from error
            self.best = Evaluation(**state["best"]) if state["best"] else None
            self.best_actor, self.seconds = state["best_actor"], state["seconds"]
            self._saved_steps = self.learner.steps
            folder.drop_rows_after(self.learner.steps)
        self._writer = SummaryWriter(str(folder.path), purge_step=self.learner.steps if resume else None)

    def save(self) -> None:
        """Save everything that the run needs to continue."""
        if self._saved_steps == self.learner.steps:
            return
        self.folder.save(
            {
                "steps": self.learner.steps,
                "learner": self.learner.get_state(),
                "best": asdict(self.best) if self.best else None,
                "best_actor": self.best_actor,
                "seconds": self.seconds,
            }
        )
        self._saved_steps = self.learner.steps

    @property
    def finished(self) -> bool:
        """Whether all steps are done."""
        return self.learner.update_count >= self.config.updates

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
                on_update(*self.step())
            self.save()
        finally:
            self.close()

    def step(self) -> tuple[UpdateFigures, Evaluation | None]:
        """Do one update, the evaluation and the checkpoint that are due then, and log; returns the first two."""
        start = time.perf_counter()
        figures = self.learner.update()
        evaluation = self._evaluate_if_due()
        self.seconds += time.perf_counter() - start
        self._log(figures, evaluation)
        if self._due(self.config.checkpoint_every):
            self.save()
            write_checkpoint(
                self.folder.checkpoints / f"steps_{self.learner.steps:09d}.ckpt",
                {"steps": self.learner.steps, "actor": self.learner.policy.state_dict()},
            )
        return figures, evaluation

    def export(self, path: str | Path, last: bool = False) -> Path:
        """Write the best evaluated policy, or the last one, as a policy file with the figures of its training.

        The best policy's weights take the place of the last ones.
        """
        if last:
            training = self.folder.evaluations()[-1]
        else:
            training = asdict(self.best) if self.best else {}
            self.learner.policy.load_state_dict(self.best_actor)
        figures = {"seconds": round(self.seconds, 1), "seed": self.config.seed, "steps": self.learner.steps}
        created = time.strftime("%Y-%m-%dT%H:%M:%S%z")
        return self.learner.export(path, {"training": training, **figures}, created)

    def close(self) -> None:
        """Close the log."""
        self._writer.close()

    def _due(self, every: int) -> bool:
        """Return whether a multiple of `every` steps was passed in the last update, or the run is over."""
        before = self.learner.steps - self.config.samples_per_update
        return self.learner.steps // every > before // every or self.finished

    def _evaluate_if_due(self) -> Evaluation | None:
        if not self._due(self.config.evaluate_every):
            return None
        evaluation = evaluate_policy(self.learner, self._make_world, self.config.evaluation_episodes)
        if self.best is None or evaluation.rank > self.best.rank:
            self.best = evaluation
            self.best_actor = {key: value.clone() for key, value in self.learner.policy.state_dict().items()}
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
