"""`surefoot sensitivity`: which physical parameters break a policy, one at a time."""

from __future__ import annotations

import json
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from surefoot.cli.parsing import parse
from surefoot.cli.simulator import Simulator, SimulatorOptions, check_params
from surefoot.configuration import Duration, Seed, Threads, Within
from surefoot.errors import SurefootError

if TYPE_CHECKING:
    from rich.console import Console

    from surefoot.evaluate.sensitivity import Progress, Sensitivity


@dataclass(frozen=True)
class SensitivityCommand:
    """Run policies in worlds that differ from the nominal one in one physical parameter, and say what breaks them.

    Each row of a table of ranges, the paper's table I by default, takes evenly spaced values within its range while
    all else stays nominal. Mean and standard deviation of the return over all these test worlds tell how robust a
    policy is. Written to --out: sensitivity.csv, one line a world; episodes.csv, one line an episode; a figure for
    each row and one for all of them.
    """

    policies: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="POLICY [POLICY ...]")]
    """Paths of policy files (.onnx), or names of policies that ship with surefoot."""
    out: Path = Path("sensitivity")
    """Folder for tables (.csv) and figures (.png)."""
    ranges: str = "table1"
    """Rows to vary and their ranges: the name of a table, or a YAML file."""
    values: Annotated[int, Within(2, 1000)] = 10
    """Values of each row, evenly spaced, the ends of its range included."""
    episodes: Annotated[int, Within(1, 10_000)] = 8
    """Episodes in each world."""
    duration: Duration | None = None
    """Length of an episode [s], the same in all worlds; the longest of the policies' tasks, if not given."""
    pushes: bool = False
    """Push the robot at random, as its task says how; without this nothing pushes."""
    seed: Seed = 1
    """The one seed."""
    json: bool = False
    """Print one JSON object instead of tables."""
    world: str = "mujoco"
    """Where to run: mujoco or bullet."""
    simulator: SimulatorOptions = Simulator()
    """Another simulator than the policies' own, as the nominal world."""
    threads: Threads = 0
    """Threads of the simulation; 0 means one a core."""


def main(argv: list[str]) -> int:
    """Run the command with the words after its name; returns the exit code."""
    command = parse(SensitivityCommand, argv, "surefoot sensitivity", config=(tyro.conf.FlagCreatePairsOff,))
    if not command.policies:
        raise SurefootError("no policy is given; give one or more .onnx files, or names of policies that ship")
    from surefoot.cli.policies import SIDE_BY_SIDE, find_policy, find_world, load_policies
    from surefoot.task.randomize import check_ranges, load_ranges

    paths = [find_policy(policy) for policy in command.policies]
    make_world = find_world(command.world)
    ranges = load_ranges(command.ranges)
    loaded, robot = load_policies(paths)
    check_ranges(ranges, robot)
    tasks = [command.simulator.of(one.task) for one in loaded]
    for task in tasks:
        check_params(task, robot)
    import_module("matplotlib")
    command.out.mkdir(parents=True, exist_ok=True)
    from rich.console import Console

    from surefoot.evaluate.sensitivity import episode_duration, run_sensitivity

    duration = command.duration or max(episode_duration(task) for task in tasks)
    console = Console(stderr=True)
    results = []
    for one, task in zip(loaded, tasks, strict=True):
        with _Bar(console, one.name) as progress:
            results.append(
                run_sensitivity(
                    one.policy,
                    task,
                    make_world,
                    policy_name=one.name,
                    ranges=ranges,
                    values=command.values,
                    episodes=command.episodes,
                    duration=duration,
                    seed=command.seed,
                    threads=command.threads,
                    pushes=command.pushes,
                    robots=SIDE_BY_SIDE[command.world],
                    progress=progress,
                )
            )
    trained = {one.name: one.task.randomize.ranges for one in loaded}
    files = write_files(command.out, results, trained)
    if command.json:
        whole = {
            "world": command.world,
            "robot": robot.name,
            "ranges": {row: list(given) for row, given in ranges.ranges.items()},
            "values": command.values,
            "episodes": command.episodes,
            "duration": duration,
            "pushes": command.pushes,
            "seed": command.seed,
            "policies": [
                summary(result)
                | {
                    "policy_file": str(one.path),
                    "config_hash": one.policy.contract.config_hash,
                    "actuator": task.actuator,
                    "params": task.params,
                    "params_source": task.params_source,
                }
                for result, one, task in zip(results, loaded, tasks, strict=True)
            ],
            "files": [str(file) for file in files],
        }
        print(json.dumps(whole, allow_nan=False))
    else:
        print_tables(results, files)
    return 0


