"""Figure of the reality gap: written, and says what the runs say."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.gap import PolicyGap, Runs
from surefoot.report.gap_figures import gap_figure

matplotlib = pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


def runs(world: str, *returns: float, falls: int = 0) -> Runs:
    gained = np.array(returns)
    fell = np.arange(len(gained)) < falls
    ones = np.ones(len(gained))
    return Runs(world, gained, gained + 1, ones, 20 * ones, 100 * ones, fell, ~fell)


def policy(name: str = "trot", worlds: int = 1, count: int = 3, falls: int = 0, known: bool = True) -> PolicyGap:
    spread = 0.1 * np.arange(count)
    away = [
        runs(f"world {i}", *(2.0 - 0.3 * i - spread) + (0 if known else math.nan), falls=falls) for i in range(worlds)
    ]
    return PolicyGap(name, runs("mujoco", *(3.0 + spread)), tuple(away))


MANY = [policy(f"policy {i}") for i in range(6)]
FIGURES: dict[str, Callable[[Path], Path]] = {
    "one policy": lambda path: gap_figure([policy()], path),
    "two policies": lambda path: gap_figure(
        [policy(), policy("gallop")], path, PolicyGap.pooled("all", [policy(), policy("gallop")])
    ),
    "many policies": lambda path: gap_figure(MANY, path, PolicyGap.pooled("all", MANY)),
    "many worlds": lambda path: gap_figure([policy(worlds=8)], path),
    "one run": lambda path: gap_figure([policy(count=1)], path),
    "many runs": lambda path: gap_figure([policy(count=200)], path),
    "falls": lambda path: gap_figure([policy(falls=2)], path),
    "not known": lambda path: gap_figure([policy(known=False)], path),
    "not known, and falls": lambda path: gap_figure([policy(known=False, falls=1)], path),
    "nothing known": lambda path: gap_figure([PolicyGap("p", runs("a", math.nan), (runs("b", math.nan),))], path),
    "below zero": lambda path: gap_figure([PolicyGap("p", runs("a", -1.0, -2.0), (runs("b", 0.0, 0.0),))], path),
}


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.filterwarnings("error")
def test_a_figure_is_written(name: str, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    path = tmp_path / "deeper" / "gap.png"
    assert FIGURES[name](path) == path
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        assert 0.005 < (np.asarray(picture.convert("L")) < 250).mean() < 0.9
    assert dict(matplotlib.rcParams) == before


def test_falls_worlds_and_gaps_show(tmp_path: Path) -> None:
    shown = [policy(), policy(falls=1), policy(worlds=2), policy(known=False), policy(count=2)]
    pictures = [gap_figure([one], tmp_path / f"{i}.png").read_bytes() for i, one in enumerate(shown)]
    assert len(set(pictures)) == len(shown)
    assert gap_figure([policy()], tmp_path / "again.png").read_bytes() == pictures[0]


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match="0 policies"):
        gap_figure([], tmp_path / "a.png")
    with pytest.raises(SurefootError, match="2 policies in 2 sets of worlds"):
        gap_figure([policy(), policy(worlds=2)], tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []
