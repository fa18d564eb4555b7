"""Comparison of a study's groups on hidden robots: metrics by group and robot, means over robots, and answers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from surefoot.arrays import Array
from surefoot.evaluation.statistics import Interval, crossed_interval, policies_proportion, t_interval
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params import PARAMETERS
from surefoot.robot.params_file import ParamsFile
from surefoot.studies.comparison import FAR_DISTANCE
from surefoot.studies.evaluations import Result
from surefoot.studies.hidden_robots import OTHER_MOTORS, robot_name
from surefoot.studies.questions import METRICS, Answer, Values, answer
from surefoot.studies.robot_runs import HOME
from surefoot.studies.study_config import StudyConfig, return_unit
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
_TORQUE_LAW = ("torque_constant", "resistance", "motor_strength")
"""Parameters of the motor model that describe a motor of another family without being a property of it."""


@dataclass(frozen=True)
class RobotComparison:
    """Comparison of a study's groups on hidden robots."""

    study: StudyConfig
    episodes: pd.DataFrame
    """One row per run: group, robot that the policy was trained for (empty for the data sheet), seed, and the columns
    of `measure_runs`, where world is `HOME` or the name of the robot."""

    @cached_property
    def missing(self) -> dict[str, tuple[int, int]]:
        """Number of missing trainings and of all trainings, for each group of which trainings are missing."""
        found = self.episodes[["group", "robot", "seed"]].drop_duplicates().group.value_counts()
        counts = {
            group: len(self.study.trained_on(group)) * len(self.study.seeds_of(group)) for group in self.study.groups
        }
        missing = {group: count - int(found.get(group, 0)) for group, count in counts.items()}
        return {group: (number, counts[group]) for group, number in missing.items() if number > 0}

    @property
    def missing_text(self) -> str:
        """`missing` in words; empty if nothing is missing."""
        return ", ".join(
            f"{number} of {count} trainings of '{self.study.label(group)}'"
            for group, (number, count) in self.missing.items()
        )

    @property
    def shared(self) -> list[str]:
        """Groups that are trained once, for the robot of the data sheet, and whose policies run on all robots."""
        return [group for group in self.groups if self.study.trained_on(group) == (None,)]

    @cached_property
    def policies(self) -> pd.DataFrame:
        """One row per policy of the groups in `shared` and robot: as `robots`, with the seed."""
        return pd.DataFrame(
            [
                row | {"seed": seed}
                for group in self.shared
                for seed, runs in self.episodes[self.episodes.group == group].groupby("seed")
                for row in self._rows(group, runs)
            ]
        )

    @cached_property
    def robots(self) -> pd.DataFrame:
        """One row per group and robot: seeds, runs, and `METRICS`."""
        groups = ((group, self.episodes[self.episodes.group == group]) for group in self.groups)
        return pd.DataFrame([row for group, runs in groups for row in self._rows(group, runs)])

    def _rows(self, group: str, runs: pd.DataFrame) -> list[dict[str, Any]]:
        """Return one row per robot on which a group's runs have been."""
        home, rows = runs[runs.world == HOME], []
        for seed in self.study.hidden.seeds:
            on_robot = runs[runs.world == robot_name(seed)]
            if len(on_robot):
                own = home[home.robot.isin(on_robot.robot.unique())]
                row = {"group": group, "robot": seed, "motors": self.study.hidden.family(seed)}
                rows.append(row | {"seeds": on_robot.seed.nunique(), "runs": len(on_robot)} | _metrics(own, on_robot))
        return rows

    @cached_property
    def groups(self) -> list[str]:
        """Names of the groups with runs, in the study's order."""
        return [group for group in self.study.groups if group in set(self.episodes.group)]

    @cached_property
    def metrics(self) -> dict[str, tuple[str, str, int]]:
        """`METRICS` with the unit of the study's returns."""
        unit = return_unit(self.study)
        return {name: (title, unit if own == "m" else own, digits) for name, (title, own, digits) in METRICS.items()}

    @property
    def families(self) -> list[str]:
        """Motor families for which results are reported: all, and each family if there are several."""
        families = list(dict.fromkeys(self.robots.motors))
        return [ALL, *families] if len(families) > 1 else [ALL]

    def select_family(self, family: str) -> pd.DataFrame:
        """Return the rows of `robots` with a motor family."""
        return self.robots if family == ALL else self.robots[self.robots.motors == family]

    def interval(self, group: str, metric: str, family: str = ALL) -> Interval:
        """Return the mean of a metric over robots with its interval, also over policies if all robots have the same."""
        is_fraction, rows = METRICS[metric][1] == "%", self.select_family(family)
        own = rows[rows.group == group]
        if group in self.shared:
            table = self._table(group, metric, family)
            trials = int(own.runs.sum()) // max(len(table), 1)
            if metric == "home_falls":  # The same runs for all robots.
                table, trials = table[:, 0], trials // table.shape[1]
            return _percent_interval(table, trials) if is_fraction else crossed_interval(table)
        if is_fraction and len(own):
            return _percent_interval(own[metric].to_numpy(), round(float(own.runs.mean())))
        return t_interval(own[metric])

    def _table(self, group: str, metric: str, family: str = ALL) -> Array:
        """Return a metric of a group in `shared`, by policy and robot (P, R)."""
        rows = self.policies[self.policies.group == group]
        rows = rows if family == ALL else rows[rows.motors == family]
        return rows.pivot(index="seed", columns="robot", values=metric).to_numpy()

    @property
    def not_learned(self) -> dict[str, str]:
        """Groups with too low a mean return in the training simulator for a reality gap, with the reason."""
        minimum, unit = self.study.least_home_return, f" {self.metrics['home'][1]}".rstrip()
        means = {group: self.interval(group, "home").mean for group in self.groups}
        return {
            group: f"{self.study.label(group)} did not learn: return {mean:.2f}{unit} in the training simulator, below "
            f"{minimum:g}{unit}"
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
        return {
            name: answer(
                one,
                self.values(one.figure),
                not_learned,
                {group: self._table(group, one.figure).mean(axis=1) for group in self.shared},
                self.missing,
            )
            for name, one in questions.items()
        }


def _percent_interval(percentages: Array, trials: int) -> Interval:
    """Return the mean of percentages, by robot (R,) or by policy and robot (P, R), with an interval from 0 to 100 %.

    Args:
        percentages: percentages of runs.
        trials: number of runs on each robot, or of each policy.
    """
    return policies_proportion(percentages / 100, trials).scale(100)


def _metrics(home: pd.DataFrame, on_robot: pd.DataFrame) -> dict[str, float]:
    """Return `METRICS` of a group's runs in the training simulator and on a robot; all policies have equal weight."""

    def mean(runs: pd.DataFrame, values: pd.Series) -> float:
        return float(values.groupby([runs.robot, runs.seed]).mean().mean())

    def percent(runs: pd.DataFrame, mask: pd.Series) -> float:
        return 100 * mean(runs, mask.astype(float))

    home_return, return_on_robot = mean(home, home["return"]), mean(on_robot, on_robot["return"])
    falls = (percent(runs, ~runs.balanced.astype(bool)) for runs in (home, on_robot))
    far = percent(on_robot, on_robot.distance > FAR_DISTANCE)
    values = (home_return, return_on_robot, home_return - return_on_robot, *falls, far)
    return dict(zip(METRICS, values, strict=True))


def episode_rows(run: Training, result: Result) -> pd.DataFrame:
    """Return the runs of a training's policy as rows of `RobotComparison.episodes`."""
    runs = pd.DataFrame(result["runs"])
    for place, (name, value) in enumerate({"group": run.group, "robot": run.robot, "seed": run.config.seed}.items()):
        runs.insert(place, name, value)
    return runs


def parameter_rows(study: StudyConfig, files: Mapping[int, ParamsFile], folder: Path) -> list[dict[str, Any]]:
    """Return one row per identified number, with its true value and its interval.

    The true value is the one that an experiment can find: roll and pitch of the IMU include its mounting error, and the
    friction of motors includes the friction of the knees. Motors of another family have no true value of the parameters
    in `_TORQUE_LAW`. Parameters with one interval for all motors have one row.

    Args:
        study: the study.
        files: identified parameters by robot.
        folder: folder of the robot description with other motors.
    """
    motors, rows = RobotDescription.load(study.hidden.robot).motor_names, []
    for seed, file in files.items():
        family, intervals = study.hidden.family(seed), file.tables.get("intervals", {})
        truth = without_hidden_parts(study.hidden.params(seed, folder))
        for name in file.names:
            true, estimate = (np.atleast_1d(getattr(params, name)[0]) for params in (truth, file.params))
            bounds = np.asarray(intervals.get(name, np.full((len(true), 2), np.nan)), float)
            parts = PARAMETERS[name].element_names(motors) or ("",)
            if bounds.ndim == 1:
                true, estimate = true.mean(keepdims=True), estimate.mean(keepdims=True)
                bounds, parts = bounds[None], ("",)
            if family == OTHER_MOTORS and name in _TORQUE_LAW:
                true = np.full(len(parts), np.nan)
            for k, part in enumerate(parts):
                low, high = map(float, bounds[k])
                row = {"robot": seed, "motors": family, "parameter": name, "part": part}
                row |= {"true": float(true[k]), "identified": float(estimate[k]), "low": low, "high": high}
                has_both = np.isfinite([low, high, true[k]]).all()
                rows.append(row | {"inside": bool(low <= true[k] <= high) if has_both else None})
    return rows


def without_hidden_parts(truth: PhysicalParams) -> PhysicalParams:
    """Return true parameters with the sums that no experiment can separate, as errors of the IMU and of the motors.

    The same robot for an experiment: its IMU is mounted without roll and pitch, and its knees have no friction.
    """
    mount = truth.imu_mount.copy()
    mount[:, :2] = 0.0
    return replace(
        truth,
        imu_bias=truth.imu_bias + truth.imu_mount[:, :2],
        imu_mount=mount,
        motor_friction=truth.motor_friction + truth.knee_friction[:, None],
        knee_friction=np.zeros_like(truth.knee_friction),
    )


def robot_tables(comparison: RobotComparison, parameters: Sequence[dict[str, Any]]) -> dict[str, pd.DataFrame]:
    """Return the tables of the report by name, see `CONTENTS`."""
    study = comparison.study
    groups = [
        {"group": group, "label": study.label(group), "motors": family, "figure": metric, "unit": unit}
        | {"robots": int((comparison.select_family(family).group == group).sum()), **interval.columns("mean")}
        for family in comparison.families
        for group in comparison.groups
        for metric, (_, unit, _) in comparison.metrics.items()
        for interval in [comparison.interval(group, metric, family)]
    ]
    questions = [
        {"question": name, "primary": name in study.primary_questions, "figure": one.question.figure}
        | {"group": pair.group, "against": pair.against, "robots": pair.robots, **pair.interval.columns("value")}
        | {
            "confidence": pair.confidence,
            "p": pair.p,
            "p_holm": pair.p_holm,
            "p_claim": one.p,
            "verdict": one.verdict,
            "left_out": pair.left_out,
        }
        for name, one in comparison.answers.items()
        for pair in one.comparisons
    ]
    tables: dict[str, Any] = {"robots": comparison.robots, "groups": groups, "questions": questions}
    tables |= {"parameters": list(parameters), "episodes": comparison.episodes}
    return {name: pd.DataFrame(table) for name, table in tables.items()}
