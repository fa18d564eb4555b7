"""Training loop: updates, evaluations, checkpoints and metrics. A resumed run gives exactly the same result."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from surefoot.errors import describe_os_errors
from surefoot.learn.config import LoggerName, TrainConfig
from surefoot.learn.evaluation import TrainingEvaluation, evaluate_policy
from surefoot.learn.log_writer import close_writer, open_writer, write_scalars
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.learn.resume import describe_state_errors, read_progress
from surefoot.learn.rollout_statistics import UpdateMetrics
from surefoot.learn.run_folder import RunFolder, write_checkpoint
from surefoot.learn.transfer import warm_start
from surefoot.tables import plain_value
from surefoot.task.env import SimulationFactory

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class TrainingLoop:
    """Training of a policy in a run folder. Construct it with `create` or `resume`."""

    def __init__(
        self, learner: PpoLearner, folder: RunFolder, make_world: SimulationFactory, writer: SummaryWriter
    ) -> None:
        self.config, self.learner, self.folder, self._make_world = learner.config, learner, folder, make_world
        self._writer = writer
        self.best: TrainingEvaluation | None = None
        self.best_actor: dict[str, Any] = {}
        self.seconds = 0.0
        self._saved_steps = -1
        self._is_unverified = False  # whether a checkpoint was loaded and no update was made since

    @classmethod
    def create(
        cls, config: TrainConfig, folder: RunFolder, make_world: SimulationFactory, logger: LoggerName = "tensorboard"
    ) -> TrainingLoop:
        """Start a training in a run folder, with a warm start if the configuration has `start_from`.

        Args:
            config: configuration of the run.
            folder: run folder.
            make_world: factory of the simulation.
            logger: logger, see `open_writer`.

        Raises:
            SurefootError: an invalid task, or a run from which this one can't start.
        """
        learner = PpoLearner(config, make_world)
        if config.start_from is not None:
            with describe_state_errors(f"start_from {config.start_from}: no training can start from it", own=False):
                warm_start(learner, Path(config.start_from), make_world)
        return cls(learner, folder, make_world, open_writer(logger, folder.path, config, None))

    @classmethod
    def resume(
        cls, config: TrainConfig, folder: RunFolder, make_world: SimulationFactory, logger: LoggerName = "tensorboard"
    ) -> TrainingLoop:
        """Resume a training from the last checkpoint of its folder. See `create` for the arguments.

        Raises:
            SurefootError: a checkpoint that can't be read or does not fit.
        """
        learner, state = PpoLearner(config, make_world), folder.load()
        hint = "; restore the file with which the run was started"
        with describe_state_errors(f"{folder.latest}: does not fit the run's config.yaml", hint):
            learner.set_state(state["learner"])
        with describe_state_errors(str(folder.latest), "; no run can be resumed from it"):
            best, actor, seconds = read_progress(state, learner)
        folder.drop_rows_after(learner.steps)
        loop = cls(learner, folder, make_world, open_writer(logger, folder.path, config, learner.steps))
        loop.best, loop.best_actor, loop.seconds = best, actor, seconds
        loop._saved_steps, loop._is_unverified = learner.steps, True
        return loop

    def save(self) -> None:
        """Save a checkpoint with everything that the run needs to continue."""
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
        on_update: Callable[[UpdateMetrics, TrainingEvaluation | None], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train until all steps are done or a stop is requested, then save.

        From the first evaluation on, and after a stop, the folder contains the best policy so far.

        Args:
            on_update: called after every update with its metrics, and with the evaluation if there was one.
            should_stop: called between updates; returns whether to stop. A resumed run gives the same result.
        """
        try:
            while not self.finished and not should_stop():
                metrics, evaluation = self.step()
                if evaluation is not None:
                    self.export(self.folder.policy)
                on_update(metrics, evaluation)
            self.save()
            if not self.finished:
                self.export(self.folder.policy, current=True)
        finally:
            self.close()

    def step(self) -> tuple[UpdateMetrics, TrainingEvaluation | None]:
        """Do one update, with the evaluation, the log entry and the checkpoint that are due after it.

        Returns:
            Metrics of the update, and the evaluation or None.
        """
        start = time.perf_counter()
        # The first update after loading a checkpoint shows whether its numbers are valid.
        unverified = describe_state_errors(f"{self.folder.latest}: no training can continue from it")
        with unverified if self._is_unverified else nullcontext():
            metrics = self.learner.update()
        self._is_unverified = False
        evaluation = self._evaluate_if_due()
        self.seconds += time.perf_counter() - start
        self._log(metrics, evaluation)
        if self._due(self.config.checkpoint_every):
            self.save()
            state = {"steps": self.learner.steps, "actor": self.learner.policy.state_dict()}
            write_checkpoint(self.folder.checkpoints / f"steps_{self.learner.steps:09d}.ckpt", state)
        return metrics, evaluation

    def export(self, path: str | Path, last: bool = False, current: bool = False) -> Path:
        """Write the policy with the best evaluation as a policy file, with metrics of its training.

        Args:
            path: path of the .onnx file.
            last: write the policy of the last evaluation, which must be the current one, instead of the best.
            current: also evaluate the current policy, without effect on the training, and write it if it is better.

        Raises:
            SurefootError: the file can't be written.
        """
        best, actor = self.best, self.best_actor
        if last:
            training, actor = self.folder.evaluations()[-1], {}
        else:
            if current:
                now = evaluate_policy(self.learner, self._make_world, self.config.evaluation_episodes)
                best, actor = (now, {}) if best is None or now.rank > best.rank else (best, actor)
            training = asdict(best) if best else {}
        metrics = {"seconds": round(self.seconds, 1), "seed": self.config.seed, "steps": self.learner.steps}
        created, policy = time.strftime("%Y-%m-%dT%H:%M:%S%z"), self.learner.policy
        trained = {key: value.clone() for key, value in policy.state_dict().items()}
        try:
            if actor:
                policy.load_state_dict(actor)
            with describe_os_errors(path, "written"):
                return self.learner.export(path, {"training": training, **metrics}, created)
        finally:
            policy.load_state_dict(trained)

    def close(self) -> None:
        """Close the logger."""
        close_writer(self._writer)

    def _due(self, every: int) -> bool:
        """Return whether the last update passed a multiple of `every` steps, or the run is finished."""
        before = self.learner.steps - self.config.samples_per_update
        return self.learner.steps // every > before // every or self.finished

    def _evaluate_if_due(self) -> TrainingEvaluation | None:
        if not self._due(self.config.evaluate_every):
            return None
        evaluation = evaluate_policy(self.learner, self._make_world, self.config.evaluation_episodes)
        if self.best is None or evaluation.rank > self.best.rank:
            self.best = evaluation
            self.best_actor = {key: value.clone() for key, value in self.learner.policy.state_dict().items()}
        return evaluation

    def _log(self, metrics: UpdateMetrics, evaluation: TrainingEvaluation | None) -> None:
        row: dict[str, Any] = {key: plain_value(value) for key, value in asdict(metrics).items()}
        row["seconds"] = self.seconds
        if evaluation is not None:
            row["evaluation"] = asdict(evaluation)
        self.folder.log(row)
        write_scalars(self._writer, row, metrics.steps)
