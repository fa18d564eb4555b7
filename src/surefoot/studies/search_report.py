"""Report of a search: README.md, tables and figures."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from surefoot.evaluation.runs import summarize_runs
from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.runs import footfall_diagram
from surefoot.report.figures.style import BLUE, GREEN, ORANGE, QUIET, heading, new_figure, place_labels
from surefoot.studies.evaluations import load_gait_trace
from surefoot.studies.search import SearchConfig
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


_OBJECTS = ["curve", "policy", "result"]
"""Columns of trials that are not written to tables."""


@dataclass(frozen=True)
class SearchResult:
    """A search, as its report shows it."""

    config: SearchConfig
    trials: pd.DataFrame
    """A trial a row: trial, state (complete, pruned, fail or running), return of the last evaluation [m] (NaN without),
    control steps, seconds, gait, pattern, seed, proposed settings by dotted name, why it failed. Besides, `curve`:
    control steps and return of each evaluation (E, 2); `policy` and `result`: policy file and its evaluation `gait`."""
    fresh: pd.DataFrame
    """An episode a row that the search has not seen: one of the best trials, then the columns of `measure_runs`. The
    best trial comes first; each has runs in the simulator of its training, and in Bullet if that is installed."""
    importance: dict[str, float] = field(default_factory=dict)
    """Importance of each field, all together 1; empty where too few trials are complete."""

    def claimed(self, trial: int) -> float:
        """Return the return of a trial that the search saw [m]."""
        return float(self.trials.set_index("trial")["return"][trial])

    def selection_bias(self) -> dict[int, tuple[Interval, Interval]]:
        """Return, by trial, mean return of fresh episodes at home, and the claimed return less that [m]."""
        biases = {}
        for number, runs in self.fresh.groupby("trial", sort=False):
            fresh, claimed = t_interval(runs[runs.world == runs.world.iloc[0]]["return"]), self.claimed(number)
            biases[number] = fresh, Interval(claimed - fresh.mean, claimed - fresh.high, claimed - fresh.low)
        return biases


def sort_trials(trials: pd.DataFrame) -> pd.DataFrame:
    """Return trials by their return, the highest first; those without a return last."""
    return trials.sort_values("return", ascending=False, kind="stable")


def write_report(result: SearchResult, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    trials, train, biases = result.trials, result.config.train, result.selection_bias()
    write_csv(folder / "trials.csv", trials.drop(columns=_OBJECTS))
    write_csv(folder / "best.csv", result.fresh)
    write_csv(folder / "top.csv", _top_rows(result))
    search_figure(result, folder / "search.png")
    parameter_figure(result, folder / "parameters.png")
    counts = ", ".join(f"{number} {state}" for state, number in trials.groupby("state", sort=False).size().items())
    bias = t_interval([bias.mean for _, bias in biases.values()])
    importance = [{"field": f"`{name}`", "importance": decimal(value)} for name, value in result.importance.items()]
    text = [
        f"# Search: {train.task.name}",
        f"```sh\n{command}\n```",
        f"{len(trials)} trials ({counts}) of {train.steps:,} control steps, {train.evaluation_episodes} episodes an "
        f"evaluation, seed {result.config.seed}; {trials.seconds.sum() / 3600:.2f} hours of training in all. {_TERMS}",
        "![Returns of all trials](search.png)",
        "## Best trials",
        markdown(_best_rows(result)),
        "## Selection bias of the best",
        _BIAS,
        markdown([_retest_row(result, number, *values) for number, values in biases.items()]),
        f"Claimed less fresh, mean of these {len(biases)}: {bias.text(3, sign=True)} m.",
        "## What matters",
        markdown(importance) if importance else "There are too few complete trials.",
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


def _short(name: str) -> str:
    return name.removeprefix("task.").removeprefix("ppo.")


def _best_rows(result: SearchResult) -> list[dict[str, str]]:
    """Return the rows of the best complete trials with their settings."""
    complete = result.trials[result.trials.state == "complete"]
    return [
        {"trial": str(row["trial"]), "return (m)": decimal(row["return"]), "gait": row["pattern"] or "-"}
        | {_short(name): f"{x:.3g}" if isinstance(x := row[name], float) else str(x) for name in result.config.space}
        for row in sort_trials(complete)[:_LISTED].to_dict("records")
    ]


def _retest_row(result: SearchResult, trial: int, fresh: Interval, bias: Interval) -> dict[str, str]:
    runs = result.fresh[result.fresh.trial == trial]
    home, bullet = (runs[(runs.world == runs.world.iloc[0]) == is_home] for is_home in (True, False))

    def mean(runs: pd.DataFrame, name: str) -> str:
        return MeanEstimate.from_values(runs[name]).text() if len(runs) else "not installed"

    def falls(runs: pd.DataFrame) -> str:
        return f"{(~runs.balanced).sum()} of {len(runs)}" if len(runs) else "-"

    return {
        "trial": str(trial),
        "claimed (m)": decimal(result.claimed(trial)),
        "fresh (m)": fresh.text(),
        "claimed less fresh (m)": bias.text(3, sign=True),
        "speed (m/s)": mean(home, "speed"),
        "power (W)": mean(home, "power"),
        "falls": falls(home),
        "return in Bullet (m)": mean(bullet, "return"),
        "speed in Bullet (m/s)": mean(bullet, "speed"),
        "falls in Bullet": falls(bullet),
    }


def _top_rows(result: SearchResult) -> list[dict[str, object]]:
    """Return a row for each of the best trials, and one over all of them, whose intervals are over policies."""
    biases = result.selection_bias()
    rows: list[dict[str, object]] = []
    for rank, (trial, (fresh, bias)) in enumerate(biases.items(), start=1):
        row = {"rank": str(rank), "trial": trial, "claimed": result.claimed(trial)}
        rows.append(row | _cells(fresh, bias, result.fresh[result.fresh.trial == trial]))
    fresh, bias = (t_interval([values[k].mean for values in biases.values()]) for k in (0, 1))
    claimed = float(np.mean([result.claimed(trial) for trial in biases]))
    return [*rows, {"rank": "all", "trial": None, "claimed": claimed, **_cells(fresh, bias, result.fresh)}]


def _cells(fresh: Interval, bias: Interval, runs: pd.DataFrame) -> dict[str, object]:
    """Return cells on fresh episodes: the columns of a table of worlds, each with its world's name before it."""
    cells: dict[str, object] = {**fresh.columns("fresh"), **bias.columns("selection_bias")}
    for world, part in runs.groupby("world", sort=False):
        cells |= {f"{world}_{name}": value for name, value in summarize_runs(part).items() if name != "world"}
    return cells


