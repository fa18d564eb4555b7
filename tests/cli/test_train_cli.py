"""`surefoot train`: options of the reference; Ctrl-C saves a training, and --resume finishes it."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import time
from pathlib import Path

import pytest
from processes import SUREFOOT, assert_rejected, printed_commands, surefoot

pytest.importorskip("torch")
pytest.importorskip("mujoco")

from surefoot.api.policies import find_policy
from surefoot.cli.main import main
from surefoot.learn.run_folder import RunFolder
from surefoot.policy.runtime import PolicyRuntime

TINY = (
    *("--num-envs", "16", "--steps-per-update", "16", "--evaluate-every", "100000"),
    *("--evaluation-episodes", "2", "--task.max-steps", "60"),
)


@pytest.mark.parametrize(
    ("words", "option", "other"),
    [
        (("terrain-seeing", "--robot", "go2"), "over-holes.stride-gain", "swing.amplitude"),
        (("trot",), "swing.amplitude", "foot.height"),
        (("trot", "--task.reference.kind", "foot"), "foot.height", "swing.amplitude"),
    ],
)
def test_the_options_of_a_reference_depend_on_its_kind(
    words: tuple[str, ...], option: str, other: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        main(["train", *words, "--help"])
    text = capsys.readouterr().out
    assert f"--task.reference.{option}" in text
    assert f"--task.reference.{other}" not in text


@pytest.mark.slow
def test_ctrl_c_on_a_terminal_saves_and_resume_finishes(tmp_path: Path) -> None:
    host, terminal = pty.openpty()
    words = ["train", "trot", "--steps", "100000", "--seed", "3", *TINY]
    process = subprocess.Popen(
        [*SUREFOOT, *words],
        cwd=tmp_path, stdin=terminal, stdout=terminal, stderr=terminal, env={**os.environ, "COLUMNS": "120"},
    )  # fmt: skip
    os.close(terminal)
    deadline, log = time.monotonic() + 200, []
    while time.monotonic() < deadline and not (log := list(tmp_path.glob("runs/*/*/figures.jsonl"))):
        time.sleep(0.1)
    assert log, "no update was logged"
    process.send_signal(signal.SIGINT)
    shown = b""
    while True:
        try:
            part = os.read(host, 65536)
        except OSError:
            break
        if not part:
            break
        shown += part
    assert process.wait(timeout=60) == 130
    text = shown.decode(errors="replace")
    command = printed_commands(text)
    assert command["drive it"][-2:] == ["drive", str(log[0].parent)]
    assert command["resume"][-3:] == ["train", "--resume", str(log[0].parent)]
    assert "steps/s" in text
    run = log[0].parent
    assert (run / "checkpoints" / "latest.ckpt").exists()
    assert find_policy(str(run)) == run / "policy.onnx"
    assert PolicyRuntime.load(run / "policy.onnx").contract.figures["steps"] > 0

    assert_rejected(
        surefoot("train", "--resume", run, "--steps", "1"), "steps is 1, but", "has already done", "give more"
    )
    result = surefoot("train", "--resume", run, "--steps", 256 * 10, cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert RunFolder.open(run)[1].steps == 256 * 10
    made = {str(path.relative_to(run)) for path in run.rglob("*") if path.is_file()}
    figures = {f"figures/{name}" for name in ("video.mp4", "footfalls.png", "episode.png", "episode.npz")}
    assert {"policy.onnx", "evaluation.json", *figures} <= made, made
