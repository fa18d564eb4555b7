"""The report of a study as Markdown: the command, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pandas as pd

from surefoot.evaluation.gap import gap_text
from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.parameters import parameter_figure, parameters_figure
from surefoot.report.figures.runs import footfall_diagram
from surefoot.studies.comparison import CONTENTS, FAR, Comparison, late_gain, study_tables, write_tables
from surefoot.studies.evaluations import EVALUATIONS, load_gait_trace
from surefoot.studies.study_figures import gap_figure, group_figure, learning_curves
from surefoot.tables import markdown

_BARS = ("nominal_speed", "table1_falls", "sensitivity_mean", "sensitivity_std", "gap", "gap_balanced")
_HOW_TO_READ = (
    f"Means over seeds, with intervals of {CONFIDENCE:.0%} confidence in brackets: Student's t over seeds for a group, "
    "Welch's for a difference, none widened for the number of comparisons. Episodes within one seed are averaged "
    "first. Shares have Wilson's interval, of the episodes that the spread between seeds leaves, and Newcombe's for a "
    "difference. A mean of one or two seeds has no interval; the seeds are in parentheses. Bold: the interval does not "
    "include zero."
)
_GAP_TERMS = (
    "Home: the simulator that a policy was trained in, with the motors and delays of its own task. Described: the same "
    "engine with the robot of the data sheet. Away: the other world. Gap: return at home less return away. ±: one "
    f"standard error over runs. Brackets: {CONFIDENCE:.0%} confidence over policies and robots, both taken as drawn by "
    "chance. The best policies are those with the highest return in other episodes at home."
)


def write_report(comparison: Comparison, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    tables, missing = study_tables(comparison), ", ".join(comparison.missing)
    files = write_tables(comparison, tables, folder)
    group_figure(comparison, folder / "groups.png", _BARS)
    text = [
        f"# Study: {comparison.study.name}",
        f"```sh\n{command}\n```",
        *([f"**Not complete.** Not in this report: {missing}."] if missing else []),
        "## Trainings",
        markdown([_training(comparison, group) for group in comparison.groups]),
        *_curves(comparison, folder),
        "## Evaluations",
        "\n".join(f"- **{name}**: {EVALUATIONS[name].what}." for name in comparison.kinds),
        *(_gaps(comparison, tables, folder) if "gap" in comparison.kinds else []),
        "## Results",
        _HOW_TO_READ,
        _by_figure(comparison, tables["groups"].rename(columns={"label": "column"})),
        "![Groups side by side](groups.png)",
        "## Differences",
        _differences(comparison, tables["differences"]),
        "## Every seed",
        markdown(
            [
                {"group": comparison.study.label(row["group"]), "seed": row["seed"]}
                | {figure.heading: decimal(row[figure.name], figure.digits) for figure in comparison.figures}
                for row in comparison.policies.to_dict("records")
            ]
        ),
        *(_gaits(comparison, folder) if "gait" in comparison.kinds else []),
        *(_parameters(comparison, folder) if "sensitivity" in comparison.kinds else []),
        "## Files",
        "\n".join(f"- [{file.name}]({file.name}): {CONTENTS.get(file.stem, 'all but the episodes')}" for file in files),
    ]
    atomic_write(folder / "README.md", "\n\n".join(text) + "\n")
    return folder / "README.md"


def _differences(comparison: Comparison, table: pd.DataFrame) -> str:
    if not len(table):
        return "There are no two groups to compare."
    label = comparison.study.label
    pairs = [f"{label(row.group)}, against {label(row.against)}" for row in table.itertuples()]
    return _by_figure(comparison, table.assign(column=pairs), "difference")


def _training(comparison: Comparison, group: str) -> dict[str, str]:
    """Return the row of a group's trainings."""
    policies = comparison.of_group(group)
    gains = policies.curve.map(late_gain).dropna()
    best = ["?" if math.isnan(steps) else f"{steps / 1e6:.2f}" for steps in policies.best_steps.astype(float)]
    return {
        "group": comparison.study.label(group),
        "name": f"`{group}`",
        "seeds": ", ".join(map(str, policies.seed)),
        "control steps": ", ".join(f"{steps:,}" for steps in policies.steps.unique()),
        "best after (millions)": ", ".join(best),
        "time (min)": ", ".join(f"{seconds / 60:.1f}" for seconds in policies.training_seconds),
        "late gain of return (m)": t_interval(gains).text(3, sign=True) if len(gains) else "-",
    }


