"""Comparison of a study's groups on hidden robots: metrics by group and robot, means over robots, and answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from surefoot.evaluation.statistics import Interval, t_interval
from surefoot.robot import RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.params_file import ParamsFile
from surefoot.studies.comparison import FAR_DISTANCE
from surefoot.studies.evaluations import Result
from surefoot.studies.hidden_robots import robot_name
from surefoot.studies.questions import METRICS, Answer, Values, answer
from surefoot.studies.robot_runs import HOME
from surefoot.studies.study_config import StudyConfig
from surefoot.studies.training import Training

CONTENTS = {
    "robots": "one row per group and robot: means over seeds and starts",
    "groups": "one row per group and metric, with its interval over robots; `motors`: which robots",
    "questions": "one row per comparison: difference or mean, interval, p, and the result of the claim",
    "parameters": "one row per identified number: true value, estimate and interval",
    "episodes": "one row per run of a policy, in its training simulator and on robots",
}
"""Description of each table."""
ALL = "all"
"""Value of the column `motors` in rows over all robots."""


@dataclass(frozen=True)
class RobotComparison:
    """Comparison of a study's groups on hidden robots."""

    study: StudyConfig
    episodes: pd.DataFrame
    """One row per run: group, robot that the policy was trained for (empty for the data sheet), seed, and the columns
    of `measure_runs`, where world is `HOME` or the name of the robot."""

    @cached_property
    def missing(self) -> list[str]:
        """Number of trainings that are missing in the comparison, for each group with missing ones."""
        found = self.episodes[["group", "robot", "seed"]].drop_duplicates().group.value_counts()
        counts = {
            group: (len(self.study.trained_on(group)) * len(self.study.seeds_of(group)), int(found.get(group, 0)))
            for group in self.study.groups
        }
        return [
            f"{count - present} of {count} trainings of '{self.study.label(group)}'"
            for group, (count, present) in counts.items()
            if present < count
        ]

    @cached_property
    def robots(self) -> pd.DataFrame:
        """One row per group and robot: seeds, runs, and `METRICS`."""
        rows = []
        for group in self.groups:
            runs = self.episodes[self.episodes.group == group]
            home = runs[runs.world == HOME]
            for seed in self.study.hidden.seeds:
                on_robot = runs[runs.world == robot_name(seed)]
                if len(on_robot):
                    own = home[home.robot.isin(on_robot.robot.unique())]
                    row = {"group": group, "robot": seed, "motors": self.study.hidden.family(seed)}
                    rows.append(
                        row | {"seeds": on_robot.seed.nunique(), "runs": len(on_robot)} | _metrics(own, on_robot)
                    )
        return pd.DataFrame(rows)

    @cached_property
    def groups(self) -> list[str]:
        """Names of the groups with runs, in the study's order."""
        return [group for group in self.study.groups if group in set(self.episodes.group)]

    @property
    def families(self) -> list[str]:
        """Motor families for which results are reported: all, and each family if there are several."""
        families = list(dict.fromkeys(self.robots.motors))
        return [ALL, *families] if len(families) > 1 else [ALL]

    def select_family(self, family: str) -> pd.DataFrame:
        """Return the rows of `robots` with a motor family."""
        return self.robots if family == ALL else self.robots[self.robots.motors == family]

    def interval(self, group: str, metric: str, family: str = ALL) -> Interval:
        """Return the mean of a metric over robots with its interval."""
        rows = self.select_family(family)
        return t_interval(rows[rows.group == group][metric])

    @property
    def not_learned(self) -> dict[str, str]:
        """Groups with too low a mean return in the training simulator for a reality gap, with the reason."""
        minimum = self.study.least_home_return
        means = {group: self.interval(group, "home").mean for group in self.groups}
        return {
            group: f"{self.study.label(group)} did not learn: return {mean:.2f} m in the training simulator, below "
            f"{minimum:g} m"
            for group, mean in means.items()
            if mean < minimum
        }

    def values(self, metric: str) -> Values:
        """Return a metric of each group by robot."""
        return {
            str(group): dict(zip(rows.robot, rows[metric], strict=True))
            for group, rows in self.robots.groupby("group", sort=False)
        }

    @cached_property
    def answers(self) -> dict[str, Answer]:
        """Answers to the study's questions by name, primary questions first."""
        names, not_learned = [*self.study.primary_questions, *self.study.questions], self.not_learned
        questions = {name: self.study.questions[name] for name in names}
        return {name: answer(one, self.values(one.figure), not_learned) for name, one in questions.items()}


