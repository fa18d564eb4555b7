"""The page of the paper: numbers from files of results, in words, and the page as a browser shows it."""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
from chromium import CHROMIUM, in_browser

pytest.importorskip("matplotlib")

from surefoot.errors import SurefootError
from surefoot.evaluate.statistics import Interval, MeanEstimate
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
            if not isinstance(item.ours, str):
                yield item.ours


def test_every_number_of_the_page_is_among_the_results(repository: Path):
    for one in sources():
        if not (repository / one.file).parent.is_dir():
            assert Path(one.file).parts[1] in ("from-scratch", "search")
        elif isinstance(one, NumberSource):
            assert math.isfinite(find_number(repository, one).mean), one
        else:
            assert find_counts(repository, one), one


STUDY = {
    "policies.csv": """group,seed,gait,pattern
baseline,0,walk,lateral-sequence walk
baseline,1,trot,walking trot
baseline,2,walk,lateral-sequence walk
improved,0,gallop,rotary gallop
improved,1,gallop,rotary gallop
improved,2,gallop,transverse gallop
""",
    "groups.csv": """group,figure,mean,low,high
baseline,nominal_speed,0.31,0.22,0.4
baseline,nominal_falls,5,0,14
improved,nominal_speed,2.01,1.3,2.72
improved,nominal_falls,0,0,0
""",
}
SEARCH = {
    "trials.csv": """trial,state,return,gait,pattern
0,complete,5.1,gallop,rotary gallop
1,pruned,1.2,pace,walking pace
2,complete,4.0,gallop,transverse gallop
3,complete,4.9,bound,bound
4,fail,,,
5,pruned,0.4,other,other
""",
    "top.csv": """rank,claimed,fresh,fresh_low,fresh_high,selection_bias,selection_bias_low,selection_bias_high,\
mujoco_speed_mean,mujoco_speed_error,mujoco_success_rate,bullet_return_mean,bullet_return_error,bullet_success_rate
1,5.1,4.71,4.6,4.82,0.39,0.28,0.5,2.1,0.01,1,4.41,0.11,1
2,4.9,4.61,4.5,4.72,0.29,0.18,0.4,2,0.01,1,4.31,0.12,0.9
3,4,4.08,3.9,4.26,-0.08,-0.26,0.1,1.9,0.01,0.9,3.31,0.13,0.8
all,4.667,4.467,4.1,4.8,0.2,-0.41,0.81,2.02,0.02,0.967,4.01,0.09,0.9
""",
}
DRAWN = {
    "from-scratch": ("gait_baseline", "gait_improved"),
    "search": ("gait_gallop", "gait_other", "gait_pace", "search", "parameters"),
}


