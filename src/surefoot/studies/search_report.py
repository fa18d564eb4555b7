"""Report of a search: README.md, tables and figures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from surefoot.evaluate.runs import summarize_runs
from surefoot.evaluate.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.runs import footfall_diagram
from surefoot.report.figures.style import BLUE, GREEN, ORANGE, QUIET, heading, new_figure, place_labels
from surefoot.studies.evaluations import load_gait_trace
from surefoot.studies.trials import Retest, SearchResult, TrialResult, best
from surefoot.tables import markdown, write_csv

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLORS = {"complete": BLUE, "pruned": ORANGE}
_LISTED = 10
"""Best trials in the report; the table has all."""
_TERMS = (
    "Return: mean over the episodes of the deterministic policy's evaluation at the end of a trial, with the task's "
    "own weight of energy. A pruned trial has the return of its last evaluation. Importance: how well a field "
    "separates the best trials from the others (PED-ANOVA), over complete trials only."
)
_BIAS = (
    "The best of many noisy returns is too high: its noise was selected too. Claimed: the return that the search "
    f"saw. Fresh: the same policy in episodes that the search has not seen. Brackets: {CONFIDENCE:.0%} confidence, "
    "over episodes for one policy, over policies for their mean. Bullet: with the robot as its data sheet describes it."
)


def write_report(result: SearchResult, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    write_csv(folder / "trials.csv", [trial.row() for trial in result.trials])
    write_csv(folder / "best.csv", pd.concat([_retest_table(retest) for retest in result.retests]))
    write_csv(folder / "top.csv", _top_rows(result))
    search_figure(result, folder / "search.png")
    parameter_figure(result, folder / "parameters.png")
    states = [trial.state for trial in result.trials]
    counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
    hours = sum(trial.seconds for trial in result.trials) / 3600
    text = [
        f"# Search: {result.name}",
        f"```sh\n{command}\n```",
        f"{len(result.trials)} trials ({counts}) of {result.steps:,} control steps, {result.episodes} episodes an "
        f"evaluation, seed {result.seed}; {hours:.2f} hours of training in all. {_TERMS}",
        "![Returns of all trials](search.png)",
        "## Best trials",
        markdown([_best_row(trial) for trial in best([one for one in result.trials if one.complete])[:_LISTED]]),
        "## Selection bias of the best",
        _BIAS,
        markdown([_retest_row(retest) for retest in result.retests]),
        f"Claimed less fresh, mean of these {len(result.retests)}: {result.selection_bias.text(3, sign=True)} m.",
        "## What matters",
        _importance(result),
        "![Return against each field](parameters.png)",
        "## Gaits that emerged",
        "Names of the gaits of all policies, pruned ones included: the most frequent name in 5 episodes at home.",
        *_census(result, folder),
        "## Files",
        "- [trials.csv](trials.csv): a row a trial\n- [best.csv](best.csv): a row a fresh episode of the best\n"
        "- [top.csv](top.csv): a row each of the best, claimed and fresh, and one over all of them",
    ]
    atomic_write(folder / "README.md", "\n\n".join(text) + "\n")
    return folder / "README.md"


def _number(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _best_row(trial: TrialResult) -> dict[str, str]:
    params = {name.removeprefix("task.").removeprefix("ppo."): _number(value) for name, value in trial.params.items()}
    gait = trial.gait["pattern"] if trial.gait else "-"
    return {"trial": str(trial.number), "return (m)": decimal(trial.value), "gait": gait, **params}


def _retest_row(retest: Retest) -> dict[str, str]:
    home, bullet = (retest.in_world(number) for number in (0, 1))

    def mean(runs: pd.DataFrame, name: str) -> str:
        return MeanEstimate.from_values(runs[name]).text() if len(runs) else "not installed"

    def falls(runs: pd.DataFrame) -> str:
        return f"{(~runs.balanced).sum()} of {len(runs)}" if len(runs) else "-"

    return {
        "trial": str(retest.trial.number),
        "claimed (m)": decimal(retest.trial.value),
        "fresh (m)": retest.fresh.text(),
        "claimed less fresh (m)": retest.selection_bias.text(3, sign=True),
        "speed (m/s)": mean(home, "speed"),
        "power (W)": mean(home, "power"),
        "falls": falls(home),
        "return in Bullet (m)": mean(bullet, "return"),
        "speed in Bullet (m/s)": mean(bullet, "speed"),
        "falls in Bullet": falls(bullet),
    }


def _retest_table(retest: Retest) -> pd.DataFrame:
    table = retest.runs.copy()
    table.insert(0, "trial", retest.trial.number)
    return table


def _top_rows(result: SearchResult) -> list[dict[str, object]]:
    """Return a row for each of the best trials, and one over all of them, whose intervals are over policies."""
    retests = result.retests
    rows: list[dict[str, object]] = [
        {"rank": str(rank), "trial": one.trial.number, "claimed": one.trial.value}
        | _fresh(one.fresh, one.selection_bias, [one])
        for rank, one in enumerate(retests, start=1)
    ]
    claimed = float(np.mean([one.trial.value for one in retests]))
    fresh = _fresh(t_interval([one.fresh.mean for one in retests]), result.selection_bias, retests)
    return [*rows, {"rank": "all", "trial": None, "claimed": claimed, **fresh}]


def _fresh(fresh: Interval, bias: Interval, retests: Sequence[Retest]) -> dict[str, object]:
    """Return cells on fresh episodes: the columns of a table of worlds, each with its world's name before it."""
    cells: dict[str, object] = {**fresh.columns("fresh"), **bias.columns("selection_bias")}
    for world, runs in pd.concat([one.runs for one in retests]).groupby("world", sort=False):
        cells |= {f"{world}_{name}": value for name, value in summarize_runs(runs).items() if name != "world"}
    return cells


