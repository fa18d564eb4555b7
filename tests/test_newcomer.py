"""First commands of a new user: the wheel in a fresh environment, import of a robot, and a moved folder."""

from __future__ import annotations

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

pytest.importorskip("hatchling")
pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("viser")

import surefoot
from surefoot.robot import RobotDescription

pytestmark = pytest.mark.wheel

ROOT = Path(__file__).resolve().parents[1]
SOURCE = Path(surefoot.__file__).parent
BOX = "\n".join(
    [
        *(f"v {x} {y} {z}" for x in (-0.2, 0.2) for y in (-0.1, 0.1) for z in (-0.03, 0.03)),
        *("f 1 2 4 3", "f 5 7 8 6", "f 1 5 6 2", "f 3 4 8 7", "f 1 3 7 5", "f 2 6 8 4"),
    ]
)


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Script of a wheel installed in a separate environment, which shares the other packages of this one."""
    folder = tmp_path_factory.mktemp("wheel")
    pip = [sys.executable, "-m", "pip", "--quiet", "--disable-pip-version-check"]
    build = [*pip, "wheel", "--no-deps", "--no-build-isolation", "--wheel-dir", folder, ROOT]
    subprocess.run(build, check=True, timeout=200)
    (wheel,) = folder.glob("*.whl")
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "venv"], check=True)
    python = folder / "venv" / "bin" / "python"
    subprocess.run([*pip, "--python", python, "install", "--no-deps", "--no-index", wheel], check=True, timeout=200)
    (packages,) = (folder / "venv" / "lib").glob("*/site-packages")
    (packages / "others.pth").write_text(str(Path(pytest.__file__).parents[1]))
    _share_kernels(packages / "surefoot")
    return python.with_name("surefoot")


def _share_kernels(package: Path) -> None:
    """Copy compiled kernels of unchanged modules to the installed package, which saves half a minute."""
    for source in SOURCE.rglob("*.py"):
        copy = package / source.relative_to(SOURCE)
        if copy.is_file() and copy.read_bytes() == source.read_bytes():
            os.utime(copy, ns=(source.stat().st_atime_ns, source.stat().st_mtime_ns))
    for pattern in ("*.nbi", "*.nbc", "kernels.sha256"):
        for cached in SOURCE.rglob(f"__pycache__/{pattern}"):
            target = package / cached.relative_to(SOURCE)
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(cached, target)


def test_a_robot_is_imported_trained_and_moved_to_another_folder(program: Path, tmp_path: Path):
    home = tmp_path / "first hour"
    home.mkdir()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    environment |= {"XDG_CACHE_HOME": str(tmp_path / "cache"), "DISPLAY": "", "WAYLAND_DISPLAY": ""}

    def run(*words: object, folder: Path = home, code: int = 0) -> str:
        command = [program, *map(str, words)]
        done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, timeout=200)
        assert done.returncode == code, done.stdout + done.stderr
        return done.stdout

    @contextmanager
    def page(command: list[str], folder: Path) -> Iterator[str]:
        process = subprocess.Popen([*command, "--page-port", "0"], cwd=folder, env=environment, stdout=subprocess.PIPE)
        assert process.stdout is not None
        yield process.stdout.readline().decode().split()[0]
        process.send_signal(signal.SIGINT)
        assert process.wait(20) == 130

    box = 'box size="0.424013494 0.209203351 0.0531170248"'
    text = RobotDescription.load("solo8").urdf.path.read_text()
    assert box in text
    (home / "dog.urdf").write_text(text.replace(box, 'mesh filename="body.obj"', 1))
    (home / "body.obj").write_text(BOX)
    made = run("robot", "new", "dog.urdf", "--knees", "backward", "--name", "dog", "--out", "my dog")
    assert " passed, 0 failed" in run("robot", "check", "my dog")
    train = shlex.split(re.findall("^to train it: (.*)", made, re.M)[0])
    assert train[0] == str(program)

    tiny = ("--num-envs", "8", "--steps-per-update", "32", "--evaluate-every", "512", "--evaluation-episodes", "2")
    process = subprocess.Popen(
        [*train, *tiny, "--task.max-steps", "60"], cwd=home, env=environment, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if "evaluated" in line and not any("evaluated" in earlier for earlier in lines[:-1]):
            process.send_signal(signal.SIGINT)
    assert process.wait(60) == 130, lines
    commands = dict(re.findall("^to ([^:\n]+): (.*)", "".join(lines), re.M))
    with page(shlex.split(commands["drive it"]), tmp_path) as address:
        assert urllib.request.urlopen(address).status == 200

    shutil.rmtree(home / "my dog")
    new = home.rename(tmp_path / "second hour")
    (path,) = new.glob("runs/dog-trot/*")
    assert (path / "policy.onnx").is_file()
    run("evaluate", path, "--episodes", "1", "--out", "figures", folder=new)
    with page([str(program), "drive", str(path)], tmp_path) as address:
        assert urllib.request.urlopen(address).status == 200
    run("show", "figures", "--out", "page.html", folder=new)
    assert "dog" in (new / "page.html").read_text()
    steps = 256 * (1 + int(re.findall(r"saved at ([\d,]+) steps", "".join(lines))[0].replace(",", "")) // 256)
    assert "Policy" in run("train", "--resume", path, "--steps", steps, folder=new)
