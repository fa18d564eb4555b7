"""`surefoot train --browser`: the newest policy on a page in a real browser, without effect on the weights."""

from __future__ import annotations

import io
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from processes import SUREFOOT, surefoot

pytest.importorskip("torch")
pytest.importorskip("mujoco")
pytest.importorskip("viser")
pytest.importorskip("playwright")

import torch
from chromium import errors_of, in_browser, new_page, running_browser

from surefoot.learn.run_folder import read_checkpoint

if TYPE_CHECKING:
    from playwright.sync_api import Page

TINY = (
    *("steer", "--robot", "go2", "--num-envs", "8", "--steps-per-update", "16", "--threads", "1"),
    *("--learning-threads", "1", "--evaluate-every", "1000000", "--evaluation-episodes", "2", "--task.max-steps", "60"),
)


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with running_browser() as browser:
        yield new_page(browser, 500, 400, view=False)


@in_browser
def test_page_shows_newer_policies_and_ends_with_the_training(page: Page, tmp_path: Path):
    words = [*TINY, "--steps", "10000000"]
    train = subprocess.Popen(
        [*SUREFOOT, "train", *words, "--browser", "--page-port", "0"],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    patience = threading.Timer(200.0, train.kill)
    patience.start()
    try:
        assert train.stdout is not None
        address = next(line for line in train.stdout if line.startswith("http")).split()[0]
        (newest,) = tmp_path.glob("runs/*/*/newest.onnx")
        wrong = errors_of(page)
        page.goto(address)
        page.wait_for_function("document.getElementById('state').textContent.includes('m/s')")
        # The robot walks at half of its maximum speed until it is steered.
        page.wait_for_function("points.length > 5 && points[points.length - 1].command[0] > 0.5")
        first = newest.stat().st_mtime_ns
        deadline = time.monotonic() + 60
        while newest.stat().st_mtime_ns == first and time.monotonic() < deadline:
            time.sleep(0.1)
        shown = page.evaluate("points[points.length - 1].time")
        page.wait_for_function(f"points[points.length - 1].time > {shown} + 1.5")
        assert newest.stat().st_mtime_ns > first
        assert wrong == []
    finally:
        patience.cancel()
        train.kill()
    # The page's process ends with the training, even if the training is killed.
    page.wait_for_function("document.getElementById('role').textContent.includes('has ended')")


def content(checkpoint: Path) -> bytes:
    """Return the content of a checkpoint without the duration."""
    state, buffer = read_checkpoint(checkpoint), io.BytesIO()
    del state["seconds"]
    torch.save(state, buffer)
    return buffer.getvalue()


@pytest.mark.slow
def test_page_does_not_change_the_weights(tmp_path: Path):
    for name, words in {"with": ("--browser", "--page-port", "0"), "without": ()}.items():
        done = surefoot("train", *TINY, "--steps", "512", "--out", tmp_path / name, *words)
        assert done.returncode == 0, done.stderr
    names = ("with", "without")
    first, second = (content(next(tmp_path.glob(f"{name}/*/*/checkpoints/latest.ckpt"))) for name in names)
    assert first == second
    assert not list(tmp_path.glob("with/*/*/newest.onnx"))
