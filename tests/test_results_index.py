"""results/README.md links all measurements, and all links between pages of results resolve."""

from __future__ import annotations

from pathlib import Path

import pytest
from markdown_pages import ROOT, dead_links, links

RESULTS = ROOT / "results"


def missing(results: Path) -> list[str]:
    """Return folders and files of results that are not linked in the index."""
    linked = {link.split("/")[0] for link in links((results / "README.md").read_text(encoding="utf-8"))}
    return sorted(path.name for path in results.iterdir() if path.name != "README.md" and path.name not in linked)


def test_the_index_has_every_folder_and_file():
    assert missing(RESULTS) == []


@pytest.mark.parametrize("page", [path.relative_to(ROOT).as_posix() for path in sorted(RESULTS.rglob("README.md"))])
def test_links_of_a_page_of_results_resolve(page: str):
    assert dead_links(ROOT / page) == []


def test_every_folder_has_a_page():
    assert [path.name for path in RESULTS.iterdir() if path.is_dir() and not (path / "README.md").is_file()] == []


def test_a_missing_folder_and_a_dead_link_are_detected(tmp_path: Path):
    (tmp_path / "runs").mkdir()
    (tmp_path / "old").mkdir()
    (tmp_path / "power.csv").touch()
    (tmp_path / "README.md").write_text("# All\n[runs](runs/README.md), [top](#all), [not](#there)\n")
    assert missing(tmp_path) == ["old", "power.csv"]
    assert dead_links(tmp_path / "README.md") == ["runs/README.md", "#there"]
