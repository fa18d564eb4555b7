"""Export of a trained policy: the contract of a task, and the file."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from surefoot import __version__
from surefoot.configuration import to_mapping
from surefoot.learn.run import TrainingRun
from surefoot.learn.trainer import Trainer
from surefoot.policy.contract import Contract, ObservationPart, config_hash
from surefoot.policy.export import export_policy
from surefoot.task.env import LocomotionEnv


def make_contract(
    env: LocomotionEnv,
    figures: Mapping[str, Any] | None = None,
    *,
    name: str = "",
    config: Mapping[str, Any] | None = None,
    created: str = "",
) -> Contract:
    """Return the contract of a policy that was trained in an environment.

    Args:
        env: robot, observer, gait, task and nominal parameters are read from it.
        figures: figures of the run that made the policy.
        name: name of the policy; the task's, if not given.
        config: the whole configuration of the run as plain tables, for its hash; the task's, if not given.
        created: when the policy was made, ISO 8601.
    """
    robot, gait, task = env.robot, env.gait, to_mapping(env.task)
    assumed = env.task.nominal(robot)
    return Contract(
        name=name or env.task.name,
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
        control_step=float(assumed.control_step[0]),
        servo_latency=float(assumed.servo_latency[0]),
        control_latency=float(assumed.control_latency[0]),
        servo_kp=float(assumed.servo_kp[0]),
        servo_kd=float(assumed.servo_kd[0]),
        voltage=float(assumed.voltage[0]),
        task=task,
        config_hash=config_hash(task if config is None else config),
        figures=dict(figures or {}),
        version=__version__,
        created=created,
    )


def export_trainer(
    trainer: Trainer,
    path: str | Path,
    figures: Mapping[str, Any] | None = None,
    *,
    name: str = "",
    created: str = "",
) -> Path:
    """Write a trainer's present policy as a policy file; see `make_contract` and `export_policy`."""
    config = trainer.config
    contract = make_contract(trainer.env, figures, name=name or config.name, config=to_mapping(config), created=created)
    return export_policy(trainer.policy, config.ppo.activation, contract, path)


def export_run(run: TrainingRun, path: str | Path) -> Path:
    """Write the best policy of a run, with the figures of its training."""
    run.use_best()
    figures = {
        "training": asdict(run.best) if run.best else {},
        "seconds": round(run.seconds, 1),
        "seed": run.config.seed,
        "steps": run.trainer.steps,
    }
    return export_trainer(run.trainer, path, figures, created=time.strftime("%Y-%m-%dT%H:%M:%S%z"))
