"""Positional arguments and values of options; long errors are reported in one short line."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest
from processes import assert_rejected, surefoot

pytest.importorskip("mujoco")

from surefoot.cli.helpers.parsing import positional_words


def test_error_is_one_short_line_without_control_characters(tmp_path: Path):
    path = tmp_path / "a.yaml"
    path.write_text(f'"\\e[2J{"x" * 100_000}": 1\n')
    done = surefoot("evaluate", "trot", "--randomize", path)
    assert_rejected(done)
    assert len(done.stderr) < 2500
    assert "\033" not in done.stderr


@dataclass(frozen=True)
class Options:
    name: str = ""
    loud: bool = False
    values: tuple[float, ...] = ()


@pytest.mark.parametrize(
    ("line", "found"),
    [
        ("a b", "a b"),
        ("--name a b", "b"),
        ("--name=a b", "b"),
        ("--loud a --name b", "a"),
        ("--no-such a b --help c", "b c"),
        ("--values 1 2 a", "2 a"),
        ("--loud", ""),
    ],
)
def test_positional_words_exclude_values_of_options(line: str, found: str):
    assert positional_words(line.split(), Options) == found.split()


def test_a_pattern_that_matches_several_runs_is_rejected(tmp_path: Path):
    for name in ("first", "second"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "run.json").write_text("{}")
    done = surefoot("show", tmp_path / "first", tmp_path / "second")
    assert_rejected(done)
    assert "several runs" in done.stderr
    assert "several runs" not in surefoot("show", "trot", "more").stderr
