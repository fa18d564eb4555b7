"""Documentation pages are in the site's navigation, and rows of evaluations match their declarations."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("pandas")

from surefoot.configuration import read_yaml

ROOT = Path(__file__).resolve().parents[1]


def load_script(path: str) -> ModuleType:
    """Return a script of the repository as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_evaluations_match_the_declared_policies_and_options():
    script = load_script("benchmarks/evaluations.py")
    names = read_yaml(script.NAMES)
    named = script.named_rows(names)
    rows = script.read_table()
    lines = script.TABLE.read_text(encoding="utf-8").splitlines()[1:]
    assert [line.split(",")[0] for line in lines] == sorted(rows), "one row a name, sorted"
    for name, row in rows.items():
        policy, options = named[name]
        about = names["policies"].get(policy, {})
        path = script.find_file(policy, names["policies"], Path("nowhere"))
        described = script.describe(policy, options, about, path)
        assert row.items() >= described.items(), f"{name} is stale: run benchmarks/evaluations.py"


def test_every_page_is_in_the_navigation():
    """`make docs` would also reject missing pages, but is not part of `make test`."""
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    packages = {f"reference/{path.parent.name}.md" for path in ROOT.glob("src/surefoot/*/__init__.py")}
    assert not (pages | packages) - set(listed)
