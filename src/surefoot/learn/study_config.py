"""A study as data: groups of trainings that differ in some settings, several seeds each, at fixed places."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from surefoot.configuration import Seed, Within, check_bounds, from_mapping, read_yaml, write_yaml
from surefoot.errors import SurefootError, check_name, choices, located
from surefoot.files import read_json_lines
from surefoot.learn.config import TrainConfig, load_train_config
from surefoot.task.config import preset_names
from surefoot.task.randomize import with_ranges

CHECKPOINT_EVERY = 200_000
"""Control steps between two checkpoints of a study's runs: about a minute of one core, lost at most when killed."""
_SAME_RESULT = ("threads", "checkpoint_every")
"""Fields that a run's outcome does not depend on; a stored run may differ in them."""

State = Literal["new", "started", "finished"]


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

    def label(self, group: str) -> str:
        """What figures and tables call a group."""
        return self.groups[group].label or group


@dataclass(frozen=True)
class StudyRun:
    """One training of a study."""

    group: str
    """Name of its group."""
    config: TrainConfig
    """The training."""
    path: Path
    """Its folder."""

    @property
    def name(self) -> str:
        """Group and seed, as the user reads them."""
        return f"{self.group} seed {self.config.seed}"

    @property
    def policy(self) -> Path:
        """The exported policy of a finished run."""
        return self.path / "policy.onnx"

    @property
    def state(self) -> State:
        """How far the run is, told from its files alone."""
        if self.policy.exists():
            return "finished"
        checkpoints = self.path / "checkpoints"
        saved = any((checkpoints / name).exists() for name in ("latest.ckpt", "fresh.ckpt"))
        return "started" if saved else "new"

    def rows(self) -> list[dict[str, Any]]:
        """The figures of its updates; a last line that was cut off is left out."""
        return read_json_lines(self.path / "figures.jsonl")

    def check(self, extend: bool = False) -> None:
        """Refuse a folder whose run is another one than the study asks for.

        Args:
            extend: let fewer steps pass, which `extend` mends.

        Raises:
            SurefootError: with the folder, the first field that differs, and what to do.
        """
        if self.state == "new":
            return
        stored = self._stored()
        kept = {name: getattr(stored, name) for name in _SAME_RESULT}
        if extend and stored.steps < self.config.steps:
            kept["steps"] = stored.steps
        found = difference(stored, replace(self.config, **kept))
        if found is not None:
            name, was, now = found
            more = "" if name != "steps" or now < was else "go on with it by --extend, "
            raise SurefootError(
                f"{self.path}: was trained with {name} {was!r}, and the study asks for {now!r}; {more}move the folder "
                "away to train it anew, give another --runs, or change the study back"
            )

    def extend(self) -> None:
        """Let a run that was made for fewer steps go on to as many as the study now asks for.

        A run does the same in its first steps whatever their number, so it goes on as if it had been made for more.
        """
        if self.state == "new" or (stored := self._stored()).steps >= self.config.steps:
            return
        # In this order: killed in between, it is a run that is not finished, not one that claims more steps.
        self.policy.unlink(missing_ok=True)
        write_yaml(self.path / "config.yaml", replace(stored, steps=self.config.steps))

    def _stored(self) -> TrainConfig:
        try:
            return from_mapping(TrainConfig, read_yaml(self.path / "config.yaml"))
        except SurefootError as error:
            raise SurefootError(f"{self.path}: {error}; move the folder away to train anew") from None


def difference(one: Any, other: Any, way: str = "") -> tuple[str, Any, Any] | None:
    """The first field in which two configurations differ, by its dotted name, with both values; None if in none."""
    for item in fields(one):
        name = f"{way}.{item.name}" if way else item.name
        a, b = getattr(one, item.name), getattr(other, item.name)
        if is_dataclass(a) and is_dataclass(b):
            found = difference(a, b, name)
            if found is not None:
                return found
        elif a != b:
            return name, a, b
    return None


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
    task = with_ranges(dict(task), folder)
    reference = task.get("reference")
    if isinstance(reference, Mapping) and isinstance(reference.get("file"), str):
        task["reference"] = {**reference, "file": str((folder / reference["file"]).resolve())}
    return {**train, "task": task}


def group_config(study: StudyConfig, group: str) -> TrainConfig:
    """The training of a group: its own settings over the study's, over the task's; one thread, since runs share cores.

    Raises:
        SurefootError: settings that do not fit.
    """
    base = load_train_config(study.task)
    every = min(base.checkpoint_every, CHECKPOINT_EVERY)
    config = replace(base, name=group, threads=1, learning_threads=1, checkpoint_every=every)
    for where, given in (("train", study.train), (f"groups.{group}.train", study.groups[group].train)):
        config = from_mapping(TrainConfig, given, where, base=config)
    return config


def study_runs(study: StudyConfig, root: Path, only: tuple[str, ...] = ()) -> list[StudyRun]:
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
        StudyRun(name, replace(config, seed=seed), root / name / f"seed_{seed}")
        for seed in study.seeds
        for name, config in configs.items()
    ]
