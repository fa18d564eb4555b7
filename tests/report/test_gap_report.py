"""Figures and report of groups' reality gaps: what is drawn and told follows from the numbers."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

pytest.importorskip("matplotlib")
from PIL import Image
from surefoot.evaluate.gap_groups import gap_groups
from surefoot.evaluate.tables import write_tables
from surefoot.report.gap_bars import gap_bars
from surefoot.report.gap_report import gap_text

from surefoot.errors import SurefootError
from surefoot.evaluate.comparison import Comparison
from surefoot.evaluate.gap import Estimate, plus_minus
from surefoot.report.study_report import write_report

MakeComparison = Callable[..., Comparison]


def test_a_pair_of_bars_stands_for_each_group(tmp_path: Path, gap_comparison: MakeComparison) -> None:
    for seeds in (1, 5):
        groups = list(gap_groups(gap_comparison(seeds), 3).values())
        with Image.open(gap_bars(groups, tmp_path / f"gap_{seeds}.png", "Gaps")) as image:
            image.load()
            assert image.width > 600
            assert len(image.convert("RGB").getcolors(1 << 24)) > 20
    with pytest.raises(SurefootError, match="no groups"):
        gap_bars([], tmp_path / "none.png")


def test_the_report_tells_gaps_and_what_others_found(tmp_path: Path, gap_comparison: MakeComparison) -> None:
    study = gap_comparison()
    write_tables(study, tmp_path)
    text = write_report(study, tmp_path, "surefoot study gaps.yaml").read_text()
    for file in re.findall(r"\]\(([^)]+)\)", text):
        assert (tmp_path / file).exists(), file
    assert "](gap_both.png)" in text
    assert "](gap_others.png)" in text
    assert "](learning_curves_both.png)" in text
    assert "The top three policies of each group, together nine runs of a group in each world:" in text
    # What was found of a set is told with it, though one of its groups has no policies yet.
    assert "In the paper, all was well." in text
    assert re.search(
        r"\*\*second\*\*, against \*\*first\*\*: the gap is 1\.30 m smaller \(-1\.30 ± 0\.\d\d m over runs; "
        r"over policies and robots -1\.30 \[-\d\.\d\d, .\d\.\d\d\] m, which .* zero\); the return away changes by "
        r"\+\d\.\d\d \[.*\] m\. Of all their policies: .* "
        r"In the paper, the second did better\.",
        text,
    )
    assert "The same of all policies of the groups:" in text
    assert re.search(r"\| first \| 4, 3, 2 \| .* \| 1\.30 ± 0\.\d\d \| 1\.30 \[-?\d\.\d\d, \d\.\d\d\] \|", text)
    assert "fewer than three" not in text


def test_a_group_that_falls_at_home_is_marked(gap_comparison: MakeComparison) -> None:
    text = "\n".join(gap_text(gap_comparison()))
    assert "**third** keeps its balance at home in only three of nine runs" in text
    assert "**second** keeps" not in text


def test_pairs_of_no_set_are_told_at_the_end(gap_comparison: MakeComparison) -> None:
    parts = gap_text(gap_comparison())
    assert parts.index("### Other differences") == len(parts) - 2
    assert parts[-1].startswith("**third**, against **first**: the gap is 1.30 m smaller")


def test_few_policies_claim_no_interval(gap_comparison: MakeComparison) -> None:
    parts = gap_text(replace(gap_comparison(seeds=1), bars={}))
    assert "**Some groups have fewer than three evaluated policies yet.**" in parts
    assert "### Groups" in parts
    text = "\n".join(parts)
    assert "too few policies or robots for an interval" in text
    assert "zero" not in text.split("### Groups")[1]
    # The best are all there are, so one table tells both.
    assert "The same of all policies" not in text


def test_errors_stand_behind_means() -> None:
    assert plus_minus(Estimate(1.234, 0.056)) == "1.23 ± 0.06"
    assert plus_minus(Estimate(-0.001, 0.056), sign=True) == "0.00 ± 0.06"
    assert plus_minus(Estimate(0.5, float("nan")), 1, sign=True) == "+0.5"
