"""The folder of a run: configuration, versions, results, and checkpoints that survive interruptions."""

from __future__ import annotations

import hashlib
import io
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch

from surefoot import __version__
from surefoot.configuration import from_mapping, to_mapping
from surefoot.errors import SurefootError, choices, describe_os_errors, prefix_errors, quote
from surefoot.files import atomic_write, read_configuration, read_json_lines
from surefoot.learn.checkpoint_state import check_count
from surefoot.learn.config import TrainConfig
from surefoot.learn.run_config import read_run_config, write_run_config
from surefoot.policy.contract import PluginRecord
from surefoot.task.observation import PARTS
from surefoot.task.plugins import changed_plugins, used_plugins
from surefoot.task.reward import TERMS

FORMAT = 4
_MAGIC = b"surefoot checkpoint 1\n"
_KINDS = (bool, np.int64, np.float32, np.float64)
_ARRAYS: list[Any] = [np.zeros(0).__reduce__()[0], np.ndarray, np.dtype, *(type(np.dtype(kind)) for kind in _KINDS)]
"""What a checkpoint holds besides tensors, tables and numbers: NumPy's arrays of these kinds of numbers."""
_TIME = "%Y-%m-%d_%H-%M-%S"
_PACKAGES = ("mujoco", "numpy", "numba", "torch", "rsl-rl-lib", "gymnasium", "onnx", "onnxruntime")


