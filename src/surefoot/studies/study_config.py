"""A study as data: groups of trainings that differ in some settings, several seeds each, at fixed places."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from surefoot.configuration import Seed, Within, from_mapping, read_yaml
from surefoot.errors import SurefootError, check_name, choices, prefix_errors, suggest
from surefoot.learn.config import TrainConfig
from surefoot.robot import RobotDescription
from surefoot.robot.randomization import resolve_table
from surefoot.studies.training import Training, base_config
from surefoot.task.config import preset_names


@dataclass(frozen=True)
class GroupConfig:
    """Trainings that differ in nothing but the seed."""

    label: str = ""
    """What figures and tables call the group; its name, if empty."""
    train: dict[str, Any] = field(default_factory=dict)
    """What differs from the study's training run: any field of TrainConfig."""


@dataclass(frozen=True)
class PublishedFinding:
    """A published result that a study repeats."""

    groups: tuple[str, ...]
    """The groups that repeat it: those of a set of `bars`, or of a pair of `compare`."""
    text: str


@dataclass(frozen=True)
class StudyConfig:
    """Groups of trainings, several seeds each, and how they are evaluated."""

    groups: dict[str, GroupConfig]
    """The groups, by the names of their folders."""
    name: str = "study"
    """Name of the study; its folders carry it."""
    task: str = "trot"
    """Base of every group: a preset, or the path of a task's file, counted from the study's file."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """A training for each, in every group."""
    train: dict[str, Any] = field(default_factory=dict)
    """Settings of all groups over those of the task: any field of TrainConfig."""
    evaluate: tuple[str, ...] = ()
    """Kinds of evaluation of every trained policy."""
    compare: tuple[tuple[str, str], ...] = ()
    """Pairs of groups whose difference is reported, the second against the first; every pair, if empty."""
    primary: str = "nominal_return"
    """The figure that the comparisons are about; p values of each figure are adjusted for their number."""
    top: Annotated[int, Within(1, 1000)] = 3
    """How many policies of a group, those with the highest return in their own simulator, are its best."""
    bars: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Groups whose reality gaps are drawn side by side, by the name of the figure."""
    findings: tuple[PublishedFinding, ...] = ()
    """Published results, reported beside the groups that repeat them."""

    def __post_init__(self) -> None:
        """Refuse groups, seeds or sets that do not fit together."""
        if not self.groups:
            raise SurefootError("groups is empty; a study has 1 group or more")
        for name in (self.name, *self.groups, *self.bars):
            check_name("name", name)
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise SurefootError(f"seeds is {list(self.seeds)}; it takes 1 or more, none twice")
        for pair in self.compare:
            self._check_names("compare", pair)
        findings = {f"findings[{number}]": finding.groups for number, finding in enumerate(self.findings)}
        for where, groups in ({f"bars.{name}": groups for name, groups in self.bars.items()} | findings).items():
            if not groups or len(set(groups)) < len(groups):
                raise SurefootError(f"{where} is {list(groups)}; it takes 1 group or more, none twice")
            self._check_names(where, groups)
        reported = [set(groups) for groups in (*self.bars.values(), *self.pairs)]
        for where, groups in findings.items():
            if set(groups) not in reported:
                raise SurefootError(
                    f"{where}: {choices(groups)} are together in no set of bars and in no pair of compare, so it would "
                    "not be reported"
                )

    def _check_names(self, where: str, groups: tuple[str, ...]) -> None:
        for name in groups:
            if name not in self.groups:
                raise SurefootError(f"{where}: '{name}' is no group of the study; {suggest(name, self.groups)}")

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of groups whose difference is reported."""
        return self.compare or tuple(itertools.combinations(self.groups, 2))

    def with_steps(self, steps: int) -> StudyConfig:
        """Return the study with a number of control steps for every training, evaluated halfway and at the end."""
        groups = {name: replace(group, train={**group.train, "steps": steps}) for name, group in self.groups.items()}
        return replace(self, groups=groups, train={**self.train, "evaluate_every": max(1, steps // 2)})

    def label(self, group: str) -> str:
        """Return what figures and tables call a group."""
        return self.groups[group].label or group


def load_study(path: Path) -> StudyConfig:
    """Read a study's file; paths in it count from the file's folder.

    Raises:
        SurefootError: it can't be read, or does not fit.
    """
    data = {"name": path.stem, **read_yaml(path)}
    with prefix_errors(path):
        study = from_mapping(StudyConfig, data)
        if study.task not in preset_names():
            study = replace(study, task=str(path.parent / study.task))
        robot = base_config(study.task).task.robot
        train = _with_paths(study.train, path.parent, robot)
        if isinstance(task := train.get("task"), Mapping) and isinstance(task.get("robot"), str):
            robot = task["robot"]
        groups = {
            name: replace(group, train=_with_paths(group.train, path.parent, robot))
            for name, group in study.groups.items()
        }
        study = replace(study, train=train, groups=groups)
        for name in study.groups:
            group_config(study, name)
    return study


def _with_paths(train: dict[str, Any], folder: Path, robot: str) -> dict[str, Any]:
    """Return settings with named tables of ranges as their rows, and robots and files of references by whole paths.

    The ranges are those for the robot, if the settings name no other.
    """
    task = train.get("task")
    if not isinstance(task, Mapping):
        return train
    # A named table of ranges replaces every range there was.
    own = task.get("robot")
    if isinstance(own, str):
        robot = RobotDescription.resolve(own, folder)
    task = resolve_table(dict(task), folder, robot)
    if isinstance(own, str):
        task["robot"] = robot
    reference = task.get("reference")
    if isinstance(reference, Mapping) and isinstance(reference.get("file"), str):
        task["reference"] = {**reference, "file": str((folder / reference["file"]).resolve())}
    return {**train, "task": task}


def group_config(study: StudyConfig, group: str) -> TrainConfig:
    """Return the training of a group: its own settings over the study's, over the task's; one thread.

    Raises:
        SurefootError: settings that do not fit.
    """
    config = replace(base_config(study.task), name=group)
    for where, data in (("train", study.train), (f"groups.{group}.train", study.groups[group].train)):
        config = from_mapping(TrainConfig, data, where, base=config)
    return config


def study_runs(study: StudyConfig, root: Path, only: tuple[str, ...] = ()) -> list[Training]:
    """Return the trainings of some groups, or of all, in the folder `root`.

    They go seed by seed, so that a study that is stopped has runs of every group.

    Raises:
        SurefootError: no such group.
    """
    for name in only:
        if name not in study.groups:
            raise SurefootError(f"group '{name}' is not in the study; {suggest(name, study.groups)}")
    configs = {name: group_config(study, name) for name in study.groups if not only or name in only}
    return [
        Training(name, replace(config, seed=seed), root / name / f"seed_{seed}")
        for seed in study.seeds
        for name, config in configs.items()
    ]
