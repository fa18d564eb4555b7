"""Markdown report of a study on hidden robots: claims, groups, robots, figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from surefoot.evaluation.statistics import CONFIDENCE, decimal
from surefoot.files import atomic_write
from surefoot.report.figures.robots import GroupOnRobots, robots_figure
from surefoot.report.figures.style import capitalize_first
from surefoot.studies.hidden_robots import DATA_SHEET_MOTORS, OTHER_MOTORS, robot_name
from surefoot.studies.questions import LEVEL, NO_RESULTS, Answer, ComparedPair
from surefoot.studies.report import image, p_text, read_tables, readme
from surefoot.studies.robot_comparison import ALL, CONTENTS, RobotComparison, robot_tables
from surefoot.studies.study_config import StudyConfig
from surefoot.tables import markdown, with_unit, write_csv

_HOW_TO_READ = (
    "Each robot was identified through its link. Policies were trained for one robot, in a simulator with its "
    "identified parameters, and run in that simulator and on that robot, without pushes.{shared} A group's value on a "
    "robot is the mean over seeds and starts, all robots with the same seeds of trainings.",
    "Gap: return in the training simulator minus return on the robot, with its sign; it is negative if a policy does "
    "better on the robot. Claims are about means over robots. A fall is a run in which the robot did not keep its "
    "balance to the end. {confidence:.0%} confidence intervals (Student's t; for percentages binomial, with the "
    "effective number of runs) and paired differences are over robots{and_policies}.",
    "Every part of a claim is tested at {level:.2g}, and the claim's p value is their maximum (intersection-union "
    "test), without correction. p values of differences are two-sided, and 1 if the difference has the other sign. A "
    "claim of equivalence has two one-sided tests, and a 90 % interval. p values of comparisons without a claim are "
    "corrected within their question by Holm's method.",
)
_SHARED = (
    " The policies of {names} were trained once, on the robot of the data sheet, and run in that simulator and on all "
    "robots."
)
_PARAMETERS = (
    "The true `imu_bias` includes the mounting error of the IMU, and the true `motor_friction` the friction of the "
    "knees, because no experiment separates them. The parameters of the motor model are no property of motors of "
    "another family, so they have no true value there."
)


def write_robot_report(
    comparison: RobotComparison, parameters: Sequence[dict[str, Any]], folder: Path, command: str
) -> Path:
    """Write tables, figures and README.md into a folder; return the path of README.md.

    Args:
        comparison: the groups on their robots.
        parameters: rows of `parameter_rows`.
        folder: folder of the report.
        command: command line, which the report names.
    """
    tables = {name: table for name, table in robot_tables(comparison, parameters).items() if len(table)}
    for name, table in tables.items():
        write_csv(folder / f"{name}.csv", table)
    for family in comparison.families:
        _draw(comparison, family, folder / _figure_file(family))
    path = folder / "README.md"
    atomic_write(path, report_from_tables(comparison.study, folder, command))
    return path


def report_from_tables(study: StudyConfig, folder: Path, command: str) -> str:
    """Return the README.md of a study from the tables of its report; neither runs nor robots are needed."""
    tables = read_tables(folder, CONTENTS)
    tables["episodes"]["robot"] = tables["episodes"]["robot"].fillna("")
    comparison = RobotComparison(study, tables["episodes"])
    parts = [
        *([f"**Not complete.** Not in this report: {comparison.missing_text}."] if comparison.missing else []),
        *_claims(comparison),
        "## How to read",
        *_how_to_read(comparison),
        *[part for family in comparison.families for part in _results(comparison, family)],
        *_open_questions(comparison),
        "## Every robot",
        *_every_robot(comparison),
        *(_parameters(comparison, tables["parameters"]) if "parameters" in tables else []),
    ]
    listed = {f"{name}.csv": CONTENTS[name] for name in tables}
    return readme(f"Study: {comparison.study.name}", command, parts, listed)


def _figure_file(family: str) -> str:
    return f"returns_{family}.png"


def _how_to_read(comparison: RobotComparison) -> list[str]:
    names = " and ".join(f"'{comparison.study.label(group)}'" for group in comparison.shared)
    shared, and_policies = (_SHARED.format(names=names), f", and over policies for {names}") if names else ("", "")
    texts = {"confidence": CONFIDENCE, "level": LEVEL, "shared": shared, "and_policies": and_policies}
    return [part.format(**texts) for part in _HOW_TO_READ]


def _motors(comparison: RobotComparison, family: str) -> str:
    """Return the name of a motor family in tables."""
    other = comparison.study.hidden.other_motors
    return "as in the data sheet" if family == DATA_SHEET_MOTORS or other is None else other.label


def _family_label(comparison: RobotComparison, family: str) -> str:
    other = comparison.study.hidden.other_motors
    label = "" if other is None else other.label
    return {
        ALL: "all robots",
        DATA_SHEET_MOTORS: "robots with motors of the data sheet's family",
        OTHER_MOTORS: f"robots with {label}",
    }[family]


def _draw(comparison: RobotComparison, family: str, path: Path) -> None:
    """Draw the figure of a motor family."""
    other, rows = comparison.study.hidden.other_motors, comparison.select_family(family)
    groups = [
        GroupOnRobots(
            comparison.study.label(group),
            part.home.to_numpy(),
            part.on_robot.to_numpy(),
            (comparison.interval(str(group), "home", family), comparison.interval(str(group), "on_robot", family)),
            float(part.falls.mean()) / 100,
            (part.motors == OTHER_MOTORS).to_numpy(),
        )
        for group, part in rows.groupby("group", sort=False)
    ]
    marked = other.label if other is not None and family == ALL else ""
    unit = comparison.metrics["gap"][1]
    title = f"{with_unit('Return of an episode', unit)}, {_family_label(comparison, family)}"
    robots_figure(groups, path, marked, title, unit)


def _claims(comparison: RobotComparison) -> list[str]:
    """Return the section of claims: one line each, and a table of their parts."""
    claims = {name: one for name, one in comparison.answers.items() if one.question.is_claim}
    if not claims:
        return []
    primary = comparison.study.primary_questions
    lines = [
        f"- {'**Primary.** ' if name in primary else ''}{capitalize_first(one.question.text)}: **{one.verdict}**"
        + ("" if np.isnan(one.p) else f" (p {p_text(one.p)})")
        for name, one in claims.items()
    ]
    out = [f"- {capitalize_first(reason)}." for reason in comparison.not_learned.values()]
    parts = [part for one in claims.values() for part in _answer(comparison, one)]
    return ["## Claims", "\n".join([*lines, *out]), *parts]


def _open_questions(comparison: RobotComparison) -> list[str]:
    """Return the section of questions without a claim, if there are any."""
    answers = [one for one in comparison.answers.values() if not one.question.is_claim]
    parts = [part for one in answers for part in _answer(comparison, one)]
    return ["## Questions without a claim", *parts] if parts else []


def _answer(comparison: RobotComparison, one: Answer) -> list[str]:
    """Return the comparisons of a question as a sentence and a table."""
    title, unit, digits = comparison.metrics[one.question.figure]
    if all(pair.left_out == NO_RESULTS for pair in one.comparisons):
        return [f"{capitalize_first(one.question.text)}: no results yet."]

    def row(pair: ComparedPair) -> dict[str, str]:
        label = comparison.study.label
        cells = {"group": label(pair.group)} | ({"against": label(pair.against)} if pair.against else {})
        cells |= {with_unit(title, unit): pair.interval.text(digits, sign=True), "robots": str(pair.robots)}
        cells |= {"p": p_text(pair.p)}
        return cells | (
            {"left out": pair.left_out or "-"} if one.question.is_claim else {"p, Holm": p_text(pair.p_holm)}
        )

    return [f"{capitalize_first(one.question.text)}:", markdown([row(pair) for pair in one.comparisons])]


def _results(comparison: RobotComparison, family: str) -> list[str]:
    """Return the section of a motor family: the figure, and a table with one row per group."""
    label, rows = _family_label(comparison, family), comparison.select_family(family)
    table = []
    for group in comparison.groups:
        part = rows[rows.group == group]
        if len(part):
            cells = {"group": comparison.study.label(group), "robots": str(len(part)), "runs": str(part.runs.sum())}
            for metric, (title, unit, digits) in comparison.metrics.items():
                cells[with_unit(title, unit)] = comparison.interval(group, metric, family).text(digits)
            table.append(cells)
    return [
        f"## {capitalize_first(label)}",
        image(f"Return in simulation and on the robot: {label}", _figure_file(family)),
        markdown(table),
    ]


def _every_robot(comparison: RobotComparison) -> list[str]:
    """Return a table with one row per group and robot."""
    rows: list[Mapping[str, Any]] = comparison.robots.to_dict("records")
    return [
        markdown(
            [
                {"group": comparison.study.label(row["group"]), "robot": robot_name(row["robot"])}
                | {"motors": _motors(comparison, row["motors"]), "seeds": row["seeds"]}
                | {
                    with_unit(title, unit): decimal(row[name], digits)
                    for name, (title, unit, digits) in comparison.metrics.items()
                }
                for row in rows
            ]
        )
    ]


def _parameters(comparison: RobotComparison, table: pd.DataFrame) -> list[str]:
    """Return how many intervals of identified parameters contain the true value, by parameter and motor family."""
    with_interval = table[table.inside.notna()]
    rows = [
        {"parameter": f"`{name}`"}
        | {
            _family_label(comparison, family): _coverage(part[part.motors == family])
            for family in dict.fromkeys(table.motors)
        }
        for name, part in with_interval.groupby("parameter", sort=False)
    ]
    heading = "## Intervals of the identification that contain the true value"
    return [heading, _PARAMETERS, markdown(rows)] if rows else []


def _coverage(part: pd.DataFrame) -> str:
    return f"{int(part.inside.sum())} of {len(part)}" if len(part) else "-"
