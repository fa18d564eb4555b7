"""Figures show their data, and leave matplotlib's global state as it was."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

pytest.importorskip("gymnasium")
pytest.importorskip("matplotlib")
import matplotlib
from matplotlib.figure import Figure
from run_tables import policy_gap, runs_table, sensitivity_table

from surefoot.errors import SurefootError
from surefoot.evaluation.gap import PolicyGap
from surefoot.evaluation.sensitivity import Sensitivity
from surefoot.report.figures.gap import gap_figure
from surefoot.report.figures.learning import learning_curves
from surefoot.report.figures.parameters import aggregate_figure, parameter_figure, parameters_figure
from surefoot.report.figures.runs import _mean_power, episode_plot, footfall_diagram, side_by_side
from surefoot.report.figures.tracking import tracking_figure
from surefoot.robot import RobotDescription
from surefoot.studies.comparison import Comparison
from surefoot.studies.report import group_figure
from surefoot.task.trace import EpisodeTrace

pytestmark = pytest.mark.filterwarnings("error")
MakeRun = Callable[..., EpisodeTrace]
MakeComparison = Callable[..., Comparison]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Record the figures written during a test, and check that matplotlib's settings are unchanged afterwards."""
    figures: list[Figure] = []
    save, before = Figure.savefig, dict(matplotlib.rcParams)

    def keep(figure: Figure, *arguments: Any, **options: Any) -> None:
        save(figure, *arguments, **options)
        figures.append(figure)

    monkeypatch.setattr(Figure, "savefig", keep)
    yield figures
    assert dict(matplotlib.rcParams) == before


def heights(figure: Figure) -> list[float]:
    """Return the heights of the bars in the first panel, without bars that only create legend entries."""
    return [float(bar.get_height()) for bar in figure.axes[0].patches if bar.get_height()]


def lines(figure: Figure, panel: int, length: int = 2) -> list[list[float]]:
    """Return the values of all lines in a panel with at least a given number of points."""
    plotted = [np.asarray(line.get_ydata(), float) for line in figure.axes[panel].lines]
    return [values.tolist() for values in plotted if values.size >= length]


def trot(make_run: MakeRun, steps: int = 700, with_distance: bool = True) -> EpisodeTrace:
    """Return a synthetic trot; without `with_distance`, its position and foot contacts are unknown."""
    time, rng = 0.006 * np.arange(1, steps + 1), np.random.default_rng(0)
    phases, gap = np.array([0.0, 0.5, 0.5, 0.0]), 0.0 if with_distance else np.nan
    arrays = {
        "base_position_world": np.outer(np.arange(steps + 1) * 0.006, [0.6, 0.02, 0.0]) + gap,
        "base_quat_world": np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)) + gap,
        "roll_pitch_yaw": 0.05 * rng.normal(size=(steps, 3)),
        "motor_angle": 0.2 * np.sin(time[:, None] * 12 + np.arange(8)),
        "energy": 0.4 * rng.random(steps),
        "foot_contact": ((time[:, None] / 0.5 - phases) % 1.0 < 0.4).astype(float) + gap,
    }
    return make_run(steps=steps, step=0.006, arrays=arrays)


