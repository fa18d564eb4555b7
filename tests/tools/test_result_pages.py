"""Pages of results equal their templates with numbers from result files."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import pytest
from result_pages import REPORTS, ROOT, changes, main, pages, write_page

from surefoot.errors import SurefootError


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Return a root folder with result files."""
    (tmp_path / "results" / "pushes").mkdir(parents=True)
    rows = ["name,speed,fell,falls,episodes,gait", "trot,0.6615,0.27,27,100,trot", "b/bullet,-2.05,0,1,20,other"]
    (tmp_path / "results" / "runs.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "results" / "pushes" / "calm.json").write_text('{"falls": 3, "episodes": 64, "rmse": {"yaw": 0.098}}')
    (tmp_path / "results" / "found.toml").write_text("[params]\nfriction = [0.25, 0.5]  # N m\n")
    return tmp_path


@pytest.mark.parametrize(
    ("source", "printed"),
    [
        ("runs trot: speed .1", "0.7"),
        ("runs trot: speed 0", "1"),
        ("runs trot: speed +.2", "+0.66"),
        ("runs name=b/bullet,gait=other: speed .3", "-2.050"),
        ("runs trot: falls of episodes", "27 of 100"),
        ("pushes/calm: falls of episodes", "3 of 64"),
        ("pushes/calm: rmse.yaw .1", "0.1"),
        ("runs trot: fell x100 0", "27"),
        ("runs trot; b/bullet: speed .1", "0.7, -2.0"),
        ("runs trot; b/bullet: sum falls of episodes", "28 of 120"),
        ("runs trot; b/bullet: sd speed .2", "1.92"),
        ("runs trot: gait", "trot"),
        ("runs all fell=0: min speed .1", "-2.0"),
        ("runs all episodes=100; b/bullet: max speed .1", "0.7"),
        ("found: params.friction.1 .2", "0.50"),
    ],
)
def test_a_source_is_printed_in_its_format(results: Path, source: str, printed: str):
    assert write_page(results, f"A page.\nIt has {{{source}}} m.\n") == f"A page.\nIt has {printed} m.\n"


@pytest.mark.parametrize(
    ("source", "pieces"),
    [
        ("run trot: speed", "results has no file run.csv or run.json"),
        ("runs trott: speed", "results/runs.csv: has 0 rows of name trott"),
        ("runs all gait=pace: max speed", "results/runs.csv: has no rows of gait=pace"),
        ("found: params.friction.2", "has no params.friction.2"),
        ("runs trot: sped", "has no sped"),
        ("runs trot: gait .1", "is not a number: trot"),
        ("runs trot speed", "is not a source"),
    ],
)
def test_a_source_that_does_not_exist_is_reported_with_its_line(results: Path, source: str, pieces: str):
    with pytest.raises(SurefootError, match=re.escape(pieces)) as raised:
        write_page(results, f"A page.\n\nIt has {{{source}}}.\n")
    assert str(raised.value).startswith("It has ")


def test_a_table_has_one_row_per_item(results: Path):
    template = """# Runs

:::table trot = a trot, \\
    b/bullet = Bullet
| policy | speed | falls |
|---|---|---|
| {1} (`{0}`) | {runs {0}: speed .2} | \\
    {runs {0}: falls of episodes} |
| both | {runs trot; b/bullet: mean speed +.1} | {runs trot; b/bullet: sum falls} |
:::

:::table all of runs
- {0}: {runs {0}: gait}
:::
"""
    page = """# Runs

| policy | speed | falls |
|---|---|---|
| a trot (`trot`) | 0.66 | 27 of 100 |
| Bullet (`b/bullet`) | -2.05 | 1 of 20 |
| both | -0.7 | 28 |

- trot: trot
- b/bullet: other
"""
    assert write_page(results, template) == page
    assert changes("a\nb\n", "a\nc\n") == ["2: has 'b', the results 'c'"]


def test_a_source_may_continue_on_the_next_line(results: Path):
    assert write_page(results, "It goes {runs\ntrot: speed .2} m/s.\n") == "It goes 0.66 m/s.\n"


def test_an_unknown_folder_is_rejected():
    with pytest.raises(SurefootError, match="nowhere: no such template; there are "):
        pages(["nowhere"])


@pytest.mark.parametrize("name", [path.parent.name for path in pages([])])
def test_a_page_of_results_is_up_to_date(name: str, capsys: pytest.CaptureFixture[str]):
    if name in REPORTS:
        pytest.importorskip("matplotlib")
    assert main(["--check", name]) == 0, capsys.readouterr().out


def test_every_page_of_results_is_generated():
    """A page that is written by hand could contain wrong numbers."""
    assert sorted(ROOT.glob("results/*/README.md")) == [path for path in sorted(pages([])) if "results" in path.parts]


@pytest.mark.parametrize(
    ("name", "old", "new"), [("reality-gap", "3.05 [2.61", "3.06 [2.61"), ("search", "2.46", "2.47")]
)
def test_a_changed_digit_in_a_report_is_found(
    name: str, old: str, new: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    pytest.importorskip("matplotlib")
    shutil.copytree(
        ROOT / "results" / name, tmp_path / "results" / name, ignore=shutil.ignore_patterns("*.xz", "*.png")
    )
    (tmp_path / "studies").symlink_to(ROOT / "studies")
    page = tmp_path / "results" / name / "README.md"
    text = page.read_text(encoding="utf-8")
    page.write_text(text.replace(old, new, 1), encoding="utf-8")
    monkeypatch.setattr("result_pages.ROOT", tmp_path)
    assert old in text
    assert main(["--check", name]) == 1
    assert new in capsys.readouterr().out