def _curves(comparison: Comparison, folder: Path) -> list[str]:
    """Draw the learning curves, a figure for each set of groups; return lines that show them."""
    lines = []
    for name, groups in comparison.sets().items():
        file = f"learning_curves_{name}.png" if comparison.study.bars else "learning_curves.png"
        curves = {comparison.study.label(group): list(comparison.of_group(group).curve) for group in groups}
        learning_curves(curves, folder / file)
        lines.append(f"![Learning curves]({file})")
    return lines


def _by_figure(comparison: Comparison, table: pd.DataFrame, change: str = "") -> str:
    """Return intervals with a row for each figure and a column for each group or pair.

    Columns of the ends begin with `change` where the intervals are of differences: those without zero are bold then.
    """
    names = [change, f"{change}_low", f"{change}_high"] if change else ["mean", "low", "high"]
    rows = []
    for figure in comparison.figures:
        cells = {"figure": figure.heading}
        for _, row in table[table.figure == figure.name].iterrows():
            interval = Interval(*row[names])
            if not change and not interval.is_finite:
                interval = comparison.interval(row.group, figure.name)
            text = interval.text(figure.digits, sign=bool(change))
            cells[row.column] = f"**{text}**" if change and not interval.covers_zero else text
        rows.append(cells)
    return markdown(rows)


def _gaits(comparison: Comparison, folder: Path) -> list[str]:
    """Name the gait of each policy and draw an episode of each group's first; return the section."""
    rows, figures = [], []
    for group in comparison.groups:
        label, policies = comparison.study.label(group), comparison.of_group(group)
        for policy in policies.itertuples():
            gait = policy.results["gait"]
            stride, duty = (decimal(math.nan if gait[name] is None else gait[name]) for name in ("stride", "duty"))
            row = {"group": label, "seed": str(policy.seed), "gait": gait["gait"], "agree": f"{gait['agree']} of 5"}
            row |= {"pattern": gait["pattern"], "why unnamed": gait["reason"] or ""}
            rows.append(row | {"stride (s)": stride, "duty factor": duty})
        footfall_diagram(load_gait_trace(policies.policy.iloc[0]), folder / f"gait_{group}.png")
        figures.append(f"![Footfalls: {label}, seed {policies.seed.iloc[0]}](gait_{group}.png)")
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
        "![Return against each parameter](parameters.png)",
        "With falls: " + ", ".join(f"[{row.replace('_', ' ')}](parameters/{row}.png)" for row in rows),
    ]


def _gaps(comparison: Comparison, tables: Mapping[str, pd.DataFrame], folder: Path) -> list[str]:
    """Draw the gaps of each set of groups; return the section."""
    best, parts = comparison.best(), ["## Reality gap", _GAP_TERMS]
    groups, changes = tables["gap_groups"], tables["gap_differences"]
    for name, names in comparison.sets().items():
        file = f"gap_{name}.png"
        gap_figure([best.gap(group) for group in names], folder / file)
        finding = comparison.finding(comparison.study.bars.get(name, names))
        parts += [f"### {name}", f"![Return at home and away]({file})"]
        parts += [f"In the paper: {finding}"] if finding else []
        parts.append(_gap_table(groups[(groups.policies == "top") & groups.group.isin(names)]))
    parts += ["### All policies", _gap_table(groups[groups.policies == "all"])]
    if len(changes):
        label = comparison.study.label
        rows = [
            {
                "group": label(row.group),
                "against": label(row.against),
                "policies": f"best {comparison.study.top}" if row.policies == "top" else "all",
                "gap (m)": MeanEstimate(row.difference, row.error).text(sign=True),
                "gap, interval (m)": _interval(row, "interval_difference").text(sign=True),
                "return away, interval (m)": _interval(row, "away_difference").text(sign=True),
                "paper": comparison.finding((row.against, row.group)),
            }
            for row in changes.itertuples()
        ]
        parts += ["### Differences of gaps", markdown(rows)]
    return parts


def _interval(row: Any, name: str) -> Interval:
    return Interval(*(getattr(row, f"{name}{end}") for end in ("", "_low", "_high")))


def _gap_table(table: pd.DataFrame) -> str:
    """Return rows of the table `gap_groups` as text."""
    rows = []
    for row in table.to_dict("records"):
        is_home = math.isnan(row["gap"])
        interval = "" if is_home else Interval(row["gap"], row["gap_low"], row["gap_high"]).text()
        distance = MeanEstimate(row["distance_mean"], row["distance_error"]).text()
        rows.append(
            {"group": row["label"], "seeds": row["seeds"].replace(" ", ", ")}
            | gap_text(row, is_home)
            | {"gap, interval (m)": interval, "distance (m)": distance}
            | {
                "least distance (m)": decimal(row["least_distance"]),
                f"over {FAR:g} m": f"{row['far']} of {row['runs']}",
            }
        )
    return markdown(rows)
