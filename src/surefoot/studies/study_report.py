"""The report of a study as Markdown: the command, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.report.figures.gap import gap_figure
from surefoot.report.figures.learning import learning_curves
from surefoot.report.figures.parameters import parameter_figure, parameters_figure
from surefoot.report.figures.style import capital
from surefoot.studies.comparison import CONTENTS, FAR, Comparison, study_tables, write_tables
from surefoot.studies.evaluations import EVALUATIONS, ResultFigure
from surefoot.studies.report import gait_image, group_figure, image, stride_cells, write_readme
from surefoot.tables import markdown

_BARS = ("nominal_speed", "table1_falls", "sensitivity_mean", "sensitivity_std", "gap_away", "gap", "gap_balanced")
_COLUMNS = 4
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
    f"runs that kept their balance to the end; a run is far that came over {FAR:g} m."
)


def write_report(comparison: Comparison, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    tables, missing = study_tables(comparison), ", ".join(comparison.missing)
    files = write_tables(comparison, tables, folder)
    group_figure(comparison, folder / "groups.png", _BARS)
    label, figures = comparison.study.label, comparison.figures
    levels = [
        {one.name: comparison.interval(group, one).text(one.digits) for one in figures} for group in comparison.groups
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
        markdown([_training(comparison, group) for group in comparison.groups]),
        *_curves(comparison, folder),
        *(_gaps(comparison, tables, folder) if comparison.gap_kind else []),
        "## Results",
        *_by_figure(figures, [{"group": label(group)} for group in comparison.groups], levels),
        image("Groups side by side", "groups.png"),
        "## Differences",
        *_differences(comparison, tables["differences"], comparison.figures),
        "## Every seed",
        *_by_figure(
            figures,
            [{"group": label(row["group"]), "seed": row["seed"]} for row in seeds],
            [{one.name: decimal(row[one.name], one.digits) for one in figures} for row in seeds],
        ),
        *(_gaits(comparison, folder) if "gait" in comparison.kinds else []),
        *(_parameters(comparison, folder) if "sensitivity" in comparison.kinds else []),
    ]
    listed = {file.name: CONTENTS.get(file.stem, "all but the episodes") for file in files}
    return write_readme(folder, f"Study: {comparison.study.name}", command, parts, listed)


def _comparisons(comparison: Comparison, table: pd.DataFrame) -> list[str]:
    """Say which of the declared comparisons differ in the primary figure; return the section."""
    if not len(table):
        return ["There are no two groups to compare."]
    figure, label = comparison.primary, comparison.study.label
    rows = table[table.figure == figure.name]
    count, survive = len(rows), int((rows.p_holm < _LEVEL).sum())
    lines = [
        f"Primary figure: {figure.heading}. Comparisons that the study's file declares: {count}; with p < {_LEVEL:.2g} "
        f"after Holm's correction for {count}: {survive}.",
        markdown(
            [
                {"group": label(row.group), "against": label(row.against)}
                | {figure.heading: _change(row, figure), "p": _p(row.p), f"p, Holm over {count}": _p(row.p_holm)}
                for row in rows.itertuples()
            ]
        ),
    ]
    findings = [(row, comparison.finding((row.against, row.group))) for row in rows.itertuples()]
    claims = [f"- {label(row.group)}, against {label(row.against)}: {text}" for row, text in findings if text]
    return [*lines, *(["In the paper:", "\n".join(claims)] if claims else [])]


def _change(row: Any, figure: ResultFigure) -> str:
    """Return a difference with its interval, bold if it is significant after correction."""
    interval = Interval(row.difference, row.difference_low, row.difference_high)
    text = interval.text(figure.digits, sign=True)
    return f"**{text}**" if row.p_holm < _LEVEL else text


def _p(value: float) -> str:
    return "< 0.001" if value < 0.001 else decimal(value, 3)


def _differences(comparison: Comparison, table: pd.DataFrame, figures: Sequence[ResultFigure]) -> list[str]:
    """Return tables of differences, a row a pair."""
    if not len(table):
        return ["There are no two groups to compare."]
    label, by_name = comparison.study.label, {figure.name: figure for figure in figures}
    pairs = table[["group", "against"]].drop_duplicates()
    heads = [{"group": label(row.group), "against": label(row.against)} for row in pairs.itertuples()]
    cells = [
        {row.figure: _change(row, by_name[row.figure]) for row in part.itertuples()}
        for _, part in table.groupby(["group", "against"], sort=False)
    ]
    return _by_figure(figures, heads, cells)


def _by_figure(
    figures: Sequence[ResultFigure], heads: Sequence[dict[str, Any]], cells: Sequence[Mapping[str, str]]
) -> list[str]:
    """Return tables with rows that begin with `heads` and a column for each figure, a few figures a table."""
    return [
        markdown(
            [
                head | {figure.heading: row[figure.name] for figure in figures[first : first + _COLUMNS]}
                for head, row in zip(heads, cells, strict=True)
            ]
        )
        for first in range(0, len(figures), _COLUMNS)
    ]


def _training(comparison: Comparison, group: str) -> dict[str, str]:
    """Return the row of a group's trainings."""
    policies = comparison.of_group(group)
    return {
        "group": comparison.study.label(group),
        "name": f"`{group}`",
        "seeds": ", ".join(map(str, policies.seed)),
        "control steps": ", ".join(f"{steps:,}" for steps in policies.steps.unique()),
        "late gain of return (m)": t_interval(policies.late_gain).text(2, sign=True),
    }


