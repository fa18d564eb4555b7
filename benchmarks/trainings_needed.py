"""Power analysis of the studies: number of trainings per group at which the measured differences would be significant.

    python benchmarks/trainings_needed.py        # writes results/paper/trainings_needed.csv and census.csv; seconds

A difference of two groups of N trainings is tested with Welch's t test at 0.05, divided by the number of comparisons
that its study declares (Bonferroni, a bound for Holm's correction). N is the minimum for a power of 0.8, with the
standard deviations and the difference of the trainings in results/STUDY/policies.csv. A test's robots stay the same.
"""

from __future__ import annotations

from pathlib import Path

import pandas as pd
from scipy import stats

from surefoot.tables import print_table, write_csv

RESULTS = Path(__file__).parents[1] / "results"
LEVEL, POWER = 0.05, 0.8
DIFFERENCES = {
    "gap-pushes": ("reality-gap", "gap", "improved_pushes", "baseline_pushes"),
    "gap-baseline": ("reality-gap", "gap", "improved_pushes", "baseline"),
    "latencies": ("reality-gap", "gap_away", "improved_pushes", "actuator_only"),
    "gap-randomized-4": ("reality-gap", "gap", "small_randomized", "small_plain"),
    "gap-randomized-12": ("reality-gap", "gap", "large_randomized", "large_plain"),
    "mean-randomized-4": ("robustness", "sensitivity_mean", "small_randomized", "small_plain"),
    "mean-randomized-12": ("robustness", "sensitivity_mean", "large_randomized", "large_plain"),
    "spread-randomized-4": ("robustness", "sensitivity_std", "small_randomized", "small_plain"),
    "spread-randomized-12": ("robustness", "sensitivity_std", "large_randomized", "large_plain"),
    "space-plain": ("robustness", "sensitivity_mean", "large_plain", "small_plain"),
    "space-randomized": ("robustness", "sensitivity_mean", "large_randomized", "small_randomized"),
}
"""Study, metric, group and its reference group, by name."""
MOVED = 1.0
"""Minimum return of a training that learned to move [m]; the task's return is the path in 6 s minus the energy cost."""


def welch_power(difference: float, variances: tuple[float, float], trainings: int, level: float) -> float:
    """Return the power of Welch's two-sided t test with a number of trainings per group."""
    parts = [variance / trainings for variance in variances]
    freedom = sum(parts) ** 2 / sum(part**2 / (trainings - 1) for part in parts)
    limit = stats.t.ppf(1 - level / 2, freedom)
    return float(stats.nct.sf(limit, freedom, abs(difference) / sum(parts) ** 0.5))


def difference_row(name: str) -> dict[str, object]:
    """Return the row of a difference: measured values, and the required number of trainings per group."""
    study, metric, group, against = DIFFERENCES[name]
    policies, table = (pd.read_csv(RESULTS / study / f"{file}.csv") for file in ("policies", "differences"))
    own, other = (policies[policies.group == one][metric] for one in (group, against))
    comparisons = int((table.figure == metric).sum())
    difference, variances = float(own.mean() - other.mean()), (float(own.var()), float(other.var()))
    needed = next(n for n in range(2, 10_000) if welch_power(difference, variances, n, LEVEL / comparisons) >= POWER)
    return {
        **{"name": name, "study": study, "metric": metric, "group": group, "against": against},
        **{"difference": difference, "comparisons": comparisons, "trainings": len(own), "needed": needed},
    }


def census_row(name: str, trials: pd.DataFrame) -> dict[str, object]:
    """Return how many trials gallop, with the exact interval, and the number of trials that would show a majority."""
    gallops = int((trials.gait == "gallop").sum())
    low, high = stats.binomtest(gallops, len(trials)).proportion_ci(0.95)
    share = gallops / len(trials)
    row = {"name": name, "trials": len(trials), "gallops": gallops}
    row |= {"share": share, "share_low": low, "share_high": high}
    return row | {"needed": majority(share) if share > 0.5 else None}


def majority(share: float) -> int:
    """Return the number of trials that would show a proportion above one half, with the same power."""
    for trials in range(5, 10_000):
        # The minimum number of gallops whose probability is below the level at a proportion of one half.
        minimum = int(stats.binom.isf(LEVEL / 2, trials, 0.5)) + 1
        if stats.binom.sf(minimum - 1, trials, share) >= POWER:
            return trials
    raise ValueError(f"a proportion of {share:.3f} is too close to one half")


def main() -> None:
    rows = [difference_row(name) for name in DIFFERENCES]
    trials = pd.read_csv(RESULTS / "search" / "trials.csv")
    complete = trials[trials.state == "complete"]
    census = [
        census_row("all", trials),
        census_row("complete", complete),
        census_row("moved", complete[complete["return"] > MOVED]),
    ]
    for file, table in (("trainings_needed", rows), ("census", census)):
        write_csv(RESULTS / "paper" / f"{file}.csv", table)
        print_table([{name: str(value) for name, value in row.items()} for row in table], text_columns=5)


if __name__ == "__main__":
    main()
