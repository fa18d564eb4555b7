"""The report of a study as Markdown: the command, tables and figures."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pandas as pd

from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal
from surefoot.files import atomic_write
from surefoot.report.figures.gap import gap_figure
from surefoot.report.figures.learning import learning_curves
from surefoot.report.figures.parameters import parameter_figure, parameters_figure
from surefoot.report.figures.runs import footfall_diagram
from surefoot.report.figures.style import capital
from surefoot.studies.comparison import CONTENTS, FAR_DISTANCE, Comparison, read_tables, study_tables, write_tables
from surefoot.studies.evaluations import EVALUATIONS, ResultMetric, load_gait_trace
from surefoot.studies.report import group_figure, image, readme, stride_cells
from surefoot.studies.study_config import StudyConfig
from surefoot.tables import markdown

_BAR_METRICS = (
    "nominal_speed",
    "table1_falls",
    "sensitivity_mean",
    "sensitivity_std",
    "gap_away",
    "gap",
    "gap_balanced",
)
_METRICS_PER_TABLE = 4
"""Figures that one table of the report holds."""
_LEVEL = 1 - CONFIDENCE
_HOW_TO_READ = (
    f"Means over seeds, with intervals of {CONFIDENCE:.0%} confidence in brackets, not widened for the number of "
    "comparisons. Figures of the gap vary by policies and robots, both taken as drawn by chance; all others by seeds "
    "(Student's t for a group, Welch's for a difference). Shares have exact binomial intervals, of the episodes that "
    "the spread between seeds (and robots) leaves (Korn and Graubard). A mean of one or two seeds has no interval; the "
    f"seeds are in parentheses. **Bold** differences have p < {_LEVEL:.2g} after Holm's correction for the number of "
    "comparisons: those of one figure are a family. Late gain: mean return in the last fifth of a training less that "
    "in the fifth before."
)
_GAP_TERMS = (
    "Home: the simulator that a policy was trained in, with the motors and delays of its own task. Described: the same "
    "engine with the robot of the data sheet. Away: the other world. Gap: return at home less return away. Balanced: "
    f"runs that kept their balance to the end; a run is far that came over {FAR_DISTANCE:g} m."
)


def write_report(comparison: Comparison, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    tables = study_tables(comparison)
    write_tables(comparison, tables, folder)
    _draw(comparison, folder)
    path = folder / "README.md"
    atomic_write(path, report_text(comparison, tables, command))
    return path


def report_from_tables(study: StudyConfig, folder: Path, command: str) -> str:
    """Return README.md of a study from the tables of its report, without the runs."""
    tables = read_tables(folder)
    missing = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["missing"]
    return report_text(Comparison(study, tables["policies"], tuple(missing)), tables, command)


def report_text(comparison: Comparison, tables: Mapping[str, pd.DataFrame], command: str) -> str:
    """Return README.md of a study from its tables; of the comparison only study, policies' columns and `missing`."""
    missing, label, metrics = ", ".join(comparison.missing), comparison.study.label, comparison.metrics
    levels = [
        {one.name: _level(tables, group, one.name).text(one.digits) for one in metrics} for group in comparison.groups
    ]
    seeds = comparison.policies.to_dict("records")
    parts = [
        *([f"**Not complete.** Not in this report: {missing}."] if missing else []),
        "## How to read",
        _HOW_TO_READ,
        "\n".join(f"- **{name}**: {EVALUATIONS[name].what}." for name in comparison.kinds),
        "## Comparisons",
        *_comparisons(comparison, tables["differences"]),
        "## Trainings",
        markdown([_training(comparison, tables, group) for group in comparison.groups]),
        *(image("Learning curves", file) for file in _curve_files(comparison)),
        *(_gaps(comparison, tables) if comparison.gap_kind else []),
        "## Results",
        *_by_metric(metrics, [{"group": label(group)} for group in comparison.groups], levels),
        image("Groups side by side", "groups.png"),
        "## Differences",
        *_differences(comparison, tables["differences"], comparison.metrics),
        "## Every seed",
        *_by_metric(
            metrics,
            [{"group": label(row["group"]), "seed": row["seed"]} for row in seeds],
            [{one.name: decimal(row[one.name], one.digits) for one in metrics} for row in seeds],
        ),
        *(_gaits(comparison, tables["gaits"]) if "gait" in comparison.kinds else []),
        *(_parameters(tables["sensitivity"]) if "sensitivity" in comparison.kinds else []),
    ]
    listed = {f"{name}.csv": CONTENTS[name] for name, table in tables.items() if len(table)}
    listed["summary.json"] = "all but the episodes"
    return readme(f"Study: {comparison.study.name}", command, parts, listed)


