"""Progress, tables and files of an identification."""

from __future__ import annotations

import contextlib
import math
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from surefoot.api.extras import install_command
from surefoot.cli.helpers.output import print_json
from surefoot.errors import SurefootError, choices
from surefoot.identify.result import Identification, ParameterEstimate
from surefoot.identify.robot_params_file import merge_estimates, write_robot_params
from surefoot.progress import ProgressDisplay
from surefoot.report.figures.identification import cells, full_name, prior_value
from surefoot.report.pages.identification import write_report
from surefoot.robot import PhysicalParams, RobotDescription
from surefoot.robot.params_file import ParamsFile

if TYPE_CHECKING:
    from surefoot.identify.motion.expected_accuracy import ExpectedAccuracy

_NEEDED = {"mujoco": "sim", "numba": "sim", "scipy": "sim", "matplotlib": "report"}


def check_installed(otherwise: str = "") -> None:
    """Report a missing library of the fit before it starts, with its extra and a command that works without it."""
    for module, extra in _NEEDED.items():
        try:
            import_module(module)
        except ImportError:
            instead = f"; {otherwise} records without it" if otherwise else ""
            raise SurefootError(
                f"the fit requires {module}, which is not installed: {install_command(extra)}{instead}"
            ) from None


@contextlib.contextmanager
def fit_progress(what: str) -> Iterator[Callable[[str, float], None]]:
    """Context manager that yields a callback to show the progress of a fit on standard error."""
    line = f"fit of {what}"
    with ProgressDisplay(Console(stderr=True), lambda: Text(line), line_period=0.0, transient=True) as display:

        def report(step: str, cost: float) -> None:
            nonlocal line
            line = f"fit of {what}: {step}" + (f", residuals {math.sqrt(cost):.3g} sigma" if cost >= 0 else "")
            display.refresh(f"surefoot: {line}", force_line=True)

        yield report


def save_and_print(
    robot: RobotDescription,
    prior: ParamsFile,
    result: Identification,
    params: Path | None,
    folder: Path,
    source: str,
    more: dict[str, Any],
    as_json: bool,
) -> None:
    """Write the parameter file `params` (by default robot.toml in the folder) and the report, and print the result.

    The result is printed as tables, or as one JSON object with `more` entries. `source` describes the data.
    """
    # The parameter file is written first: it took an experiment and a fit, while a figure can be drawn again.
    files = [write_robot_params(params or folder / "robot.toml", robot, merge_estimates(prior, result, robot, source))]
    files += write_report(result, robot, prior.params, folder, source)
    if as_json:
        print_json(_as_mapping(robot, prior.params, result) | more | {"files": files})
        return
    console = Console(highlight=False, emoji=False)
    console.print(_estimates_table(robot, prior, result))
    if result.checks:
        table = _table(result.checks_title, "quantity", "before", "after", "unit")
        for check in result.checks:
            table.add_row(Text(check.what), f"{check.before:.3g}", f"{check.after:.3g}", check.unit)
        console.print(table)
    lines = [
        f"{full_name(one, robot)} and {full_name(other, robot)} are hardly distinguishable (correlation {value:+.2f})"
        for one, other, value in result.correlations
    ]
    for line in [*lines, *(f"note: {note}" for note in result.notes), f"wrote {choices(map(str, files))}"]:
        console.print(line, markup=False, soft_wrap=True)


def print_expected_accuracy(
    robot: RobotDescription, foresight: ExpectedAccuracy, prior: PhysicalParams, source: str, as_json: bool
) -> None:
    """Print the intervals that a fit to logs or to a planned motion would achieve, before anything is fitted."""
    result = Identification(source, robot.name, foresight.estimates, notes=foresight.sentences)
    if as_json:
        print_json(_as_mapping(robot, prior, result))
        return
    console = Console(highlight=False, emoji=False)
    console.print(f"expected 95 % intervals of a fit of {robot.name} to {source}, if the prior parameters are right:")
    console.print(_estimates_table(robot, ParamsFile(prior, ()), result))
    for sentence in foresight.sentences:
        console.print(sentence, markup=False, soft_wrap=True)


def print_failure(result: Identification, as_json: bool) -> None:
    """Print why a fit does not reproduce its data, and what to try; nothing was written."""
    if as_json:
        print_json({"experiment": result.experiment, "failure": list(result.failure), "files": []})
        return
    reason, *hints = result.failure
    print(f"surefoot: {reason}; nothing was written", file=sys.stderr)
    for hint in hints or ["check units, signs and the order of joints with surefoot identify replay"]:
        print(f"  {hint}", file=sys.stderr)


def _estimates_table(robot: RobotDescription, prior: ParamsFile, result: Identification) -> Table:
    before = "prior" if prior.names else "data sheet"
    table = _table(f"{result.experiment}: {robot.name}", "parameter", before, "estimate", "95 % interval", "unit")
    groups: dict[str, list[ParameterEstimate]] = {}
    for item in result.estimates:
        groups.setdefault(item.name, []).append(item)
    for name, items in groups.items():
        unit = items[0].unit if items[0].unit != "1" else ""
        if items[0].index is not None and not any(item.identifiable for item in items):
            # One row for all motors.
            table.add_row(Text(name), "", "not identifiable", "", unit, style="dim")
            continue
        if items[0].index is not None:
            table.add_row(Text(name), "", "", "", unit)
            unit = ""
        for item in items:
            label = name if item.index is None else "  " + full_name(item.label, robot).removeprefix(name).strip()
            was, value, interval = cells(item, prior.params)
            table.add_row(Text(label), was or "-", value, interval, unit, style=None if item.identifiable else "dim")
    return table


def _table(title: str, first: str, *others: str) -> Table:
    """Return a table for 80 columns, with text in the first and last columns and numbers between."""
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="left" if name == others[-1] else "right", overflow="fold")
    return table


def _as_mapping(robot: RobotDescription, prior: PhysicalParams, result: Identification) -> dict[str, Any]:
    """Return an identification as a dict for JSON."""
    return {
        "experiment": result.experiment,
        "robot": result.robot,
        "date": result.date,
        "digest": result.digest,
        "estimates": [
            {
                name: getattr(item, name)
                for name in ("name", "index", "value", "interval", "unit", "identifiable", "of_robot")
            }
            | {"label": full_name(item.label, robot), "before": prior_value(item, prior)}
            for item in result.estimates
        ],
        "checks": [vars(check) for check in result.checks],
        "correlations": result.correlations,
        "notes": result.notes,
        "sensors": result.sensors,
        "gains": result.gains,
    }
