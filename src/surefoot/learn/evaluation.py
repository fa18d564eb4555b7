"""Evaluation of the deterministic policy during training."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

from surefoot.evaluation.rollout import EpisodeRecorder, run_to_end
from surefoot.evaluation.tracking import Tracking
from surefoot.learn.config import TrainConfig
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv, SimulationFactory

EVALUATION_SEED = 1_000_003


@dataclass(frozen=True)
class TrainingEvaluation:
    """Metrics of the deterministic policy over some episodes without pushes."""

    steps: int
    """Control steps of training before the evaluation."""
    speed_mean: float
    """Mean speed of episodes, distance divided by time [m/s]."""
    return_mean: float
    """Mean return."""
    falls: int
    """Number of episodes that ended before their time."""
    pushed_falls: int
    """Number of falls in a second set of episodes with pushes, if the task has pushes; otherwise 0."""
    power_mean: float
    """Mean mechanical power [W]."""
    rmse: dict[str, Any] | None = None
    """Root mean square tracking error of each command [m/s, rad/s], as in `evaluate`; None without commands."""

    @property
    def rank(self) -> tuple[float, float]:
        """Sort key of policies, higher is better: fewer falls, then the return minus a penalty for pushed falls."""
        return -self.falls, self.return_mean - 0.25 * self.pushed_falls


def evaluation_task(config: TrainConfig) -> TaskConfig:
    """Return the task of evaluations: terrain of all levels, no curricula, own physics step, reward of evaluations."""
    task = config.task
    return replace(
        task,
        reward=config.evaluation_reward or task.reward,
        terrain=replace(task.terrain, start_level=task.terrain.levels - 1, curriculum=False),
        randomize_ramp=0,
        physics_step=0.0,
        commands=replace(task.commands, ramp=0),
    )


def evaluate_policy(learner: PpoLearner, make_world: SimulationFactory, episodes: int) -> TrainingEvaluation:
    """Run the deterministic policy for complete episodes, always with the same seed, and return its metrics."""
    config, results, rmse = learner.config, [], None
    base = evaluation_task(config)
    for pushed in (False, True) if base.pushes.enabled else (False,):
        task = replace(base, pushes=replace(base.pushes, enabled=pushed, ramp=0))
        env = LocomotionEnv(task, episodes, make_world, EVALUATION_SEED + config.seed, False, config.threads)
        observation, _ = env.reset()
        recorder = EpisodeRecorder(env, pushed) if task.commands.enabled and not pushed else None
        results.append(run_to_end(learner.act, env, observation, record=recorder.record if recorder else None))
        if recorder is not None:
            steps, meta = results[0].steps, {"world": config.world, "ended": "time"}
            traces = [recorder.trace(i, int(count), meta) for i, count in enumerate(steps) if count]
            rmse = Tracking.from_traces(traces).to_mapping()["rmse"]
    runs, falls = results[0], [int((~result.balanced).sum()) for result in results]
    speed, mean_return, power = (float(column.mean()) for column in (runs.speed, runs["return"], runs.power))
    return TrainingEvaluation(learner.steps, speed, mean_return, falls[0], sum(falls[1:]), power, rmse)
