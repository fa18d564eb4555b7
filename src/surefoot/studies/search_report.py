"""Markdown report of a search, with its tables and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from surefoot.configuration import read_yaml
from surefoot.evaluation.runs import summarize_runs
from surefoot.evaluation.statistics import CONFIDENCE, Interval, MeanEstimate, decimal, t_interval
from surefoot.files import atomic_write
from surefoot.report.figures.runs import footfall_diagram
from surefoot.studies.evaluations import load_gait_trace
from surefoot.studies.report import image, readme, search_figure, settings_figure, stride_cells
from surefoot.studies.search import make_config
from surefoot.studies.search_result import SearchResult, sort_trials
from surefoot.studies.search_space import short_name
from surefoot.tables import markdown, with_unit, write_csv

_MAX_LISTED_TRIALS = 10
"""Number of best trials in the report; trials.csv has all."""
_TERMS = (
    "Return: mean over the episodes of the deterministic policy's evaluation at the end of a trial, with the task's "
    "own energy weight. A pruned trial has the return of its last evaluation. Importance: how well a field separates "
    "the best trials from the others (PED-ANOVA), among complete trials."
)
_BIAS = (
    "The best of many noisy returns is biased upwards, because the selection also favours lucky noise. Claimed: the "
    "return that the search measured. Fresh: the return of the same policy in new episodes. Brackets: "
    f"{CONFIDENCE:.0%} confidence interval, over episodes for one policy, over policies for their mean. Bullet: with "
    "the robot as its data sheet describes it."
)


_OBJECT_COLUMNS = ["curve", "policy", "result"]
"""Columns of trials that are not written to trials.csv."""
_CONTENTS = {
    "trials.csv": "one row per trial",
    "best.csv": "one row per fresh episode of the best trials",
    "top.csv": "one row per best trial, with claimed and fresh return, and one over all of them",
    "census.csv": "one row per gait: trials, patterns and the trial with the highest return",
    "importance.csv": "one row per field",
}
"""Description of each table."""
_MAX_PATTERN_LENGTH = 200
"""Maximum number of characters of a gait's patterns in the report; longer ones are only in census.csv."""


def write_report(result: SearchResult, folder: Path, command: str) -> Path:
    """Write tables, figures and README.md into a folder; return the path of README.md.

    The report names `command`, the command line.
    """
    trials = result.trials
    write_csv(folder / "trials.csv", trials.drop(columns=_OBJECT_COLUMNS))
    write_csv(folder / "best.csv", result.fresh)
    write_csv(folder / "top.csv", _top_rows(result))
    census = _census(result)
    importance = [{"field": name, "importance": value} for name, value in result.importance.items()]
    for name, rows, columns in (
        ("census", census, ("gait", "trials", "complete", "patterns", "highest_return", "of_trial", "stride", "duty")),
        ("importance", importance, ("field", "importance")),
    ):
        write_csv(folder / f"{name}.csv", pd.DataFrame(rows, columns=list(columns)))
    search_figure(result, folder / "search.png")
    settings_figure(result, folder / "parameters.png")
    # A trial that was incomplete at the last report may have another gait now.
    for old in folder.glob("gait_*.png"):
        old.unlink()
    for row in census:
        (policy,) = trials[trials.trial == row["of_trial"]].policy
        footfall_diagram(load_gait_trace(policy), folder / f"gait_{row['gait']}.png")
    path = folder / "README.md"
    atomic_write(path, report_text(result, tuple(result.config.space), census, command))
    return path


def report_from_tables(folder: Path, command: str) -> str:
    """Return the README.md of a search from the tables of its report; the trials' folders are not needed."""
    census, importance, fresh, trials = (
        pd.read_csv(folder / f"{name}.csv", keep_default_na=name != "census")
        for name in ("census", "importance", "best", "trials")
    )
    fresh["balanced"] = fresh.balanced.astype(bool)
    # The file may be from an earlier version, whose task this version can't read.
    stored = read_yaml(folder / "search.yaml")
    train = stored["train"]
    config = make_config(train["task"]["name"], None, stored["seed"], train["steps"])
    config = replace(config, train=replace(config.train, evaluation_episodes=train["evaluation_episodes"]))
    result = SearchResult(config, trials, fresh, dict(zip(importance.field, importance.importance, strict=True)))
    return report_text(result, tuple(stored["space"]), census.to_dict("records"), command)


def report_text(result: SearchResult, fields: Sequence[str], census: Sequence[Mapping[str, Any]], command: str) -> str:
    """Return the README.md of a search.

    Args:
        result: the search; only its configuration, importance and columns that are in tables are needed.
        fields: dotted names of the fields that were searched.
        census: one row per gait.
        command: command line, which the report names.
    """
    trials, train, biases = result.trials, result.config.train, result.selection_bias()
    counts = ", ".join(f"{number} {state}" for state, number in trials.groupby("state", sort=False).size().items())
    bias = t_interval([bias.mean for _, bias in biases.values()])
    importance = [{"field": f"`{name}`", "importance": decimal(value)} for name, value in result.importance.items()]
    parts = [
        f"{len(trials)} trials ({counts}) of {train.steps:,} control steps, {train.evaluation_episodes} episodes per "
        f"evaluation, seed {result.config.seed}; {trials.seconds.sum() / 3600:.2f} hours of training. {_TERMS}",
        image("Returns of all trials", "search.png"),
        "## Best trials",
        markdown(_best_rows(result, fields)),
        "## Selection bias of the best",
        _BIAS,
        markdown([_retest_row(result, number, *values) for number, values in biases.items()]),
        f"Claimed minus fresh, mean of these {len(biases)}: {bias.text(3, sign=True)} {result.return_unit}".strip()
        + ".",
        "## Importance of fields",
        markdown(importance) if importance else "There are too few complete trials.",
        image("Return against each field", "parameters.png"),
        "## Gaits that emerged",
        "The gait of each policy, including pruned trials, is the most frequent name in 5 episodes in the training "
        "simulator.",
        *_census_section(census, result.return_unit),
    ]
    return readme(f"Search: {train.task.name}", command, parts, _CONTENTS)


