"""Export of a trained policy: the contract of a task, and the file."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from surefoot import __version__
from surefoot.configuration import to_mapping
from surefoot.learn.config import TrainConfig
from surefoot.learn.run import TrainingRun
from surefoot.learn.trainer import Trainer
from surefoot.policy.contract import RANGES, Contract, ObservationPart, config_hash
from surefoot.policy.export import export_policy
from surefoot.robot import PhysicalParams
from surefoot.robot.params_file import param_values
from surefoot.task.config import TaskConfig
from surefoot.task.env import LocomotionEnv


def make_contract(
    env: LocomotionEnv,
    config: TrainConfig | TaskConfig | None = None,
    figures: Mapping[str, Any] | None = None,
    created: str = "",
) -> Contract:
    """Return the contract of a policy that was trained in an environment.

    Args:
        env: robot, observer, gait, task and nominal parameters are read from it.
        config: the whole configuration of the run, for the policy's name and the hash; the task's, if not given.
        figures: figures of the run that made the policy.
        created: when the policy was made, ISO 8601.
    """
    robot, gait, config = env.robot, env.gait, config or env.task
    given: dict[str, Any] = param_values(env.task.nominal(robot), RANGES)
    given |= {name: None for name in given if name not in PhysicalParams.names(robot)}
    return Contract(
        name=config.name,
        robot=robot.name,
        motor_names=robot.motor_names,
        motor_signs=tuple(float(sign) for sign in robot.motor_sign),
        leg_names=robot.leg_names,
        observation=tuple(ObservationPart(**part) for part in env.observer.describe()),
        columns=tuple(env.observer.columns),
        history=env.task.history,
        action_names=tuple(gait.action_names),
        low=tuple(gait.low.tolist()),
        high=tuple(gait.high.tolist()),
        reference=None if env.task.reference.kind == "none" else gait.reference.to_dict(),
        rest=env.task.rest or gait.rest,
        **given,
        task=to_mapping(env.task),
        config_hash=config_hash(to_mapping(config)),
        figures=dict(figures or {}),
        commands=env.task.commands.limits(robot),
        version=__version__,
        created=created,
    )


def export_trainer(
    trainer: Trainer, path: str | Path, figures: Mapping[str, Any] | None = None, created: str = ""
) -> Path:
    """Write a trainer's present policy as a policy file; see `make_contract` and `export_policy`."""
    contract = make_contract(trainer.env, trainer.config, figures, created)
    return export_policy(trainer.policy, trainer.config.ppo.activation, contract, path)


def export_run(run: TrainingRun, path: str | Path, last: bool = False) -> Path:
    """Write the best evaluated policy of a run, or its last one, with the figures of its training."""
    training = asdict(run.best) if run.best else {}
    if last:
        training = run.folder.evaluations()[-1]
    else:
        run.trainer.policy.load_state_dict(run.best_actor)
    figures = {
        "training": training,
        "seconds": round(run.seconds, 1),
        "seed": run.config.seed,
        "steps": run.trainer.steps,
    }
    return export_trainer(run.trainer, path, figures, time.strftime("%Y-%m-%dT%H:%M:%S%z"))
