"""Markdown report of a study: command, tables and figures."""

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
from surefoot.report.figures.style import capitalize_first
from surefoot.studies.comparison import CONTENTS, FAR_DISTANCE, Comparison, study_tables, write_tables
from surefoot.studies.evaluations import EVALUATIONS, ResultMetric, load_gait_trace
from surefoot.studies.report import group_figure, image, p_text, read_tables, readme, stride_cells
from surefoot.studies.study_config import StudyConfig
from surefoot.tables import markdown, with_unit

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
"""Number of metrics in one table of the report."""
_LEVEL = 1 - CONFIDENCE
_HOW_TO_READ = (
    f"Means over seeds, with {CONFIDENCE:.0%} confidence intervals in brackets, which are not widened for the number "
    "of comparisons. Intervals of the gap's metrics are over policies and robots, both as random effects; all others "
    "are over seeds (Student's t for a group, Welch's for a difference). Percentages have exact binomial intervals "
    "with the effective number of episodes that the spread between seeds (and robots) leaves (Korn and Graubard). A "
    "mean of one or two seeds has no interval; the seeds' values are in parentheses. **Bold** differences have "
    f"p < {_LEVEL:.2g} after Holm's correction for the number of comparisons of a metric. Late gain: increase of the "
    "mean return from the fourth to the last fifth of a training."
)
_GAP_TERMS = (
    "Training simulator: the simulator of the training, with the motors and delays of the policy's task. As described: "
    "the same engine with the robot of the data sheet. Target world: the other world. Gap: return in the training "
    "simulator minus return in the target world. Balanced: runs in which the robot kept its balance to the end. Far: "
    f"runs over {FAR_DISTANCE:g} m."
)


