"""`surefoot study tune`."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest
import yaml
from processes import surefoot

pytestmark = pytest.mark.slow

pytest.importorskip("cma")
pytest.importorskip("mujoco")

QUICK = ("--generations", 1, "--population", 4, "--starts", 1, "--duration", 0.5, "--episodes", 1, "--threads", 1)


def test_tune_writes_and_measures_a_gait_and_resumes_from_it(tmp_path: Path):
    done = surefoot("study", "tune", "--gait", "trot", "--speed", 0.4, *QUICK, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "trot-40 in mujoco" in done.stdout
    assert "cost of transport" in done.stdout
    result = yaml.safe_load((tmp_path / "trot-40.yaml").read_text())
    assert result["reference"]["kind"] == "foot"
    assert result["handcrafted"]["about"]["speed"] == 0.4
    words = ("study", "tune", "--raibert", "--start-from", "trot-40.yaml", "--out", "again.yaml", *QUICK)
    again = surefoot(*words, cwd=tmp_path)
    assert again.returncode == 0, again.stderr
    assert yaml.safe_load((tmp_path / "again.yaml").read_text())["handcrafted"]["raibert"]["lag"] == 0.045
    curve = list(csv.DictReader((tmp_path / "again-tuning.csv").read_text().splitlines()))
    assert [(row["gait"], row["control_steps"]) for row in curve] == [("trot-40", "332"), ("again", "332")]


def test_a_handcrafted_gait_is_evaluated_and_shown_like_a_policy(tmp_path: Path):
    pytest.importorskip("imageio_ffmpeg")
    text = "reference: {kind: foot}\nmax_steps: 20\nhandcrafted: {}\n"
    (tmp_path / "stand.yaml").write_text(text)
    done = surefoot("evaluate", "stand.yaml", "--episodes", 2, "--json", "--threads", 1, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["policy"], result["episodes"], result["falls"]) == ("stand", 2, 0)
    assert len(result["config_hash"]) == 64
    played = surefoot("show", "stand.yaml", "--duration", 0.1, "--out", "stand.mp4", cwd=tmp_path)
    assert played.returncode == 0, played.stderr
    assert (tmp_path / "stand.mp4").stat().st_size > 1000