@contextmanager
def _describe_write_errors(path: Path) -> Iterator[None]:
    """Turn a failure of the file system inside into one line."""
    try:
        yield
    except OSError as error:
        raise SurefootError(
            f"{path}: can't be written: {error.strerror}; what was saved before is untouched"
        ) from error


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint with its digest, whole or not at all.

    Raises:
        SurefootError: it can't be written, for example because the disk is full.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    payload = buffer.getvalue()
    with _describe_write_errors(path):
        atomic_write(path, _MAGIC + hashlib.sha256(payload).hexdigest().encode() + b"\n" + payload)


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Read a checkpoint written by `write_checkpoint`.

    Raises:
        SurefootError: it is missing, cut off, damaged, or no checkpoint; or it holds what could run code.
    """
    with describe_os_errors(path):
        content = path.read_bytes()
    if not content.startswith(_MAGIC):
        raise SurefootError(f"{path}: is not a surefoot checkpoint, or its start is damaged")
    digest, _, payload = content[len(_MAGIC) :].partition(b"\n")
    if hashlib.sha256(payload).hexdigest().encode() != digest:
        raise SurefootError(f"{path}: the checkpoint is broken (cut off or damaged): its digest does not match")
    try:
        with torch.serialization.safe_globals(_ARRAYS):
            state: dict[str, Any] = torch.load(io.BytesIO(payload), weights_only=True)
    except Exception as error:  # torch's errors have no common class of their own.
        raise SurefootError(
            f"{path}: is not a checkpoint that surefoot wrote: it holds more than numbers, arrays and tables of them"
        ) from error
    if not isinstance(state, dict):
        raise SurefootError(f"{path}: is not a checkpoint that surefoot wrote: it holds {quote(state)}, no table")
    return state


def _git_revision() -> str | None:
    command = ["git", "describe", "--always", "--dirty"]
    try:
        result = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return result.stdout.strip() or None


@dataclass(frozen=True)
class _Plugins:
    """Part of `run.json`."""

    plugins: tuple[PluginRecord, ...] = ()


def _check_plugins(path: Path, about: dict[str, Any]) -> None:
    """Refuse a run with terms of a plug-in that is not registered; print a line if one has changed."""
    with prefix_errors(path / "run.json"):
        data = {"plugins": about.get("plugins", [])}
        records = from_mapping(_Plugins, data).plugins
    for record in records:
        missing = [name for name in (*record.rewards, *record.observations) if name not in {**TERMS, **PARTS}]
        if missing:
            raise SurefootError(
                f"{path}: was trained with {choices(map(quote, missing))} of a plug-in; name the file: "
                f"--plugin {quote(record.name)}"
            )
    for line in changed_plugins(records):
        print(f"surefoot: {line}", file=sys.stderr)


class RunFolder:
    """The folder of one run: configuration, versions, figures, TensorBoard log, checkpoints and policy."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.latest = self.checkpoints / "latest.ckpt"
        self.previous = self.checkpoints / "previous.ckpt"
        self.figures_log = path / "figures.jsonl"
        self.policy = path / "policy.onnx"

    @classmethod
    def create(cls, config: TrainConfig, root: Path) -> RunFolder:
        """Make the folder `root/<task>/<time>_<name>` of a new run.

        Raises:
            SurefootError: it can't be made.
        """
        base = root / config.task.name / f"{time.strftime(_TIME)}_{config.name}_seed{config.seed}"
        path, count = base, 1
        while path.exists():
            count += 1
            path = base.with_name(f"{base.name}-{count}")
        return cls.create_at(config, path)

    @classmethod
    def create_at(cls, config: TrainConfig, path: Path, words: Sequence[str] | None = None) -> RunFolder:
        """Make the folder of a new run at a given path; figures of an earlier run there are removed.

        Args:
            config: of the run.
            path: of the folder.
            words: the command's words after `surefoot`; those of this process, if None.

        Raises:
            SurefootError: it can't be made.
        """
        folder = cls(path)
        try:
            folder.checkpoints.mkdir(parents=True, exist_ok=True)
            folder.figures_log.unlink(missing_ok=True)
            write_run_config(config, path)
        except OSError as error:
            raise SurefootError(f"{path}: a run folder can't be made there: {error.strerror}") from error
        about = {
            "format": FORMAT,
            "surefoot": __version__,
            "git": _git_revision(),
            "command": ["surefoot", *(sys.argv[1:] if words is None else words)],
            "started": time.strftime(_TIME),
            "seed": config.seed,
            "plugins": to_mapping(
                used_plugins({**config.task.reward, **config.evaluation_reward}, config.task.observations)
            ),
            "python": platform.python_version(),
            "packages": {name: metadata.version(name) for name in _PACKAGES},
            "machine": {"processor": platform.machine(), "cores": os.cpu_count()},
        }
        with _describe_write_errors(path / "run.json"):
            atomic_write(path / "run.json", json.dumps(about, indent=2) + "\n")
        return folder

    @classmethod
    def open(cls, path: Path) -> tuple[RunFolder, TrainConfig]:
        """Open an existing run's folder.

        Raises:
            SurefootError: no run folder, one of another version, or a configuration that does not fit.
        """
        about_path = path / "run.json"
        try:
            about = json.loads(read_configuration(about_path))
            format_ = about["format"]
        except OSError:
            raise SurefootError(f"{path}: is not a run folder; one has run.json and config.yaml") from None
        except (ValueError, KeyError, TypeError, RecursionError):
            raise SurefootError(f"{about_path}: is damaged; it must be the JSON that surefoot wrote") from None
        if format_ != FORMAT:
            raise SurefootError(
                f"{path}: is of run format {format_}, by surefoot {about.get('surefoot')}; "
                f"this is surefoot {__version__}, which reads format {FORMAT}"
            )
        _check_plugins(path, about)
        return cls(path), read_run_config(path)

    def save(self, state: dict[str, Any]) -> None:
        """Save the run's state; keep the one saved before as `previous.ckpt`."""
        if self.latest.exists():
            with _describe_write_errors(self.previous):
                atomic_write(self.previous, self.latest.read_bytes())
        write_checkpoint(self.latest, state)

    def load(self) -> dict[str, Any]:
        """Return the run's last state.

        Raises:
            SurefootError: it is missing or broken; the message has whether the one before it is whole.
        """
        try:
            return read_checkpoint(self.latest)
        except SurefootError as error:
            try:
                steps = self.saved_steps(read_checkpoint(self.previous))
            except SurefootError:
                raise SurefootError(f"{error}; there is no older checkpoint to resume from") from None
            raise SurefootError(
                f"{error}; {self.previous.name} beside it is whole, at {steps} steps: "
                f"rename it to {self.latest.name} to resume"
            ) from None

    def saved_steps(self, state: dict[str, Any]) -> int:
        """Return how many control steps were done in a checkpoint's state.

        Raises:
            SurefootError: it does not say.
        """
        with prefix_errors(self.latest):
            return check_count(state.get("steps"), "steps")

    def log(self, row: dict[str, Any]) -> None:
        """Append a row of figures.

        Raises:
            SurefootError: it can't be written, for example because the disk is full.
        """
        with _describe_write_errors(self.figures_log), self.figures_log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def rows(self) -> list[dict[str, Any]]:
        """Return all rows of figures; a last line that was cut off is left out."""
        return read_json_lines(self.figures_log)

    def evaluations(self) -> list[dict[str, Any]]:
        """Return the evaluations among the rows."""
        return [row["evaluation"] for row in self.rows() if "evaluation" in row]

    def drop_rows_after(self, steps: int) -> None:
        """Remove rows later than `steps`, which a resumed run writes again."""
        lines = [json.dumps(row) + "\n" for row in self.rows() if row["steps"] <= steps]
        with _describe_write_errors(self.figures_log):
            atomic_write(self.figures_log, "".join(lines))
