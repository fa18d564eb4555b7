"""Trainings per hour in a bare loop, and with Ray on 1 and 2 workers; overhead of Ray in percent.

    bare  a loop in this process: train, export, next
    one   the same trainings through `run_trainings` with 1 worker, including its start (imports, compiled code)
    two   the same with 2 workers

They take turns, so that load changes affect all equally. `warm` leaves out a worker's start: it counts from the end of
the worker's first training. Ray's own start is reported separately.

    python benchmarks/search.py                      # gallops of 100,000 control steps, 4 per turn, 3 turns
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from rounds import measure, ratio_quartiles

from surefoot.learn.run_folder import RunFolder
from surefoot.learn.training_loop import TrainingLoop
from surefoot.studies.training import Training, base_config
from surefoot.studies.workers import ray_cluster, run_trainings
from surefoot.world.sim_world import SimWorld


class Turns:
    """Runs the same trainings in each way, always in new folders."""

    def __init__(self, folder: Path, task: str, steps: int, count: int) -> None:
        config = base_config(task)
        self.config = replace(config, steps=steps, evaluate_every=max(1, steps // 4))
        self.folder, self.count, self.turn = folder, count, 0
        self.warm: list[float] = []
        """Time per training on a warm worker [s], one for each turn with 1 worker."""

    def trainings(self) -> list[Training]:
        self.turn += 1
        place = self.folder / f"turn_{self.turn}"
        return [
            Training(f"{seed}", replace(self.config, seed=seed), place / f"{seed}", trial=True)
            for seed in range(self.count)
        ]

    def bare(self) -> tuple[int, float]:
        start = time.perf_counter()
        for training in self.trainings():
            loop = TrainingLoop.create(training.config, RunFolder.create_at(training.config, training.path), SimWorld)
            loop.run(lambda *_: None)
            loop.export(loop.folder.policy, last=True)
        return self.count, time.perf_counter() - start

    def on_ray(self, workers: int) -> tuple[int, float]:
        ends: list[float] = []

        def change(training: Training, what: str, why: str) -> None:
            if what == "done":
                ends.append(time.perf_counter())

        start = time.perf_counter()
        outcome = run_trainings(self.trainings(), workers, lambda *_: False, change)
        seconds = time.perf_counter() - start
        if len(outcome.done) < self.count:
            raise RuntimeError(f"trainings failed: {outcome.failed}")
        if workers == 1:
            self.warm.append((ends[-1] - ends[0]) / (self.count - 1))
        return self.count, seconds


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--task", default="gallop")
    parser.add_argument("--steps", type=int, default=100_000, help="control steps of a training")
    parser.add_argument("--trainings", type=int, default=4, help="trainings per turn, 2 or more")
    parser.add_argument("--rounds", type=int, default=3, help="turns of each variant")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    options = parser.parse_args()
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="surefoot-search-") as folder, ray_cluster(None, 2):
        began = time.perf_counter() - start
        turns = Turns(Path(folder), options.task, options.steps, options.trainings)
        layers = {"bare": turns.bare, "one": lambda: turns.on_ray(1), "two": lambda: turns.on_ray(2)}
        rates = measure(layers, options.rounds)
    warm = {"warm": [1 / seconds for seconds in turns.warm], "bare": rates["bare"]}
    overheads = {
        "overhead": [100 * (ratio - 1) for ratio in ratio_quartiles(rates, "bare", "one")],
        "overhead of a warm worker": [100 * (ratio - 1) for ratio in ratio_quartiles(warm, "bare", "warm")],
    }
    if options.json:
        hourly = {name: [3600 * rate for rate in values] for name, values in rates.items()}
        print(json.dumps({"ray_start_seconds": began, "trainings_an_hour": hourly, "percent": overheads}))
        return
    print(f"Ray started in {began:.1f} s; {options.steps:,} control steps per training")
    for name, values in rates.items():
        print(
            f"{name:<5} {3600 * sorted(values)[len(values) // 2]:8.1f} trainings per hour (median, {len(values)} turns)"
        )
    for what, (low, middle, high) in overheads.items():
        print(f"{what}: {middle:+.1f} % of the bare loop's time (quartiles {low:+.1f} to {high:+.1f})")
    print(f"ratio of two workers to one: {ratio_quartiles(rates, 'two', 'one')[1]:.2f}")


if __name__ == "__main__":
    main()