def _best_rows(result: SearchResult, fields: Sequence[str]) -> list[dict[str, str]]:
    """Return the rows of the best complete trials with their settings."""
    complete = result.trials[result.trials.state == "complete"]
    return [
        {
            "trial": str(row["trial"]),
            with_unit("return", result.return_unit): decimal(row["return"]),
            "gait": row["pattern"] or "-",
        }
        | {short_name(name): _setting(row[name]) for name in fields}
        for row in sort_trials(complete)[:_MAX_LISTED_TRIALS].to_dict("records")
    ]


def _setting(value: Any) -> str:
    """Return a setting as text; a column with missing values holds whole numbers as floats."""
    if not isinstance(value, float):
        return str(value)
    return str(int(value)) if value.is_integer() else f"{value:.3g}"


def _retest_row(result: SearchResult, trial: int, fresh: Interval, bias: Interval) -> dict[str, str]:
    runs = result.fresh[result.fresh.trial == trial]
    home, bullet = (runs[(runs.world == runs.world.iloc[0]) == is_home] for is_home in (True, False))

    def mean(runs: pd.DataFrame, name: str) -> str:
        return MeanEstimate.from_values(runs[name]).text() if len(runs) else "not installed"

    def falls(runs: pd.DataFrame) -> str:
        return f"{(~runs.balanced).sum()} of {len(runs)}" if len(runs) else "-"

    unit = result.return_unit
    return {
        "trial": str(trial),
        with_unit("claimed", unit): decimal(result.claimed(trial)),
        with_unit("fresh", unit): fresh.text(),
        with_unit("claimed minus fresh", unit): bias.text(3, sign=True),
        "speed (m/s)": mean(home, "speed"),
        "power (W)": mean(home, "power"),
        "falls": falls(home),
        with_unit("return in Bullet", unit): mean(bullet, "return"),
        "speed in Bullet (m/s)": mean(bullet, "speed"),
        "falls in Bullet": falls(bullet),
    }


def _top_rows(result: SearchResult) -> list[dict[str, object]]:
    """Return one row per best trial, and one over all of them, whose intervals are over policies."""
    biases = result.selection_bias()
    rows: list[dict[str, object]] = []
    for rank, (trial, (fresh, bias)) in enumerate(biases.items(), start=1):
        row = {"rank": str(rank), "trial": trial, "claimed": result.claimed(trial)}
        rows.append(row | _cells(fresh, bias, result.fresh[result.fresh.trial == trial]))
    fresh, bias = (t_interval([values[k].mean for values in biases.values()]) for k in (0, 1))
    claimed = float(np.mean([result.claimed(trial) for trial in biases]))
    return [*rows, {"rank": "all", "trial": None, "claimed": claimed, **_cells(fresh, bias, result.fresh)}]


def _cells(fresh: Interval, bias: Interval, runs: pd.DataFrame) -> dict[str, object]:
    """Return the columns of `top.csv` about fresh episodes; columns of `summarize_runs` have the world as a prefix."""
    cells: dict[str, object] = {**fresh.columns("fresh"), **bias.columns("selection_bias")}
    for world, part in runs.groupby("world", sort=False):
        cells |= {f"{world}_{name}": value for name, value in summarize_runs(part).items() if name != "world"}
    return cells


def _census(result: SearchResult) -> list[dict[str, Any]]:
    """Return one row per gait, the most frequent first."""
    gaits = dict(list(sort_trials(result.trials).groupby("gait")))
    rows = []
    for gait, trials in sorted(gaits.items(), key=lambda item: -len(item[1])):
        first = trials.iloc[0]
        patterns = [one["reason"] or one["pattern"] for one in trials.result]
        rows.append(
            {
                "gait": gait,
                "trials": len(trials),
                "complete": int((trials.state == "complete").sum()),
                "patterns": ", ".join(f"{patterns.count(one)} {one}" for one in dict.fromkeys(patterns)),
                "highest_return": first["return"],
                "of_trial": first.trial,
                **{name: first.result[name] for name in ("stride", "duty")},
            }
        )
    return rows


def _census_section(census: Sequence[Mapping[str, Any]], unit: str) -> list[str]:
    rows, figures = [], []
    for one in census:
        patterns = one["patterns"]
        rows.append(
            {
                **{name: str(one[name]) for name in ("gait", "trials", "complete")},
                "patterns": patterns if len(patterns) < _MAX_PATTERN_LENGTH else "many, see census.csv",
                with_unit("highest return", unit): decimal(one["highest_return"]),
                "of trial": str(one["of_trial"]),
                **stride_cells(one),
            }
        )
        figures += [f"Trial {one['of_trial']}:", image(f"Footfalls: {one['gait']}", f"gait_{one['gait']}.png")]
    return [markdown(rows), *figures] if rows else ["There is no policy yet."]
