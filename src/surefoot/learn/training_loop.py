"""The training loop: updates, evaluations, checkpoints, figures. A resumed run gives exactly the same result."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from surefoot.errors import SurefootError, describe_os_errors
from surefoot.evaluation.rollout import run_to_end
from surefoot.evaluation.tracking import MotionRecorder
from surefoot.learn.config import LoggerName, TrainConfig
from surefoot.learn.log_writer import close_writer, open_writer
from surefoot.learn.ppo_learner import PpoLearner, UpdateFigures
from surefoot.learn.run_folder import RunFolder, write_checkpoint
from surefoot.tables import plain_value
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
    rmse: dict[str, Any] | None = None
    """Root mean square error of each command's speed [m/s] or rate [rad/s], as `evaluate` has it; None without."""

    @property
    def rank(self) -> tuple[float, float]:
        """Key of the order of policies, greater is better: fewest falls, then the return less falls under pushes."""
        return -self.falls, self.return_mean - 0.25 * self.pushed_falls


def evaluate_policy(learner: PpoLearner, make_world: SimulationFactory, episodes: int) -> Evaluation:
    """Run the deterministic policy for whole episodes, always from the same seed."""
    config, results, rmse = learner.config, [], None
    base = replace(
        config.task,
        reward=config.evaluation_reward or config.task.reward,
        terrain=replace(config.task.terrain, start_level=config.task.terrain.levels - 1, curriculum=False),
    )
    base = replace(base, randomize_ramp=0, commands=replace(base.commands, ramp=0))
    for pushed in (False, True) if config.task.pushes.enabled else (False,):
        task = replace(base, pushes=replace(base.pushes, enabled=pushed, ramp=0))
        env = LocomotionEnv(task, episodes, make_world, EVALUATION_SEED + config.seed, False, config.threads)
        observation, _ = env.reset()
        recorder = MotionRecorder(env) if env.task.commands.enabled else None
        results.append(run_to_end(learner.act, env, observation, record=recorder.record if recorder else None))
        if recorder is not None and not pushed:
            rmse = recorder.tracking(results[0].steps).to_mapping()["rmse"]
    runs, falls = results[0], [int((~result.balanced).sum()) for result in results]
    speed, mean_return, power = (float(column.mean()) for column in (runs.speed, runs["return"], runs.power))
    return Evaluation(learner.steps, speed, mean_return, falls[0], sum(falls[1:]), power, rmse)


class TrainingLoop:
    """The training of a policy in a run folder.

    Args:
        config: configuration of the run.
        folder: its run folder.
        make_world: makes the simulation.
        resume: continue from the folder's last checkpoint.
        logger: see `open_writer`.

    Raises:
        SurefootError: a task that does not fit, or a checkpoint that can't be read.
    """

    def __init__(
        self,
        config: TrainConfig,
        folder: RunFolder,
        make_world: SimulationFactory,
        resume: bool = False,
        logger: LoggerName = "tensorboard",
    ) -> None:
        self.config, self.folder, self._make_world = config, folder, make_world
        self.learner = PpoLearner(config, make_world)
        if config.start_from is not None and not resume:
            other, before = RunFolder.open(Path(config.start_from))
            # These change what the networks observe, and bounds what actions mean.
            former = before.task
            task = replace(
                config.task,
                observations=former.observations,
                history=former.history,
                reference=former.reference,
                randomize=former.randomize,
                pushes=former.pushes,
                terrain=former.terrain,
                feedback=former.feedback,
                reward=former.reward,
            )
            env = LocomotionEnv(task, 1, make_world, threads=1)
            env.reset()
            state = other.load()
            self.learner.load_networks(state["learner"]["algorithm"], env, state["best_actor"])
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
        self._writer = open_writer(logger, folder.path, config, self.learner.steps if resume else None)

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

    def _evaluate_if_due(self) -> Evaluation | None:
        if not self._due(self.config.evaluate_every):
            return None
        evaluation = evaluate_policy(self.learner, self._make_world, self.config.evaluation_episodes)
        if self.best is None or evaluation.rank > self.best.rank:
            self.best = evaluation
            self.best_actor = {key: value.clone() for key, value in self.learner.policy.state_dict().items()}
        return evaluation

    def _log(self, figures: UpdateFigures, evaluation: Evaluation | None) -> None:
        row: dict[str, Any] = {key: plain_value(value) for key, value in asdict(figures).items()} | {
            "seconds": self.seconds
        }
        if evaluation is not None:
            row["evaluation"] = asdict(evaluation)
        self.folder.log(row)
        evaluated = row.pop("evaluation", {})
        for part, values in (("train", row), ("evaluation", evaluated)):
            for key, value in _scalars(values).items():
                self._writer.add_scalar(f"{part}/{key}", value, figures.steps)


def _scalars(values: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the numbers of a row by name, those of tables as TABLE/NAME."""
    scalars: dict[str, float] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            scalars |= _scalars(value, f"{prefix}{key}/")
        elif isinstance(value, int | float) and key != "steps":
            scalars[f"{prefix}{key}"] = value
    return scalars
