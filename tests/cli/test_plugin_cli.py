"""`--plugin`: the example's reward term and observation, from training to the drive page and deployment."""

from __future__ import annotations

import json
import urllib.request
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from processes import EmulatorHere, assert_rejected, emulators, serve_page, surefoot

pytest.importorskip("torch")
pytest.importorskip("viser")
pytest.importorskip("imageio_ffmpeg")

from surefoot.deploy import motion_runner
from surefoot.learn.run_folder import RunFolder
from surefoot.task.plugins import load_plugins, remove_plugins

TINY = (
    *("--steps", "512", "--num-envs", "16", "--steps-per-update", "16", "--evaluate-every", "100000"),
    *("--evaluation-episodes", "1", "--task.max-steps", "40", "--threads", "1", "--learning-threads", "1"),
)


@pytest.fixture(autouse=True)
def _no_plugin_is_left() -> Iterator[None]:
    yield
    remove_plugins()


@pytest.fixture(scope="module")
def plugin(repository: Path) -> Path:
    return repository / "examples/plugin.py"


@pytest.fixture(scope="module")
def run(repository: Path, plugin: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run with the example's plug-in."""
    folder = tmp_path_factory.mktemp("runs")
    task = repository / "examples/plugin.yaml"
    assert_rejected(
        surefoot("train", task, *TINY, cwd=folder), "reward.foot_clearance is not a term; choices: progress"
    )
    done = surefoot("train", task, "--plugin", plugin, *TINY, cwd=folder)
    remove_plugins()
    assert done.returncode == 0, done.stderr
    assert f"policy.onnx --plugin {plugin}\n" in done.stdout
    return next(folder.glob("runs/plugin/*"))


def test_evaluation_requires_the_observation_but_not_the_reward_term(run: Path, plugin: Path, tmp_path: Path) -> None:
    policy, words = run / "policy.onnx", ("--episodes", "1", "--json")
    assert_rejected(
        surefoot("evaluate", policy, *words), "needs observation 'lean' of a plug-in", "--plugin 'plugin.py'"
    )
    whole = surefoot("evaluate", policy, *words, "--plugin", plugin)
    assert (whole.returncode, whole.stderr) == (0, "")
    remove_plugins()
    text = plugin.read_text()
    start, end = text.index("@reward_term"), text.index("@observation")
    (tmp_path / "observation.py").write_text(text[:start] + text[end:])
    part = surefoot("evaluate", policy, *words, "--plugin", tmp_path / "observation.py")
    assert part.returncode == 0, part.stderr
    assert "plugin: returns are without 'foot_clearance'" in part.stderr
    assert json.loads(part.stdout)["distance_mean"] == json.loads(whole.stdout)["distance_mean"]
    assert json.loads(part.stdout)["return_mean"] > json.loads(whole.stdout)["return_mean"]


def test_a_run_is_resumed_with_the_plugin_given_again(run: Path, plugin: Path) -> None:
    assert_rejected(
        surefoot("train", "--resume", run), "was trained with 'foot_clearance', 'lean' of a plug-in; name the"
    )
    load_plugins([plugin])
    assert RunFolder.open(run)[1].task.observations[0] == "lean"


def test_the_drive_page_runs_a_policy_with_a_plugin(run: Path, plugin: Path) -> None:
    with (
        serve_page("drive", run / "policy.onnx", "--plugin", plugin) as address,
        urllib.request.urlopen(address, timeout=20) as page,
    ):
        assert page.status == 200


@pytest.fixture
def emulate() -> Iterator[Callable[..., Any]]:
    """Start emulators whose robots stand up quickly, and which are ended with the test."""
    with mock.patch.multiple(motion_runner, STARTUP_TIME=0.3, SHUTDOWN_TIME=0.3), emulators(EmulatorHere) as start:
        yield start


def test_a_robot_runs_the_policy(run: Path, plugin: Path, emulate: Callable[..., Any], tmp_path: Path) -> None:
    words = ("deploy", run / "policy.onnx", "--port", emulate("--lockstep").port, "--lockstep", "--duration", "0.3")
    assert_rejected(surefoot(*words, cwd=tmp_path), "needs observation 'lean' of a plug-in")
    done = surefoot(*words, "--json", "--plugin", plugin, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    (result,) = json.loads(done.stdout)["runs"]
    assert result["ended"] == "time"
