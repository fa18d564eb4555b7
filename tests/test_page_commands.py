"""Commands and Python blocks of pages run in an empty folder, as a reader would enter them."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import pytest
from markdown_pages import FENCED, ROOT
from page_commands import PageRun, page_path, shortened

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("pybullet")
pytest.importorskip("viser")

from surefoot.robot import RobotDescription

SMALLER = {
    "500_000": "1",
    "num_envs=64": "num_envs=4",
    '"num_envs": 128': '"num_envs": 4',
    "n_steps=64, batch_size=1024": "n_steps=8, batch_size=16",
    "episodes=20": "episodes=2",
    "surefoot.evaluate(policy)": "surefoot.evaluate(policy, episodes=1)",
    "surefoot.play(run)": "surefoot.play(run, duration=0.2)",
}
"""Replacements that shorten Python blocks of pages."""

SQUARE = "time,forward,sideways,yaw_rate\n0,0.5,0,0\n1,0,0,0.5\n"


def test_options_make_commands_short():
    assert shortened("train", ["steer", "--steps", "1000000"])[:3] == ["steer", "--steps", "256"]
    assert shortened("train", ["--resume", "run", "--steps", "9999"]) == ["--resume", "run", "--steps", "384"]
    assert shortened("evaluate", ["trot", "--duration", "0.5"]) == ["trot", "--duration", "0.5", "--episodes", "2"]


def reader(folder: Path, page: str, **options: Any) -> PageRun:
    """Return a run of a page in a folder with the files that pages presuppose."""
    (folder / "data").symlink_to(ROOT / "data")
    (folder / "square.csv").write_text(SQUARE)
    shutil.copy(RobotDescription.load("solo8").urdf.path, folder / "mine.urdf")
    run = PageRun(folder, **options)
    run.run(page_path(page))
    return run


PAGES: dict[str, dict[str, Any]] = {
    "start": {},
    "train": {},
    "task": {},
    "robot": {},
    "terrain": {"elsewhere": {"--height-map 5556": "tests/cli/test_deploy_cli.py"}},
    "evaluate": {
        "before": (("evaluate", "trot", "--episodes", "1", "--out", "traces"),),
        "names": {"FOLDER": "traces"},
    },
    "steer": {
        "elsewhere": {
            "emulate --robot go2": "tests/cli/test_deploy_cli.py",
            "deploy go2-steer": "tests/cli/test_deploy_cli.py, tests/cli/test_deploy_page_cli.py",
        }
    },
    "watch": {
        "elsewhere": {
            "--commands gamepad": "tests/deploy/test_command_sources.py",
            "train steer --robot go2 --browser": "tests/cli/test_train_page_cli.py",
            "emulate --robot go2": "tests/cli/test_deploy_page_cli.py",
            "deploy go2-steer": "tests/cli/test_deploy_page_cli.py",
        }
    },
}
"""Pages, and the requirements of their commands."""


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_commands_of_a_page_run(tmp_path: Path, page: str):
    assert reader(tmp_path, page, **PAGES[page]).ran


def fenced(page: str, language: str) -> list[str]:
    """Return the blocks of a page in a language."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return [code for _, found, code in FENCED.findall(text) if found == language]


@pytest.mark.slow
def test_python_of_the_python_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    pytest.importorskip("stable_baselines3")
    import surefoot as package

    train = package.train
    few = {"num_envs": 4, "steps_per_update": 8, "evaluation_episodes": 1, "ppo": {"minibatches": 1}}

    def train_little(*words, settings=None, **options):
        settings = dict(settings or {})
        ppo = {**few["ppo"], **settings.pop("ppo", {})}
        task = {"max_steps": 30, **settings.pop("task", {})}
        return train(*words, settings={**few, **settings, "ppo": ppo, "task": task}, **options)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(package, "train", train_little, raising=False)
    text = "\n".join(fenced("python.md", "python"))
    for old, new in SMALLER.items():
        assert old in text, old
        text = text.replace(old, new)
    names: dict[str, object] = {}
    exec(compile(text, "docs/python.md", "exec"), names)
    assert names["picture"].shape == (480, 640, 3)  # type: ignore[attr-defined]
    for name in ("sb3-trot.onnx", "mine.onnx"):
        assert (tmp_path / name).is_file()


def test_commands_are_sent_as_shown_on_the_page():
    from surefoot.deploy.command_sources import ChannelCommands

    (code,) = (code for code in fenced("watch.md", "python") if "send_command" in code)
    source = ChannelCommands(0)
    exec(code.replace("5555", str(source.port)).replace("sleep(0.1)", "sleep(0)"), {})
    assert source.read(0.0).tolist() == [0.5, 0.0, -0.2]
    source.close()
