"""One of many trainings, in its folder: its state, and whether the folder holds this training or another."""

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
"""Control steps between two checkpoints of one of many trainings: about a minute of one core, lost when killed."""
_SAME_RESULT = ("threads", "checkpoint_every")
"""Fields that a run's outcome does not depend on; a stored run may differ in them."""

State = Literal["new", "started", "finished"]


def base_config(task: str) -> TrainConfig:
    """Return a task's training as one of many, which share the cores: one thread, and checkpoints often.

    Raises:
        SurefootError: no such task, or a file that does not fit.
    """
    base = load_train_config(task)
    return replace(base, threads=1, learning_threads=1, checkpoint_every=min(base.checkpoint_every, CHECKPOINT_EVERY))


@dataclass(frozen=True)
class Training:
    """One training of a study or a search."""

    group: str
    """Name of its group in a study, or of the trial."""
    config: TrainConfig
    path: Path
    robot: str = ""
    """Name of the identified robot whose parameters it has, such as robot_201; empty for the data sheet's."""
    trial: bool = False
    """Whether it is a trial of a search: its last policy is exported, not its best, and its checkpoints are removed."""

    @property
    def title(self) -> str:
        """Group, and robot if it has one."""
        return f"{self.group} {self.robot}".rstrip()

    @property
    def name(self) -> str:
        """Group, robot and seed, as the user reads them."""
        return f"{self.title} seed {self.config.seed}"

    @property
    def policy(self) -> Path:
        """The exported policy of a finished run."""
        return self.path / "policy.onnx"

    @property
    def state(self) -> State:
        """State of the run, from its files alone."""
        has_checkpoint = (self.path / "checkpoints" / "latest.ckpt").exists()
        if not self.policy.exists():
            return "started" if has_checkpoint else "new"
        # A run that `surefoot train --resume` went on with and that was stopped has a policy too.
        rows = self.rows() if has_checkpoint and not self.trial else []
        is_short = bool(rows) and rows[-1]["steps"] < self.config.steps and rows[-1]["steps"] < self.stored().steps
        return "started" if is_short else "finished"

    def rows(self) -> list[dict[str, Any]]:
        """Return the figures of its updates; a last line that was cut off is left out."""
        return read_json_lines(self.path / "figures.jsonl")

    def check(self, extend: bool = False) -> None:
        """Refuse a folder with another run than this one; with `extend`, fewer steps pass.

        Raises:
            SurefootError: with the folder, the first field that differs, and what to do.
        """
        if self.state == "new":
            return
        stored = self.stored()
        same = {name: getattr(stored, name) for name in _SAME_RESULT} | {"task": _with_copies(self.config, stored).task}
        if extend and stored.steps < self.config.steps:
            same["steps"] = stored.steps
        if change := first_difference(stored, replace(self.config, **same)):
            name, was, now = change
            more = "" if name != "steps" or now < was else "go on with it by --extend, "
            raise SurefootError(
                f"{self.path}: was trained with {name} {was!r}, and the study asks for {now!r}; {more}move the folder "
                "away to train it anew, give another --out, or change the study back"
            )

    def extend(self) -> None:
        """Let a run that was made for fewer steps go on to as many as the study now asks for.

        The number of steps does not change the steps before, so the result is that of a run made for more.
        """
        if self.state == "new" or self.stored().steps >= self.config.steps:
            return
        # In this order: killed in between, it is a run that is not finished, not one that claims more steps.
        self.policy.unlink(missing_ok=True)
        set_steps(self.path, self.config.steps)

    def stored(self) -> TrainConfig:
        """Return the configuration in the folder.

        Raises:
            SurefootError: there is none, or it does not fit.
        """
        try:
            return read_run_config(self.path)
        except SurefootError as error:
            raise SurefootError(f"{self.path}: {error}; move the folder away to train anew") from None


def _with_copies(config: TrainConfig, stored: TrainConfig) -> TrainConfig:
    """Return a configuration with a run's copies of the robot and of the reference's table, where they are equal."""
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
    """Return the first field in which two configurations differ, by its dotted name, with both values; else None."""
    for item in fields(one):
        a, b = getattr(one, item.name), getattr(other, item.name)
        if is_dataclass(a) and is_dataclass(b):
            if change := first_difference(a, b, f"{prefix}{item.name}."):
                return change
        elif a != b:
            return prefix + item.name, a, b
    return None
