"""The table in docs/terrain.md contains the largest terrain sizes with success in results/terrain/success.csv."""

from __future__ import annotations

import re

import pytest
from markdown_pages import ROOT
from result_numbers import read_rows

SUCCESS = 0.9
KINDS = {
    "stairs up": ("stairs",),
    "stairs down": ("stairs_down",),
    "slope, up and down": ("slope", "slope_down"),
    "rough ground": ("rough",),
    "blocks": ("blocks",),
    "gaps": ("gaps",),
}
COLUMNS = (("go2-terrain", "nominal"), ("go2-terrain", "table1"), ("go2-terrain-seeing", "nominal"))


def largest(policy: str, robots: str, kinds: tuple[str, ...]) -> str:
    """Return the largest size per kind of terrain with a sufficient success rate, in degrees or centimetres."""
    where = {"policy": policy, "world": "mujoco", "robots": robots}
    rows = [read_rows(ROOT / "results/terrain/success.csv", {**where, "kind": kind}) for kind in kinds]
    sizes = [max((float(row["size"]) for row in one if float(row["success"]) >= SUCCESS), default=0.0) for one in rows]
    size = min(sizes)
    if not size:
        return "none"
    return f"{size:g}°" if kinds[0].startswith("slope") else f"{100 * size:g} cm"


@pytest.mark.parametrize("title", KINDS)
def test_a_row_of_the_page_contains_the_largest_sizes(title: str):
    page = (ROOT / "docs/terrain.md").read_text(encoding="utf-8")
    row = re.search(rf"^\| {title} \| (.+) \|$", page, re.MULTILINE)
    assert row is not None
    assert row[1].split(" | ") == [largest(*column, KINDS[title]) for column in COLUMNS]
