"""The report of a study as Markdown: the command, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from surefoot.evaluate.gap import gap_difference
from surefoot.evaluate.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.parameters import parameter_figure, parameters_figure
from surefoot.report.figures.runs import footfall_diagram
from surefoot.studies.comparison import CONTENTS, FAR, Comparison, GroupResult, difference, late_gain, write_tables
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
    files = write_tables(comparison, folder)
    group_figure(comparison, folder / "groups.png", _BARS)
    text = [
        f"# Study: {comparison.name}",
        f"```sh\n{command}\n```",
        *([f"**Not complete.** Not in this report: {', '.join(comparison.missing)}."] if comparison.missing else []),
        "## Trainings",
        markdown([_training(group) for group in comparison.groups]),
        *_curves(comparison, folder),
        "## Evaluations",
        "\n".join(f"- **{name}**: {EVALUATIONS[name].what}." for name in comparison.kinds),
        *(_gaps(comparison, folder) if "gap" in comparison.kinds else []),
        "## Results",
        _HOW_TO_READ,
        _by_figure(
            comparison,
            {group.label: [group.interval(one.name) for one in comparison.figures] for group in comparison.groups},
        ),
        "![Groups side by side](groups.png)",
        "## Differences",
        *_differences(comparison),
        "## Every seed",
        _seeds(comparison),
        *(_gaits(comparison, folder) if "gait" in comparison.kinds else []),
        *(_parameters(comparison, folder) if "sensitivity" in comparison.kinds else []),
        "## Files",
        "\n".join(f"- [{file.name}]({file.name}): {CONTENTS.get(file.stem, 'all but the episodes')}" for file in files),
    ]
    atomic_write(folder / "README.md", "\n\n".join(text) + "\n")
    return folder / "README.md"


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
    for name, groups in comparison.sets() if comparison.bars else [("", comparison.groups)]:
        file = f"learning_curves_{name}.png" if name else "learning_curves.png"
        learning_curves({group.label: [seed.curve for seed in group.seeds] for group in groups}, folder / file)
        lines.append(f"![Learning curves]({file})")
    return lines


def _by_figure(comparison: Comparison, columns: Mapping[str, Sequence[Interval]], sign: bool = False) -> str:
    """Return a table with a row for each figure and a column for each group or pair; `sign` marks what is not zero."""

    def cell(interval: Interval, digits: int) -> str:
        text = interval.text(digits, sign)
        return f"**{text}**" if sign and not interval.covers_zero else text

    return markdown(
        [
            {"figure": figure.heading} | {name: cell(values[i], figure.digits) for name, values in columns.items()}
            for i, figure in enumerate(comparison.figures)
        ]
    )


def _differences(comparison: Comparison) -> list[str]:
    pairs = {f"{other.label}, against {base.label}": (base, other) for base, other in comparison.present_pairs()}
    if not pairs:
        return ["There are no two groups to compare."]
    changes = {name: [difference(*pair, figure.name) for figure in comparison.figures] for name, pair in pairs.items()}
    return [_by_figure(comparison, changes, sign=True)]


def _seeds(comparison: Comparison) -> str:
    return markdown(
        [
            {"group": group.label, "seed": seed.seed}
            | {figure.heading: decimal(seed.figures[figure.name], figure.digits) for figure in comparison.figures}
            for group in comparison.groups
            for seed in group.seeds
        ]
    )


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


def _gaps(comparison: Comparison, folder: Path) -> list[str]:
    """Draw the gaps of each set of groups; return the section."""
    best, parts = comparison.best(), ["## Reality gap", _GAP_TERMS]
    for name, groups in comparison.sets():
        file = f"gap_{name}.png"
        chosen = [group for group in best.groups if group.name in {one.name for one in groups}]
        gap_figure([group.gap for group in chosen], folder / file)
        parts += [f"### {name}", f"![Return at home and away]({file})", *_finding(comparison, name)]
        parts.append(markdown([row for group in chosen for row in _gap_rows(group)]))
    parts += ["### All policies", markdown([row for group in comparison.groups for row in _gap_rows(group)])]
    changes = []
    for which, part in ((f"best {comparison.top}", best), ("all", comparison)):
        for base, other in part.present_pairs():
            over_runs, crossed, away = gap_difference(base.gap, other.gap)
            changes.append(
                {
                    "group": other.label,
                    "against": base.label,
                    "policies": which,
                    "gap (m)": over_runs.text(sign=True),
                    "gap, interval (m)": crossed.text(sign=True),
                    "return away, interval (m)": away.text(sign=True),
                    "paper": comparison.finding((base.name, other.name)),
                }
            )
    return [*parts, *(["### Differences of gaps", markdown(changes)] if changes else [])]


def _finding(comparison: Comparison, name: str) -> list[str]:
    """Return the paper's finding on a set of groups, those without policies included."""
    text = comparison.finding(comparison.bars.get(name, [group.name for group in comparison.groups]))
    return [f"In the paper: {text}"] if text else []


def _gap_rows(group: GroupResult) -> list[dict[str, str]]:
    gap, rows = group.gap, []
    for number, (world, row) in enumerate(zip(gap.worlds, gap.text_rows(), strict=True)):
        runs = gap.in_world(world)
        start = {"group": row.pop("policy"), "seeds": ", ".join(str(seed.seed) for seed in group.seeds)}
        if number:
            row["gap (m)"] = gap.gap_over_runs(world).text()
        more = {
            "gap, interval (m)": gap.interval(world).text() if number else "",
            "distance (m)": MeanEstimate.from_values(runs.distance).text(),
            "least distance (m)": decimal(runs.distance.min()),
            f"over {FAR:g} m": f"{(runs.distance > FAR).sum()} of {len(runs)}",
        }
        rows.append(start | row | more)
    return rows
