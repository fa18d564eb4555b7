"""Measured numbers on pages agree with the result files: the claims in docs/claims.yaml, and the paper's scorecard."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from result_numbers import COMBINED, find_row, find_value, read_rows

from surefoot.configuration import from_mapping, read_yaml

ROOT = Path(__file__).resolve().parents[1]
WORDS = {"one": 1, "two": 2, "three": 3, "four": 4, "five": 5, "six": 6, "ten": 10, "twelve": 12, "forty": 40}
NUMBER = re.compile(rf"(?<![\w.-])\d+(?:\.\d+)?(?![\w.]*\w)|\b(?:{'|'.join(WORDS)})\b", re.IGNORECASE)


@dataclass(frozen=True)
class Number:
    """Source of a number in a claim: its place in the results, or a setting."""

    file: str = ""
    row: dict[str, Any] = field(default_factory=dict)
    excluded: dict[str, Any] = field(default_factory=dict)
    column: str = ""
    of: str = ""
    times: float = 1.0
    tolerance: float | None = None
    setting: float | None = None

    def measured(self, root: Path) -> float:
        """Return the number at the source.

        Raises:
            AssertionError: there is no row, several rows without `of`, or no such column.
        """
        if self.setting is not None:
            return self.setting
        path = root / "results" / self.file
        if path.suffix != ".csv":
            return self.times * float(find_value(find_row(path, {}), self.column))
        rows = [row for row in read_rows(path, {}) if holds(row, self.row) and not holds_any(row, self.excluded)]
        if not self.column:
            return self.times * len(rows)
        assert len(rows) == 1 or (rows and self.of), f"{self.file} has {len(rows)} rows of {self.row}"
        values = [float(row[self.column]) for row in rows]
        return self.times * (COMBINED[self.of](values) if self.of else values[0])


def among(row: dict[str, str], column: str, values: Any) -> bool:
    """Return whether a row has one of the values in a column."""
    assert column in row, f"no column {column}"
    return row[column] in [str(value) for value in (values if isinstance(values, list) else [values])]


def holds(row: dict[str, str], selected: dict[str, Any]) -> bool:
    """Return whether a row has the selected values in all columns."""
    return all(among(row, column, values) for column, values in selected.items())


def holds_any(row: dict[str, str], excluded: dict[str, Any]) -> bool:
    """Return whether a row has an excluded value in any column."""
    return any(among(row, column, values) for column, values in excluded.items())


def wrong(root: Path, claim: dict[str, Any]) -> list[str]:
    """Return the errors of a claim: its text is not on the page, or a number differs from its source."""
    text = " ".join(claim["text"].split())
    page = " ".join((root / claim["page"]).read_text(encoding="utf-8").split())
    if text not in page.replace("**", ""):
        return [f"{claim['page']} does not have: {text}"]
    printed = NUMBER.findall(text)
    sources = [
        from_mapping(Number, {"excluded" if key == "not" else key: value for key, value in one.items()})
        for one in claim["numbers"]
    ]
    if len(printed) != len(sources):
        return [f"{claim['page']}: {len(sources)} sources for the numbers {printed}"]
    found = []
    for number, source in zip(printed, sources, strict=True):
        value, measured = float(WORDS.get(number.lower(), 0) or number), source.measured(root)
        digits = len(number.partition(".")[2])
        tolerance = 0.5 * 10.0**-digits if source.tolerance is None else source.tolerance
        if not abs(value - measured) <= tolerance + 1e-9:
            found.append(f"{claim['page']}: '{text}' has {number}, {source.file or 'its setting'} has {measured:.6g}")
    return found


CLAIMS: list[dict[str, Any]] = read_yaml(ROOT / "docs" / "claims.yaml")["claims"]


@pytest.mark.parametrize("claim", CLAIMS, ids=[f"{one['page']}: {one['text'][:40]}" for one in CLAIMS])
def test_a_claim_is_on_its_page_and_rounds_to_its_source(claim: dict[str, Any]):
    assert wrong(ROOT, claim) == []


def scorecard_differences(root: Path) -> list[str]:
    """Return where README and pages of results contradict tools/paper.yaml."""
    from paper_page import VERDICTS, claims_markdown, claims_summary, load_content

    reproduction, results, readme = (
        (root / name).read_text(encoding="utf-8") for name in ("docs/reproduction.md", "docs/results.md", "README.md")
    )
    found = []
    for verdict, title in VERDICTS.items():
        expected = f"\n### {title}\n\n{claims_markdown(root, verdict)}\n"
        if expected not in reproduction:
            found.append(f"docs/reproduction.md does not have:{expected}")
    summary = claims_summary()
    found += [
        f"{name} does not have: {summary}"
        for name, text in (("docs/reproduction.md", reproduction), ("docs/results.md", results))
        if summary not in " ".join(text.split())
    ]
    paper = " ".join(readme.partition("## The paper\n")[2].partition("\n## ")[0].replace("**", "").split())
    sentences = re.split(r"(?<=[.)]) (?=[A-Z])", paper)
    words = {
        "reproduced": "surefoot reproduces",
        "same": "same direction, not significant",
        "mixed": "mixed evidence",
        "differs": "differ",
        "untestable": "not testable without a robot",
    }
    for claim in (one for one in load_content().claims if one.readme):
        said = [one for one in sentences if claim.readme in one]
        if len(said) != 1 or words[claim.verdict] not in said[0]:
            found.append(f"README.md has {said}; '{claim.readme}' is: {words[claim.verdict]}")
    return found


def test_pages_have_the_scorecard_of_the_paper():
    """README, results and reproduction classify every claim of the paper like `surefoot study paper`."""
    pytest.importorskip("matplotlib")
    assert scorecard_differences(ROOT) == []


@pytest.mark.parametrize(
    ("page", "old", "new"),
    [
        ("docs/reproduction.md", "18 of 27 that", "18 of 28 that"),
        ("docs/results.md", "Of 22 claims", "Of 23 claims"),
        ("README.md", "twelve observations beat", "twelve observations are worse than"),
        ("README.md", "**differ**", "are as in the paper"),
    ],
)
def test_a_different_verdict_on_a_page_is_detected(tmp_path: Path, page: str, old: str, new: str):
    pytest.importorskip("matplotlib")
    (tmp_path / "docs").mkdir()
    (tmp_path / "results").symlink_to(ROOT / "results")
    for name in ("docs/reproduction.md", "docs/results.md", "README.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        (tmp_path / name).write_text(text.replace(old, new) if name == page else text)
    assert scorecard_differences(ROOT) == []
    assert len(scorecard_differences(tmp_path)) in (1, 2)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Page with four numbers, and the results that contain them."""
    (tmp_path / "results").mkdir()
    (tmp_path / "README.md").write_text("It goes **0.66** m/s and fell in 3 of\nfive runs (95 % of 18.4 W).\n")
    rows = ["name,speed,falls", "a,0.6615,1", "b,0.7,2", "c,0.9,9", "d,0.9,9", "e,0.9,9"]
    (tmp_path / "results" / "runs.csv").write_text("\n".join(rows) + "\n")
    (tmp_path / "results" / "power.json").write_text('{"trot": {"power": 0.01841}}')
    return tmp_path


