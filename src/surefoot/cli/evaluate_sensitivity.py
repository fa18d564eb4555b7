"""`surefoot evaluate sensitivity`: vary one physical parameter at a time, and find those that break a policy."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from surefoot.cli.helpers.options import (
    Count,
    Json,
    PluginNames,
    PolicyNames,
    Pushes,
    PushForce,
    Seed,
    Terrain,
    Threads,
    World,
    make_figures_folder,
)
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.cli.helpers.simulator import Simulator, SimulatorOptions, describe_simulator
from surefoot.configuration import Duration, Within, to_mapping

if TYPE_CHECKING:
    from surefoot.evaluation.sensitivity import Sensitivity


@dataclass(frozen=True)
class SensitivityCommand:
    """Vary one physical parameter at a time, and find the values at which the gait of a policy breaks.

    Each parameter in a table of ranges (by default the paper's table I) takes evenly spaced values within its range,
    while all others are nominal; each value is a test world. The mean and standard deviation of the return over all
    test worlds measure the robustness of a policy. Files in --out: policies.csv, one row per policy; breaks.csv, one
    row per end of a range at which a gait breaks; sensitivity.csv, one row per test world; episodes.csv, one row per
    episode; one figure per parameter, and one for all.
    """

    policies: PolicyNames
    out: Path = Path("sensitivity")
    """Folder for tables (.csv) and figures (.png)."""
    ranges: str = "table1"
    """Parameters to vary and their ranges: the name of a table, or a YAML file."""
    values: Annotated[int, Within(2, 1000)] = 10
    """Number of values per parameter, evenly spaced from end to end of its range."""
    episodes: Count = 8
    """Number of episodes per test world."""
    duration: Duration | None = None
    """Duration of an episode [s], the same in all worlds. Defaults to the longest episode of the policies' tasks."""
    pushes: Pushes = False
    push_force: PushForce = None
    """Also vary the force of horizontal pushes from LOW to HIGH [N], as parameter `push_force`."""
    seed: Seed = 1
    json: Json = False
    world: World = "mujoco"
    terrain: Terrain = "flat"
    simulator: SimulatorOptions = Simulator()
    """Differences of the nominal world from the policies' own simulator."""
    threads: Threads = 0
    plugin: PluginNames = ()


def main(argv: list[str]) -> int:
    """Run the command with the arguments `argv`; return the exit code."""
    command = parse(SensitivityCommand, argv, "surefoot evaluate sensitivity")
    import pandas as pd

    from surefoot.api.evaluation import run_test_worlds
    from surefoot.api.policies import load_policies
    from surefoot.evaluation.conditions import episode_duration
    from surefoot.robot.randomization import load_ranges
    from surefoot.world.registry import find_world

    find_world(command.world)
    loaded, robot = load_policies(command.policies)
    ranges = load_ranges(command.ranges, robot=robot.folder)
    own = {name: getattr(command, name) for name in ("world", "pushes", "terrain")}
    condition = command.simulator.condition(**own, curricula=True)
    tasks = [condition.apply(one.task, robot) for one in loaded]
    make_figures_folder(command.out)
    from surefoot.evaluation.sensitivity import find_gait_limits, trained_ranges
    from surefoot.report.figures.parameters import aggregate_figure, parameter_figure
    from surefoot.tables import write_csv

    duration = command.duration or max(episode_duration(task) for task in tasks)
    names = ("values", "episodes", "pushes", "push_force", "seed")
    settings = {name: getattr(command, name) for name in names} | {"duration": duration}
    results = run_test_worlds(loaded, condition, robot, ranges=ranges, threads=command.threads, **settings)
    unit = min(task.return_unit(robot) for task in tasks)
    groups, trained = {one.policy: [one] for one in results}, {one.name: trained_ranges(one.task) for one in loaded}
    tables = {
        "policies": [pd.DataFrame([_summary(one)]).drop(columns="breaks") for one in results],
        "breaks": [find_gait_limits(one).assign(policy=one.policy) for one in results],
        "sensitivity": [one.worlds.assign(policy=one.policy) for one in results],
        "episodes": [one.episodes.assign(policy=one.policy) for one in results],
    }
    files = [
        *(
            write_csv(command.out / f"{name}.csv", pd.concat(parts).set_index("policy").reset_index())
            for name, parts in tables.items()
        ),
        aggregate_figure(results, command.out / "aggregate.png", unit),
        *(parameter_figure(row, groups, command.out / f"{row}.png", trained, unit) for row in results[0].rows),
    ]
    if command.json:
        whole = {
            "world": command.world,
            "robot": robot.name,
            "ranges": to_mapping(ranges),
            **settings,
            "policies": [
                _summary(result)
                | {
                    "policy_file": str(one.path),
                    "config_hash": one.policy.contract.config_hash,
                    **describe_simulator(task),
                }
                for result, one, task in zip(results, loaded, tasks, strict=True)
            ],
            "files": [str(file) for file in files],
        }
        print_json(whole)
    else:
        _print_tables(results, files, unit)
    return 0


def _summary(result: Sensitivity) -> dict[str, Any]:
    """Return the aggregates of one policy's test worlds for JSON."""
    from surefoot.evaluation.sensitivity import find_gait_limits

    return {
        "policy": result.policy,
        "test_worlds": len(result.worlds),
        "return_mean": result.mean,
        "return_std": result.std,
        "fall_rate": result.fall_rate,
        "nominal_return": float(result.nominal["return"].mean()),
        "nominal_falls": int(result.nominal.fell.sum()),
        "falls": int(result.tests.fell.sum()),
        "episodes": len(result.tests),
        "breaks": find_gait_limits(result).to_dict("records"),
    }


def _print_tables(results: list[Sensitivity], files: list[Path], unit: str) -> None:
    """Print a table of policies, and a table of parameters: range, worst world and nearest values that break the gait.

    `unit` is the unit of returns.
    """
    from surefoot.evaluation.sensitivity import find_gait_limits
    from surefoot.tables import print_files, print_table, with_unit

    policies, rows = [], []
    for result in results:
        policies.append(
            {
                "policy": result.policy,
                with_unit("nominal return", unit): f"{result.nominal['return'].mean():.2f}",
                with_unit("return", unit): f"{result.mean:.2f} ± {result.std:.2f}",
                "test worlds": str(len(result.worlds)),
                "falls": f"{result.tests.fell.sum()} of {len(result.tests)}",
            }
        )
        breaks = find_gait_limits(result)
        for row in result.rows:
            worlds = result.of_row(row)
            worst = worlds.loc[worlds.return_mean.idxmin()]
            rows.append(
                {
                    "policy": result.policy,
                    "parameter": with_unit(row, result.unit(row)),
                    "range": f"{worlds.value.iloc[0]:.3g} to {worlds.value.iloc[-1]:.3g}",
                    with_unit("worst return", unit): f"{worst.return_mean:.2f}",
                    "at": f"{worst.value:.3g}",
                    "falls": f"{worlds.falls.sum()} of {worlds.episodes.sum()}",
                    "breaks at": ", ".join(f"{value:.3g}" for value in breaks.value[breaks.row == row]) or "-",
                }
            )
    print_table(policies, "Test worlds: mean and standard deviation of the return")
    print_table(rows, "Each parameter: its worst test world, and the nearest values at which the gait breaks", 2)
    print_files(files, files[0].parent)
