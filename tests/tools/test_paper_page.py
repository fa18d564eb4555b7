"""Page of the paper: numbers from result files, differences in words, and the page in a browser."""

from __future__ import annotations

import json
import re
import subprocess
from pathlib import Path

import pytest
from chromium import find_chromium, in_browser

pytest.importorskip("matplotlib")

from paper_page import VERDICTS, claims_markdown, difference, load_content, write_page
from result_numbers import fill

from surefoot.errors import SurefootError


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Return a root folder with one table and one summary."""
    (tmp_path / "results").mkdir()
    rows = ["group,world,mean,error,low,high,gait", "a,home,2.0,0.1,1.8,2.2,trot", "a,away,1.5,0.2,1.1,1.9,trot"]
    (tmp_path / "results/groups.csv").write_text("\n".join([*rows, "b,home,1.0,,,,bound", "c,home,,,,,"]) + "\n")
    (tmp_path / "results/run.json").write_text(json.dumps({"calm": {"speed": 0.66}, "falls": 3, "gait": "trot"}))
    return tmp_path


@pytest.mark.parametrize(
    ("text", "filled"),
    [
        ("goes {groups group=a,world=away: mean ± error x100 0} m/s", "goes 150 ± 20 m/s"),
        ("{groups group=a,world=away: mean [low, high] .2} m", "1.50 [1.10, 1.90] m"),
        # A single policy has no standard error.
        ("{groups b: mean [low, high] .2} m, {groups b: mean ± error .1} m", "1.00 m, 1.0 m"),
        ("{groups group=a,world=home; b: mean ± error .1}", "2.0 ± 0.1, 1.0"),
        ("{groups group=a,world=home; b: mean mean .1}", "1.5"),
        ("{run: calm.speed 0.2} m/s, {run: gait}", "0.66 m/s, trot"),
        ("{groups: count gait}; {groups group=b: count} of {groups: count}", "2 trot, 1 bound; 1 of 4"),
    ],
)
def test_a_text_is_filled_with_numbers_of_results(results: Path, text: str, filled: str):
    assert fill(results, text) == filled


@pytest.mark.parametrize(
    ("source", "piece"),
    [
        ("groups a: mean .2", "results/groups.csv: has 2 rows of group a; there must be one"),
        ("groups d: mean .2", "has 0 rows of group d"),
        ("groups b: mode .2", "has no mode in b"),
        ("groups c: mean [low, high] .2", "has no mean in c"),
        ("groups b: mean [least, most] .2", "has no least in b"),
        ("groups b; c: mean mean .2", "has no mean in a row of b; c"),
        ("groups group=b: count pattern", "has no column pattern in these rows"),
        ("run: calm.power .2", "results/run.json: has no calm.power in its keys"),
        ("run: gait .2", "is not a number: trot"),
        ("runs: gait", "results has no file runs.csv or runs.json or runs.toml"),
        ("cut: speed .2", "results/cut.json: is not JSON"),
    ],
)
def test_a_source_without_a_number_is_rejected(results: Path, source: str, piece: str):
    (results / "results/cut.json").write_text('{"speed": ')
    with pytest.raises(SurefootError, match=re.escape(piece)):
        fill(results, f"{{{source}}}")


@pytest.mark.parametrize(
    ("paper", "ours", "words"),
    [
        ("2.0 m", "3.00 m", "50% more"),
        ("2.0 m", "1.50 ± .10 m", "25% less"),
        ("1.0", "4", "4.0 times as much"),
        ("1.00 m/s", "1.004 m/s", "the same"),
        (".50 m/s", ".66 [.45, .87] m/s", "the interval contains the paper's value"),
        ("2.0 m", "3.0 [2.1, 3.9] m", "50% more"),
        ("2.0 m", "3.0 s", ""),
        ("few", "3.0 m", ""),
        ("2.0 m", "not measured", ""),
        ("15 to 19 ms", "20 ms", ""),
    ],
)
def test_differences_are_stated_in_words(paper: str, ours: str, words: str):
    assert difference(paper, ours) == words


def test_claims_are_listed_by_verdict(repository: Path):
    for verdict in VERDICTS:
        head, rule, *lines = claims_markdown(repository, verdict).splitlines()
        claims = [one for one in load_content().claims if one.verdict == verdict]
        assert (head.count("|"), rule.count("|")) == (3, 3)
        assert [line.count("|") for line in lines] == [3] * len(claims)
        assert [line.split("|")[1].strip() for line in lines] == [one.claim for one in claims]
        for where in (one.where for one in claims):
            assert (repository / "docs" / where.partition("#")[0]).is_file(), where


@pytest.fixture(scope="module")
def page(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the page of the committed results."""
    path = tmp_path_factory.mktemp("page") / "paper.html"
    assert write_page(repository, path) == []
    return path


def shown(root: Path) -> int:
    """Return the number of pictures on the page."""
    return sum(len(one.find_files(root)) for section in load_content().sections for one in section.pictures)


@pytest.mark.parametrize(
    ("section", "line", "number"),
    [
        ("Section VI-A: gaits that emerge", "gaits, policies trained to the end", r"\d+ \w+(, \d+ \w+)*"),
        ("Section VI-A: from scratch", "improved: speed in simulation", r"\d?\.\d\d \[-?\d?\.\d\d, \d?\.\d\d\] m/s"),
        (
            "Section VI-B: a hundred controllers",
            "top three: speed in the training simulator",
            r"\d\.\d\d ± \d\.\d\d m/s",
        ),
    ],
)
def test_a_line_of_the_page_has_the_number_from_the_results(page: Path, section: str, line: str, number: str):
    (text,) = (
        part for part in page.read_text(encoding="utf-8").split("<h2") if part.partition(">")[2].startswith(section)
    )
    rows = (re.findall(r"<td[^>]*>(.*?)</td>", row) for row in text.split("<tr>"))
    cells = {row[0]: row[2] for row in rows if len(row) > 2}
    assert re.fullmatch(number, cells[line]), cells[line]


def test_the_page_has_every_section_and_picture_and_loads_nothing(page: Path, repository: Path):
    text = page.read_text(encoding="utf-8")
    content = load_content()
    assert text.count("<h2") == 2 + len(content.sections)
    places = [text.index(f"<h3>{title}</h3>") for title in VERDICTS.values()]
    assert places == sorted(places)
    assert text.count("<h3") == len(VERDICTS)
    assert places[-1] < text.index("aria-label=Contents")
    links, places = (re.findall(rf'{name}="#?(s\d+)"', text) for name in ("href", "id"))
    assert links == places == [f"s{k + 1}" for k in range(len(content.sections))]
    assert text.count("<figure>") == shown(repository)
    assert all(section.title.replace("'", "&#x27;") in text for section in content.sections)
    assert not re.search(r'(src|href)="(?!data:|#)', text)


def test_missing_results_are_named(tmp_path: Path):
    missing = write_page(tmp_path, tmp_path / "paper.html")
    assert "results/evaluations trot" in missing
    assert {"docs/motor.png", "results/from-scratch/policies group=baseline"} <= set(missing)
    assert "results/search/gait_*.png" in missing
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
    done = subprocess.run([find_chromium(), *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    counted = re.search(r"<title>(\d+) (\d+)</title>", done.stdout)
    assert counted is not None
    assert counted.groups() == (str(shown(repository)),) * 2
    assert "CONSOLE" not in done.stderr
