"""Where a training logs its figures: TensorBoard, or Weights & Biases too."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from surefoot.configuration import to_mapping
from surefoot.errors import SurefootError
from surefoot.learn.config import LoggerName, TrainConfig

_PROJECT = "surefoot"


def open_writer(logger: LoggerName, folder: Path, config: TrainConfig, resumed_at: int | None) -> SummaryWriter:
    """Return a writer of scalars to the run folder.

    Weights & Biases gets the same scalars and the configuration, in project `surefoot` under the folder's name; the
    variables WANDB_* hold, such as WANDB_MODE=offline, which keeps the run in the folder.

    Args:
        logger: where scalars go; with `wandb` to TensorBoard as well.
        folder: of the run.
        config: of the run.
        resumed_at: control steps at which the run goes on: what was logged after them is dropped; None: a new run.

    Raises:
        SurefootError: Weights & Biases can't be used, for example without an account.
    """
    if logger == "tensorboard":
        return SummaryWriter(str(folder), purge_step=resumed_at)
    import wandb
    from rsl_rl.utils.wandb_log_writer import WandbLogWriter

    defaults = {
        "WANDB_DIR": str(folder),
        "WANDB_RUN_ID": hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16],
        "WANDB_RESUME": "allow",
    }
    before = dict(os.environ)
    os.environ.update({name: value for name, value in defaults.items() if name not in before})
    try:
        writer = WandbLogWriter(str(folder), os.environ.get("WANDB_PROJECT", _PROJECT))
    except wandb.Error as error:
        raise SurefootError(f"wandb: {error}; `wandb login`, or WANDB_MODE=offline logs to {folder}") from error
    finally:
        for name in defaults.keys() - before.keys():
            os.environ.pop(name, None)
    wandb.config.update(to_mapping(config), allow_val_change=True)
    if resumed_at is not None:
        # The next scalar makes another file of events, which starts there.
        writer.file_writer.close()
        writer.file_writer, writer.purge_step = None, resumed_at
    return writer


def write_scalars(writer: SummaryWriter, row: Mapping[str, Any], steps: int) -> None:
    """Write the numbers of a row of figures, as train/NAME, and those of its evaluation, as evaluation/NAME."""
    training = {key: value for key, value in row.items() if key != "evaluation"}
    for part, values in (("train", training), ("evaluation", row.get("evaluation", {}))):
        for key, value in _scalars(values).items():
            writer.add_scalar(f"{part}/{key}", value, steps)


def _scalars(values: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the numbers of a row by name, those of tables as TABLE/NAME."""
    scalars: dict[str, float] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            scalars |= _scalars(value, f"{prefix}{key}/")
        elif isinstance(value, int | float) and key != "steps":
            scalars[f"{prefix}{key}"] = value
    return scalars


def close_writer(writer: SummaryWriter) -> None:
    """Close a writer, and the run of Weights & Biases if it has one."""
    writer.close()
    if stop := getattr(writer, "stop", None):
        stop()
