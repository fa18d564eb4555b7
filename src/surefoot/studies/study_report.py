"""The report of a study as Markdown: the command, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from surefoot.evaluate.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.parameters import parameter_figure, parameters_figure
from surefoot.report.figures.runs import footfall_diagram
from surefoot.studies.comparison import CONTENTS, FAR, Comparison, GroupResult, late_gain, study_tables, write_tables
from surefoot.studies.evaluations import EVALUATIONS, load_gait_trace
from surefoot.studies.study_figures import gap_figure, group_figure, learning_curves
from surefoot.tables import markdown

_BARS = ("nominal_speed", "table1_falls", "sensitivity_mean", "sensitivity_std", "gap", "gap_balanced")
_HOW_TO_READ = (
    f"Means over seeds, with intervals of {CONFIDENCE:.0%} confidence in brackets: Student's t over seeds for a group, "
    "Welch's for a difference, none widened for the number of comparisons. Episodes within one seed are averaged "
    "first. Brackets are left out where there are too few seeds. Bold: the interval does not include zero."
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
        markdown([_training(group) for group in comparison.groups]),
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
                {"group": group.label, "seed": seed.seed}
                | {figure.heading: decimal(seed.figures[figure.name], figure.digits) for figure in comparison.figures}
                for group in comparison.groups
                for seed in group.seeds
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
    label = {group.name: group.label for group in comparison.groups}
    pairs = [f"{label[row.group]}, against {label[row.against]}" for row in table.itertuples()]
    return _by_figure(comparison, table.assign(column=pairs), "difference")


def _training(group: GroupResult) -> dict[str, str]:
    """Return the row of a group's trainings."""
    gains = np.array([late_gain(seed.curve) for seed in group.seeds])
    gains = gains[np.isfinite(gains)]
    return {
        "group": group.label,
        "name": f"`{group.name}`",
        "seeds": ", ".join(str(seed.seed) for seed in group.seeds),
        "control steps": ", ".join(dict.fromkeys(f"{seed.steps:,}" for seed in group.seeds)),
        "best after (millions)": ", ".join("?" if s.best is None else f"{s.best / 1e6:.2f}" for s in group.seeds),
        "time (min)": ", ".join(f"{seed.seconds / 60:.1f}" for seed in group.seeds),
        "late gain of return (m)": t_interval(gains).text(3, sign=True) if len(gains) else "-",
    }


def _curves(comparison: Comparison, folder: Path) -> list[str]:
    """Draw the learning curves, a figure for each set of groups; return lines that show them."""
    lines = []
    for name, groups in comparison.sets() if comparison.study.bars else [("", comparison.groups)]:
        file = f"learning_curves_{name}.png" if name else "learning_curves.png"
        learning_curves({group.label: [seed.curve for seed in group.seeds] for group in groups}, folder / file)
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
            text = interval.text(figure.digits, sign=bool(change))
            cells[row.column] = f"**{text}**" if change and not interval.covers_zero else text
        rows.append(cells)
    return markdown(rows)


def _gaits(comparison: Comparison, folder: Path) -> list[str]:
    """Name the gait of each policy and draw an episode of each group's first; return the section."""
    rows, figures = [], []
    for group in comparison.groups:
        for seed in group.seeds:
            gait = seed.results["gait"]
            stride, duty = (decimal(math.nan if gait[name] is None else gait[name]) for name in ("stride", "duty"))
            row = {"group": group.label, "seed": str(seed.seed), "gait": gait["gait"], "agree": f"{gait['agree']} of 5"}
            row |= {"pattern": gait["pattern"], "why unnamed": gait["reason"] or ""}
            rows.append(row | {"stride (s)": stride, "duty factor": duty})
        policy, file = group.seeds[0].policy, f"gait_{group.name}.png"
        assert policy is not None
        footfall_diagram(load_gait_trace(policy), folder / file)
        figures.append(f"![Footfalls: {group.label}, seed {group.seeds[0].seed}]({file})")
    return ["## Gaits", markdown(rows), *figures]


def _parameters(comparison: Comparison, folder: Path) -> list[str]:
    """Draw returns and falls against each parameter; return the section."""
    groups = {group.label: group.sensitivities for group in comparison.groups}
    rows = comparison.groups[0].sensitivities[0].rows
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
    for name, members in comparison.sets():
        names, file = [group.name for group in members], f"gap_{name}.png"
        gap_figure([group.gap for group in best.groups if group.name in names], folder / file)
        finding = comparison.finding(comparison.study.bars.get(name, names))
        parts += [f"### {name}", f"![Return at home and away]({file})"]
        parts += [f"In the paper: {finding}"] if finding else []
        parts.append(_gap_table(groups[(groups.policies == "top") & groups.group.isin(names)]))
    parts += ["### All policies", _gap_table(groups[groups.policies == "all"])]
    if len(changes):
        labels = {group.name: group.label for group in comparison.groups}
        rows = [
            {
                "group": labels[row.group],
                "against": labels[row.against],
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

    def mean(row: Any, name: str, digits: int = 2) -> str:
        return MeanEstimate(getattr(row, f"{name}_mean"), getattr(row, f"{name}_error")).text(digits)

    return markdown(
        [
            {
                "group": row.label,
                "seeds": row.seeds.replace(" ", ", "),
                "world": row.world,
                "return (m)": mean(row, "return"),
                "gap (m)": "" if math.isnan(row.gap) else MeanEstimate(row.gap, row.gap_error).text(),
                "speed (m/s)": mean(row, "speed"),
                "power (W)": mean(row, "power", 1),
                "falls": f"{row.falls} of {row.runs}",
                "success": f"{100 * row.success_rate:.0f} %",
                "gap, interval (m)": "" if math.isnan(row.gap) else _interval(row, "gap").text(),
                "distance (m)": mean(row, "distance"),
                "least distance (m)": decimal(row.least_distance),
                f"over {FAR:g} m": f"{row.far} of {row.runs}",
            }
            for row in table.itertuples()
        ]
    )
