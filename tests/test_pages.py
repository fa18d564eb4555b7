"""Measured numbers of pages with markers are read from files of results: see docs/page_numbers.py.

Those of README and docs/why.md are in docs/claims.yaml: see tests/test_claims.py.
"""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import pytest

pytest.importorskip("pandas")

from surefoot.configuration import read_yaml
from surefoot.errors import SurefootError

ROOT = Path(__file__).resolve().parents[1]
RESULTS = [
    "policies/README.md",
    *(
        f"docs/{name}.md"
        for name in (
            *("terrain", "go2", "deploy", "firmware", "show"),
            *("results", "robustness", "reality-gap", "study", "handcrafted", "robots", "steer"),
            *("speed", "adopt", "identification", "real-robot", "search"),
        )
    ),
]
"""Pages with results and markers."""
UNIT = (
    r"(?:%|(?:km|kN|kg|kHz|ms|mm|cm|mJ|dB|degC|deg|rad|million|minutes?|seconds?|hours?|MB|kB|[NWmsJVAMhHg]|Hz)"
    r"(?:/\w+)?\b)"
)
NUMBER = re.compile(rf"(?<![\w.,/-])[+-]?(?:\d+\s+of\s+\d+|(?:\d[\d,]*)?\.\d+(?:\s*{UNIT})?|\d[\d,]*\s*{UNIT})")
CODE = re.compile(
    r"^```.*?^```|(?:\A|\n)\n(?:    [^\n]*\n|\n)+|`(?:[^`\n]|\n(?!\n))+`|\]\([^)]*\)", re.DOTALL | re.MULTILINE
)


def load_script(path: str) -> ModuleType:
    """Return a script of the repository as a module."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def numbers() -> ModuleType:
    """Return docs/page_numbers.py."""
    return load_script("docs/page_numbers.py")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """Return a root with files of results."""
    (tmp_path / "results" / "pushes").mkdir(parents=True)
    rows = ["name,speed,fell,falls,episodes,gait", "trot,0.6615,0.27,27,100,trot", "b/bullet,-2.05,0,1,20,other"]
    (tmp_path / "results" / "runs.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "results" / "pushes" / "calm.json").write_text('{"falls": 3, "episodes": 64, "rmse": {"yaw": 0.098}}')
    (tmp_path / "results" / "found.toml").write_text("[params]\nfriction = [0.25, 0.5]  # N m\n")
    return tmp_path


@pytest.mark.parametrize(
    ("stale", "new"),
    [
        (".6<!--= runs trot: speed --> m/s", ".7"),
        ("0.61<!--= runs trot: speed -->", "0.66"),
        ("goes 2<!--= runs trot: speed -->", "goes 1"),
        ("+.10<!--= runs trot: speed -->", "+.66"),
        ("(3.000<!--= runs name=b/bullet,gait=other: speed -->", "(-2.050"),
        ("1 of 2<!--= runs trot: falls -->", "27 of 100"),
        ("1 of 2<!--= pushes/calm: falls -->", "3 of 64"),
        ("| .1<!--= pushes/calm: rmse.yaw -->", "| .1"),
        ("9 %<!--= runs trot: fell x100 -->", None),
        ("9<!--= runs trot:\nfell x100 --> %", "27"),
        ("in 2018, .1, .2<!--= runs trot; b/bullet: speed -->", "in 2018, .7, -2.0"),
        ("1 of 2<!--= runs trot; b/bullet: sum falls -->", "28 of 120"),
        ("1.00<!--= runs trot; b/bullet: sd speed -->", "1.92"),
        ("walk<!--= runs trot: gait -->", "trot"),
        ("1.0<!--= runs all fell=0: min speed -->", "-2.0"),
        ("1.0<!--= runs all episodes=100; b/bullet: max speed -->", ".7"),
        ("1.1<!--= found: params.friction.1 -->", ".5"),
    ],
)
def test_a_marker_writes_the_number_before_it_in_its_format(
    numbers: ModuleType, results: Path, stale: str, new: str | None
):
    if new is None:
        with pytest.raises(SurefootError, match="line 1: no number stands before"):
            numbers.write_page(results, stale)
        return
    written = numbers.write_page(results, f"A page.\n{stale}\n")
    assert written == f"A page.\n{new}{stale[stale.index('<!--') :]}\n"
    assert numbers.write_page(results, written) == written


@pytest.mark.parametrize(
    ("marker", "pieces"),
    [
        ("1<!--= run trot: speed -->", "results has no file run.csv or run.json"),
        ("1<!--= runs trott: speed -->", "line 2: results/runs.csv: has 0 rows of name trott"),
        ("1<!--= runs all gait=pace: max speed -->", "results/runs.csv: has no rows of gait=pace"),
        ("1<!--= found: params.friction.2 -->", "has no params.friction.2"),
        ("1<!--= runs trot: sped -->", "has no sped"),
        ("1<!--= runs trot: gait -->", "is no number: trot"),
        ("1<!--= runs trot speed -->", "is no source"),
    ],
)
def test_a_marker_without_a_source_is_reported_with_its_line(
    numbers: ModuleType, results: Path, marker: str, pieces: str
):
    with pytest.raises(SurefootError, match=re.escape(pieces)):
        numbers.write_page(results, f"A page.\n{marker}\n")


def test_a_table_is_generated_from_its_lines(numbers: ModuleType, results: Path):
    page = """<!-- table of: trot = a trot, b/bullet = Bullet
