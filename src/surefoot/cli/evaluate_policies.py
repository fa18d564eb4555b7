"""`surefoot evaluate POLICY POLICY ...`: compare policies with the same commands on the same robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from surefoot.cli.helpers.options import Count, Json, PluginNames, PolicyNames, Seed, Threads, make_figures_folder
from surefoot.cli.helpers.output import print_json
from surefoot.cli.helpers.parsing import parse
from surefoot.configuration import Duration
from surefoot.errors import SurefootError, choices

if TYPE_CHECKING:
    from surefoot.policy.contract import Contract

CONDITIONS = ("nominal", "bullet", "table1", "pushes", "latency", "feet")


@dataclass(frozen=True)
class CompareCommand:
    """Compare policies that follow velocity commands, with the same commands on the same robots.

    Commands are sampled from the range that all policies support. Conditions: nominal; bullet: the other physics
    engine; table1: randomized robots (ranges of the paper's table I); pushes; latency: sensor readings 20 ms old; feet:
    three times as stiff.
    """

    policies: PolicyNames
    conditions: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME")] = CONDITIONS
    """Conditions to run, one or more."""
    episodes: Count = 32
    """Number of robots (episodes) per policy and condition."""
    duration: Duration = 10.0
    """Duration of an episode [s]."""
    seed: Seed = 0
    threads: Threads = 0
    out: Path | None = None
    """Folder for the table (.csv) and a report (.html)."""
    json: Json = False
    plugin: PluginNames = ()


def main(argv: list[str]) -> int:
    """Run the comparison with the arguments `argv`; return the exit code."""
    command = parse(CompareCommand, argv, "surefoot evaluate POLICY POLICY")
    unknown = [name for name in command.conditions if name not in CONDITIONS]
    if unknown or not command.conditions or len(set(command.conditions)) != len(command.conditions):
        named = choices(command.conditions) or "none"
        raise SurefootError(f"--conditions are {named}; choose from {choices(CONDITIONS)}, each at most once")
    from surefoot.api.evaluation import compare_policies
    from surefoot.api.policies import load_policies
    from surefoot.evaluation.policy_table import common_commands, comparison_conditions, format_rows
    from surefoot.robot.randomization import load_ranges
    from surefoot.tables import plain_rows, print_table, write_csv
    from surefoot.world.registry import find_world

    make_figures_folder(command.out)
    candidates, robot = load_policies(command.policies)
    limits = [candidate.policy.contract.commands for candidate in candidates]
    commands = common_commands(limits, [candidate.name for candidate in candidates])
    by_name = comparison_conditions(robot, load_ranges("table1", robot=robot.folder), command.duration)
    chosen = [by_name[name] for name in command.conditions]
    for condition in chosen:
        find_world(condition.world)
    table = compare_policies(candidates, chosen, robot, commands, command.episodes, command.seed, command.threads)
    files = []
    if command.out is not None:
        from surefoot.report.pages.policy_table import write_page

        sources = [(candidate.name, _source(candidate.policy.contract)) for candidate in candidates]
        page = write_page(command.out / "policies.html", robot.name, table, chosen, commands, sources)
        files = [write_csv(command.out / "policies.csv", table), page]
    if command.json:
        print_json({"robot": robot.name, "policies": plain_rows(table), "files": [str(file) for file in files]})
        return 0
    for condition in chosen:
        print_table(format_rows(table, condition.name), f"{condition.name}: {condition.meaning}, {condition.world}")
    for file in files:
        print(f"wrote {file}")
    return 0


def _source(contract: Contract) -> str:
    """Return a description of a policy's origin."""
    adopted = contract.figures.get("adopted")
    if isinstance(adopted, Mapping):
        return f"adopted from {adopted.get('format')}, network {str(adopted.get('network'))[:12]}"
    return "trained with surefoot"
