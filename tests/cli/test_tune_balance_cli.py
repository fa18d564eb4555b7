"""`surefoot tune-balance`, as a process."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from processes import refused, surefoot

from surefoot.task.config import load_task

pytest.importorskip("cma")
pytest.importorskip("mujoco")

QUICK = ("--generations", 1, "--population", 4, "--robots", 1, "--duration", 0.5, "--threads", 1)
TASK = "base: terrain-seeing\nrobot: go2\nreference: {over_holes: {balance: {slope_swing: -0.5}}}\n"


def test_tune_balance_writes_a_task_that_can_be_trained(tmp_path: Path):
    (tmp_path / "mine.yaml").write_text(TASK)
    done = surefoot("tune-balance", "mine.yaml", *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "gaps:0.25 0.00" in done.stdout
    assert "wrote mine-balance.yaml" in done.stdout
    (task, train), (tuned, kept) = (load_task(str(tmp_path / name)) for name in ("mine.yaml", "mine-balance.yaml"))
    assert kept == train
    assert replace(tuned, name=task.name, reference=task.reference) == task
    before, after = task.reference, tuned.reference
    assert before.over_holes is not None
    assert after.over_holes is not None
    assert after.over_holes.balance != before.over_holes.balance
    assert after.over_holes.foot == before.over_holes.foot


@pytest.mark.parametrize(
    ("words", "parts"),
    [
        (("steer",), ["task 'steer' has no reference.over_holes", "gaps"]),
        (("nothing.yaml",), ["task 'nothing.yaml' does not exist"]),
        (("terrain", "--out", "gains.txt"), ["task gains.txt: the name must end in .yaml"]),
        (("terrain", "--population", "1"), ["population is 1", "4 or more"]),
    ],
)
def test_tune_balance_refuses_what_does_not_fit(tmp_path: Path, words: tuple[str, ...], parts: list[str]):
    refused(surefoot("tune-balance", *words, cwd=tmp_path), *parts)
