"""Export of a trained policy."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from surefoot.learn.run import TrainingRun
from surefoot.learn.trainer import Trainer
from surefoot.policy.export import export_policy
from surefoot.task.contract_mapping import make_contract


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