def _importance(result: SearchResult) -> str:
    if not result.importance:
        return "There are too few complete trials."
    return markdown([{"field": f"`{name}`", "importance": decimal(value)} for name, value in result.importance.items()])


def _census(result: SearchResult, folder: Path) -> list[str]:
    """Draw the footfalls of each gait, of its trial of the highest return; return the section."""
    # A trial that was under way at the last report may have another gait now.
    for old in folder.glob("gait_*.png"):
        old.unlink()
    rows, figures = [], []
    for name, trials in result.census().items():
        first = trials[0]
        assert first.policy is not None
        assert first.gait is not None
        file = f"gait_{name}.png"
        footfall_diagram(load_gait_trace(first.policy), folder / file)
        patterns = [trial.gait["reason"] or trial.gait["pattern"] for trial in trials if trial.gait]
        rows.append(
            {
                "gait": name,
                "trials": str(len(trials)),
                "complete": str(sum(trial.complete for trial in trials)),
                "patterns": ", ".join(f"{patterns.count(one)} {one}" for one in dict.fromkeys(patterns)),
                "highest return (m)": decimal(first.value),
                "of trial": str(first.number),
                "stride (s)": decimal(math.nan if first.gait["stride"] is None else first.gait["stride"]),
                "duty factor": decimal(math.nan if first.gait["duty"] is None else first.gait["duty"]),
            }
        )
        figures.append(f"Trial {first.number}:\n\n![Footfalls: {name}]({file})")
    return [markdown(rows), *figures] if rows else ["There is no policy yet."]


def search_figure(result: SearchResult, path: Path) -> Path:
    """Draw returns of trials in order, their evaluations in training, and the distribution of returns."""
    scale, unit = (1e6, "million ") if result.steps >= 2e5 else (1.0, "")
    with new_figure(path, (11.0, 3.8), columns=3) as (figure, (order, curves, spread)):
        for state, color in _COLORS.items():
            trials = [trial for trial in result.trials if trial.state == state]
            values = [trial.value for trial in trials]
            order.plot([trial.number for trial in trials], values, "o", color=color, markersize=4.0, label=state)
            for trial in trials:
                steps, returns = np.array(trial.curve).T
                curves.plot(steps / scale, returns, color=color, alpha=0.5, linewidth=0.8)
        complete = [trial.value if trial.complete else -math.inf for trial in result.trials]
        so_far = pd.Series(np.maximum.accumulate(complete), [trial.number for trial in result.trials])
        so_far = so_far[np.isfinite(so_far)]
        order.step(so_far.index, so_far, where="post", color=GREEN, linewidth=1.2, label="best so far")
        order.set_title("Return at the end (m)")
        order.set_xlabel("trial")
        order.locator_params(axis="x", integer=True)
        curves.set_title("Return in training (m)")
        curves.set_xlabel(f"{unit}control steps")
        spread.hist(
            [[t.value for t in result.trials if t.state == state and math.isfinite(t.value)] for state in _COLORS],
            bins=20,
            stacked=True,
            color=list(_COLORS.values()),
            label=list(_COLORS),
        )
        spread.set_title("Trials by return (m)")
        spread.set_xlabel("return (m)")
        figure.legend(*order.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        heading(figure, f"Search: {result.name}, {len(result.trials)} trials")
    return path


def parameter_figure(result: SearchResult, path: Path) -> Path:
    """Draw the return of every trial that has a policy against each field, the most important first."""
    trials = [trial for trial in result.trials if trial.policy is not None]
    names = list(dict.fromkeys([*result.importance, *trials[0].params]))
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    with new_figure(path, (2.9 * columns, 1.0 + 2.3 * rows), rows=rows, columns=columns) as (figure, axes):
        for ax, name in zip(axes, names, strict=False):
            _against(ax, trials, name)
            importance = f" ({result.importance[name]:.2f})" if name in result.importance else ""
            ax.set_title(name.removeprefix("task.").removeprefix("ppo.") + importance, fontsize=8.0)
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        handles = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2)
        heading(figure, "Return (m) against each field; in brackets: its importance")
    return path


def _against(ax: Axes, trials: list[TrialResult], name: str) -> None:
    """Draw returns against a field: on an axis of names where values are not numbers."""
    values = [trial.params[name] for trial in trials]
    if any(isinstance(value, str) for value in values):
        labels = sorted({str(value) for value in values}, key=lambda text: (len(text), text))
        places = np.array([labels.index(str(value)) for value in values], np.float64)
        place_labels(ax, labels)
        ax.set_xlim(-0.5, len(labels) - 0.5)
    else:
        places = np.array(values, np.float64)
        if places.min() > 0 and places.max() > 8 * places.min():
            ax.set_xscale("log")
            ax.xaxis.set_minor_formatter("")
    returns = np.array([trial.value for trial in trials])
    for state, color in _COLORS.items():
        chosen = np.array([trial.state == state for trial in trials])
        ax.plot(places[chosen], returns[chosen], "o", color=color, markersize=3.5, alpha=0.7, label=state)
    ax.tick_params(colors=QUIET, labelsize=7.0)