CLAIM = {
    "page": "README.md",
    "text": "It goes 0.66 m/s and fell in 3 of five runs (95 % of 18.4 W).",
    "numbers": [
        {"file": "runs.csv", "row": {"name": "a"}, "column": "speed"},
        {"file": "runs.csv", "row": {"name": ["a", "b"]}, "column": "falls", "of": "sum"},
        {"file": "runs.csv", "not": {"name": "z"}},
        {"setting": 95},
        {"file": "power.json", "column": "trot.power", "times": 1000},
    ],
}


def test_a_correct_claim_has_no_errors(root: Path):
    assert wrong(root, CLAIM) == []


@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("README.md", "0.66", "0.67", "does not have"),
        ("README.md", "five", "six", "does not have"),
        ("results/runs.csv", "0.6615", "0.6651", "has 0.66, runs.csv has 0.6651"),
        ("results/runs.csv", "b,0.7,2", "b,0.7,3", "has 3, runs.csv has 4"),
        ("results/runs.csv", "e,0.9,9\n", "", "has five, runs.csv has 4"),
        ("results/power.json", "1841", "1846", "has 18.4, power.json has 18.46"),
    ],
)
def test_a_changed_digit_is_detected(root: Path, file: str, old: str, new: str, says: str):
    text = (root / file).read_text()
    assert text.count(old) == 1
    (root / file).write_text(text.replace(old, new))
    (found,) = wrong(root, CLAIM)
    assert says in found


def test_every_number_of_a_text_has_a_source(root: Path):
    (found,) = wrong(root, {**CLAIM, "numbers": CLAIM["numbers"][1:]})
    assert "4 sources for the numbers ['0.66', '3', 'five', '95', '18.4']" in found


@pytest.mark.parametrize("row", [{"name": "x"}, {"falls": 9}, {"speeds": 1}])
def test_a_source_selects_one_row(root: Path, row: dict[str, Any]):
    with pytest.raises(AssertionError):
        Number("runs.csv", row, column="speed").measured(root)
