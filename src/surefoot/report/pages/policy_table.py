"""Report of a comparison of policies: one table per condition."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from pathlib import Path

import pandas as pd

from surefoot import __version__
from surefoot.evaluation.conditions import Condition
from surefoot.evaluation.policy_table import format_rows
from surefoot.files import atomic_write
from surefoot.report.pages import html
from surefoot.robot.commands import COMMANDS
from surefoot.task.commands import CommandConfig


def write_page(
    path: Path,
    robot: str,
    table: pd.DataFrame,
    conditions: Sequence[Condition],
    commands: CommandConfig,
    sources: Sequence[tuple[str, str]],
) -> Path:
    """Write the report as a self-contained page.

    Args:
        path: file to write (.html).
        robot: name of the robot.
        table: rows of `measure`, with the column `policy`.
        conditions: conditions in the table, in order.
        commands: distribution of the commands.
        sources: name and origin of each policy.
    """
    title = f"Comparison of policies for {robot}"
    ranges = "; ".join(
        f"{name.replace('_', ' ')} {getattr(commands, name)[0]:g} to {getattr(commands, name)[1]:g} {unit}"
        for name, unit in COMMANDS.items()
    )
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="quiet">All policies run with the same random commands on the same robots: {escape(ranges)}, with a '
        f"new command every {commands.hold[0]:g} to {commands.hold[1]:g} s. Errors are root mean squares of the mean "
        "velocity over each stride and, in the last columns, of the instantaneous velocity; the first second of each "
        "command is excluded. Cost of transport: energy per weight and distance along the command. Hottest motor: its "
        f"mean heat. Results from simulation, not from a robot. surefoot {escape(__version__)}.</p>",
    ]
    for condition in conditions:
        rows = format_rows(table, condition.name)
        if not rows:
            continue
        kinds = "t" + "n" * (len(rows[0]) - 1)
        lines = [html.row(tuple(rows[0]), kinds, "th"), *(html.row(tuple(row.values()), kinds) for row in rows)]
        parts.append(f"<h2>{escape(f'{condition.meaning}, {condition.world}')}</h2>")
        parts.append(f'<div class="wide"><table>{"".join(lines)}</table></div>')
    names = "".join(html.row(source, "tt") for source in sources)
    parts.append(f"<h2>Policies</h2><table>{names}</table>")
    atomic_write(path, html.page(title, parts))
    return path
