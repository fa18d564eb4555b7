"""Loggers of training metrics: TensorBoard, and optionally Weights & Biases."""

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
    """Open a writer of scalars in the run folder.

    Weights & Biases receives the same scalars and the configuration, in the project `surefoot`, under the folder's
    name. The environment variables WANDB_* apply: WANDB_MODE=offline, for example, keeps the run in the folder.

    Args:
        logger: logger; with `wandb`, scalars are also logged to TensorBoard.
        folder: run folder.
        config: configuration of the run.
        resumed_at: control steps from which a run is resumed, or None for a new run. Later entries are dropped.

    Raises:
        SurefootError: Weights & Biases is not available, for example without an account.
    """
    # Readers drop entries from the given step on; the entry of these steps is not written again.
    purge_step = None if resumed_at is None else resumed_at + 1
    if logger == "tensorboard":
        return SummaryWriter(str(folder), purge_step=purge_step)
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
        # Close the file of events: the next scalar opens a new one, which starts at these steps.
        writer.file_writer.close()
        writer.file_writer, writer.purge_step = None, purge_step
    return writer


def write_scalars(writer: SummaryWriter, row: Mapping[str, Any], steps: int) -> None:
    """Write a row of metrics as scalars train/NAME, and the metrics of its evaluation as evaluation/NAME."""
    training = {key: value for key, value in row.items() if key != "evaluation"}
    for part, values in (("train", training), ("evaluation", row.get("evaluation", {}))):
        for key, value in _scalars(values).items():
            writer.add_scalar(f"{part}/{key}", value, steps)


def _scalars(values: Mapping[str, Any], prefix: str = "") -> dict[str, float]:
    """Return the numbers of a row by name; numbers in tables as TABLE/NAME."""
    scalars: dict[str, float] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            scalars |= _scalars(value, f"{prefix}{key}/")
        elif isinstance(value, int | float) and key != "steps":
            scalars[f"{prefix}{key}"] = value
    return scalars


def close_writer(writer: SummaryWriter) -> None:
    """Close a writer and, if it has one, its Weights & Biases run."""
    writer.close()
    if stop := getattr(writer, "stop", None):
        stop()