def _draw(comparison: Comparison, folder: Path) -> None:
    """Draw the figures that the text shows."""
    label = comparison.study.label
    group_figure(comparison, folder / "groups.png", _BAR_METRICS)
    for file, groups in _curve_files(comparison).items():
        curves = {label(group): list(comparison.of_group(group).curve) for group in groups}
        learning_curves(curves, folder / file)
    if comparison.gap_kind:
        best = comparison.best()
        for name, names in comparison.sets().items():
            gap_figure([comparison.gap(group) for group in names], folder / f"gap_{name}.png", over_policies=True)
            gap_figure([best.gap(group) for group in names], folder / f"gap_{name}_top.png")
    if "gait" in comparison.kinds:
        for group in comparison.groups:
            footfall_diagram(load_gait_trace(comparison.of_group(group).policy.iloc[0]), folder / f"gait_{group}.png")
    if "sensitivity" in comparison.kinds:
        tested = {label(group): comparison.sensitivities(group) for group in comparison.groups}
        parameters_figure(tested, folder / "parameters.png")
        for row in next(iter(tested.values()))[0].rows:
            parameter_figure(row, tested, folder / "parameters" / f"{row}.png")


def _level(tables: Mapping[str, pd.DataFrame], group: str, metric: str) -> Interval:
    """Return the mean of a figure over a group, with its interval or the numbers of a few policies."""
    rows = tables["groups"]
    row = rows[(rows.group == group) & (rows.figure == metric)].iloc[0]
    interval = Interval(row["mean"], row["low"], row["high"])
    policies = tables["policies"]
    values = () if interval.is_finite else tuple(policies[policies.group == group][metric])
    return replace(interval, values=values)


def _comparisons(comparison: Comparison, table: pd.DataFrame) -> list[str]:
    """Say which of the declared comparisons differ in the primary figure; return the section."""
    if not len(table):
        return ["There are no two groups to compare."]
    metric, label = comparison.primary, comparison.study.label
    rows = table[table.figure == metric.name]
    count, survive = len(rows), int((rows.p_holm < _LEVEL).sum())
    lines = [
        f"Primary figure: {metric.heading}. Comparisons that the study's file declares: {count}; with p < {_LEVEL:.2g} "
        f"after Holm's correction for {count}: {survive}.",
        markdown(
            [
                {"group": label(row.group), "against": label(row.against)}
                | {metric.heading: _change(row, metric), "p": _p(row.p), f"p, Holm over {count}": _p(row.p_holm)}
                for row in rows.itertuples()
            ]
        ),
    ]
    findings = [(row, comparison.finding((row.against, row.group))) for row in rows.itertuples()]
    claims = [f"- {label(row.group)}, against {label(row.against)}: {text}" for row, text in findings if text]
    return [*lines, *(["In the paper:", "\n".join(claims)] if claims else [])]


def _change(row: Any, metric: ResultMetric) -> str:
    """Return a difference with its interval, bold if it is significant after correction."""
    interval = Interval(row.difference, row.difference_low, row.difference_high)
    text = interval.text(metric.digits, sign=True)
    return f"**{text}**" if row.p_holm < _LEVEL else text


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else decimal(value, 3)


def _differences(comparison: Comparison, table: pd.DataFrame, metrics: Sequence[ResultMetric]) -> list[str]:
    """Return tables of differences, a row a pair."""
    if not len(table):
        return ["There are no two groups to compare."]
    label, by_name = comparison.study.label, {metric.name: metric for metric in metrics}
    pairs = table[["group", "against"]].drop_duplicates()
    heads = [{"group": label(row.group), "against": label(row.against)} for row in pairs.itertuples()]
    cells = [
        {row.figure: _change(row, by_name[row.figure]) for row in part.itertuples()}
        for _, part in table.groupby(["group", "against"], sort=False)
    ]
    return _by_metric(metrics, heads, cells)


def _by_metric(
    metrics: Sequence[ResultMetric], heads: Sequence[dict[str, Any]], cells: Sequence[Mapping[str, str]]
) -> list[str]:
    """Return tables with rows that begin with `heads` and a column for each figure, a few figures a table."""
    return [
        markdown(
            [
                head | {metric.heading: row[metric.name] for metric in metrics[first : first + _METRICS_PER_TABLE]}
                for head, row in zip(heads, cells, strict=True)
            ]
        )
        for first in range(0, len(metrics), _METRICS_PER_TABLE)
    ]


