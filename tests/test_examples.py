"""Notebook and scripts of examples/, run with few steps."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("torch")

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
QUICK = """
steps, seconds, episodes = 1, 0.2, 2
_train, _quick = surefoot.train, {"num_envs": 4, "steps_per_update": 8, "evaluation_episodes": 1}
surefoot.train = lambda *words, settings={}, **options: _train(
    *words, settings={**_quick, "task": {"max_steps": 30}, **settings}, **options
)
"""
"""Parameters of the notebook that make the test short."""


@pytest.fixture
def python_path(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let notebook kernels import the tested surefoot."""
    source = str(Path(importlib.util.find_spec("surefoot").origin).parents[1])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([source, os.environ.get("PYTHONPATH", "")]))


@pytest.mark.notebook
@pytest.mark.usefixtures("python_path")
def test_the_notebook_runs_from_beginning_to_end(tmp_path: Path):
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    path = EXAMPLES / "first_hour.ipynb"
    assert path.stat().st_size < 500_000
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    (parameters,) = [cell for cell in notebook.cells if "parameters" in cell.metadata.get("tags", [])]
    parameters.source = f"{parameters.source}\n{QUICK}"
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    html = [
        output.data["text/html"]
        for cell in notebook.cells
        for output in cell.get("outputs", [])
        if "text/html" in output.get("data", {})
    ]
    assert sum("data:video/mp4;base64," in text for text in html) == 2
    assert sum("<iframe src=" in text for text in html) == 1
    assert (tmp_path / "runs" / "mine-trot").is_dir()
    assert not list(tmp_path.glob("*.mp4"))


def test_sb3_trains_a_policy_that_is_exported_and_evaluated(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("stable_baselines3")
    spec = importlib.util.spec_from_file_location("sb3_example", EXAMPLES / "sb3.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.main(1, str(tmp_path / "p.onnx"), robots=4, episodes=1)
    assert "sb3-trot in mujoco" in capsys.readouterr().out
