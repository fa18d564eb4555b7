"""The training loop: updates, evaluations, checkpoints, figures. A resumed run gives exactly the same result."""

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
from surefoot.learn.resume import read_progress, describe_state_errors
from surefoot.learn.rollout_statistics import UpdateMetrics
from surefoot.learn.run_folder import RunFolder, write_checkpoint
from surefoot.learn.transfer import warm_start
from surefoot.tables import plain_value
from surefoot.task.env import SimulationFactory

if TYPE_CHECKING:
    from torch.utils.tensorboard import SummaryWriter


class TrainingLoop:
    """The training of a policy in a run folder, made by `create` or `resume`."""

    def __init__(
        self, learner: PpoLearner, folder: RunFolder, make_world: SimulationFactory, writer: SummaryWriter
    ) -> None:
        self.config, self.learner, self.folder, self._make_world = learner.config, learner, folder, make_world
        self._writer = writer
        self.best: TrainingEvaluation | None = None
        self.best_actor: dict[str, Any] = {}
        self.seconds = 0.0
        self._saved_steps = -1
        self._is_untried = False  # whether no update was made since a checkpoint was read

    @classmethod
    def create(
        cls, config: TrainConfig, folder: RunFolder, make_world: SimulationFactory, logger: LoggerName = "tensorboard"
    ) -> TrainingLoop:
        """Begin a training in its run folder, with the networks of another run where `start_from` names one.

        Args:
            config: configuration of the run.
            folder: its run folder.
            make_world: makes the simulation.
            logger: see `open_writer`.

        Raises:
            SurefootError: a task or a run to start from that does not fit.
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
        """Continue a training from its folder's last checkpoint; arguments as of `create`.

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
        loop._saved_steps, loop._is_untried = learner.steps, True
        return loop

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
        on_update: Callable[[UpdateMetrics, TrainingEvaluation | None], None],
        should_stop: Callable[[], bool] = lambda: False,
    ) -> None:
        """Train until all steps are done, or until a stop is requested; then save.

        The folder's policy is the best one from the first evaluation on, and after a stop.

        Args:
            on_update: called after every update with its figures and the evaluation, if one was due.
            should_stop: called between two updates, where the run can be saved and resumed without a difference.
        """
        try:
            while not self.finished and not should_stop():
                figures, evaluation = self.step()
                if evaluation is not None:
                    self.export(self.folder.policy)
                on_update(figures, evaluation)
            self.save()
            if not self.finished:
                self.export(self.folder.policy, present=True)
        finally:
            self.close()

    def step(self) -> tuple[UpdateMetrics, TrainingEvaluation | None]:
        """Do one update, the evaluation and the checkpoint that are due then, and log; returns the first two."""
        start = time.perf_counter()
        # The first update after a checkpoint shows whether its numbers make sense.
        untried = describe_state_errors(f"{self.folder.latest}: no training can go on from it")
        with untried if self._is_untried else nullcontext():
            figures = self.learner.update()
        self._is_untried = False
        evaluation = self._evaluate_if_due()
        self.seconds += time.perf_counter() - start
        self._log(figures, evaluation)
        if self._due(self.config.checkpoint_every):
            self.save()
            state = {"steps": self.learner.steps, "actor": self.learner.policy.state_dict()}
            write_checkpoint(self.folder.checkpoints / f"steps_{self.learner.steps:09d}.ckpt", state)
        return figures, evaluation

    def export(self, path: str | Path, last: bool = False, present: bool = False) -> Path:
        """Write the best evaluated policy as a policy file with the figures of its training.

        Args:
            path: .onnx to write.
            last: write the last evaluated policy, which is the present one, in place of the best.
            present: evaluate the present policy too, without an effect on the training, and write it if it is better.

        Raises:
            SurefootError: the file can't be written.
        """
        best, actor = self.best, self.best_actor
        if last:
            training, actor = self.folder.evaluations()[-1], {}
        else:
            if present:
                now = evaluate_policy(self.learner, self._make_world, self.config.evaluation_episodes)
                best, actor = (now, {}) if best is None or now.rank > best.rank else (best, actor)
            training = asdict(best) if best else {}
        figures = {"seconds": round(self.seconds, 1), "seed": self.config.seed, "steps": self.learner.steps}
        created, policy = time.strftime("%Y-%m-%dT%H:%M:%S%z"), self.learner.policy
        trained = {key: value.clone() for key, value in policy.state_dict().items()}
        try:
            if actor:
                policy.load_state_dict(actor)
            with describe_os_errors(path, "written"):
                return self.learner.export(path, {"training": training, **figures}, created)
        finally:
            policy.load_state_dict(trained)

    def close(self) -> None:
        """Close the log."""
        close_writer(self._writer)

    def _due(self, every: int) -> bool:
        """Return whether a multiple of `every` steps was passed in the last update, or the run is over."""
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

    def _log(self, figures: UpdateMetrics, evaluation: TrainingEvaluation | None) -> None:
        row: dict[str, Any] = {key: plain_value(value) for key, value in asdict(figures).items()}
        row["seconds"] = self.seconds
        if evaluation is not None:
            row["evaluation"] = asdict(evaluation)
        self.folder.log(row)
        write_scalars(self._writer, row, figures.steps)