| policy | speed | falls |
|---|---|---|
| {1} (`{0}`) | {runs {0}: speed .2} | {runs {0}: falls of episodes} |
| both | {runs trot; b/bullet: mean speed +0.1} | {runs trot; b/bullet: falls} |
-->
OLD<!-- end of table -->

<!-- table of: all of runs
- {0}: {runs {0}: gait}
-->
<!-- end of table -->
"""
    first = """| policy | speed | falls |
|---|---|---|
| a trot (`trot`) | .66 | 27 of 100 |
| Bullet (`b/bullet`) | -2.05 | 1 of 20 |
| both | -0.7 | 27, 1 |
"""
    expected = page.replace("OLD", first).replace("-->\n<!-- end", "-->\n- trot: trot\n- b/bullet: other\n<!-- end")
    assert numbers.write_page(results, page) == expected
    assert numbers.write_page(results, expected) == expected
    assert numbers.changes("a\nb\n", "a\nc\n") == ["2: has 'b', the results 'c'"]


def stray_numbers(text: str, numbers: ModuleType) -> list[str]:
    """Return the measured numbers of a page that have no source, and what it declares as given but does not have."""
    given = [
        " ".join(one.split()) for part in re.findall(r"<!-- given:(.*?)-->", text, re.DOTALL) for one in part.split(";")
    ]
    text = numbers.CLAIMS.sub("", text)
    text = numbers.TABLE.sub(lambda match: re.sub(r"\{[^{}]*(\{\d\}[^{}]*)*\}", "cell", match[3]), text)
    text = re.sub(rf"(?:{numbers.TOKEN},\s+)*{numbers.TOKEN}<!--=.*?-->", "", text, flags=re.DOTALL)
    text = CODE.sub("\n\n", re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL))
    found = [" ".join(match.split()) for match in NUMBER.findall(text)]
    return [one for one in found if one not in given] + [f"given: {one}" for one in given if one not in found]


@pytest.mark.parametrize(
    ("text", "stray"),
    [
        ("It goes .66 m/s, in table 2 of 2018.", [".66 m/s", "2 of 2018"]),
        ("It goes .66<!--= runs trot: speed --> m/s and weighs 7 kg.", ["7 kg"]),
        ("<!-- given: .66 m/s; 3 of\n20 -->Of .66 m/s, 3\nof 20.", []),
        ("<!-- given: 5 % -->\nAt 60 W.", ["60 W", "given: 5 %"]),
        (
            "Type `--force 60.5`, see [1.5 m](a.md#1.5):\n\n    --steps 3.5\n\nThen 3 steps\n    or 1.5.\n",
            ["1.5 m", "1.5"],
        ),
        (
            "<!-- table of: a = .5 m\n| {0} | at 9 N | {runs {0}: speed .2} |\n-->\n| 1.5 |\n<!-- end of table -->",
            ["9 N"],
        ),
        (
            "<!-- table of: a\n| `{0}` | {runs {0}: speed} |\n-->\n<!-- end of table -->\nAt `a` 1.5, `b` 2.5.",
            ["1.5", "2.5"],
        ),
        ("```\n1.5\n```\nIn 40 to 60 steps, 1,000,000 of them, MuJoCo 3.3", ["3.3"]),
    ],
)
def test_numbers_without_a_source_are_found(numbers: ModuleType, text: str, stray: list[str]):
    assert stray_numbers(text, numbers) == stray


def pages() -> list[Path]:
    return [path for pattern in ("policies/README.md", "docs/*.md") for path in sorted(ROOT.glob(pattern))]


@pytest.mark.parametrize("page", [path.relative_to(ROOT).as_posix() for path in pages()])
def test_a_page_is_as_the_results_are(numbers: ModuleType, page: str):
    text = (ROOT / page).read_text(encoding="utf-8")
    assert numbers.changes(text, numbers.write_page(ROOT, text)) == [], "run docs/page_numbers.py"
    if page in RESULTS:
        assert stray_numbers(text, numbers) == []


def test_evaluations_are_of_the_policies_and_options_that_are_named():
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
    """`make docs` refuses others; it is no part of `make test`."""
    listed = re.findall(r"[\w/-]+\.md", (ROOT / "mkdocs.yml").read_text())
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    packages = {f"reference/{path.parent.name}.md" for path in ROOT.glob("src/surefoot/*/__init__.py")}
    assert not (pages | packages) - set(listed)
