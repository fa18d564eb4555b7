"""Configuration in a run folder, with copies of the files to which it refers, so that the folder can be moved."""

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
"""Folder with a copy of a robot that does not ship with surefoot, also the value of `task.robot` in the file."""
_CONFIG = "config.yaml"
_TABLE = "reference"
"""File name without suffix of the copy of a reference table, also of the value of `task.reference.file`."""
_MAP = "ground"
"""File name without suffix of the copy of a height map, also of the value of `task.terrain.ground`."""


def write_run_config(config: TrainConfig, folder: Path) -> None:
    """Write the configuration of a run, with copies of its reference table, height map, and robot unless that ships.

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
    if (heights := task.terrain.map_file) is not None:
        name = f"{_MAP}{heights.suffix}"
        atomic_write(folder / name, heights.read_bytes())
        task = replace(task, terrain=replace(task.terrain, ground=name))
    write_yaml(folder / _CONFIG, replace(config, task=task))


def read_run_config(folder: Path) -> TrainConfig:
    """Read the configuration of a run, with the current paths of the copies in its folder.

    Raises:
        SurefootError: it can't be read or is invalid.
    """
    config, here = _read(folder), folder.absolute()
    task = config.task
    if task.robot == ROBOT and (here / ROBOT).is_dir():
        task = replace(task, robot=str(here / ROBOT))
    file = task.reference.file or ""
    if _is_copy(here, file, _TABLE) and isinstance(task.reference, TableReferenceConfig):
        task = replace(task, reference=replace(task.reference, file=str(here / file)))
    if _is_copy(here, task.terrain.ground, _MAP):
        task = replace(task, terrain=replace(task.terrain, ground=str(here / task.terrain.ground)))
    return replace(config, task=task)


def _is_copy(folder: Path, file: str, stem: str) -> bool:
    """Return whether a path in a run's configuration names the copy with a given stem in its folder."""
    return Path(file).stem == file.rpartition(".")[0] == stem and (folder / file).is_file()


def copied_files(folder: Path) -> list[str]:
    """Return the names of the copied files in a run folder."""
    paths = [
        path
        for pattern in (f"{ROBOT}/**/*", f"{_TABLE}.*", f"{_MAP}.*")
        for path in folder.glob(pattern)
        if path.is_file()
    ]
    return sorted(path.relative_to(folder).as_posix() for path in paths)


def set_steps(folder: Path, steps: int) -> None:
    """Change the number of control steps in the configuration of a run."""
    write_yaml(folder / _CONFIG, replace(_read(folder), steps=steps))


def _read(folder: Path) -> TrainConfig:
    data = read_yaml(folder / _CONFIG)
    if isinstance(task := data.get("task"), dict) and "reference" in task:
        # Runs of earlier versions have the keys of all kinds of references.
        task["reference"] = keys_of_kind(REFERENCES, task["reference"])
    with prefix_errors(folder / _CONFIG):
        return from_mapping(TrainConfig, data)