def _training(comparison: Comparison, tables: Mapping[str, pd.DataFrame], group: str) -> dict[str, str]:
    """Return the row of a group's trainings."""
    policies = comparison.of_group(group)
    return {
        "group": comparison.study.label(group),
        "name": f"`{group}`",
        "seeds": ", ".join(map(str, policies.seed)),
        "control steps": ", ".join(f"{steps:,}" for steps in policies.steps.unique()),
        "late gain of return (m)": _level(tables, group, "late_gain").text(2, sign=True),
    }


def _curve_files(comparison: Comparison) -> dict[str, list[str]]:
    """Return the groups of each figure of learning curves, by its file."""
    sets = comparison.sets().items()
    return {
        f"learning_curves_{name}.png" if comparison.study.bars else "learning_curves.png": one for name, one in sets
    }


def _gaits(comparison: Comparison, table: pd.DataFrame) -> list[str]:
    """Return the section with the gait of each policy and an episode of each group's first."""
    label = comparison.study.label
    rows = [
        {"group": label(row["group"]), "seed": str(row["seed"]), "gait": row["gait"], "agree": f"{row['agree']} of 5"}
        | {"pattern": row["pattern"], "why unnamed": "" if pd.isna(row["reason"]) else row["reason"]}
        | stride_cells(row)
        for row in table.to_dict("records")
    ]
    firsts = {group: comparison.of_group(group).seed.iloc[0] for group in comparison.groups}
    images = [image(f"Footfalls: {label(group)}, seed {seed}", f"gait_{group}.png") for group, seed in firsts.items()]
    return ["## Gaits", markdown(rows), *images]


def _parameters(table: pd.DataFrame) -> list[str]:
    """Return the section with returns and falls against each parameter."""
    return [
        "## One parameter at a time",
        image("Return against each parameter", "parameters.png"),
        "With falls: " + ", ".join(f"[{row.replace('_', ' ')}](parameters/{row}.png)" for row in table.row.unique()),
    ]


def _gaps(comparison: Comparison, tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return the sections on the gaps of each set of groups, of all policies and of the best."""
    groups, lines, top = tables["gap_groups"], ["## Reality gap", _GAP_TERMS], comparison.study.top
    label, best = comparison.study.label, comparison.best()
    for name, names in comparison.sets().items():
        finding = comparison.finding(comparison.study.bars.get(name, names))
        lines += [f"### {capital(name)}", image("Return of all policies at home and away", f"gap_{name}.png")]
        lines += [f"In the paper: {finding}"] if finding else []
        lines.append(_gap_table(groups[(groups.policies == "all") & groups.group.isin(names)]))
    chosen = [f"{label(group)} {', '.join(map(str, best.of_group(group).seed))}" for group in best.groups]
    lines += [
        f"## The best {top} policies of each group",
        f"As the paper measures: those with the highest return in other episodes at home; ± is one standard error over "
        f"runs. Seeds: {'; '.join(chosen)}.",
    ]
    for name, names in comparison.sets().items():
        lines += [image(f"Return of the best {top} policies at home and away", f"gap_{name}_top.png")]
        lines.append(_gap_table(groups[(groups.policies == "top") & groups.group.isin(names)]))
    return [*lines, *_differences(best, tables["top_differences"], EVALUATIONS[comparison.gap_kind].metrics)]


def _gap_table(table: pd.DataFrame) -> str:
    """Return rows of the table `gap_groups` as text."""
    rows = []
    for row in table.to_dict("records"):
        share = Interval(*(100 * row[f"balanced_share{end}"] for end in ("", "_low", "_high")))
        is_top, is_home = row["policies"] == "top", math.isnan(row["gap"])
        level = MeanEstimate(row["return_mean"], row["return_error"]) if is_top else _interval(row, "return")
        gap = MeanEstimate(row["gap"], row["gap_error"]) if is_top else _interval(row, "gap")
        rows.append(
            {"group": row["label"], "world": row["world"], "return (m)": level.text()}
            | {"gap (m)": "" if is_home else gap.text(), "balanced (%)": share.text(0)}
            | {f"over {FAR_DISTANCE:g} m": f"{row['far']} of {row['runs']}"}
        )
    return markdown(rows)


def _interval(row: Mapping[str, Any], name: str) -> Interval:
    return Interval(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
