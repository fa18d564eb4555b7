"""Configuration of a study: groups of trainings that differ in some settings, with several seeds each."""

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
from surefoot.robot.params_file import ParamsFile
from surefoot.robot.randomization import check_ranges, resolve_table
from surefoot.studies.hidden_robots import (
    HiddenRobots,
    check_identified,
    read_identified,
    robot_name,
    select_identified,
)
from surefoot.studies.questions import Question, check_pairs
from surefoot.studies.training import Training, base_config
from surefoot.task.config import preset_names

OTHERS = "others"
"""Name of the set of all groups that are in no set of bars."""


@dataclass(frozen=True)
class GroupConfig:
    """Group of trainings that differ only in their seed."""

    label: str = ""
    """Label in figures and tables; defaults to the group's name."""
    train: dict[str, Any] = field(default_factory=dict)
    """Differences from the study's `train`: any field of TrainConfig."""
    identified: tuple[str, ...] = ()
    """Physical parameters, or groups of them, that a training takes from the parameter file of its identified robot;
    values in `train` take precedence. A group with any is trained for each robot, other groups once for the data
    sheet."""
    seeds: tuple[Seed, ...] = ()
    """One training per seed; defaults to the study's seeds."""


@dataclass(frozen=True)
class PublishedFinding:
    """Published result that a study reproduces."""

    groups: tuple[str, ...]
    """Groups that reproduce it: a set of `bars`, or a pair of `compare`."""
    text: str


