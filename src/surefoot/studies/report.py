"""The reporter of studies and searches: README.md in a folder, with its command, sections, figures and tables."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from surefoot.evaluation.statistics import decimal
from surefoot.files import atomic_write
from surefoot.report.figures.runs import footfall_diagram
from surefoot.studies.evaluations import load_gait_trace


def write_readme(folder: Path, title: str, command: str, parts: Iterable[str], files: Mapping[str, str]) -> Path:
    """Write README.md into a folder; return its path.

    Args:
        folder: the folder.
        title: title of the report.
        command: command line that made it.
        parts: headings, paragraphs, tables and images in Markdown.
        files: content of each table in the folder, by file name.
    """
    listed = "\n".join(f"- [{name}]({name}): {content}" for name, content in files.items())
    text = [f"# {title}", f"```sh\n{command}\n```", *parts, "## Files", listed]
    path = folder / "README.md"
    atomic_write(path, "\n\n".join(text) + "\n")
    return path


def image(caption: str, file: str) -> str:
    """Return an image of the folder in Markdown."""
    return f"![{caption}]({file})"


def gait_image(policy: Path, folder: Path, name: str, caption: str) -> str:
    """Draw the footfalls of the episode that the evaluation `gait` of a policy file stored; return the image."""
    file = f"gait_{name}.png"
    footfall_diagram(load_gait_trace(policy), folder / file)
    return image(f"Footfalls: {caption}", file)


def stride_cells(result: Mapping[str, Any]) -> dict[str, str]:
    """Return the stride period and duty factor of a result of the evaluation `gait` as cells of a table."""
    return {
        heading: decimal(math.nan if result[name] is None else result[name])
        for heading, name in (("stride (s)", "stride"), ("duty factor", "duty"))
    }