@pytest.mark.parametrize(("steps", "with_distance"), [(700, True), (1, True), (700, False)])
def test_episode_figures_show_footfalls_tilt_angles_and_power(
    steps: int, with_distance: bool, robot: RobotDescription, make_run: MakeRun, tmp_path: Path, drawn: list[Figure]
) -> None:
    trace = trot(make_run, steps, with_distance)
    assert footfall_diagram(trace, tmp_path / "deeper" / "feet.png").exists()
    episode_plot(trace, robot, tmp_path / "episode.png")
    feet, episode = drawn
    # One row per foot; bars of the front left foot start at its touchdowns, every 0.5 s.
    assert [label.get_text().split(" (")[0] for label in feet.axes[0].get_yticklabels()] == [
        *("back right", "front right", "front left", "back left")
    ]
    if steps > 1 and with_distance:
        starts = [path.vertices[:, 0].min() for path in feet.axes[0].collections[2].get_paths()]
        np.testing.assert_allclose(np.diff(starts[1:]), 0.5, atol=0.01)
    roll, pitch = lines(episode, 0, 1)
    np.testing.assert_array_equal([roll, pitch], trace.roll_pitch_yaw[:, :2].T)
    # One second, starting at 2 s if the episode is long enough.
    shown = (trace.time >= min(trace.duration, 2.0) - 1e-9) & (trace.time <= 3.0) if steps > 1 else [0]
    np.testing.assert_array_equal(lines(episode, 4, 1), robot.to_pose(trace.motor_angle[shown])[:, 0].T)
    power = lines(episode, 3, 1)[0]
    assert np.mean(power) == pytest.approx(trace.energy.mean() / 0.006)


