"""Report of a search: README.md, tables and figures."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd

from surefoot.evaluation.runs import summarize_runs
from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.studies.report import gait_image, image, search_figure, settings_figure, stride_cells, write_readme
from surefoot.studies.search_result import SearchResult, sort_trials
from surefoot.studies.search_space import short_name
from surefoot.tables import markdown, write_csv

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
_CONTENTS = {
    "trials.csv": "a row a trial",
    "best.csv": "a row a fresh episode of the best",
    "top.csv": "a row each of the best, claimed and fresh, and one over all of them",
}
"""Content of each table."""


def write_report(result: SearchResult, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md, with the command that made them, into a folder; return README's path."""
    trials, train, biases = result.trials, result.config.train, result.selection_bias()
    write_csv(folder / "trials.csv", trials.drop(columns=_OBJECTS))
    write_csv(folder / "best.csv", result.fresh)
    write_csv(folder / "top.csv", _top_rows(result))
    search_figure(result, folder / "search.png")
    settings_figure(result, folder / "parameters.png")
    counts = ", ".join(f"{number} {state}" for state, number in trials.groupby("state", sort=False).size().items())
    bias = t_interval([bias.mean for _, bias in biases.values()])
    importance = [{"field": f"`{name}`", "importance": decimal(value)} for name, value in result.importance.items()]
    parts = [
        f"{len(trials)} trials ({counts}) of {train.steps:,} control steps, {train.evaluation_episodes} episodes an "
        f"evaluation, seed {result.config.seed}; {trials.seconds.sum() / 3600:.2f} hours of training in all. {_TERMS}",
        image("Returns of all trials", "search.png"),
        "## Best trials",
        markdown(_best_rows(result)),
        "## Selection bias of the best",
        _BIAS,
        markdown([_retest_row(result, number, *values) for number, values in biases.items()]),
        f"Claimed less fresh, mean of these {len(biases)}: {bias.text(3, sign=True)} m.",
        "## What matters",
        markdown(importance) if importance else "There are too few complete trials.",
        image("Return against each field", "parameters.png"),
        "## Gaits that emerged",
        "Names of the gaits of all policies, pruned ones included: the most frequent name in 5 episodes at home.",
        *_census(result, folder),
    ]
    return write_readme(folder, f"Search: {train.task.name}", command, parts, _CONTENTS)


def _best_rows(result: SearchResult) -> list[dict[str, str]]:
    """Return the rows of the best complete trials with their settings."""
    complete = result.trials[result.trials.state == "complete"]
    return [
        {"trial": str(row["trial"]), "return (m)": decimal(row["return"]), "gait": row["pattern"] or "-"}
        | {
            short_name(name): f"{x:.3g}" if isinstance(x := row[name], float) else str(x)
            for name in result.config.space
        }
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
        first = trials.iloc[0]
        patterns = [one["reason"] or one["pattern"] for one in trials.result]
        rows.append(
            {
                "gait": gait,
                "trials": str(len(trials)),
                "complete": str((trials.state == "complete").sum()),
                "patterns": ", ".join(f"{patterns.count(one)} {one}" for one in dict.fromkeys(patterns)),
                "highest return (m)": decimal(first["return"]),
                "of trial": str(first.trial),
                **stride_cells(first.result),
            }
        )
        figures += [f"Trial {first.trial}:", gait_image(first.policy, folder, gait, gait)]
    return [markdown(rows), *figures] if rows else ["There is no policy yet."]
