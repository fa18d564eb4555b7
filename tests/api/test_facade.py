"""`import surefoot`: its functions, and its import without other packages."""

from __future__ import annotations

import math
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("viser")

import surefoot
from surefoot.api import facade
from surefoot.api.drive_page import DrivePage
from surefoot.api.extras import describe_missing, install_command
from surefoot.evaluation.runs import summarize


def python(code: str, absent: tuple[str, ...] = ()) -> str:
    """Run code in a new process without certain packages; return its output."""
    lack = f"import sys\nfor name in {absent!r}: sys.modules[name] = None\n"
    done = subprocess.run([sys.executable, "-c", lack + code], capture_output=True, text=True, timeout=120, check=True)
    return done.stdout.strip()


def test_importing_surefoot_imports_no_other_package():
    output = python("import surefoot; print(surefoot.__version__, {'numpy', 'yaml', 'torch'} & set(sys.modules))")
    assert output == f"{surefoot.__version__} set()"


def test_robots_and_errors_need_only_the_bare_install():
    absent = ("mujoco", "torch", "pandas", "gymnasium", "scipy", "numba", "PIL", "viser")
    code = (
        "import surefoot\nprint(*surefoot.robots())\n"
        "try: surefoot.train('trot', figures=False)\nexcept surefoot.SurefootError as error: print(error)"
    )
    names, error = python(code, absent).splitlines()
    assert names == "go2 minitaur pupper_v2 solo8"
    assert error.startswith("this needs ")
    assert error.endswith(f"which is not installed: {install_command('train')}")


def test_only_the_listed_names_are_available():
    assert set(surefoot.__all__) <= set(dir(surefoot))
    assert all(getattr(surefoot, name).__doc__ for name in surefoot.__all__)
    with pytest.raises(AttributeError, match="module 'surefoot' has no attribute 'gallop'"):
        _ = surefoot.gallop


def test_evaluate_applies_its_arguments():
    policy = surefoot.load("trot")
    assert (policy.name, policy.robot.name) == ("trot", "minitaur")
    assert repr(policy).startswith("<policy trot for robot minitaur: ")
    assert policy.feedback(np.zeros((3, 4))).shape == (3, 8)
    result = surefoot.evaluate(
        policy,
        episodes=2,
        duration=0.3,
        params={"motor_strength": 0.8},
        randomize={"control_latency": (0.01, 0.03)},
        seed=3,
        threads=1,
    )
    assert result.runs.steps.tolist() == [50, 50]
    first, second = (trace.meta["params"] for trace in result.traces)
    assert (first["motor_strength"], second["motor_strength"]) == (0.8, 0.8)
    assert 0.01 <= first["control_latency"] < 0.03
    assert first["control_latency"] != second["control_latency"]
    assert result.summary == summarize(result.traces, policy.robot.urdf.total_mass)
    assert "trot in mujoco" in repr(result)
    assert "<table" in result._repr_html_()
    assert "0 of 2" in repr(result)


def test_play_writes_a_video_that_a_notebook_plays(tmp_path: Path):
    video = surefoot.play("trot", out=tmp_path / "trot.mp4", duration=0.1)
    assert video.path.read_bytes()[4:8] == b"ftyp"
    assert 'src="data:video/mp4;base64,' in video._repr_html_()
    assert not facade.in_notebook()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: surefoot.load("waltz"), "policy 'waltz' does not exist"),
        (lambda: surefoot.evaluate("trot", world="moon"), "world 'moon' does not exist"),
        (lambda: surefoot.evaluate("trot", params={"gravity": 1.6}), "'gravity' is not a physical parameter"),
        (lambda: surefoot.evaluate("trot", commands="path.csv"), "task 'trot' has no commands to follow"),
        (lambda: surefoot.evaluate("trot", duration=0.0), "duration is 0; it must be over 0"),
        (lambda: surefoot.evaluate("trot", duration=math.nan), "duration is nan; it must be a finite number"),
        (lambda: surefoot.evaluate("trot", seed=-1), "seed is -1; it must be 0 or more"),
        (lambda: surefoot.evaluate("trot", episodes=2.5), "episodes is 2.5; it must be"),
        (lambda: surefoot.evaluate("trot", episodes=np.int64(0)), "episodes is 0; it must be 1 or more"),
        (lambda: surefoot.play("trot", out="trot.mp4", duration=-1.0), "duration is -1; it must be over 0"),
        (lambda: surefoot.play("trot", out="trot.gif"), "video trot.gif: the name must end in .mp4"),
        (lambda: surefoot.train("trot", settings={"ppo": {"gama": 0.9}}), "ppo.gama is not a key; did you mean gamma"),
        (lambda: surefoot.train("trot", robot="cat"), "robot 'cat': no such robot"),
        (lambda: surefoot.export(object(), "p.onnx"), "model is a object; it must be a torch module"),
    ],
)
def test_errors_are_one_line(call, message: str):
    with pytest.raises(surefoot.SurefootError) as caught:
        call()
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_drive_uses_the_robot_of_a_loaded_policy(tmp_path: Path):
    own = tmp_path / "mine"
    shutil.copytree(surefoot.robots()["minitaur"].folder, own)
    policy = surefoot.load("trot", robot=own)
    with surefoot.drive(policy) as drive:
        assert drive.page.robot.robot.folder == own


def test_settings_change_a_reward_and_an_interrupted_training_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    training = pytest.importorskip("surefoot.api.training")
    run_folder = pytest.importorskip("surefoot.learn.run_folder")
    monkeypatch.setattr(
        training.TrainingProgress, "report", lambda self, figures, evaluation: signal.raise_signal(signal.SIGINT)
    )
    small = {"num_envs": 4, "steps_per_update": 32, "evaluation_episodes": 1, "threads": 1}
    settings = small | {"task": {"max_steps": 30, "reward": {"energy": -0.004}}}
    with pytest.raises(KeyboardInterrupt):
        surefoot.train("trot", steps=100_000, settings=settings, runs=tmp_path, figures=False)
    (path,) = tmp_path.glob("trot/*")
    folder, config = run_folder.RunFolder.open(path)
    assert config.task.reward == {"progress": 1.0, "energy": -0.004}
    assert folder.load()["steps"] == 128
    assert surefoot.load(path).name == "trot"


def test_a_page_continues_when_its_policy_is_moved(tmp_path: Path):
    shutil.copy(surefoot.load("trot").path, tmp_path / "own.onnx")
    page = DrivePage(str(tmp_path / "own.onnx"), "mujoco")
    (tmp_path / "own.onnx").rename(tmp_path / "moved.onnx")
    before = page.policies
    assert not page._list_policies()
    assert page.policies == before


def test_packages_for_meshes_belong_to_an_extra():
    for name in ("trimesh", "collada", "fast_simplification"):
        assert str(describe_missing(ModuleNotFoundError(name=name))).endswith(install_command("sim"))


@pytest.mark.parametrize(
    ("origin", "command"),
    [
        ('{"dir_info": {"editable": true}, "url": "file:///home/my%20dog"}', "pip install -e '/home/my dog[sim]'"),
        ('{"archive_info": {}, "url": "file:///tmp/surefoot-1-py3.whl"}', "pip install '/tmp/surefoot-1-py3.whl[sim]'"),
        (None, "pip install 'surefoot[sim]'"),
    ],
)
def test_an_extra_is_installed_from_the_source_of_surefoot(
    origin: str | None, command: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("importlib.metadata.distribution", lambda name: SimpleNamespace(read_text=lambda file: origin))
    assert install_command("sim") == command