def _curves(comparison: Comparison, folder: Path) -> list[str]:
    """Draw the learning curves, a figure for each set of groups; return lines that show them."""
    lines = []
    for name, groups in comparison.sets().items():
        file = f"learning_curves_{name}.png" if comparison.study.bars else "learning_curves.png"
        curves = {comparison.study.label(group): list(comparison.of_group(group).curve) for group in groups}
        learning_curves(curves, folder / file)
        lines.append(image("Learning curves", file))
    return lines


def _gaits(comparison: Comparison, folder: Path) -> list[str]:
    """Name the gait of each policy and draw an episode of each group's first; return the section."""
    rows, figures = [], []
    for group in comparison.groups:
        label, policies = comparison.study.label(group), comparison.of_group(group)
        for policy in policies.itertuples():
            gait = policy.results["gait"]
            row = {"group": label, "seed": str(policy.seed), "gait": gait["gait"], "agree": f"{gait['agree']} of 5"}
            row |= {"pattern": gait["pattern"], "why unnamed": gait["reason"] or ""}
            rows.append(row | stride_cells(gait))
        figures.append(gait_image(policies.policy.iloc[0], folder, group, f"{label}, seed {policies.seed.iloc[0]}"))
    return ["## Gaits", markdown(rows), *figures]


def _parameters(comparison: Comparison, folder: Path) -> list[str]:
    """Draw returns and falls against each parameter; return the section."""
    groups = {comparison.study.label(group): comparison.sensitivities(group) for group in comparison.groups}
    rows = next(iter(groups.values()))[0].rows
    parameters_figure(groups, folder / "parameters.png")
    for row in rows:
        parameter_figure(row, groups, folder / "parameters" / f"{row}.png")
    return [
        "## One parameter at a time",
        image("Return against each parameter", "parameters.png"),
        "With falls: " + ", ".join(f"[{row.replace('_', ' ')}](parameters/{row}.png)" for row in rows),
    ]


def _gaps(comparison: Comparison, tables: Mapping[str, pd.DataFrame], folder: Path) -> list[str]:
    """Draw the gaps of each set of groups, of all policies and of the best; return the sections."""
    groups, lines, top = tables["gap_groups"], ["## Reality gap", _GAP_TERMS], comparison.study.top
    label, best = comparison.study.label, comparison.best()
    for name, names in comparison.sets().items():
        file = f"gap_{name}.png"
        gap_figure([comparison.gap(group) for group in names], folder / file, over_policies=True)
        finding = comparison.finding(comparison.study.bars.get(name, names))
        lines += [f"### {capital(name)}", image("Return of all policies at home and away", file)]
        lines += [f"In the paper: {finding}"] if finding else []
        lines.append(_gap_table(groups[(groups.policies == "all") & groups.group.isin(names)]))
    chosen = [f"{label(group)} {', '.join(map(str, best.of_group(group).seed))}" for group in best.groups]
    lines += [
        f"## The best {top} policies of each group",
        f"As the paper measures: those with the highest return in other episodes at home; ± is one standard error over "
        f"runs. Seeds: {'; '.join(chosen)}.",
    ]
    for name, names in comparison.sets().items():
        file = f"gap_{name}_top.png"
        gap_figure([best.gap(group) for group in names], folder / file)
        lines += [image(f"Return of the best {top} policies at home and away", file)]
        lines.append(_gap_table(groups[(groups.policies == "top") & groups.group.isin(names)]))
    return [*lines, *_differences(best, tables["top_differences"], EVALUATIONS[comparison.gap_kind].figures)]


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
            | {f"over {FAR:g} m": f"{row['far']} of {row['runs']}"}
        )
    return markdown(rows)


def _interval(row: Mapping[str, Any], name: str) -> Interval:
    return Interval(*(row[f"{name}{end}"] for end in ("", "_low", "_high")))
