"""Figures of a sensitivity study: each is written, and says what the study says."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("gymnasium")

from surefoot.report.sensitivity_figures import COLORS, aggregate_figure, parameter_figure

from surefoot.errors import SurefootError
from surefoot.evaluate.sensitivity import Nominal, Sensitivity, TestWorld

matplotlib = pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")


def study(policy: str = "trot", values: int = 10, episodes: int = 8, falls: bool = True) -> Sensitivity:
    """A made-up study of latency and mass, that falls at the upper end of each."""
    worlds = [TestWorld("latency", float(value)) for value in np.linspace(0.0, 0.04, values)]
    worlds += [TestWorld("mass", float(value)) for value in np.linspace(0.8, 1.2, values)]
    along = np.tile(np.linspace(0.0, 1.0, values), 2)[:, None]
    returns = 3.0 - 2.0 * along + np.linspace(-0.2, 0.2, episodes)
    nominal = Nominal({"latency": 0.02, "mass": 1.0}, np.full(episodes, 2.0), np.zeros(episodes, np.bool_))
    fell = np.broadcast_to(falls & (along > 0.7), returns.shape)
    return Sensitivity(policy, tuple(worlds), returns, fell, returns / 6.0, nominal)


def pixels(path: Path) -> np.ndarray:
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        return np.asarray(picture.convert("RGB")).astype(int)


def has_color(path: Path, color: str) -> bool:
    """Whether some pixels have a colour, to the bit."""
    wanted = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    return bool((pixels(path) == wanted).all(axis=-1).sum() > 20)


TRAINED = {"trot": {}, "gallop": {"latency": (0.01, 0.03)}}
FIGURES: dict[str, Callable[[Path], Path]] = {
    "one policy": lambda path: parameter_figure("latency", [study()], path),
    "two policies": lambda path: parameter_figure("latency", [study(), study("gallop")], path, TRAINED),
    "ten policies": lambda path: parameter_figure("mass", [study(f"policy {i}") for i in range(10)], path, TRAINED),
    "one episode": lambda path: parameter_figure("mass", [study(episodes=1)], path, TRAINED),
    "many values": lambda path: parameter_figure("mass", [study(values=40)], path, TRAINED),
    "one value": lambda path: parameter_figure("latency", [study(values=1)], path, {"trot": {"latency": (0.0, 0.0)}}),
    "no nominal": lambda path: parameter_figure("mass", [replace(study(), nominal=Nominal())], path, TRAINED),
    "aggregate": lambda path: aggregate_figure([study(), study("gallop")], path),
    "aggregate of one": lambda path: aggregate_figure([study(values=1, episodes=1)], path),
    "aggregate without nominal": lambda path: aggregate_figure([replace(study(), nominal=Nominal())], path),
}


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.filterwarnings("error")
def test_a_figure_is_written(name: str, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    path = tmp_path / "deeper" / "figure.png"
    assert FIGURES[name](path) == path
    assert 0.005 < (pixels(path).min(axis=-1) < 250).mean() < 0.9
    assert dict(matplotlib.rcParams) == before


def test_each_policy_has_a_colour_of_its_own(tmp_path: Path) -> None:
    both = parameter_figure("mass", [study(), study("gallop")], tmp_path / "both.png")
    assert has_color(both, COLORS[0])
    assert has_color(both, COLORS[1])
    assert not has_color(both, COLORS[2])


def test_a_policy_keeps_its_colour_where_another_lacks_the_row(tmp_path: Path) -> None:
    lacking = study()
    lacking = replace(
        lacking,
        worlds=lacking.worlds[:10],
        returns=lacking.returns[:10],
        fell=lacking.fell[:10],
        speed=lacking.speed[:10],
    )
    path = parameter_figure("mass", [lacking, study("gallop")], tmp_path / "mass.png")
    assert has_color(path, COLORS[1])
    assert not has_color(path, COLORS[0])


def test_falls_and_training_show(tmp_path: Path) -> None:
    pictures = [
        parameter_figure("latency", [study("gallop", falls=falls)], tmp_path / f"{i}.png", trained)
        for i, (falls, trained) in enumerate(
            [(True, None), (False, None), (True, {}), (True, TRAINED), (True, {"gallop": {"latency": (0.0, 0.04)}})]
        )
    ]
    assert len({path.read_bytes() for path in pictures}) == 5


def test_the_same_study_gives_the_same_bytes(tmp_path: Path) -> None:
    first = aggregate_figure([study()], tmp_path / "a.png")
    second = aggregate_figure([study()], tmp_path / "b.png")
    assert first.read_bytes() == second.read_bytes()


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match="row 'voltage' is in none of the 1 studies given"):
        parameter_figure("voltage", [study()], tmp_path / "a.png")
    with pytest.raises(SurefootError, match="no study is given"):
        aggregate_figure([], tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []
