"""Figure of the success rate against the size of terrain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from surefoot.report.figures.style import COLORS, MARKERS, new_figure
from surefoot.world.terrain import KINDS


def success_figure(rows: Sequence[Mapping[str, Any]], path: Path) -> Path:
    """Draw the success rate against the size of terrain, one panel per kind of terrain.

    Args:
        rows: rows with policy, world, robots, kind, size and success; kinds without a size are skipped.
        path: file to write (.png).
    """
    kinds = [kind for kind in KINDS if any(row["kind"] == kind for row in rows)]
    cases = list(dict.fromkeys((row["policy"], row["world"], row["robots"]) for row in rows))
    columns = min(len(kinds), 4)
    rows_of_panels = -(-len(kinds) // columns)
    with new_figure(path, (2.6 * columns, 2.4 * rows_of_panels), rows_of_panels, columns) as (figure, axes):
        for axis, kind in zip(axes, kinds, strict=False):
            for number, case in enumerate(cases):
                own = sorted(
                    (float(row["size"]), float(row["success"]))
                    for row in rows
                    if row["kind"] == kind and (row["policy"], row["world"], row["robots"]) == case
                )
                label = ", ".join(str(part) for part in case if part not in ("mujoco", "nominal")).replace(
                    "table1", "randomized robots"
                )
                axis.plot(
                    *zip(*own, strict=True) if own else ([], []),
                    color=COLORS[number % len(COLORS)],
                    marker=MARKERS[number % len(MARKERS)],
                    label=label,
                )
            axis.set(title=kind.replace("_", " "), xlabel=f"size [{KINDS[kind].unit}]", ylim=(-0.03, 1.03))
        for axis in axes[len(kinds) :]:
            axis.set_visible(False)
        axes[0].set_ylabel("success")
        figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=min(len(cases), 5))
    return path
