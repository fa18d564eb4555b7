"""Evaluation of a policy during training."""

from __future__ import annotations

from dataclasses import replace

from surefoot.learn.config import load_train_config
from surefoot.learn.evaluation import TrainingEvaluation, evaluate_policy
from surefoot.learn.ppo_learner import PpoLearner
from surefoot.world.sim_world import SimWorld


def test_rank_prefers_no_falls_over_return():
    steady = TrainingEvaluation(steps=1, speed_mean=0.5, return_mean=1.0, falls=0, pushed_falls=0, power_mean=3.0)
    assert steady.rank > replace(steady, falls=1, return_mean=5.0).rank
    assert steady.rank > replace(steady, pushed_falls=2, return_mean=1.2).rank
    assert steady.rank < replace(steady, pushed_falls=2, return_mean=1.6).rank


def test_pushed_falls_and_tracking_errors_are_separate():
    preset = load_train_config("steer", "go2")
    pushes = replace(preset.task.pushes, enabled=True, relative=True, force=(8.0, 9.0), period=0.2, duration=0.1)
    task = replace(preset.task, max_steps=60, pushes=pushes)
    learner = PpoLearner(replace(preset, task=task, num_envs=2, threads=1, learning_threads=1), SimWorld)
    evaluation = evaluate_policy(learner, SimWorld, 4)
    assert evaluation.steps == 0
    assert (evaluation.falls, evaluation.pushed_falls) == (0, 4)
    assert evaluation.rmse is not None
    assert set(evaluation.rmse) == {"forward", "sideways", "yaw_rate"}
    assert evaluation == evaluate_policy(learner, SimWorld, 4)
    without = replace(learner.config.task, pushes=replace(pushes, enabled=False))
    learner.config = replace(learner.config, task=without)
    assert evaluate_policy(learner, SimWorld, 4) == replace(evaluation, pushed_falls=0)
