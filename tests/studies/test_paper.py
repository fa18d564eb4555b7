"""The page of the paper: numbers from files of results, in words, and the page as a browser shows it."""

from __future__ import annotations

import json
import math
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import CHROMIUM, in_browser

pytest.importorskip("matplotlib")

from surefoot.errors import SurefootError
from surefoot.evaluation.statistics import Interval, MeanEstimate
from surefoot.studies.paper import (
    NumberSource,
    ValueCounts,
    difference,
    find_counts,
    find_number,
    load_content,
    write_page,
)


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """A folder with one table and one summary."""
    (tmp_path / "groups.csv").write_text("group,world,mean,error\na,home,2.0,0.1\na,away,1.5,0.2\nb,home,1.0,\n")
    (tmp_path / "run.json").write_text(json.dumps({"calm": {"speed": 0.66}, "falls": 3, "gait": "trot"}))
    return tmp_path


def test_a_number_is_read_from_the_row_of_its_columns(results: Path):
    where = {"group": "a", "world": "away"}
    number = find_number(results, NumberSource("groups.csv", "mean", where, error="error", scale=100))
    assert number == MeanEstimate(150.0, 20.0)


def test_a_number_is_read_at_keys_of_a_json_file(results: Path):
    assert find_number(results, NumberSource("run.json", "calm.speed")) == Interval(0.66)


def test_an_interval_or_error_of_a_single_policy_is_left_out(results: Path):
    where = {"group": "b"}
    assert find_number(results, NumberSource("groups.csv", "mean", where, low="error", high="error")).text() == "1.00"
    assert find_number(results, NumberSource("groups.csv", "mean", where, error="error")).text() == "1.00"
    with pytest.raises(SurefootError, match="has no number low"):
        find_number(results, NumberSource("groups.csv", "mean", where, low="low", high="high"))


def test_values_are_counted_the_most_frequent_first(results: Path):
    (results / "gaits.csv").write_text("state,gait\ncomplete,bound\ncomplete,trot\npruned,trot\nfail,\n")
    assert find_counts(results, ValueCounts("gaits.csv", "gait")) == "2 trot, 1 bound"
    assert find_counts(results, ValueCounts("gaits.csv", "gait", {"state": "complete"})) == "1 bound, 1 trot"
    with pytest.raises(SurefootError, match=r"gaits\.csv: has no column pattern in rows of any kind"):
        find_counts(results, ValueCounts("gaits.csv", "pattern"))
    with pytest.raises(SurefootError, match="has no column gait in rows of state running"):
        find_counts(results, ValueCounts("gaits.csv", "gait", {"state": "running"}))


@pytest.mark.parametrize(
    ("source", "pieces"),
    [
        (NumberSource("groups.csv", "mean", {"group": "a"}), ["groups.csv: has 2 rows of group a; there must be one"]),
        (NumberSource("groups.csv", "mean", {"group": "c"}), ["has 0 rows of group c"]),
        (NumberSource("groups.csv", "mode", {"group": "b"}), ["has no number mode"]),
        (NumberSource("groups.csv", "error", {"group": "b"}), ["has no number error"]),
        (NumberSource("run.json", "calm.power"), ["run.json: has no number calm.power"]),
        (NumberSource("run.json", "gait"), ["has no number gait"]),
        (NumberSource("run.json", "falls.mean"), ["has no number falls.mean"]),
    ],
)
def test_find_number_refuses_a_source_without_a_number(results: Path, source: NumberSource, pieces: list[str]):
    with pytest.raises(SurefootError) as caught:
        find_number(results, source)
    for piece in pieces:
        assert piece in str(caught.value)


def test_find_number_refuses_a_file_that_is_cut_off(results: Path):
    (results / "cut.json").write_text('{"speed": ')
    with pytest.raises(SurefootError, match=r"cut\.json: is not JSON"):
        find_number(results, NumberSource("cut.json", "speed"))


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


def sources() -> Iterator[NumberSource | ValueCounts]:
    for section in load_content().sections:
        for item in section.items:
            if not isinstance(item.surefoot, str):
                yield item.surefoot


def test_every_number_of_the_page_is_among_the_results(repository: Path):
    for one in sources():
        if isinstance(one, NumberSource):
            assert math.isfinite(find_number(repository, one).mean), one
        else:
            assert find_counts(repository, one), one


@pytest.fixture(scope="module")
def page(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of the results that ship."""
    path = tmp_path_factory.mktemp("page") / "paper.html"
    assert write_page(repository, path) == []
    return path


def shown(root: Path) -> int:
    """Return how many pictures the page has."""
    return sum(len(one.find_files(root)) for section in load_content().sections for one in section.pictures)


@pytest.mark.parametrize(
    ("section", "line", "number"),
    [
        ("Section VI-A: gaits that emerge", "gaits, policies trained to the end", r"\d+ \w+(, \d+ \w+)*"),
        ("Section VI-A: from scratch", "improved: speed in simulation", r"\d\.\d\d \[-?\d\.\d\d, \d\.\d\d\] m/s"),
        ("Section VI-B: a hundred controllers", "top three: speed at home", r"\d\.\d\d ± \d\.\d\d m/s"),
    ],
)
def test_a_line_of_the_page_has_the_number_of_the_results(page: Path, section: str, line: str, number: str):
    (text,) = (
        part for part in page.read_text(encoding="utf-8").split("<h2") if part.partition(">")[2].startswith(section)
    )
    rows = (re.findall(r"<td[^>]*>(.*?)</td>", row) for row in text.split("<tr>"))
    cells = {row[0]: row[2] for row in rows if len(row) > 2}
    assert re.fullmatch(number, cells[line]), cells[line]


def test_the_page_holds_every_section_and_picture_and_loads_nothing(page: Path, repository: Path):
    text = page.read_text(encoding="utf-8")
    content = load_content()
    assert text.count("<h2") == 1 + len(content.sections)
    links, places = (re.findall(rf'{name}="#?(s\d+)"', text) for name in ("href", "id"))
    assert links == places == [f"s{k + 1}" for k in range(len(content.sections))]
    assert text.count("<figure>") == shown(repository)
    assert all(section.title.replace("'", "&#x27;") in text for section in content.sections)
    speed = json.loads((repository / "results/policies/trot.json").read_text())["speed_mean"]
    assert f"{speed:.2f} ± " in text
    assert not re.search(r'(src|href)="(?!data:|#)', text)


def test_missing_results_are_named(tmp_path: Path):
    missing = write_page(tmp_path, tmp_path / "paper.html")
    assert "results/policies/trot.json" in missing
    assert {"docs/motor.png", "results/from-scratch/policies.csv", "results/search/gait_*.png"} <= set(missing)
    assert "not measured" in (tmp_path / "paper.html").read_text(encoding="utf-8")


@in_browser
def test_a_browser_shows_every_picture_without_an_error(page: Path, repository: Path):
    script = (
        "<script>addEventListener('load', () => { const all = [...document.images];"
        "document.title = all.length + ' ' + all.filter(one => one.naturalWidth > 100).length; })</script>"
    )
    tried = page.with_name("tried.html")
    tried.write_text(page.read_text(encoding="utf-8").replace("</body>", script + "</body>"), encoding="utf-8")
    words = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--dump-dom", tried.as_uri()]
    done = subprocess.run([CHROMIUM, *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    counted = re.search(r"<title>(\d+) (\d+)</title>", done.stdout)
    assert counted is not None
    assert counted.groups() == (str(shown(repository)),) * 2
    assert "CONSOLE" not in done.stderr
