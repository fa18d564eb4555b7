"""Handcrafted gaits: foot trajectories, optionally with Raibert's controller, and their files."""

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
"""Key of the controller and its tuning in a task file."""


@dataclass(frozen=True)
class OpenLoop:
    """A policy without feedback: the reference runs in open loop."""

    width: int
    """Number of feedback columns A."""

    def feedback(self, observation: ArrayLike) -> Array:
        """Return zero feedback (N, A) for observations (N, O)."""
        return np.zeros((len(np.asarray(observation)), self.width))


@dataclass(frozen=True)
class _Entry:
    """Entry of a task file under `KEY`."""

    raibert: RaibertConfig | None = None
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class HandcraftedGait:
    """A task with foot trajectories as its reference, and a controller."""

    task: TaskConfig
    """Robot, foot trajectories, observations and bounds of the feedback."""
    raibert: RaibertConfig | None = None
    """Gains of Raibert's controller. Defaults to open-loop trajectories."""
    about: dict[str, Any] = field(default_factory=dict)
    """Settings and parameters of the tuning that produced the gait."""

    def __post_init__(self) -> None:
        """Reject a task with another kind of reference."""
        if not isinstance(self.task.reference, FootReferenceConfig):
            raise SurefootError(
                f"task.reference.kind is {self.task.reference.kind!r}; a handcrafted gait has a reference of kind foot"
            )

    def policy(self) -> OpenLoop | RaibertController:
        """Return the controller.

        Raises:
            SurefootError: foot trajectories out of the robot's range.
        """
        robot = RobotDescription.load(self.task.robot)
        assert isinstance(self.task.reference, FootReferenceConfig)
        reference = self.task.reference.make(robot)
        if self.raibert is None:
            return OpenLoop(len(self.task.gait(robot).action_names))
        return RaibertController(robot, reference.feet, self.raibert, self.task.observations, self.task.history)

    def save(self, path: Path) -> None:
        """Write a task file without default values, which `surefoot train` also accepts.

        The path of the robot's folder is relative to the file, so that both can be moved together.
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
        """Load a handcrafted gait from its task file.

        Raises:
            SurefootError: a file that can't be read, has no handcrafted gait, or is invalid.
        """
        data = read_yaml(path)
        with prefix_errors(path):
            if KEY not in data:
                raise SurefootError(f"{KEY} is missing; the file is a task without a handcrafted gait")
            entry = from_mapping(_Entry, data[KEY] or {}, KEY)
            return cls(load_task(str(path))[0], entry.raibert, entry.about)
