"""Commands and Python of pages run in an empty folder: short trainings, and the files that the pages show."""

from __future__ import annotations

import glob
import re
import shlex
import urllib.request
from pathlib import Path

import pytest
from markdown_pages import FENCED, ROOT, blocks, lines
from processes import served, surefoot
from test_readme import TINY

SKIPPED = ("python3", "pip", "tensorboard", "surefoot COMMAND")
"""Beginnings of lines that install something, or run no command of surefoot."""
SMALLER = {
    "500_000": "1",
    "num_envs=64": "num_envs=4",
    '"num_envs": 128': '"num_envs": 4',
    "n_steps=64, batch_size=1024": "n_steps=8, batch_size=16",
    "episodes=20": "episodes=2",
    "surefoot.evaluate(policy)": "surefoot.evaluate(policy, episodes=1)",
    "surefoot.play(run)": "surefoot.play(run, duration=0.2)",
}
"""What makes Python of pages quick."""


def fenced(page: str, language: str) -> list[str]:
    """Return the blocks of a page in a language."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    return [code for _, found, code in FENCED.findall(text) if found == language]


def write_files(page: str) -> None:
    """Write the files that a page shows here: YAML with its name in a comment, and its plug-in."""
    for code in fenced(page, "yaml"):
        if name := re.match(r"# ([\w-]+\.yaml)", code):
            Path(name[1]).write_text(code)
    for code in fenced(page, "python"):
        if "reward_term" in code:
            Path("plugin.py").write_text(code)


def quick(words: list[str]) -> list[str]:
    """Return the words of a command that does less; patterns of files become their names."""
    words = [name for word in words for name in (glob.glob(word) if "*" in word else [word])]
    if words[0] == "train" and "--help" not in words:
        if "--resume" in words:
            return [*words[: words.index("--resume") + 2], "--steps", "384"]
        return [*words, *TINY]
    return [*words, "--values", "2"] if words[:2] == ["evaluate", "sensitivity"] else words


@pytest.mark.slow
@pytest.mark.parametrize("page", ["start.md", "train.md", "task.md"])
def test_commands_of_a_page_run_in_an_empty_folder(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for package in ("torch", "mujoco", "viser"):
        pytest.importorskip(package)
    monkeypatch.chdir(tmp_path)
    write_files(page)
    ran = []
    for block in blocks((ROOT / "docs" / page).read_text(encoding="utf-8")):
        for line in lines(block):
            if line.startswith(SKIPPED):
                continue
            program, *words = shlex.split(line)
            assert program == "surefoot", line
            words = quick(words)
            if words[0] == "drive":
                with served(*words, cwd=tmp_path) as address:
                    assert urllib.request.urlopen(address).status == 200
            else:
                done = surefoot(*words)
                assert done.returncode == 0, f"{line}: {done.stdout[-2000:]}{done.stderr[-2000:]}"
            ran.append(words[0])
    assert "train" in ran


@pytest.mark.slow
def test_python_of_the_python_page_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for package in ("torch", "mujoco", "matplotlib", "stable_baselines3"):
        pytest.importorskip(package)
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


def test_commands_are_sent_as_the_page_shows():
    from surefoot.deploy.command_sources import ChannelCommands

    (code,) = (code for code in fenced("watch.md", "python") if "send_command" in code)
    source = ChannelCommands(0)
    exec(code.replace("5555", str(source.port)).replace("sleep(0.1)", "sleep(0)"), {})
    assert source.read(0.0).tolist() == [0.5, 0.0, -0.2]
    source.close()