def _census(result: SearchResult, folder: Path) -> list[str]:
    """Draw the footfalls of each gait, of its trial of the highest return; return the section."""
    # A trial that was under way at the last report may have another gait now.
    for old in folder.glob("gait_*.png"):
        old.unlink()
    gaits = dict(list(sort_trials(result.trials).groupby("gait")))
    rows, figures = [], []
    for gait, trials in sorted(gaits.items(), key=lambda item: -len(item[1])):
        first, file = trials.iloc[0], f"gait_{gait}.png"
        footfall_diagram(load_gait_trace(first.policy), folder / file)
        patterns = [one["reason"] or one["pattern"] for one in trials.result]
        stride, duty = (math.nan if first.result[name] is None else first.result[name] for name in ("stride", "duty"))
        rows.append(
            {
                "gait": gait,
                "trials": str(len(trials)),
                "complete": str((trials.state == "complete").sum()),
                "patterns": ", ".join(f"{patterns.count(one)} {one}" for one in dict.fromkeys(patterns)),
                "highest return (m)": decimal(first["return"]),
                "of trial": str(first.trial),
                "stride (s)": decimal(stride),
                "duty factor": decimal(duty),
            }
        )
        figures.append(f"Trial {first.trial}:\n\n![Footfalls: {gait}]({file})")
    return [markdown(rows), *figures] if rows else ["There is no policy yet."]


def search_figure(result: SearchResult, path: Path) -> None:
    """Draw returns of trials in order, their evaluations in training, and the distribution of returns."""
    trials, steps = result.trials, result.config.train.steps
    scale, unit = (1e6, "million ") if steps >= 2e5 else (1.0, "")
    with new_figure(path, (11.0, 3.8), columns=3) as (figure, (order, curves, spread)):
        parts = [trials[trials.state == state] for state in _COLORS]
        for part, (state, color) in zip(parts, _COLORS.items(), strict=True):
            order.plot(part.trial, part["return"], "o", color=color, markersize=4.0, label=state)
            for curve in part.curve:
                curves.plot(*(np.array(curve) / [scale, 1.0]).T, color=color, alpha=0.5, linewidth=0.8)
        so_far = trials["return"].where(trials.state == "complete").cummax().ffill()
        order.step(trials.trial, so_far, where="post", color=GREEN, linewidth=1.2, label="best so far")
        order.set_title("Return at the end (m)")
        order.set_xlabel("trial")
        order.locator_params(axis="x", integer=True)
        curves.set_title("Return in training (m)")
        curves.set_xlabel(f"{unit}control steps")
        returns, colors = [part["return"].dropna() for part in parts], list(_COLORS.values())
        spread.hist(returns, bins=20, stacked=True, color=colors, label=list(_COLORS))
        spread.set_title("Trials by return (m)")
        spread.set_xlabel("return (m)")
        figure.legend(*order.get_legend_handles_labels(), loc="outside lower center", ncols=3)
        heading(figure, f"Search: {result.config.train.task.name}, {len(trials)} trials")


def parameter_figure(result: SearchResult, path: Path) -> None:
    """Draw the return of every trial that has a policy against each field, the most important first."""
    trials = result.trials[result.trials.policy.notna()]
    names = list(dict.fromkeys([*result.importance, *result.config.space]))
    columns = min(4, len(names))
    rows = -(-len(names) // columns)
    with new_figure(path, (2.9 * columns, 1.0 + 2.3 * rows), rows=rows, columns=columns) as (figure, axes):
        for ax, name in zip(axes, names, strict=False):
            _against(ax, trials, name)
            importance = f" ({result.importance[name]:.2f})" if name in result.importance else ""
            ax.set_title(_short(name) + importance, fontsize=8.0)
        for ax in axes[len(names) :]:
            ax.set_axis_off()
        handles = {label: line for ax in axes for line, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(handles.values(), handles.keys(), loc="outside lower center", ncols=2)
        heading(figure, "Return (m) against each field; in brackets: its importance")


def _against(ax: Axes, trials: pd.DataFrame, name: str) -> None:
    """Draw returns against a field: on an axis of names where values are not numbers."""
    values = list(trials[name])
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
    for state, color in _COLORS.items():
        of_state = (trials.state == state).to_numpy()
        returns = trials["return"][of_state]
        ax.plot(places[of_state], returns, "o", color=color, markersize=3.5, alpha=0.7, label=state)
    ax.tick_params(colors=QUIET, labelsize=7.0)
