"""What an identification found: its progress, tables, files."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from surefoot.cli.helpers.output import print_json
from surefoot.errors import SurefootError, choices
from surefoot.identify.overlay import Known, overlay, write_known
from surefoot.identify.result import Identification, ParameterEstimate
from surefoot.progress import ProgressDisplay
from surefoot.report.figures.identification import cells, full_name, prior_value
from surefoot.report.pages.identification import write_report
from surefoot.robot import RobotDescription

_NEEDED = {"mujoco": "sim", "numba": "sim", "scipy": "sim", "matplotlib": "report"}


def check_installed(otherwise: str = "") -> None:
    """Refuse to begin where a fit is going to lack a library; name it, its extra, and a command that works without."""
    for module, extra in _NEEDED.items():
        try:
            import_module(module)
        except ImportError:
            instead = f"; {otherwise} records without it" if otherwise else ""
            raise SurefootError(
                f"the fit needs {module}, which is not installed: pip install 'surefoot[{extra}]'{instead}"
            ) from None


@contextlib.contextmanager
def fitting(what: str) -> Iterator[Callable[[str, float], None]]:
    """Yield a callback that shows the progress of a fit on standard error."""
    line = f"fit of {what}"
    with ProgressDisplay(Console(stderr=True), lambda: Text(line), line_period=0.0, transient=True) as display:

        def report(step: str, cost: float) -> None:
            nonlocal line
            line = f"fit of {what}: {step}" + (f", residuals {math.sqrt(cost):.3g} sigma" if cost >= 0 else "")
            display.refresh(f"surefoot: {line}", force_line=True)

        yield report


def write(
    robot: RobotDescription, known: Known, found: Identification, params: Path, folder: Path, source: str
) -> list[Path]:
    """Write what is known now, with the data's `source`, to the file `params`, and the report to a folder."""
    # First what took a robot and a fit to get; a figure can be drawn again.
    files = [write_known(params, robot, overlay(known, found, robot, source))]
    return [*files, *write_report(found, robot, known.params, folder, source)]


def report(
    robot: RobotDescription,
    known: Known,
    found: Identification,
    files: list[Path],
    more: dict[str, Any],
    as_json: bool,
) -> None:
    """Print what was found, and the files that were written, as tables or as one JSON object, which has more."""
    if as_json:
        print_json(as_mapping(robot, known, found) | more | {"files": files})
        return
    console = Console(highlight=False, emoji=False)
    console.print(_estimates(robot, known, found))
    if found.checks:
        table = _table("RMS error on data that were not fitted", "quantity", "before", "after", "unit")
        for check in found.checks:
            table.add_row(Text(check.what), f"{check.before:.3g}", f"{check.after:.3g}", check.unit)
        console.print(table)
    lines = [
        f"{full_name(one, robot)} and {full_name(other, robot)} can hardly be told apart (correlation {value:+.2f})"
        for one, other, value in found.correlations
    ]
    for line in [*lines, *(f"note: {note}" for note in found.notes)]:
        console.print(line, markup=False, soft_wrap=True)
    console.print(f"wrote {choices(map(str, files))}", markup=False, soft_wrap=True)


def _estimates(robot: RobotDescription, known: Known, found: Identification) -> Table:
    table = _table(f"{found.experiment}: {robot.name}", "parameter", "known" if known.given else "sheet", "found",
                   "95 % interval", "unit")  # fmt: skip
    groups: dict[str, list[ParameterEstimate]] = {}
    for item in found.estimates:
        groups.setdefault(item.name, []).append(item)
    for name, items in groups.items():
        unit = items[0].unit if items[0].unit != "1" else ""
        if items[0].index is not None:
            table.add_row(Text(name), "", "", "", unit)
            unit = ""
        for item in items:
            label = name if item.index is None else "  " + full_name(item.label, robot).removeprefix(name).strip()
            was, value, interval = cells(item, known.params)
            table.add_row(Text(label), was or "-", value, interval, unit, style=None if item.identifiable else "dim")
    return table


def _table(title: str, first: str, *others: str) -> Table:
    """A table that fits 80 columns: texts at both ends, numbers between."""
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, pad_edge=False)
    table.add_column(first, overflow="fold")
    for name in others:
        table.add_column(name, justify="left" if name == others[-1] else "right", overflow="fold")
    return table


def as_mapping(robot: RobotDescription, known: Known, found: Identification) -> dict[str, Any]:
    """What was found, for JSON: numbers that are not finite are null."""
    return {
        "experiment": found.experiment,
        "robot": found.robot,
        "date": found.date,
        "digest": found.digest,
        "estimates": [
            {
                "name": item.name,
                "index": item.index,
                "label": full_name(item.label, robot),
                "before": _finite(prior_value(item, known.params)),
                "value": _finite(item.value),
                "interval": [_finite(end) for end in item.interval],
                "unit": item.unit,
                "identifiable": item.identifiable,
            }
            for item in found.estimates
        ],
        "checks": [{**vars(one), "before": _finite(one.before), "after": _finite(one.after)} for one in found.checks],
        "correlations": [[*pair[:2], _finite(pair[2])] for pair in found.correlations],
        "notes": list(found.notes),
        "sensors": found.sensors,
    }


def _finite(value: float | None) -> float | None:
    return float(value) if value is not None and math.isfinite(value) else None
