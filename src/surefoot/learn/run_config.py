"""The configuration in a run's folder, with copies of the files that it names: a run goes on wherever it is moved."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from surefoot.configuration import from_mapping, keys_of_kind, read_yaml, write_yaml
from surefoot.errors import prefix_errors
from surefoot.files import atomic_write
from surefoot.learn.config import TrainConfig
from surefoot.robot import RobotDescription
from surefoot.robot.archive import copy_robot
from surefoot.task.reference_config import REFERENCES, TableReferenceConfig

ROBOT = "robot"
"""Folder with a copy of a robot that does not ship, and then `task.robot` of the file."""
_CONFIG = "config.yaml"
_TABLE = "reference"
"""Stem of a copy of the reference's table, and then `task.reference.file` with its suffix."""


def write_run_config(config: TrainConfig, folder: Path) -> None:
    """Write a run's configuration with copies of its robot, unless it ships, and of its reference's table.

    Raises:
        OSError: a file can't be written or read.
        SurefootError: a robot that can't be copied.
    """
    task, robot = config.task, RobotDescription.load(config.task.robot)
    if not robot.is_builtin:
        copy_robot(robot.folder, folder / ROBOT)
        task = replace(task, robot=ROBOT)
    if isinstance(task.reference, TableReferenceConfig) and (file := task.reference.file) is not None:
        name = f"{_TABLE}{Path(file).suffix}"
        atomic_write(folder / name, Path(file).read_bytes())
        task = replace(task, reference=replace(task.reference, file=name))
    write_yaml(folder / _CONFIG, replace(config, task=task))


def read_run_config(folder: Path) -> TrainConfig:
    """Read a run's configuration, with paths of the copies in the folder as it is now.

    Raises:
        SurefootError: it can't be read or does not fit.
    """
    config, here = _read(folder), folder.absolute()
    task = config.task
    if task.robot == ROBOT and (here / ROBOT).is_dir():
        task = replace(task, robot=str(here / ROBOT))
    file = task.reference.file or ""
    is_copy = Path(file).stem == file.rpartition(".")[0] == _TABLE and (here / file).is_file()
    if is_copy and isinstance(task.reference, TableReferenceConfig):
        task = replace(task, reference=replace(task.reference, file=str(here / file)))
    return replace(config, task=task)


def copied_files(folder: Path) -> list[str]:
    """Return the names of the copies in a run's folder."""
    paths = [path for pattern in (f"{ROBOT}/**/*", f"{_TABLE}.*") for path in folder.glob(pattern) if path.is_file()]
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def set_steps(folder: Path, steps: int) -> None:
    """Write another number of control steps into a run's configuration; all else stays as it is."""
    write_yaml(folder / _CONFIG, replace(_read(folder), steps=steps))


def _read(folder: Path) -> TrainConfig:
    data = read_yaml(folder / _CONFIG)
    if isinstance(task := data.get("task"), dict) and "reference" in task:
        # Runs of earlier versions have the keys of all kinds.
        task["reference"] = keys_of_kind(REFERENCES, task["reference"])
    with prefix_errors(folder / _CONFIG):
        return from_mapping(TrainConfig, data)
