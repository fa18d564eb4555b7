"""Handcrafted gaits: foot trajectories with or without Raibert's controller, as files and as policies."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.configuration import from_mapping, read_yaml, to_mapping
from surefoot.errors import SurefootError, prefix_errors
from surefoot.files import atomic_write
from surefoot.robot import RobotDescription
from surefoot.task.config import TaskConfig, load_task
from surefoot.task.raibert import RaibertConfig, RaibertController
from surefoot.task.reference_config import FootReferenceConfig

KEY = "handcrafted"
"""Key in a task's file of everything besides the task."""


@dataclass(frozen=True)
class OpenLoop:
    """A policy that adds nothing to the reference."""

    width: int
    """Numbers of the feedback, A."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return feedback (N, A) of zero for observations (N, O)."""
        return np.zeros((len(np.asarray(observation)), self.width))


@dataclass(frozen=True)
class _Entry:
    """The entry of a file under `KEY`."""

    raibert: RaibertConfig | None = None
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class HandcraftedGait:
    """A task whose reference is of kind foot, and its controller."""

    task: TaskConfig
    """Robot, foot trajectories, observations and bounds of the feedback."""
    raibert: RaibertConfig | None = None
    """Gains of Raibert's controller; the trajectories alone, if none are given."""
    about: dict[str, Any] = field(default_factory=dict)
    """Settings and parameters of its tuning."""

    def __post_init__(self) -> None:
        """Refuse a task with another reference."""
        if not isinstance(self.task.reference, FootReferenceConfig):
            raise SurefootError(
                f"task.reference.kind is {self.task.reference.kind!r}; a handcrafted gait has a reference of kind foot"
            )

    def policy(self) -> OpenLoop | RaibertController:
        """Return the controller.

        Raises:
            SurefootError: foot trajectories that the robot does not allow.
        """
        robot = RobotDescription.load(self.task.robot)
        assert isinstance(self.task.reference, FootReferenceConfig)
        reference = self.task.reference.make(robot)
        if self.raibert is None:
            return OpenLoop(len(self.task.gait(robot).action_names))
        return RaibertController(robot, reference.feet, self.raibert, self.task.observations, self.task.history)

    def save(self, path: Path) -> None:
        """Write a file of the task, without defaults, that `surefoot train` takes too.

        The path of a robot's folder counts from the file's, so that both can be moved together.
        """
        data, default = to_mapping(self.task), to_mapping(TaskConfig())
        task = {name: value for name, value in data.items() if value != default[name]}
        if "robot" in task and not RobotDescription.load(self.task.robot).is_builtin:
            task["robot"] = os.path.relpath(Path(self.task.robot).resolve(), path.resolve().parent)
        task["reference"] = {"kind": "foot", "foot": data["reference"]["foot"]}
        gains = None if self.raibert is None else to_mapping(self.raibert)
        atomic_write(path, yaml.safe_dump({**task, KEY: {"raibert": gains, "about": self.about}}, sort_keys=False))

    @classmethod
    def load(cls, path: Path) -> HandcraftedGait:
        """Read a file.

        Raises:
            SurefootError: it can't be read, is a task without a handcrafted gait, or does not fit.
        """
        data = read_yaml(path)
        with prefix_errors(path):
            if KEY not in data:
                raise SurefootError(f"{KEY} is missing; the file is of a task, not of a handcrafted gait")
            entry = from_mapping(_Entry, data[KEY] or {}, KEY)
            return cls(load_task(str(path))[0], entry.raibert, entry.about)
