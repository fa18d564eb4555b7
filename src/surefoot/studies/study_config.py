"""A study as data: groups of trainings that differ in some settings, several seeds each, at fixed places."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

from surefoot.configuration import Seed, Within, check_bounds, from_mapping, read_yaml
from surefoot.errors import SurefootError, check_name, choices, located
from surefoot.learn.config import TrainConfig
from surefoot.robot.randomization import resolve_ranges
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
class Finding:
    """What others found where a study looks again."""

    groups: tuple[str, ...]
    """The groups that stand for theirs: those of a set of `bars`, or of a pair of `compare`."""
    text: str
    """What they found."""


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
    """What all groups share and the task does not say: any field of TrainConfig."""
    evaluate: tuple[str, ...] = ()
    """Kinds of evaluation of every trained policy."""
    compare: tuple[tuple[str, str], ...] = ()
    """Pairs of groups whose difference is reported, the second against the first; every pair, if empty."""
    top: Annotated[int, Within(1, 1000)] = 3
    """How many policies of a group, those with the highest return in their own simulator, tell its reality gap."""
    bars: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Groups whose reality gaps are drawn side by side, by the name of the figure."""
    findings: tuple[Finding, ...] = ()
    """What others found, told beside the same groups of this study."""

    def __post_init__(self) -> None:
        """Refuse what no study can be."""
        if not self.groups:
            raise SurefootError("groups is empty; a study has 1 group or more")
        for what in (self.name, *self.groups, *self.bars):
            check_name("name", what)
        check_bounds(self)
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise SurefootError(f"seeds is {list(self.seeds)}; it takes 1 or more, none twice")
        for name in (name for pair in self.compare for name in pair):
            if name not in self.groups:
                raise SurefootError(f"compare: '{name}' is no group of the study; groups: {choices(self.groups)}")
        for name, groups in self.bars.items():
            self._check_set(f"bars.{name}", groups)
        told = [set(groups) for groups in (*self.bars.values(), *self.pairs)]
        for number, finding in enumerate(self.findings):
            self._check_set(f"findings[{number}]", finding.groups)
            if set(finding.groups) not in told:
                raise SurefootError(
                    f"findings[{number}]: {choices(finding.groups)} are together in no set of bars and in no pair of "
                    "compare, so it would be told nowhere"
                )

    def _check_set(self, where: str, groups: tuple[str, ...]) -> None:
        if not groups or len(set(groups)) < len(groups):
            raise SurefootError(f"{where} is {list(groups)}; it takes 1 group or more, none twice")
        for name in groups:
            if name not in self.groups:
                raise SurefootError(f"{where}: '{name}' is no group of the study; groups: {choices(self.groups)}")

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of groups whose difference is reported."""
        return self.compare or tuple(itertools.combinations(self.groups, 2))

    def lasting(self, steps: int) -> StudyConfig:
        """Return the study with so many control steps for every training, evaluated in the middle and at the end."""
        groups = {name: replace(group, train={**group.train, "steps": steps}) for name, group in self.groups.items()}
        return replace(self, groups=groups, train={**self.train, "evaluate_every": max(1, steps // 2)})

    def label(self, group: str) -> str:
        """What figures and tables call a group."""
        return self.groups[group].label or group


def load_study(path: Path) -> StudyConfig:
    """Read a study's file; paths in it count from the file's folder.

    Raises:
        SurefootError: it can't be read, or does not fit.
    """
    data = {"name": path.stem, **read_yaml(path)}
    with located(path):
        study = from_mapping(StudyConfig, data)
        if study.task not in preset_names():
            study = replace(study, task=str(path.parent / study.task))
        groups = {
            name: replace(group, train=_with_paths(group.train, path.parent)) for name, group in study.groups.items()
        }
        study = replace(study, train=_with_paths(study.train, path.parent), groups=groups)
        for name in study.groups:
            group_config(study, name)
    return study


def _with_paths(train: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Settings with the files that they name found: tables of ranges as their rows, references by whole path."""
    task = train.get("task")
    if not isinstance(task, Mapping):
        return train
    # A named table of ranges replaces every range there was.
    task = resolve_ranges(dict(task), folder)
    reference = task.get("reference")
    if isinstance(reference, Mapping) and isinstance(reference.get("file"), str):
        task["reference"] = {**reference, "file": str((folder / reference["file"]).resolve())}
    return {**train, "task": task}


def group_config(study: StudyConfig, group: str) -> TrainConfig:
    """The training of a group: its own settings over the study's, over the task's; one thread, since runs share cores.

    Raises:
        SurefootError: settings that do not fit.
    """
    config = replace(base_config(study.task), name=group)
    for where, given in (("train", study.train), (f"groups.{group}.train", study.groups[group].train)):
        config = from_mapping(TrainConfig, given, where, base=config)
    return config


def study_runs(study: StudyConfig, root: Path, only: tuple[str, ...] = ()) -> list[Training]:
    """The runs of a study, seed by seed, so that a study that is stopped has something of every group.

    Args:
        study: the study.
        root: the folder for its runs.
        only: names of the groups wanted; all, if empty.

    Raises:
        SurefootError: no such group.
    """
    for name in only:
        if name not in study.groups:
            raise SurefootError(f"group '{name}' is not in the study; groups: {choices(study.groups)}")
    configs = {name: group_config(study, name) for name in study.groups if not only or name in only}
    return [
        Training(name, replace(config, seed=seed), root / name / f"seed_{seed}")
        for seed in study.seeds
        for name, config in configs.items()
    ]
