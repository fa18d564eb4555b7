"""The page of the paper: numbers from files of results, in words, and the page as a browser shows it."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")

from surefoot.errors import SurefootError
from surefoot.evaluate.runs import Estimate
from surefoot.evaluate.statistics import Interval
from surefoot.report.paper import Item, Source, difference, find_number, load_content, write_page

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with one table and one summary."""
    (tmp_path / "groups.csv").write_text("group,world,mean,error\na,home,2.0,0.1\na,away,1.5,0.2\nb,home,1.0,\n")
    (tmp_path / "run.json").write_text(json.dumps({"calm": {"speed": 0.66}, "falls": 3, "gait": "trot"}))
    return tmp_path


def test_a_number_stands_in_the_one_row_that_fits(results: Path):
    where = {"group": "a", "world": "away"}
    found = find_number(results, Source("groups.csv", "mean", where, error="error", scale=100))
    assert found == Estimate(150.0, 20.0)


def test_a_number_stands_behind_keys_of_a_json_file(results: Path):
    assert find_number(results, Source("run.json", "calm.speed")) == Interval(0.66)


@pytest.mark.parametrize(
    ("source", "pieces"),
    [
        (Source("groups.csv", "mean", {"group": "a"}), ["groups.csv: has 2 rows of group a; there must be one"]),
        (Source("groups.csv", "mean", {"group": "c"}), ["has 0 rows of group c"]),
        (Source("groups.csv", "mode", {"group": "b"}), ["has no number mode"]),
        (Source("groups.csv", "error", {"group": "b"}), ["has no number error"]),
        (Source("run.json", "calm.power"), ["run.json: has no number calm.power"]),
        (Source("run.json", "gait"), ["has no number gait"]),
        (Source("run.json", "falls.mean"), ["has no number falls.mean"]),
    ],
)
def test_a_number_that_is_not_there_is_told(results: Path, source: Source, pieces: list[str]):
    with pytest.raises(SurefootError) as caught:
        find_number(results, source)
    for piece in pieces:
        assert piece in str(caught.value)


def test_a_file_that_is_cut_off_is_told(results: Path):
    (results / "cut.json").write_text('{"speed": ')
    with pytest.raises(SurefootError, match=r"cut\.json: is not JSON"):
        find_number(results, Source("cut.json", "speed"))


@pytest.mark.parametrize(
    ("paper", "ours", "words"),
    [
        (2.0, Interval(3.0), "50% more"),
        (2.0, Interval(1.5), "25% less"),
        (1.0, Interval(4.0), "4.0 times as much"),
        (1.0, Interval(1.004), "the same"),
        (2.0, Interval(3.0, low=1.9, high=4.1), "the interval holds the paper's"),
        (2.0, Interval(3.0, low=2.1, high=3.9), "50% more"),
        ("few", Interval(3.0), ""),
        (2.0, None, ""),
    ],
)
def test_the_difference_in_words(paper: float | str, ours: Interval | None, words: str):
    assert difference(paper, ours) == words


def sources() -> list[Item]:
    return [item for section in load_content().sections for item in section.items if isinstance(item.ours, Source)]


def test_every_number_of_the_page_is_among_the_results(repository: Path):
    for item in sources():
        assert isinstance(item.ours, Source)
        assert find_number(repository, item.ours).mean >= 0, item.what


@pytest.fixture(scope="module")
def page(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the results that ship."""
    path = tmp_path_factory.mktemp("paper") / "paper.html"
    assert write_page(repository, path) == []
    return path


def test_the_page_holds_every_section_number_and_picture_and_loads_nothing(page: Path, repository: Path):
    text = page.read_text(encoding="utf-8")
    content = load_content()
    assert text.count("<h2>") == 1 + len(content.sections)
    assert text.count("<figure>") == sum(len(section.pictures) for section in content.sections)
    assert all(section.title.replace("'", "&#x27;") in text for section in content.sections)
    speed = json.loads((repository / "results/policies/trot.json").read_text())["speed_mean"]
    assert f"{speed:.2f} ± " in text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_results_that_are_not_there_are_named_and_not_made_up(tmp_path: Path):
    missing = write_page(tmp_path, tmp_path / "paper.html")
    assert "results/policies/trot.json" in missing
    assert "docs/motor.png" in missing
    assert "not measured" in (tmp_path / "paper.html").read_text(encoding="utf-8")


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this computer; the page is not tried in a browser")
def test_a_browser_shows_every_picture_without_an_error(page: Path):
    script = (
        "<script>addEventListener('load', () => { const all = [...document.images];"
        "document.title = all.length + ' ' + all.filter(one => one.naturalWidth > 100).length; })</script>"
    )
    tried = page.with_name("tried.html")
    tried.write_text(page.read_text(encoding="utf-8").replace("</body>", script + "</body>"), encoding="utf-8")
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom", tried.as_uri()]
    done = subprocess.run([CHROMIUM, *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    shown = re.search(r"<title>(\d+) (\d+)</title>", done.stdout)
    assert shown is not None
    pictures = sum(len(section.pictures) for section in load_content().sections)
    assert shown.groups() == (str(pictures), str(pictures))
    assert "CONSOLE" not in done.stderr