def write_report(comparison: Comparison, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md into a folder; return the path of README.md.

    The report names `command`, the command line.
    """
    tables = study_tables(comparison)
    write_tables(comparison, tables, folder)
    _draw(comparison, folder)
    path = folder / "README.md"
    atomic_write(path, report_text(comparison, tables, command))
    return path


def report_from_tables(study: StudyConfig, folder: Path, command: str) -> str:
    """Return the README.md of a study from the tables of its report; the runs are not needed."""
    tables = read_tables(folder, CONTENTS)
    missing = json.loads((folder / "summary.json").read_text(encoding="utf-8"))["missing"]
    return report_text(Comparison(study, tables["policies"], tuple(missing)), tables, command)


def report_text(comparison: Comparison, tables: Mapping[str, pd.DataFrame], command: str) -> str:
    """Return the README.md of a study from its tables.

    Only the study, the tabulated columns of `policies`, and `missing` of the comparison are needed.
    """
    missing, label, metrics = ", ".join(comparison.missing), comparison.study.label, comparison.metrics
    levels = [
        {one.name: _level(tables, group, one.name).text(one.digits) for one in metrics} for group in comparison.groups
    ]
    seeds = comparison.policies.to_dict("records")
    parts = [
        *([f"**Not complete.** Not in this report: {missing}."] if missing else []),
        "## How to read",
        _HOW_TO_READ,
        "\n".join(f"- **{name}**: {EVALUATIONS[name].description}." for name in comparison.kinds),
        "## Comparisons",
        *_comparisons(comparison, tables["differences"]),
        "## Trainings",
        markdown([_training(comparison, tables, group) for group in comparison.groups]),
        *(image("Learning curves", file) for file in _curve_files(comparison)),
        *(_gaps(comparison, tables) if comparison.gap_kind else []),
        "## Results",
        *_by_metric(metrics, [{"group": label(group)} for group in comparison.groups], levels),
        image("Metrics of all groups", "groups.png"),
        "## Differences",
        *_differences(comparison, tables["differences"], comparison.metrics),
        *(_effects(comparison, tables["effects"], metrics) if "effects" in tables else []),
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
    """Draw the figures of the report."""
    label, unit = comparison.study.label, comparison.return_unit
    group_figure(comparison, folder / "groups.png", _BAR_METRICS)
    for file, groups in _curve_files(comparison).items():
        curves = {label(group): list(comparison.select_group(group).curve) for group in groups}
        learning_curves(curves, folder / file, unit)
    if comparison.gap_kind:
        best = comparison.best()
        for name, names in comparison.sets().items():
            gap_figure([comparison.gap(group) for group in names], folder / f"gap_{name}.png", unit, over_policies=True)
            gap_figure([best.gap(group) for group in names], folder / f"gap_{name}_top.png", unit)
    if "gait" in comparison.kinds:
        for group in comparison.groups:
            footfall_diagram(
                load_gait_trace(comparison.select_group(group).policy.iloc[0]), folder / f"gait_{group}.png"
            )
    if "sensitivity" in comparison.kinds:
        tested = {label(group): comparison.sensitivities(group) for group in comparison.groups}
        parameters_figure(tested, folder / "parameters.png", unit)
        for row in next(iter(tested.values()))[0].rows:
            parameter_figure(row, tested, folder / "parameters" / f"{row}.png", unit=unit)


def _level(tables: Mapping[str, pd.DataFrame], group: str, metric: str) -> Interval:
    """Return the mean of a metric over a group, with its interval or, for one or two policies, their values."""
    rows = tables["groups"]
    row = rows[(rows.group == group) & (rows.figure == metric)].iloc[0]
    interval = Interval(row["mean"], row["low"], row["high"])
    policies = tables["policies"]
    values = () if interval.is_finite else tuple(policies[policies.group == group][metric])
    return replace(interval, values=values)


def _comparisons(comparison: Comparison, table: pd.DataFrame) -> list[str]:
    """Return the section that lists the declared comparisons of the primary metric."""
    if not len(table):
        return ["There are no two groups to compare."]
    metric, label = comparison.primary, comparison.study.label
    rows = table[table.figure == metric.name]
    count, significant = len(comparison.study.pairs), int((rows.p_holm < _LEVEL).sum())
    lines = [
        f"Primary metric: {metric.heading}. Comparisons that the study's file declares: {count}; with p < {_LEVEL:.2g} "
        f"after Holm's correction for {count}: {significant}.",
        markdown(
            [
                {"group": label(row.group), "against": label(row.against)}
                | {
                    metric.heading: _change(row, metric),
                    "p": p_text(row.p),
                    f"p, Holm over {count}": p_text(row.p_holm),
                }
                for row in rows.itertuples()
            ]
        ),
    ]
    findings = [(row, comparison.finding((row.against, row.group))) for row in rows.itertuples()]
    claims = [f"- {label(row.group)}, against {label(row.against)}: {text}" for row, text in findings if text]
    return [*lines, *(["In the paper:", "\n".join(claims)] if claims else [])]


def _change(row: Any, metric: ResultMetric) -> str:
    """Return a difference with its interval, bold if it is significant after correction."""
    text = _difference(row).text(metric.digits, sign=True)
    return f"**{text}**" if row.p_holm < _LEVEL else text


def _difference(row: Any) -> Interval:
    return Interval(row.difference, row.difference_low, row.difference_high)


def _differences(comparison: Comparison, table: pd.DataFrame, metrics: Sequence[ResultMetric]) -> list[str]:
    """Return tables of differences, one row per pair."""
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


def _effects(comparison: Comparison, table: pd.DataFrame, metrics: Sequence[ResultMetric]) -> list[str]:
    """Return the section on main effects, whose p values stand next to them."""
    label, shown = comparison.study.label, [one for one in metrics if one.name in set(table.figure)]
    names = list(table.effect.unique())
    pairs = [
        f"- {name}: mean over " + " and ".join(f"{label(group)} less {label(base)}" for base, group in pairs) + "."
        for name, pairs in comparison.study.effects.items()
        if name in names
    ]
    cells = []
    for name in names:
        rows = {row.figure: row for row in table[table.effect == name].itertuples()}
        cells.append(
            {
                one.name: f"{_difference(rows[one.name]).text(one.digits, sign=True)}, p {p_text(rows[one.name].p)}"
                for one in shown
            }
        )
    return [
        "## Main effects",
        "\n".join(pairs),
        "p values are not corrected.",
        *_by_metric(shown, [{"effect": name} for name in names], cells),
    ]


def _by_metric(
    metrics: Sequence[ResultMetric], heads: Sequence[dict[str, Any]], cells: Sequence[Mapping[str, str]]
) -> list[str]:
    """Return tables with rows that begin with `heads`, and up to `_METRICS_PER_TABLE` columns of metrics each."""
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
    policies = comparison.select_group(group)
    return {
        "group": comparison.study.label(group),
        "name": f"`{group}`",
        "seeds": ", ".join(map(str, policies.seed)),
        "control steps": ", ".join(f"{steps:,}" for steps in policies.steps.unique()),
        with_unit("late gain of return", comparison.return_unit): _level(tables, group, "late_gain").text(2, sign=True),
    }


def _curve_files(comparison: Comparison) -> dict[str, list[str]]:
    """Return the groups of each figure of learning curves, by file."""
    sets = comparison.sets().items()
    return {
        f"learning_curves_{name}.png" if comparison.study.bars else "learning_curves.png": one for name, one in sets
    }


def _gaits(comparison: Comparison, table: pd.DataFrame) -> list[str]:
    """Return the section with the gait of each policy, and the footfalls of each group's first policy."""
    label = comparison.study.label
    rows = [
        {"group": label(row["group"]), "seed": str(row["seed"]), "gait": row["gait"], "agree": f"{row['agree']} of 5"}
        | {"pattern": row["pattern"], "why unnamed": "" if pd.isna(row["reason"]) else row["reason"]}
        | stride_cells(row)
        for row in table.to_dict("records")
    ]
    firsts = {group: comparison.select_group(group).seed.iloc[0] for group in comparison.groups}
    images = [image(f"Footfalls: {label(group)}, seed {seed}", f"gait_{group}.png") for group, seed in firsts.items()]
    return ["## Gaits", markdown(rows), *images]


def _parameters(table: pd.DataFrame) -> list[str]:
    """Return the section on the sensitivity to each parameter."""
    return [
        "## One parameter at a time",
        image("Return against each parameter", "parameters.png"),
        "With falls: " + ", ".join(f"[{row.replace('_', ' ')}](parameters/{row}.png)" for row in table.row.unique()),
    ]


def _gaps(comparison: Comparison, tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """Return the sections on the reality gap, for all policies and for the best, by set of groups."""
    groups, lines, top = tables["gap_groups"], ["## Reality gap", _GAP_TERMS], comparison.study.top
    label, best = comparison.study.label, comparison.best()
    for name, names in comparison.sets().items():
        finding = comparison.finding(comparison.study.bars.get(name, names))
        image_text = image("Return of all policies in training simulator and target world", f"gap_{name}.png")
        lines += [f"### {capitalize_first(name)}", image_text]
        lines += [f"In the paper: {finding}"] if finding else []
        lines.append(_gap_table(groups[(groups.policies == "all") & groups.group.isin(names)], comparison.return_unit))
    chosen = [f"{label(group)} {', '.join(map(str, best.select_group(group).seed))}" for group in best.groups]
    lines += [
        f"## The best {top} policies of each group",
        "As in the paper: the policies with the highest return in separate episodes in the training simulator; ± is "
        f"one standard error over runs. Seeds: {'; '.join(chosen)}.",
    ]
    for name, names in comparison.sets().items():
        caption = f"Return of the best {top} policies in training simulator and target world"
        lines += [image(caption, f"gap_{name}_top.png")]
        lines.append(_gap_table(groups[(groups.policies == "top") & groups.group.isin(names)], comparison.return_unit))
    return [*lines, *_differences(best, tables["top_differences"], best.metrics_of(comparison.gap_kind))]


def _gap_table(table: pd.DataFrame, unit: str) -> str:
    """Return rows of the table `gap_groups` in Markdown; `unit` is the unit of returns."""
    rows = []
    for row in table.to_dict("records"):
        balanced = Interval(*(100 * row[f"balanced_share{end}"] for end in ("", "_low", "_high")))
        is_top, is_home = row["policies"] == "top", math.isnan(row["gap"])
        level = MeanEstimate(row["return_mean"], row["return_error"]) if is_top else _interval(row, "return")
        gap = MeanEstimate(row["gap"], row["gap_error"]) if is_top else _interval(row, "gap")
        rows.append(
            {"group": row["label"], "world": row["world"], with_unit("return", unit): level.text()}
            | {with_unit("gap", unit): "" if is_home else gap.text(), "balanced (%)": balanced.text(0)}
            | {f"over {FAR_DISTANCE:g} m": f"{row['far']} of {row['runs']}"}
        )
    return markdown(rows)


def _interval(row: Mapping[str, Any], name: str) -> Interval:
    return Interval(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