def test_figure_is_a_png_with_the_same_bytes_for_the_same_data(make_run: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match=r"must end in \.png"):
        footfall_diagram(trot(make_run), tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []
    first, second = (footfall_diagram(trot(make_run), tmp_path / name) for name in ("a.png", "b.png"))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(("count", "worlds"), [(1, 1), (3, 8), (200, 1)])
def test_gap_figure_has_a_bar_for_each_policy_and_world(
    count: int, worlds: int, tmp_path: Path, drawn: list[Figure]
) -> None:
    away = [runs_table(f"world {i}", *[2.0 - 0.1 * i] * count, falls=i) for i in range(worlds)]
    policy = PolicyGap.from_runs("trot", [runs_table("mujoco", *[3.0] * count), *away])
    gap_figure([policy, replace(policy, name="gallop, slow")], tmp_path / "gap.png")
    expected = [3.0, *(2.0 - 0.1 * i for i in range(worlds))]
    np.testing.assert_allclose(heights(drawn[0]), expected * 2)
    labels = [label.get_text() for label in drawn[0].axes[0].get_xticklabels()]
    assert [label.splitlines()[0] for label in labels] == ["trot", "gallop"]
    assert all("+1.00 m" in label for label in labels)
    fallen = [text.get_text() for text in drawn[0].axes[0].texts if "fell" in text.get_text()]
    assert fallen[: max(worlds - 1, 0)] == [f"{min(i, count)} of {count}\nfell" for i in range(1, worlds)]
    crosses = [line for line in drawn[0].axes[0].lines if line.get_marker() == "x"]
    assert sum(len(line.get_xdata()) for line in crosses) == (2 * sum(range(4)) + 8 * 3 if worlds == 8 else 0) * (
        count == 3
    )


def test_gap_figure_shows_unknown_and_negative_returns(tmp_path: Path, drawn: list[Figure]) -> None:
    gap_figure([policy_gap("p", [1.0], {"b": [math.nan]}, falls=1)], tmp_path / "a.png")
    gap_figure([policy_gap("p", [-1.0, -3.0], {"b": [0.5, 0.5]})], tmp_path / "b.png")
    assert heights(drawn[0]) == [1.0]
    assert "return\nunknown\n1 of 1\nfell" in [text.get_text() for text in drawn[0].axes[0].texts]
    assert heights(drawn[1]) == [-2.0, 0.5]
    assert drawn[1].axes[0].get_ylim()[0] < -3.0


def sensitivity(policy: str = "trot", values: int = 5, episodes: int = 4, level: float = 3.0) -> Sensitivity:
    """Return test worlds of latency and mass; the robot falls at the upper end of both."""
    worlds = [("control_latency", float(value)) for value in np.linspace(0.0, 0.04, values)]
    worlds += [("base_mass_ratio", float(value)) for value in np.linspace(0.8, 1.2, values)]
    along = np.tile(np.linspace(0.0, 1.0, values), 2)[:, None]
    returns = level - 2.0 * along + np.linspace(-0.2, 0.2, episodes)
    fell = np.broadcast_to(along > 0.7, returns.shape)
    nominal = {"control_latency": 0.02, "base_mass_ratio": 1.0}, np.full(episodes, 2.0), np.zeros(episodes, np.bool_)
    return sensitivity_table(policy, worlds, returns, fell, nominal)


def test_parameter_figure_shows_returns_and_falls(tmp_path: Path, drawn: list[Figure]) -> None:
    group = [sensitivity(level=3.0), sensitivity(level=4.0)]
    groups = {"trot": [sensitivity()], "group": group, **{f"other {i}": [sensitivity(episodes=1)] for i in range(9)}}
    parameter_figure("control_latency", groups, tmp_path / "a.png")
    first, second, *_ = lines(drawn[0], 0, 3)
    np.testing.assert_allclose(first, np.linspace(3.0, 1.0, 5))
    np.testing.assert_allclose(second, np.linspace(3.5, 1.5, 5))
    assert lines(drawn[0], 1, 3)[0] == [0, 0, 0, 100, 100]
    band = drawn[0].axes[0].collections[1].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (pytest.approx(1.0), pytest.approx(4.0))
    parameters_figure(groups, tmp_path / "all.png")
    assert [ax.get_title(loc="left") for ax in drawn[1].axes] == ["Control latency (s)", "Base mass ratio"]
    np.testing.assert_allclose(lines(drawn[1], 1, 3)[1], np.linspace(3.5, 1.5, 5))
    assert len({ax.get_ylim() for ax in drawn[1].axes}) == 1


def test_parameter_figure_shades_the_trained_range(tmp_path: Path, drawn: list[Figure]) -> None:
    groups = {"trot": [sensitivity()], "gallop": [sensitivity("gallop")]}
    parameter_figure(
        "control_latency", groups, tmp_path / "a.png", {"trot": {}, "gallop": {"control_latency": (0.01, 0.03)}}
    )
    (span,) = drawn[0].axes[0].patches
    assert (span.get_x(), span.get_width()) == (pytest.approx(0.01), pytest.approx(0.02))
    # The nominal value and the trot's training value are marked.
    assert [line.get_xdata()[0] for line in drawn[0].axes[0].lines if len(line.get_xdata()) == 2] == [0.02, 0.02]


def test_aggregate_figure_shows_the_return_over_all_test_worlds(tmp_path: Path, drawn: list[Figure]) -> None:
    few = sensitivity("gallop", values=1, episodes=1)
    aggregate_figure([sensitivity(), few], tmp_path / "a.png")
    widths = [bar.get_width() for bar in drawn[0].axes[0].patches]
    assert widths == pytest.approx([2.0, few.mean])
    assert sorted(drawn[0].axes[0].lines[0].get_xdata()) == pytest.approx(sorted([3.0, 2.5, 2.0, 1.5, 1.0] * 2))


def test_parameter_figure_rejects_a_parameter_that_was_not_varied(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match="no test world of trot varies 'voltage'"):
        parameter_figure("voltage", {"trot": [sensitivity()]}, tmp_path / "a.png")
    assert list(tmp_path.iterdir()) == []


def test_learning_curves_are_means_over_seeds(tmp_path: Path, drawn: list[Figure]) -> None:
    columns = {"steps": np.arange(1, 41) * 1e5, "speed": 0.5, "falls": 0.0, "episodes": 1}
    curves = [pd.DataFrame({**columns, "return": level}) for level in (1.0, 3.0)]
    young = curves[0][:1].assign(**dict.fromkeys(("return", "speed", "falls"), np.nan), episodes=0)
    learning_curves({"a": curves, "one": curves[:1], "young": [young]}, tmp_path / "a.png")
    first, second = lines(drawn[0], 0)
    assert (set(first), set(second)) == ({2.0}, {1.0})
    assert set(lines(drawn[0], 1)[0]) == {0.5}
    assert drawn[0].axes[0].lines[0].get_xdata()[-1] == pytest.approx(4.0)  # million
    band = drawn[0].axes[0].collections[0].get_paths()[0].vertices
    assert (band[:, 1].min(), band[:, 1].max()) == (1.0, 3.0)


@pytest.mark.parametrize("seeds", [1, 5])
def test_group_figure_shows_intervals_and_seeds(
    seeds: int, tmp_path: Path, drawn: list[Figure], gap_comparison: MakeComparison
) -> None:
    study = gap_comparison(seeds)
    group_figure(study, tmp_path / "a.png", ("nominal_return", "gap"))
    first, second = drawn[0].axes
    assert (first.get_title(loc="left"), second.get_title(loc="left")) == ("Return, nominal (m)", "Gap (m)")
    widths = [bar.get_width() for bar in first.patches]
    assert widths == pytest.approx([study.interval(group, study.primary).mean for group in study.groups])
    dots = [line.get_xdata() for line in first.lines if line.get_marker() == "o"]
    assert [list(values) for values in dots] == [
        list(study.select_group(group).nominal_return) for group in study.groups
    ]


@pytest.mark.parametrize("steps", [1, 200])
def test_side_by_side_omits_unknown_positions(
    steps: int, make_run: MakeRun, tmp_path: Path, drawn: list[Figure]
) -> None:
    options = {"energy": 0.2 * steps, "steps": steps}
    seen, unseen = make_run(distance=2.0, **options), make_run(distance=math.nan, **options)
    side_by_side({"home": [seen, seen], "robot": [unseen]}, tmp_path / "runs.png", "trot")
    home, _, robot, *_ = lines(drawn[0], 0)
    assert home[-1] == 2.0
    assert np.isnan(robot).all()
    np.testing.assert_allclose(lines(drawn[0], 2, 1), 20.0)


def test_mean_power_is_the_energy_of_the_last_half_second(make_run: MakeRun) -> None:
    # 20 W for a second, then 60 W.
    energy = np.where(np.arange(1, 201) > 100, 0.6, 0.2)
    times, power = _mean_power(make_run(steps=200, arrays={"energy": energy}))
    assert np.allclose(power[times < 1.0 - 1e-9], 20.0)
    assert power[124] == pytest.approx(40.0)  # half of it in either
    assert power[-1] == pytest.approx(60.0)


def test_tracking_figure_draws_errors_at_their_commands(tmp_path: Path, make_run: MakeRun, drawn: list[Figure]):
    grid = [(x, 0.0, w) for w in (-0.5, 0.5) for x in (0.0, 0.5, 1.0)] + [(1.0, y, 0.0) for y in (-0.2, 0.2)]
    # All move forward at 0.5 m/s without turning for 2 s; the first second is excluded.
    runs = [
        make_run(
            *(1.0, 1.0, 100, 0.02),
            {"command": np.tile(row, (100, 1))},
            ended="fall" if row == (1.0, 0.0, 0.5) else "time",
        )
        for row in grid
    ]
    assert tracking_figure(runs, tmp_path / "tracking.png").stat().st_size > 1000
    panels = [ax for ax in drawn[0].axes if ax.get_title(loc="left")]
    assert [ax.get_title(loc="left") for ax in panels] == 2 * [
        f"error {name}" for name in ("forward", "lateral", "yaw rate")
    ]
    meshes = [np.ma.filled(ax.collections[0].get_array(), np.nan) for ax in panels]
    forward, left, turn = meshes[:3]
    np.testing.assert_allclose(forward, 2 * [[0.5, 0.0, 0.5]], atol=1e-9)
    np.testing.assert_allclose(left, np.zeros((2, 3)), atol=1e-9)
    np.testing.assert_allclose(turn, np.full((2, 3), 0.5), atol=1e-9)
    np.testing.assert_allclose(meshes[4], [[0.2], [0.2]], atol=1e-9)
    assert [ax.get_ylabel().split(" (")[0] for ax in panels] == 3 * ["yaw rate"] + 3 * ["lateral"]
    crosses = [tuple(np.concatenate(ax.lines[0].get_data()).tolist()) for ax in panels]
    assert crosses == 3 * [(1.0, 0.5)] + 3 * [()]
