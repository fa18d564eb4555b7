"""Training of a study or search in its folder: its state, and whether the folder has this training or another."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal

from surefoot.errors import SurefootError
from surefoot.files import read_json_lines
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.learn.run_config import read_run_config, set_steps
from surefoot.robot import RobotDescription
from surefoot.robot.archive import robot_files

CHECKPOINT_EVERY = 200_000
"""Control steps between two checkpoints, about a minute on one core, which is lost if the process is killed."""
_SAME_RESULT = ("threads", "checkpoint_every")
"""Fields on which a run's result does not depend; a stored run may differ in them."""

State = Literal["new", "started", "finished"]


def base_config(task: str) -> TrainConfig:
    """Return a task's training configuration for parallel trainings: one thread, and frequent checkpoints.

    Raises:
        SurefootError: the task does not exist, or its file is invalid.
    """
    base = load_train_config(task)
    return replace(base, threads=1, learning_threads=1, checkpoint_every=min(base.checkpoint_every, CHECKPOINT_EVERY))


@dataclass(frozen=True)
class Training:
    """One training of a study or a search."""

    group: str
    """Name of the group in a study, or of the trial in a search."""
    config: TrainConfig
    path: Path
    robot: str = ""
    """Name of the identified robot, such as robot_201; empty for the robot of the data sheet."""
    trial: bool = False
    """Whether it is a trial of a search, which exports its last policy instead of its best, and removes checkpoints."""

    @property
    def title(self) -> str:
        """Group, and robot if there is one."""
        return f"{self.group} {self.robot}".rstrip()

    @property
    def name(self) -> str:
        """Group, robot and seed, for messages."""
        return f"{self.title} seed {self.config.seed}"

    @property
    def policy(self) -> Path:
        """Exported policy of a finished run."""
        return self.path / "policy.onnx"

    @property
    def checkpoint(self) -> Path:
        """Last checkpoint of the run; a run that a cluster returned has none."""
        return self.path / "checkpoints" / "latest.ckpt"

    @property
    def state(self) -> State:
        """State of the run, according to its files."""
        has_checkpoint = self.checkpoint.exists()
        if not self.policy.exists():
            return "started" if has_checkpoint else "new"
        # A run that was resumed by `surefoot train --resume`, and then stopped, also has a policy.
        rows = self.rows() if has_checkpoint and not self.trial else []
        is_short = bool(rows) and rows[-1]["steps"] < self.config.steps and rows[-1]["steps"] < self.stored().steps
        return "started" if is_short else "finished"

    def rows(self) -> list[dict[str, Any]]:
        """Return the metrics of its updates; an incomplete last line is left out."""
        return read_json_lines(self.path / "figures.jsonl")

    def check(self, extend: bool = False) -> None:
        """Check that the folder is empty or has this run; with `extend`, the run there may have fewer steps.

        Raises:
            SurefootError: the folder has another run, named by the first field that differs, or one to extend without a
                checkpoint; says what to do.
        """
        if self.state == "new":
            return
        stored = self.stored()
        same = {name: getattr(stored, name) for name in _SAME_RESULT} | {"task": _with_copies(self.config, stored).task}
        if extend and stored.steps < self.config.steps:
            same["steps"] = stored.steps
        if change := first_difference(stored, replace(self.config, **same)):
            name, was, now = change
            more = "" if name != "steps" or now < was else "continue it with --extend, "
            raise SurefootError(
                f"{self.path}: was trained with {name} {was!r}, and the study asks for {now!r}; {more}move the folder "
                "away to train it again, choose another --out, or change the study back"
            )
        if extend and stored.steps < self.config.steps and not self.checkpoint.exists():
            raise SurefootError(
                f"{self.path}: has no checkpoint, so that its {stored.steps:,} control steps can't be continued; move "
                "the folder away to train it again, or change the study back"
            )

    def extend(self) -> None:
        """Set the steps of a shorter run to the study's number, so that it is continued.

        The total number of steps does not change earlier steps, so the result equals a run made for more steps.
        """
        if self.state == "new" or self.stored().steps >= self.config.steps:
            return
        # The policy is removed first: if the process is killed in between, the run counts as unfinished.
        self.policy.unlink(missing_ok=True)
        set_steps(self.path, self.config.steps)

    def stored(self) -> TrainConfig:
        """Return the configuration in the folder.

        Raises:
            SurefootError: there is none, or it is invalid.
        """
        try:
            return read_run_config(self.path)
        except SurefootError as error:
            raise SurefootError(f"{self.path}: {error}; move the folder away to train again") from None


def _with_copies(config: TrainConfig, stored: TrainConfig) -> TrainConfig:
    """Return a configuration that uses the run's copies of robot and reference table, if their content is the same."""
    task, copies = config.task, stored.task
    if task.robot != copies.robot and _robot_files(task.robot) == _robot_files(copies.robot):
        task = replace(task, robot=copies.robot)
    file, copy = task.reference.file, copies.reference.file
    if file and copy and Path(file).read_bytes() == Path(copy).read_bytes():
        task = replace(task, reference=copies.reference)
    return replace(config, task=task)


def _robot_files(robot: str) -> dict[str, bytes]:
    return robot_files(RobotDescription.find_folder(robot))


def first_difference(one: Any, other: Any, prefix: str = "") -> tuple[str, Any, Any] | None:
    """Return dotted name and both values of the first field in which two configurations differ, or None."""
    for item in fields(one):
        a, b = getattr(one, item.name), getattr(other, item.name)
        if is_dataclass(a) and is_dataclass(b):
            if change := first_difference(a, b, f"{prefix}{item.name}."):
                return change
        elif a != b:
            return prefix + item.name, a, b
    return None