class _Bar:
    """A progress bar on stderr, so that stdout is the result's alone."""

    def __init__(self, console: Console, name: str) -> None:
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        self._bar = Progress(*columns, console=console, transient=True, disable=not console.is_terminal)
        self._row = self._bar.add_task(name, total=None)
        self._calls = 0

    def __enter__(self) -> Progress:
        self._bar.start()
        return self._show

    def __exit__(self, *_: object) -> None:
        self._bar.stop()

    def _show(self, done: int, total: int) -> None:
        self._calls += 1
        if self._calls % 10 == 0 or done == total:
            self._bar.update(self._row, completed=done, total=total)


def write_files(
    folder: Path, results: list[Sensitivity], trained: dict[str, dict[str, tuple[float, float]]]
) -> list[Path]:
    """Write both tables, a figure for each row and one for all; returns the files."""
    from surefoot.evaluate.sensitivity_tables import write_csv, write_episodes_csv
    from surefoot.report.sensitivity_figures import aggregate_figure, parameter_figure

    files = [write_csv(folder / "sensitivity.csv", results), write_episodes_csv(folder / "episodes.csv", results)]
    files.append(aggregate_figure(results, folder / "aggregate.png"))
    for row in results[0].rows:
        files.append(parameter_figure(row, results, folder / f"{row}.png", trained_ranges=trained))
    return files


def summary(result: Sensitivity) -> dict[str, Any]:
    """What a program wants to know of one policy, as JSON holds it."""
    from surefoot.evaluate.breaks import find_breaks, plain_words

    return {
        "policy": result.policy,
        "test_worlds": len(result.worlds),
        "return_mean": result.mean,
        "return_std": result.std,
        "fall_rate": result.fall_rate,
        "nominal_return": result.nominal.mean_return,
        "nominal_falls": int(result.nominal.fell.sum()),
        "breaks": [vars(item) for item in find_breaks(result)],
        "words": plain_words(result),
    }


def print_tables(results: list[Sensitivity], files: list[Path]) -> None:
    """Print each policy's table and what breaks it, then the files."""
    from rich.console import Console
    from rich.table import Table

    from surefoot.evaluate.breaks import plain_words
    from surefoot.evaluate.sensitivity import row_unit

    console = Console()
    for result in results:
        table = Table(title=f"{result.policy}: nominal return {result.nominal.mean_return:.2f} m")
        table.add_column("row", no_wrap=True)
        for column in ("range", "worst return", "at", "falls"):
            table.add_column(column, justify="right", no_wrap=column in ("range", "at"))
        for row in result.rows:
            rows, unit = result.of_row(row), row_unit(row)
            worst = rows[result.mean_return[rows].argmin()]
            ends = [result.worlds[i].value for i in (rows[0], rows[-1])]
            table.add_row(
                row,
                f"{ends[0]:.3g} to {ends[1]:.3g} {unit}".rstrip(),
                f"{result.mean_return[worst]:.2f} m",
                f"{result.worlds[worst].value:.3g} {unit}".rstrip(),
                f"{result.fell[rows].sum()} of {result.fell[rows].size}",
            )
        console.print(table)
        said = (
            f"{result.policy}: return {result.mean:.2f} ± {result.std:.2f} m over {len(result.worlds)} test worlds, "
            f"{result.fell.sum()} of {result.fell.size} episodes fall"
        )
        for line in (said, plain_words(result), ""):
            console.print(line, highlight=False, markup=False, soft_wrap=True)
    told = f"wrote {files[0].parent}: {', '.join(file.name for file in files)}"
    console.print(told, highlight=False, markup=False, soft_wrap=True)