@pytest.fixture(scope="module")
def root(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The results that ship, but a study from scratch and a search whose numbers are made up."""
    folder = tmp_path_factory.mktemp("root")
    for name in ("docs", "policies"):
        (folder / name).symlink_to(repository / name)
    (folder / "results").mkdir()
    for path in (repository / "results").iterdir():
        if path.name not in DRAWN:
            (folder / "results" / path.name).symlink_to(path)
    for name, tables in (("from-scratch", STUDY), ("search", SEARCH)):
        (folder / "results" / name).mkdir()
        for file, text in tables.items():
            (folder / "results" / name / file).write_text(text)
        for drawn in DRAWN[name]:
            shutil.copy(repository / "docs" / "motor.png", folder / "results" / name / f"{drawn}.png")
    return folder


@pytest.fixture(scope="module")
def page(root: Path) -> Path:
    """The page of these results."""
    assert write_page(root, root / "paper.html") == []
    return root / "paper.html"


def shown(root: Path) -> int:
    """Return how many pictures the page has."""
    return sum(len(one.find_files(root)) for section in load_content().sections for one in section.pictures)


def lines(page: Path, title: str) -> dict[str, list[str]]:
    """Return the cells of a section's lines by their first one."""
    (section,) = (part for part in page.read_text(encoding="utf-8").split("<h2>") if part.startswith(title))
    rows = (re.findall(r"<td[^>]*>(.*?)</td>", row) for row in section.split("<tr>"))
    return {row[0]: row[1:] for row in rows if row}


def test_the_page_shows_gaits_from_scratch_beside_those_of_the_paper(page: Path):
    cells = lines(page, "Section VI-A: from scratch")
    assert cells["baseline: gaits of the policies"][:2] == ["a slow walk", "2 lateral-sequence walk, 1 walking trot"]
    assert cells["baseline: speed in simulation"][1] == "0.31 [0.22, 0.40] m/s"
    assert cells["baseline: episodes with a fall in simulation"][1] == "5 [0, 14] %"
    assert cells["improved: gaits of the policies"][:2] == ["gallop", "2 rotary gallop, 1 transverse gallop"]
    numbers = ["1.34 m/s", "2.01 [1.30, 2.72] m/s", "the interval holds the paper&#x27;s"]
    assert cells["improved: speed in simulation"][:3] == numbers
    assert "over three seeds" in cells["improved: speed in simulation"][3]


def test_the_page_shows_the_best_of_a_search_and_their_selection_bias(page: Path):
    cells = lines(page, "Section VI-B: a hundred controllers")
    assert cells["trials"][:2] == ["100 a group", "3 complete, 2 pruned, 1 fail"]
    returns = {name: words[1] for name, words in cells.items() if ": return" in name}
    assert list(returns.values()) == [
        *("5.10 m", "4.71 [4.60, 4.82] m", "4.41 ± 0.11 m"),
        *("4.90 m", "4.61 [4.50, 4.72] m", "4.31 ± 0.12 m"),
        *("4.00 m", "4.08 [3.90, 4.26] m", "3.31 ± 0.13 m"),
        "0.200 [-0.410, 0.810] m",
    ]
    assert cells["top three: speed at home"][:3] == ["1.34 m/s", "2.02 ± 0.02 m/s", "51% more"]
    assert cells["top three: episodes with balance kept, at home"][1] == "97 %"
    assert cells["top three: episodes with balance kept, in Bullet"][1] == "90 %"


def test_the_gaits_of_a_search_are_counted_and_each_is_drawn(page: Path):
    cells = lines(page, "Section VI-A: gaits that emerge")
    assert cells["gaits, all policies"][1] == "2 gallop, 1 pace, 1 bound, 1 other"
    assert cells["gaits, policies trained to the end"][1] == "2 gallop, 1 bound"
    assert cells["the same, in more words"][1] == "1 rotary gallop, 1 transverse gallop, 1 bound"
    text = page.read_text(encoding="utf-8")
    assert re.findall(r"Footfalls: (\w+)</figcaption>", text) == ["gallop", "other", "pace"]


def test_the_page_holds_every_section_number_and_picture_and_loads_nothing(page: Path, root: Path, repository: Path):
    text = page.read_text(encoding="utf-8")
    content = load_content()
    assert text.count("<h2>") == 1 + len(content.sections)
    assert text.count("<figure>") == shown(root)
    assert all(section.title.replace("'", "&#x27;") in text for section in content.sections)
    speed = json.loads((repository / "results/policies/trot.json").read_text())["speed_mean"]
    assert f"{speed:.2f} ± " in text
    assert not re.search(r'(src|href)="(?!data:)', text)


def test_missing_results_are_named(tmp_path: Path):
    missing = write_page(tmp_path, tmp_path / "paper.html")
    assert "results/policies/trot.json" in missing
    assert {"docs/motor.png", "results/from-scratch/policies.csv", "results/search/gait_*.png"} <= set(missing)
    assert "not measured" in (tmp_path / "paper.html").read_text(encoding="utf-8")


@in_browser
def test_a_browser_shows_every_picture_without_an_error(page: Path, root: Path):
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
    assert counted.groups() == (str(shown(root)), str(shown(root)))
    assert "CONSOLE" not in done.stderr
