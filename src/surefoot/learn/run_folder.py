"""Run folders: configuration, versions, metrics, policy, and checkpoints that survive interruptions."""

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
"""NumPy types that a checkpoint may contain in addition to tensors, tables and numbers."""
_TIME = "%Y-%m-%d_%H-%M-%S"
_PACKAGES = ("mujoco", "numpy", "numba", "torch", "rsl-rl-lib", "gymnasium", "onnx", "onnxruntime")


@contextmanager
def _describe_write_errors(path: Path) -> Iterator[None]:
    """Convert errors of the file system into a one-line error."""
    try:
        yield
    except OSError as error:
        raise SurefootError(f"{path}: can't be written: {error.strerror}; files saved earlier are unchanged") from error


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint with its digest (atomic).

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
        SurefootError: it is missing, cut off, damaged, or not a checkpoint, or contains objects that could run code.
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
            f"{path}: is not a checkpoint that surefoot wrote: it contains more than numbers, arrays and tables of them"
        ) from error
    if not isinstance(state, dict):
        raise SurefootError(f"{path}: is not a checkpoint that surefoot wrote: it contains {quote(state)}, not a table")
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
    """Entry `plugins` of `run.json`."""

    plugins: tuple[PluginRecord, ...] = ()


def _check_plugins(path: Path, about: dict[str, Any]) -> None:
    """Raise a `SurefootError` if a run's plug-in is not registered, and print a note if one has changed."""
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
    """Folder of a run: configuration, versions, metrics, TensorBoard log, checkpoints and policy."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.latest = self.checkpoints / "latest.ckpt"
        self.previous = self.checkpoints / "previous.ckpt"
        self.metrics_log = path / "figures.jsonl"
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
    def create_at(cls, config: TrainConfig, path: Path, arguments: Sequence[str] | None = None) -> RunFolder:
        """Make the folder of a new run at a path. Metrics of an earlier run there are removed.

        Args:
            config: configuration of the run.
            path: path of the folder.
            arguments: arguments of the command `surefoot`, for `run.json`. Defaults to the arguments of this process.

        Raises:
            SurefootError: it can't be made.
        """
        folder = cls(path)
        try:
            folder.checkpoints.mkdir(parents=True, exist_ok=True)
            folder.metrics_log.unlink(missing_ok=True)
            write_run_config(config, path)
        except OSError as error:
            raise SurefootError(f"{path}: a run folder can't be made there: {error.strerror}") from error
        about = {
            "format": FORMAT,
            "surefoot": __version__,
            "git": _git_revision(),
            "command": ["surefoot", *(sys.argv[1:] if arguments is None else arguments)],
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
        """Open the folder of an existing run, and return it with its configuration.

        Raises:
            SurefootError: not a run folder, one of another version, or an invalid configuration.
        """
        about_path = path / "run.json"
        try:
            about = json.loads(read_configuration(about_path))
            format_ = about["format"]
        except OSError:
            raise SurefootError(f"{path}: is not a run folder, which has run.json and config.yaml") from None
        except (ValueError, KeyError, TypeError, RecursionError):
            raise SurefootError(f"{about_path}: is damaged; it must be the JSON that surefoot wrote") from None
        if format_ != FORMAT:
            raise SurefootError(
                f"{path}: has the run format {format_} of surefoot {about.get('surefoot')}; "
                f"this is surefoot {__version__}, which reads format {FORMAT}"
            )
        _check_plugins(path, about)
        return cls(path), read_run_config(path)

    def save(self, state: dict[str, Any]) -> None:
        """Save the state of the run, and keep the last one as `previous.ckpt`."""
        if self.latest.exists():
            with _describe_write_errors(self.previous):
                atomic_write(self.previous, self.latest.read_bytes())
        write_checkpoint(self.latest, state)

    def load(self) -> dict[str, Any]:
        """Load the last state of the run.

        Raises:
            SurefootError: it is missing or broken. The message says whether the previous one can be used.
        """
        try:
            return read_checkpoint(self.latest)
        except SurefootError as error:
            try:
                steps = self.saved_steps(read_checkpoint(self.previous))
            except SurefootError:
                raise SurefootError(f"{error}; there is no older checkpoint to resume from") from None
            raise SurefootError(
                f"{error}; {self.previous.name} next to it is intact, at {steps} steps: "
                f"rename it to {self.latest.name} to resume"
            ) from None

    def saved_steps(self, state: dict[str, Any]) -> int:
        """Return the number of control steps in a checkpoint's state.

        Raises:
            SurefootError: a state without a valid number of steps.
        """
        with prefix_errors(self.latest):
            return check_count(state.get("steps"), "steps")

    def log(self, row: dict[str, Any]) -> None:
        """Append a row of metrics.

        Raises:
            SurefootError: it can't be written, for example because the disk is full.
        """
        with _describe_write_errors(self.metrics_log), self.metrics_log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def rows(self) -> list[dict[str, Any]]:
        """Return all rows of metrics, without an incomplete last line."""
        return read_json_lines(self.metrics_log)

    def evaluations(self) -> list[dict[str, Any]]:
        """Return the evaluations in the rows of metrics."""
        return [row["evaluation"] for row in self.rows() if "evaluation" in row]

    def drop_rows_after(self, steps: int) -> None:
        """Remove rows after `steps`, which a resumed run writes again."""
        lines = [json.dumps(row) + "\n" for row in self.rows() if row["steps"] <= steps]
        with _describe_write_errors(self.metrics_log):
            atomic_write(self.metrics_log, "".join(lines))
