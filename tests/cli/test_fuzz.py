"""A few cases of `benchmarks/fuzz.py`, in a separate process without threads, from which each case is forked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

for module in ("mujoco", "torch", "onnx", "matplotlib", "imageio_ffmpeg"):
    pytest.importorskip(module)

QUICK = ("study", "study options", "space", "params", "policy to deploy", "recording", "deploy options",
         "doctor options", "identify options", "mjcf", "collada", "foreign urdf", "messages to drive",
         "messages to train")  # fmt: skip
"""Kinds of cases that run quickly."""


@pytest.mark.slow
def test_no_case_ends_with_a_traceback_or_hangs(repository: Path):
    kinds = [word for kind in QUICK for word in ("--kind", kind)]
    words = [sys.executable, "benchmarks/fuzz.py", "--cases", "20", "--seed", "0", *kinds]
    done = subprocess.run(words, cwd=repository, capture_output=True, text=True, timeout=280, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 of 20 cases failed" in done.stdout
