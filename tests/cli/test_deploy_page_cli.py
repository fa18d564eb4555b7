"""`surefoot deploy --browser`: the robot's own state on a page in a real browser, and commands from there."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from processes import SUREFOOT, Emulator, refused, run_surefoot

from surefoot.task.trace import EpisodeTrace

pytest.importorskip("mujoco")
pytest.importorskip("viser")
pytest.importorskip("playwright")

from chromium import errors_of, hold_stick, in_browser, new_page, running_browser

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with running_browser(gives_way=tmp_path) as browser:
        yield new_page(browser, 500, 400, view=False)


@in_browser
@pytest.mark.realtime
def test_a_page_drives_the_robot_which_stands_once_it_is_closed(
    emulate: Callable[..., Emulator], page: Page, tmp_path: Path
):
    robot = emulate("--robot", "go2", "--ideal-sensors", "--set", "servo_kp=40", "servo_kd=1")
    words = ("--port", robot.port, "--browser", "--page-port", "0", "--out", str(tmp_path), "--json")
    deploy = subprocess.Popen([*SUREFOOT, "deploy", "go2-steer", *words], stdout=-1, stderr=-1, text=True)
    try:
        assert deploy.stderr is not None
        address = deploy.stderr.readline().split()[0]
        wrong = errors_of(page)
        page.goto(address)
        page.wait_for_function("document.getElementById('state').textContent.startsWith('run')")
        assert page.locator("#policy").is_hidden()
        assert page.locator("#push").is_hidden()
        hold_stick(page, 0.2, 0.0)
        page.wait_for_timeout(2500)
        assert page.evaluate("points[points.length - 1].heat") > 20.0  # degC, as the robot tells it
        # No tab, no fresh command: the robot stands.
        page.goto("about:blank")
        page.wait_for_timeout(2500)
        page.goto(address)
        page.wait_for_function("points.length > 5")
        page.locator("#stop").click()
        output, _ = deploy.communicate(timeout=30)
    finally:
        deploy.kill()
    assert deploy.returncode == 0
    (run,) = json.loads(output)["runs"]
    assert run["ended"] == "stopped"
    trace = EpisodeTrace.load(run["trace"])
    forward, speeds = trace.command[:, 0], np.abs(trace.motor_velocity[1:]).mean(axis=1)
    driven = np.flatnonzero(forward)
    assert 1.0 < trace.time[driven[-1]] - trace.time[driven[0]] < 3.5
    assert forward.max() == pytest.approx(0.6, abs=0.05)
    stood = slice(np.searchsorted(trace.time, trace.time[driven[-1]] + 1.0), len(forward))
    assert len(forward[stood]) > 50
    assert speeds[stood].mean() < 0.1 * speeds[driven].mean()
    assert wrong == []


def test_drive_page_refuses_incompatible_options():
    command = ("deploy", "go2-steer", "--port", "x", "--browser")
    refused(run_surefoot(*command, "--commands", "5555"), "commands come from one place")
    refused(run_surefoot(*command, "--lockstep"), "a page drives in real time")
