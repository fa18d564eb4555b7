"""The report of a study as Markdown: tables and sentences that say what the numbers say, and nothing else."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from surefoot.evaluate.comparison import Comparison, GroupResult, difference
from surefoot.evaluate.kinds import KINDS, Figure
from surefoot.evaluate.statistics import CONFIDENCE, Interval, decimal, plain, t_interval
from surefoot.files import whole_file
from surefoot.report.gap_report import GAP_FILES, draw_gaps, gap_text
from surefoot.report.markdown import table
from surefoot.report.study_figures import (
    group_figure,
    learning_curves,
    parameter_figure,
    parameter_rows,
    parameters_figure,
)

_BARS = ("nominal_speed", "table1_falls", "sensitivity_mean", "sensitivity_std", "gap", "gap_balanced")
_MANY = 5
"""With more groups than this they stand below each other in tables, not side by side."""


def write_report(comparison: Comparison, folder: Path, command: str) -> Path:
    """Draw all figures and write README.md into a folder; returns its path.

    Args:
        comparison: the groups.
        folder: where tables and figures are.
        command: what makes the report.
    """
    curves = _curves(comparison, folder)
    bars = tuple(name for name in _BARS if name in {figure.name for figure in comparison.figures})
    group_figure(comparison, folder / "groups.png", bars)
    figures = [("groups.png", "Groups side by side")]
    if "gap" in comparison.kinds:
        draw_gaps(comparison, folder)
    rows: tuple[str, ...] = ()
    if "sensitivity" in comparison.kinds:
        rows = parameter_rows(comparison)
        parameters_figure(comparison, folder / "parameters.png")
        figures.append(("parameters.png", "Return against each parameter"))
        for row in rows:
            parameter_figure(comparison, row, folder / "parameters" / f"{row}.png")
    text = report_text(comparison, command, figures, rows, curves)
    with whole_file(folder / "README.md") as file:
        file.write(text.encode())
    return folder / "README.md"


def report_text(
    comparison: Comparison,
    command: str,
    figures: Sequence[tuple[str, str]] = (),
    rows: Sequence[str] = (),
    curves: Sequence[tuple[str, str]] = (),
) -> str:
    """The report's text.

    Args:
        comparison: the groups.
        command: what makes the report.
        figures: files and titles of figures, in order.
        rows: parameters that have a figure of their own.
        curves: files and titles of learning curves.
    """
    parts = [
        f"# Study: {comparison.name}",
        "This report is written by a program from the results beside it; no number is copied by hand.",
        f"```sh\n{command}\n```",
        "Run again, the command goes on where it stopped and leaves alone what is finished.",
        *_missing(comparison),
        "## What was done",
        _trainings(comparison),
        "Every policy is the one that did best in the evaluations during its training. It is then evaluated in:",
        "\n".join(f"- **{kind}**: {KINDS[kind].what}." for kind in comparison.kinds),
        *(gap_text(comparison) if "gap" in comparison.kinds else []),
        "## Results",
        _how_to_read(),
        *_results(comparison),
        *[f"![{title}]({file})" for file, title in figures[:1]],
        "## Differences",
        *_differences(comparison),
        "## Training",
        *[f"![{title}]({file})" for file, title in curves],
        "Returns during training are those of the training's own task (with noise on the actions, and with pushes and "
        "drawn parameters where a group has them), so they tell how a group goes on, not which group is better.",
        "\n".join(_late_gain(group) for group in comparison.groups),
        "## Every seed",
        _seeds(comparison),
    ]
    if rows:
        parts += [
            "## One parameter at a time",
            *[f"![{title}]({file})" for file, title in figures[1:]],
            "With falls, one figure each: " + ", ".join(f"[{r.replace('_', ' ')}](parameters/{r}.png)" for r in rows),
        ]
    parts += ["## Files", _files(comparison)]
    return "\n\n".join(parts) + "\n"


def _curves(comparison: Comparison, folder: Path) -> list[tuple[str, str]]:
    """Draw the learning curves, a figure for each set of groups; returns files and titles."""
    if not comparison.bars:
        learning_curves(comparison, folder / "learning_curves.png")
        return [("learning_curves.png", "Learning curves")]
    drawn = []
    for name, groups in comparison.sets():
        file = f"learning_curves_{name}.png"
        learning_curves(replace(comparison, groups=groups), folder / file)
        drawn.append((file, f"Learning curves: {name}"))
    return drawn


def _missing(comparison: Comparison) -> list[str]:
    if not comparison.missing:
        return []
    return [f"**Not complete.** Runs of the study that are not in this report: {', '.join(comparison.missing)}."]


def _trainings(comparison: Comparison) -> str:
    lines = []
    for group in comparison.groups:
        steps = [seed.steps for seed in group.seeds]
        minutes = [f"{seed.seconds / 60:.1f}" for seed in group.seeds]
        count = f"{steps[0]:,}" if len(set(steps)) == 1 else f"{min(steps):,} to {max(steps):,}"
        seeds = ", ".join(str(seed.seed) for seed in group.seeds)
        best = ["?" if seed.best is None else f"{seed.best / 1e6:.2f}" for seed in group.seeds]
        lines.append([group.label, f"`{group.name}`", seeds, count, ", ".join(best), ", ".join(minutes)])
    whole = sum(seed.seconds for group in comparison.groups for seed in group.seeds)
    total = sum(seed.steps for group in comparison.groups for seed in group.seeds)
    runs = table(
        ["group", "name", "seeds", "control steps, each", "best after, millions", "training, min, each"], lines
    )
    return (
        f"{runs}\n\nTogether {total:,} control steps and {whole / 3600:.2f} hours of training, "
        "one thread each. A training's time is its own, while others may have run beside it."
    )


def _how_to_read() -> str:
    return (
        f"Numbers are means over seeds with intervals of {CONFIDENCE:.0%} confidence in brackets: Student's t over "
        "seeds for a group, Welch's for a difference. What varies between seeds is what the intervals are about; "
        "episodes within one seed are averaged first. Each interval stands for itself; none is widened for the number "
        "of comparisons. Intervals of shares may reach beyond 0 and 100 %, which Student's t does not know about. "
        "Without brackets, there are too few seeds for an interval."
    )


def _results(comparison: Comparison) -> list[str]:
    groups, figures = comparison.groups, comparison.figures
    cells = [[plain(group.interval(figure.name), figure.digits) for group in groups] for figure in figures]
    titles = [f"{figure.title} ({figure.unit})" for figure in figures]
    if len(groups) > _MANY:
        parts = [[group.label, str(len(group.seeds)), *(row[i] for row in cells)] for i, group in enumerate(groups)]
        return [table(["group", "seeds", *titles], parts)]
    lines = [["seeds", *(str(len(group.seeds)) for group in groups)]]
    lines += [[title, *row] for title, row in zip(titles, cells, strict=True)]
    return [table(["", *(group.label for group in groups)], lines)]


def _differences(comparison: Comparison) -> list[str]:
    pairs, figures = comparison.present_pairs(), comparison.figures
    if not pairs:
        return ["There are no two groups to compare."]
    changes = [[difference(base, other, figure.name) for figure in figures] for base, other in pairs]
    if len(comparison.groups) > _MANY:
        header = ["group", "against", *(f"{figure.title} ({figure.unit})" for figure in figures)]
        lines = [
            [other.label, base.label, *(_cell(figure, one) for figure, one in zip(figures, row, strict=True))]
            for (base, other), row in zip(pairs, changes, strict=True)
        ]
        return ["Differences whose interval does not include zero are bold.", table(header, lines)]
    return [
        f"**{other.label}**, against **{base.label}**:\n\n"
        + "\n".join(_sentence(figure, one) for figure, one in zip(figures, row, strict=True))
        for (base, other), row in zip(pairs, changes, strict=True)
    ]


def _cell(figure: Figure, change: Interval) -> str:
    text = plain(change, figure.digits, sign=True)
    return text if change.covers_zero else f"**{text}**"


def _sentence(figure: Figure, change: Interval) -> str:
    text = f"- {figure.title}: {plain(change, figure.digits, sign=True)} {figure.unit}"
    if not change.known:
        return f"{text}; too few seeds for an interval."
    if change.low == change.high == 0:
        return f"{text}; all seeds of both groups agree."
    return f"{text}; the interval {'includes' if change.covers_zero else 'does not include'} zero."


def _late_gain(group: GroupResult) -> str:
    gains = np.array([seed.curve.late_gain for seed in group.seeds])
    gains = gains[np.isfinite(gains)]
    if not len(gains):
        return f"- {group.label}: too few episodes ended to tell how the return goes on."
    change = t_interval(gains)
    end = ""
    if change.known:
        end = f"; the interval {'includes' if change.covers_zero else 'does not include'} zero"
    return (
        f"- {group.label}: from the fourth to the last fifth of the training the return changes by "
        f"{plain(change, 3, sign=True)} m{end}."
    )


def _seeds(comparison: Comparison) -> str:
    figures = comparison.figures
    header = ["group", "seed", *(f"{figure.title} ({figure.unit})" for figure in figures)]
    lines = [
        [group.label, str(seed.seed), *(decimal(seed.figures[f.name], f.digits) for f in figures)]
        for group in comparison.groups
        for seed in group.seeds
    ]
    return table(header, lines)


def _files(comparison: Comparison) -> str:
    files = {
        "runs.csv": "one line a trained policy",
        "groups.csv": "one line a group and figure, with its interval",
        "differences.csv": "one line a pair of groups and figure, with its interval",
        "episodes.csv": "one line an episode of the evaluations without test worlds",
        "summary.json": "all of it, for programs",
    }
    if "sensitivity" in comparison.kinds:
        files["sensitivity.csv"] = "one line a policy and test world"
        files["sensitivity_episodes.csv"] = "one line an episode in test worlds"
    if "gap" in comparison.kinds:
        files |= GAP_FILES
    return "\n".join(f"- [{name}]({name}): {what}" for name, what in files.items())