def _metrics(home: pd.DataFrame, on_robot: pd.DataFrame) -> dict[str, float]:
    """Return `METRICS` of a group's runs in the training simulator and on a robot; all policies have equal weight."""

    def mean(runs: pd.DataFrame, values: pd.Series) -> float:
        return float(values.groupby([runs.robot, runs.seed]).mean().mean())

    home_return, return_on_robot = mean(home, home["return"]), mean(on_robot, on_robot["return"])
    fell, far = 1.0 - on_robot.balanced.astype(float), (on_robot.distance > FAR_DISTANCE).astype(float)
    values = (home_return, return_on_robot, home_return - return_on_robot, 100 * mean(on_robot, fell))
    return dict(zip(METRICS, (*values, 100 * mean(on_robot, far)), strict=True))


def episode_rows(run: Training, result: Result) -> pd.DataFrame:
    """Return the runs of a training's policy as rows of `RobotComparison.episodes`."""
    runs = pd.DataFrame(result["runs"])
    for place, (name, value) in enumerate({"group": run.group, "robot": run.robot, "seed": run.config.seed}.items()):
        runs.insert(place, name, value)
    return runs


def parameter_rows(study: StudyConfig, files: Mapping[int, ParamsFile], folder: Path) -> list[dict[str, Any]]:
    """Return one row per identified number, with its true value and its interval.

    Args:
        study: the study.
        files: identified parameters by robot.
        folder: folder of the robot description with other motors.
    """
    motors, rows = RobotDescription.load(study.hidden.robot).motor_names, []
    for seed, file in files.items():
        truth, intervals = study.hidden.params(seed, folder), file.tables.get("intervals", {})
        for name in file.names:
            true, estimate = (np.atleast_1d(getattr(params, name)[0]) for params in (truth, file.params))
            bounds = np.broadcast_to(np.asarray(intervals.get(name, (np.nan, np.nan)), float), (len(true), 2))
            parts = PARAMETERS[name].element_names(motors) or ("",)
            for k, part in enumerate(parts):
                low, high = map(float, bounds[k])
                row = {"robot": seed, "motors": study.hidden.family(seed), "parameter": name, "part": part}
                row |= {"true": float(true[k]), "identified": float(estimate[k]), "low": low, "high": high}
                has_interval = np.isfinite(low) and np.isfinite(high)
                rows.append(row | {"inside": bool(low <= true[k] <= high) if has_interval else None})
    return rows


def robot_tables(comparison: RobotComparison, parameters: Sequence[dict[str, Any]]) -> dict[str, pd.DataFrame]:
    """Return the tables of the report by name, see `CONTENTS`."""
    study = comparison.study
    groups = [
        {"group": group, "label": study.label(group), "motors": family, "figure": metric, "unit": unit}
        | {"robots": int((comparison.select_family(family).group == group).sum()), **interval.columns("mean")}
        for family in comparison.families
        for group in comparison.groups
        for metric, (_, unit, _) in METRICS.items()
        for interval in [comparison.interval(group, metric, family)]
    ]
    questions = [
        {"question": name, "primary": name in study.primary_questions, "figure": one.question.figure}
        | {"group": pair.group, "against": pair.against, "robots": pair.robots, **pair.interval.columns("value")}
        | {"p": pair.p, "p_holm": pair.p_holm, "p_claim": one.p, "verdict": one.verdict, "left_out": pair.left_out}
        for name, one in comparison.answers.items()
        for pair in one.comparisons
    ]
    tables: dict[str, Any] = {"robots": comparison.robots, "groups": groups, "questions": questions}
    tables |= {"parameters": list(parameters), "episodes": comparison.episodes}
    return {name: pd.DataFrame(table) for name, table in tables.items()}
