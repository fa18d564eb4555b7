"""Commands that are printed as suggestions work in another folder, for any robot."""

from __future__ import annotations

import shutil
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("viser")

from processes import EmulatorHere, emulators, printed_commands, serve_page, surefoot
from shipped_variants import maxitaur

from surefoot.cli.helpers.output import next_command
from surefoot.robot import RobotDescription

pytestmark = pytest.mark.slow

TINY = (
    *("--steps", "512", "--num-envs", "8", "--steps-per-update", "16", "--evaluate-every", "256"),
    *("--evaluation-episodes", "2", "--task.max-steps", "40", "--threads", "1"),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Folder with a space in its name, the robot "maxitaur" in `my robot`, and a separate cache."""
    folder = tmp_path_factory.mktemp("all mine")
    maxitaur(folder / "my robot")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
        yield folder


@pytest.fixture(scope="module")
def printed(folder: Path) -> dict[str, dict[str, list[str]]]:
    """Printed commands, by the command that printed them; the robot's folder is removed afterwards."""
    robot, printed = RobotDescription.load(folder / "my robot"), {}

    def run(*words: object) -> None:
        done = surefoot(*words, cwd=folder)
        assert done.returncode == 0, done.stderr
        printed[str(words[0])] = printed_commands(done.stdout)

    run("train", "trot", "--robot", "my robot", "--out", "my runs", *TINY)
    (policy,) = folder.glob("my runs/*/*/policy.onnx")
    run("evaluate", policy.parent.relative_to(folder), "--episodes", "1", "--out", "my figures")
    run("gap", policy, "--to", "mujoco", "--episodes", "1")
    time = 0.01 * np.arange(40)
    command = robot.resting_angles + 0.1 * np.sin(9.0 * time)[:, None]
    np.savez(folder / "log.npz", time=time, command=command, motor_angle=command, imu=np.zeros((40, 4)))
    run("identify", "import", "log.npz", "--robot", "my robot", "--out", "my log.npz")
    with emulators(EmulatorHere) as start:
        port = start("--lockstep", "--robot", folder / "my robot").port
        run("deploy", policy, "--port", port, "--lockstep", "--duration", "0.3")
    shutil.rmtree(folder / "my robot")
    return printed


@pytest.mark.parametrize(
    ("command", "purposes"),
    [
        ("train", ["look at", "drive it"]),
        *((name, ["look at"]) for name in ("evaluate", "gap", "identify", "deploy")),
    ],
)
def test_a_printed_command_works_in_another_folder_without_the_robots_folder(
    command: str, purposes: list[str], printed: dict[str, dict[str, list[str]]], tmp_path: Path
):
    assert list(printed[command]) == purposes
    look = printed[command]["look at"]
    # Write the page to a file instead of serving it.
    done = surefoot(*look[look.index("show") :], "--out", tmp_path / "page.html", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "maxitaur" in (tmp_path / "page.html").read_text()


@pytest.mark.parametrize(("purpose", "first"), [("look at", "show"), ("drive it", "drive")])
def test_a_printed_page_answers(purpose: str, first: str, printed: dict[str, dict[str, list[str]]], tmp_path: Path):
    words = printed["train"][purpose]
    with serve_page(*words[words.index(first) :], cwd=tmp_path) as address:
        assert urllib.request.urlopen(address).status == 200


def test_other_commands_accept_files_that_contain_their_robot(printed: object, folder: Path, tmp_path: Path):
    (run,) = folder.glob("my runs/*/*")
    for words in (
        ("evaluate", "--trace", folder / "my figures"),
        ("identify", "replay", folder / "my log.npz"),
        ("show", run, "--duration", "0.1", "--out", tmp_path / "x.mp4"),
    ):
        done = surefoot(*words, cwd=tmp_path)
        assert done.returncode == 0, (words, done.stderr)


def test_the_program_is_printed_with_a_path_unless_it_is_on_the_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    script = Path(sys.executable).with_name("surefoot")
    if not script.exists():
        pytest.skip("surefoot is not installed as a script")
    here = str(Path("my run.npz").absolute())

    def printed() -> list[str]:
        return printed_commands(next_command("look at", "show", Path("my run.npz")))["look at"]

    monkeypatch.setenv("PATH", str(script.parent))
    assert printed() == ["surefoot", "show", here]
    # Another program with this name comes first on the PATH.
    other = tmp_path / "surefoot"
    other.write_text("#!/bin/sh\n")
    other.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert printed() == [str(script), "show", here]
