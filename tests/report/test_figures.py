"""Figures: each is written, has ink on it, and leaves no trace in matplotlib's global state."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.errors import SurefootError
from surefoot.evaluate.footfalls import FEET
from surefoot.report.figures import episode_plot, footfall_diagram, learning_curve
from surefoot.task.trace import EpisodeTrace

matplotlib = pytest.importorskip("matplotlib")
Image = pytest.importorskip("PIL.Image")

STEPS = np.linspace(0, 7e6, 40)
CURVE = 1.0 - np.exp(-STEPS / 2e6)


def make_trace(steps: int = 700, known: bool = True, **meta: Any) -> EpisodeTrace:
    """Return a made-up trot; without `known`, of a robot that sees neither itself nor the ground."""
    rng = np.random.default_rng(0)
    step = 0.006
    time = step * np.arange(1, steps + 1)
    clock = np.concatenate([[0.0], time])
    phases = np.array([0.0, 0.5, 0.5, 0.0])
    contact = ((time[:, None] / 0.5 - phases) % 1.0 < 0.4).astype(float)
    gap = 0.0 if known else np.nan
    return EpisodeTrace(
        time=time,
        base_position_world=np.outer(clock, [0.6, 0.02, 0.0]) + gap,
        base_quat_world=np.tile([1.0, 0.0, 0.0, 0.0], (steps + 1, 1)) + gap,
        roll_pitch_yaw=0.05 * rng.normal(size=(steps, 3)),
        angular_velocity_base=np.zeros((steps, 3)),
        motor_angle=np.zeros((steps, 8)),
        motor_velocity=np.zeros((steps, 8)),
        motor_torque=np.zeros((steps, 8)),
        observation=np.zeros((steps, 1)),
        feedback=0.2 * np.sin(time[:, None] * 12 + np.arange(8)),
        target=np.zeros((steps, 8)),
        energy=0.4 * rng.random(steps),
        foot_contact=contact + gap,
        meta={
            "robot": "minitaur",
            "world": "mujoco",
            "policy": "trot",
            "control_step": step,
            "leg_names": list(FEET),
            "motor_names": [f"m{i}" for i in range(8)],
            "observation_names": ["roll"],
            "ended": "time",
            **meta,
        },
    )


def ink(path: Path) -> float:
    """Return the share of a picture's pixels that are not white."""
    with Image.open(path) as picture:
        assert picture.format == "PNG"
        return float((np.asarray(picture.convert("L")) < 250).mean())


FIGURES: dict[str, Callable[[Path], Path]] = {
    "footfalls": lambda path: footfall_diagram(make_trace(), path),
    "two footfalls": lambda path: footfall_diagram([make_trace(), make_trace()], path, titles=["a", "b"]),
    "footfalls unknown": lambda path: footfall_diagram(make_trace(known=False), path),
    "footfalls of a moment": lambda path: footfall_diagram(make_trace(steps=1), path),
    "curve": lambda path: learning_curve(STEPS, CURVE, CURVE, path, return_std=0.1 + 0 * STEPS, title="t"),
    "curve with gaps": lambda path: learning_curve(
        STEPS, np.where(STEPS > 4e6, np.nan, CURVE), CURVE, path, speed_target=0.5
    ),
    "curve of one point": lambda path: learning_curve([100], [0.1], [np.nan], path),
    "episode": lambda path: episode_plot(make_trace(), path),
    "episode with legs": lambda path: episode_plot(make_trace(), path, leg_angle=make_trace().feedback),
    "episode of a robot": lambda path: episode_plot(make_trace(known=False), path),
    "episode of a moment": lambda path: episode_plot(make_trace(steps=1), path),
}


@pytest.mark.parametrize("name", FIGURES)
@pytest.mark.filterwarnings("error")
def test_a_figure_is_written(name: str, tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    path = tmp_path / "deeper" / "figure.png"
    assert FIGURES[name](path) == path
    assert 0.005 < ink(path) < 0.9
    assert dict(matplotlib.rcParams) == before


def test_the_same_data_gives_the_same_bytes(tmp_path: Path) -> None:
    first = learning_curve(STEPS, CURVE, CURVE, tmp_path / "a.png")
    second = learning_curve(STEPS, CURVE, CURVE, tmp_path / "b.png")
    assert first.read_bytes() == second.read_bytes()


def test_what_does_not_fit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(SurefootError, match=r"speed \(3,\) must fit steps \(40,\)"):
        learning_curve(STEPS, CURVE, [1, 2, 3], tmp_path / "a.png")
    with pytest.raises(SurefootError, match="not empty"):
        learning_curve([], [], [], tmp_path / "a.png")
    with pytest.raises(SurefootError, match="1 titles for 2 traces"):
        footfall_diagram([make_trace(), make_trace()], tmp_path / "a.png", titles=["a"])
    with pytest.raises(SurefootError, match="leg_angle"):
        episode_plot(make_trace(), tmp_path / "a.png", leg_angle=np.zeros((3, 8)))
    with pytest.raises(SurefootError, match=r"must end in \.png"):
        episode_plot(make_trace(), tmp_path / "a.pdf")
    assert list(tmp_path.iterdir()) == []


def test_matplotlib_is_imported_only_when_drawing() -> None:
    code = "import sys, surefoot.report.figures; sys.exit('matplotlib' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False, timeout=60).returncode == 0