@dataclass(frozen=True)
class StudyConfig:
    """Groups of trainings with several seeds each, and their evaluations."""

    groups: dict[str, GroupConfig]
    """Groups by name, which is also the name of their folder."""
    name: str = "study"
    """Name of the study and its folders."""
    task: str = "trot"
    """Task of every group: a preset, or the path of a task file relative to the study's file."""
    seeds: tuple[Seed, ...] = (0, 1, 2)
    """Seeds; every group has one training per seed."""
    train: dict[str, Any] = field(default_factory=dict)
    """Settings of all groups, which override the task's: any field of TrainConfig."""
    evaluate: tuple[str, ...] = ()
    """Kinds of evaluation of every trained policy."""
    compare: tuple[tuple[str, str], ...] = ()
    """Pairs of groups whose difference is reported, the second minus the first; defaults to all pairs."""
    effects: dict[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)
    """Main effects by name: pairs of groups, the second minus the first, whose mean difference is reported."""
    primary: str = "nominal_return"
    """Primary metric of the comparisons. The p values of each metric are adjusted for the number of pairs."""
    top: Annotated[int, Within(1, 1000)] = 3
    """Number of best policies of a group, by return in the training simulator."""
    bars: dict[str, tuple[str, ...]] = field(default_factory=dict)
    """Groups whose reality gaps are drawn in one figure, by the figure's name."""
    findings: tuple[PublishedFinding, ...] = ()
    """Published results, which are reported with the groups that reproduce them."""
    robots: HiddenRobots | None = None
    """Hidden robots to identify and to evaluate policies on; none by default."""
    questions: dict[str, Question] = field(default_factory=dict)
    """Questions about groups and robots by name, each a family of comparisons of its own."""
    primary_questions: tuple[str, ...] = ()
    """Names of the study's primary claims."""
    least_home_return: Annotated[float, Within(-1e6, 1e6)] = 0.0
    """Minimum mean return in the training simulator [m]. A group below it did not learn, and is excluded from claims
    about the gap."""

    def __post_init__(self) -> None:
        """Check that groups, seeds, sets and questions fit together.

        Raises:
            SurefootError: with the first problem.
        """
        if not self.groups:
            raise SurefootError("groups is empty; a study needs 1 group or more")
        for name in (self.name, *self.groups, *self.bars):
            check_name("name", name)
        labels = [self.label(name) for name in self.groups]
        if twice := next((label for label in labels if labels.count(label) > 1), None):
            raise SurefootError(f"groups: two groups have the label '{twice}'; figures and tables name groups by it")
        if not self.seeds or len(set(self.seeds)) < len(self.seeds):
            raise SurefootError(f"seeds is {list(self.seeds)}; it needs 1 or more, all different")
        for name, group in self.groups.items():
            if len(set(group.seeds)) < len(group.seeds):
                raise SurefootError(f"groups.{name}.seeds is {list(group.seeds)}; all must be different")
        self._check_robots()
        for pair in self.compare:
            self._check_names("compare", pair)
        check_pairs("compare", self.compare)
        for name, pairs in self.effects.items():
            groups = tuple(group for pair in pairs for group in pair)
            if len(pairs) < 2 or len(set(groups)) < len(groups):
                raise SurefootError(
                    f"effects.{name}: it has {len(pairs)} pairs, of {choices(groups)}; it needs 2 or more, without a "
                    "group in common"
                )
            self._check_names(f"effects.{name}", groups)
        if OTHERS in self.bars:
            raise SurefootError(f"bars.{OTHERS}: this name belongs to the groups that are in no set; take another one")
        findings = {f"findings[{number}]": finding.groups for number, finding in enumerate(self.findings)}
        for where, groups in ({f"bars.{name}": groups for name, groups in self.bars.items()} | findings).items():
            if not groups or len(set(groups)) < len(groups):
                raise SurefootError(f"{where} is {list(groups)}; it needs 1 group or more, all different")
            self._check_names(where, groups)
        reported = [set(groups) for groups in (*self.bars.values(), *self.pairs)]
        for where, groups in findings.items():
            if set(groups) not in reported:
                raise SurefootError(
                    f"{where}: {choices(groups)} form neither a set of bars nor a pair of compare, so the finding "
                    "would not be reported"
                )

    def _check_robots(self) -> None:
        for name, group in self.groups.items():
            if group.identified and self.robots is None:
                raise SurefootError(f"groups.{name}.identified needs robots, and the study has none")
            check_identified(group.identified, f"groups.{name}.identified")
        if self.questions and self.robots is None:
            raise SurefootError("questions needs robots, and the study has none; compare takes pairs of groups")
        if self.robots is not None and (self.evaluate or self.compare or self.effects or self.bars or self.findings):
            raise SurefootError(
                "robots: a study on robots is evaluated by runs on them, and compared by questions; leave out "
                "evaluate, compare, effects, bars and findings"
            )
        for name, question in self.questions.items():
            with prefix_errors(f"questions.{name}"):
                question.check(tuple(self.groups))
        claims = [name for name, question in self.questions.items() if question.is_claim]
        for name in self.primary_questions:
            if name not in claims:
                raise SurefootError(
                    f"primary_questions: '{name}' is not a question with a claim; {suggest(name, claims)}"
                )

    def _check_names(self, where: str, groups: tuple[str, ...]) -> None:
        for name in groups:
            if name not in self.groups:
                raise SurefootError(f"{where}: '{name}' is no group of the study; {suggest(name, self.groups)}")

    @property
    def hidden(self) -> HiddenRobots:
        """Hidden robots of a study that has them."""
        assert self.robots is not None
        return self.robots

    @property
    def pairs(self) -> tuple[tuple[str, str], ...]:
        """Pairs of groups whose difference is reported."""
        return self.compare or tuple(itertools.combinations(self.groups, 2))

    def with_steps(self, steps: int) -> StudyConfig:
        """Return the study with another number of control steps per training, evaluated halfway and at the end."""
        groups = {name: replace(group, train={**group.train, "steps": steps}) for name, group in self.groups.items()}
        return replace(self, groups=groups, train={**self.train, "evaluate_every": max(1, steps // 2)})

    def with_seeds(self, seeds: tuple[int, ...]) -> StudyConfig:
        """Return the study with other seeds for all groups."""
        return replace(self, seeds=seeds, groups={name: replace(one, seeds=()) for name, one in self.groups.items()})

    def with_more_seeds(self, seeds: tuple[int, ...]) -> StudyConfig:
        """Return the study with additional seeds for all groups."""
        groups = {name: replace(one, seeds=_union(one.seeds, seeds)) for name, one in self.groups.items() if one.seeds}
        return replace(self, seeds=_union(self.seeds, seeds), groups=self.groups | groups)

    def trained_on(self, group: str) -> tuple[int | None, ...]:
        """Return the seeds of the robots for which a group is trained; None for the robot of the data sheet."""
        return self.robots.seeds if self.robots is not None and self.groups[group].identified else (None,)

    def seeds_of(self, group: str) -> tuple[int, ...]:
        """Return the seeds of a group's trainings."""
        return self.groups[group].seeds or self.seeds

    def label(self, group: str) -> str:
        """Return a group's label in figures and tables."""
        return self.groups[group].label or group


def _union(first: tuple[int, ...], second: tuple[int, ...]) -> tuple[int, ...]:
    """Return the items of both without repetitions, in order."""
    return tuple(dict.fromkeys((*first, *second)))


def load_study(path: Path) -> StudyConfig:
    """Read a study file; paths in it are relative to its folder.

    Raises:
        SurefootError: the file can't be read or is invalid.
    """
    data = {"name": path.stem, **read_yaml(path)}
    with prefix_errors(path):
        if isinstance(robots := data.get("robots"), Mapping):
            table = resolve_table({"randomize": robots.get("ranges")}, path.parent)
            data["robots"] = {**robots, "ranges": table["randomize"]}
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
            config = group_config(study, name)
            if study.robots is not None:
                study = replace(study, robots=_with_robot(study.robots, config.task.robot, name))
    return study


def _with_robot(robots: HiddenRobots, robot: str, group: str) -> HiddenRobots:
    """Return the hidden robots with their robot description, which must be the same in all groups."""
    if robots.robot and robots.robot != robot:
        raise SurefootError(f"groups.{group}: its robot is {robot}, and the hidden robots are {robots.robot}")
    check_ranges(robots.ranges, RobotDescription.load(robot))
    return replace(robots, robot=robot)


def _with_paths(train: dict[str, Any], folder: Path, robot: str) -> dict[str, Any]:
    """Return settings with ranges instead of names of tables, and absolute paths of robots and reference files.

    The ranges are for `robot` unless the settings name another.
    """
    task = train.get("task")
    if not isinstance(task, Mapping):
        return train
    # A named table replaces all other ranges.
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


def group_config(study: StudyConfig, group: str, identified: ParamsFile | None = None) -> TrainConfig:
    """Return the training configuration of a group, with one thread.

    The group's settings override the study's, and these the task's.

    Args:
        study: the study.
        group: name of the group.
        identified: parameter file of the robot for which the group is trained; parameters in the settings take
            precedence.

    Raises:
        SurefootError: a setting is invalid.
    """
    config = replace(base_config(study.task), name=group)
    for where, data in (("train", study.train), (f"groups.{group}.train", study.groups[group].train)):
        config = from_mapping(TrainConfig, data, where, base=config)
    if identified is None:
        return config
    params = {**select_identified(identified, study.groups[group].identified), **config.task.params}
    return replace(config, task=replace(config.task, params=params, params_source=identified.source))


def return_unit(study: StudyConfig) -> str:
    """Return the unit of a study's returns: m, or empty if a group's reward has terms of other units."""
    tasks = [group_config(study, group).task for group in study.groups]
    return min(task.return_unit(RobotDescription.load(task.robot)) for task in tasks)


def study_runs(
    study: StudyConfig, root: Path, only: tuple[str, ...] = (), robots: Path | None = None
) -> list[Training]:
    """Return the training runs of a study, seed by seed, so that an interrupted study has runs of every group.

    Args:
        study: the study.
        root: folder of the runs.
        only: names of groups; defaults to all.
        robots: folder with parameter files of identified robots; robots without a file have no trainings.

    Raises:
        SurefootError: a group does not exist, or a file is invalid.
    """
    for name in only:
        if name not in study.groups:
            raise SurefootError(f"group '{name}' is not in the study; {suggest(name, study.groups)}")
    runs = []
    for group in [name for name in study.groups if not only or name in only]:
        for robot in study.trained_on(group):
            file, name = None, ""
            if robot is not None:
                file, name = read_identified(robots, robot, study.hidden.robot), robot_name(robot)
                if file is None:
                    continue
            config = group_config(study, group, file)
            for seed in study.seeds_of(group):
                runs.append(Training(group, replace(config, seed=seed), root / group / name / f"seed_{seed}", name))
    order = list(dict.fromkeys(run.config.seed for run in runs))
    return sorted(runs, key=lambda run: order.index(run.config.seed))
