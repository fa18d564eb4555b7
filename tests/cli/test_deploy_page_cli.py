"""`surefoot deploy --browser`: the robot's state on a page in a real browser, and commands from the page.

Also its buttons, through a web socket, and the robot's reaction when the page's process is killed.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from processes import SUREFOOT, Emulator, assert_rejected, run_surefoot

from surefoot.task.trace import EpisodeTrace

pytest.importorskip("mujoco")
pytest.importorskip("viser")
pytest.importorskip("playwright")

from chromium import errors_of, hold_stick, in_browser, new_page, running_browser
from hostile_messages import open_tab
from websockets import ConnectionClosed
from websockets.sync.client import connect

from surefoot.cli.helpers.deploy_page import DeployPage
from surefoot.robot import RobotDescription
from surefoot.robot.commands import CommandLimits
from surefoot.stop_signals import DAMP, SIT

if TYPE_CHECKING:
    from playwright.sync_api import Page


@pytest.fixture
def page(tmp_path: Path) -> Iterator[Page]:
    with running_browser(gives_way=tmp_path) as browser:
        yield new_page(browser, 500, 400, view=False)


@in_browser
@pytest.mark.realtime
def test_a_page_steers_the_robot_which_stands_after_the_page_is_closed(
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
        # Without a tab there is no recent command, so the robot stands.
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


@pytest.fixture
def deploy_page() -> Iterator[DeployPage]:
    """Yield the page of a robot in its process."""
    limits = CommandLimits((-1.0, 1.0), (-0.5, 0.5), (-1.0, 1.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    page = DeployPage("title", str(RobotDescription.load("go2").folder), "go2-steer", limits, 0, 0)
    yield page
    page.close()


def wait_for(page: DeployPage, stops: int) -> None:
    """Wait until the page sends a given stop request."""
    end = time.monotonic() + 30.0
    while page.stops() != stops:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_a_second_press_of_sit_has_no_effect_and_damp_is_a_separate_button(deploy_page: DeployPage):
    assert deploy_page.stops() == 0
    with open_tab(deploy_page.address) as tab:
        tab.send('{"stop": true}')
        wait_for(deploy_page, SIT)
        tab.send('{"stop": true}')
        tab.send('{"stop": 1}')
        while "error" not in json.loads(tab.recv(timeout=10)):
            pass
        time.sleep(0.2)
        assert deploy_page.stops() == SIT
        tab.send('{"damp": true}')
        wait_for(deploy_page, DAMP)


def test_a_watching_tab_can_stop_but_not_steer_the_robot(deploy_page: DeployPage):
    host = deploy_page.address.split("/")[2]
    with open_tab(deploy_page.address), connect(f"ws://{host}/socket", origin=f"http://{host}") as watcher:  # type: ignore[arg-type]
        for text in ('{"command": [1, 0, 0]}', '{"stop": true, "command": [1, 0, 0]}', '{"stop": true, "moved": 1}'):
            watcher.send(text)
            while (answer := json.loads(watcher.recv(timeout=10)).get("error")) is None:
                pass
            assert answer == "you are watching; another browser is in control"
        assert deploy_page.stops() == 0
        watcher.send('{"stop": true}')
        wait_for(deploy_page, SIT)
        watcher.send('{"damp": true}')
        wait_for(deploy_page, DAMP)


@pytest.mark.parametrize("path", ["socket", "viser"])
def test_a_connection_with_too_many_messages_is_closed(deploy_page: DeployPage, path: str):
    host = deploy_page.address.split("/")[2]
    with connect(f"ws://{host}/{path}", origin=f"http://{host}") as flood:  # type: ignore[arg-type]
        with pytest.raises(ConnectionClosed, match="too many messages"):  # noqa: PT012
            for _ in range(3000):
                flood.send("x")
            while True:
                flood.recv(timeout=10)
        assert deploy_page.stops() == 0


def test_the_number_of_views_is_limited_to_sixteen(deploy_page: DeployPage):
    host = deploy_page.address.split("/")[2]
    with ExitStack() as stack:
        views = [stack.enter_context(connect(f"ws://{host}/viser", origin=f"http://{host}")) for _ in range(17)]  # type: ignore[arg-type]
        with pytest.raises(ConnectionClosed, match="too many views"):
            views[-1].recv(timeout=10)
        assert deploy_page.stops() == 0


def test_the_robot_sits_down_when_the_pages_process_is_killed(
    deploy_page: DeployPage, capsys: pytest.CaptureFixture[str]
):
    assert deploy_page.stops() == 0
    os.kill(deploy_page._process.pid, signal.SIGKILL)
    wait_for(deploy_page, SIT)
    assert deploy_page.stops() == SIT
    assert capsys.readouterr().err.count("the page's process has ended; the robot sits down and is disarmed") == 1


def press(address: str, button: str) -> None:
    """Press a button of the page twice."""
    with open_tab(address) as tab:
        for _ in range(2):
            tab.send(f'{{"{button}": true}}')
        time.sleep(0.5)


def kill_page(process: subprocess.Popen[str]) -> None:
    """Kill the page's process of a deployment."""
    words = ["pgrep", "--parent", str(process.pid), "--full", "deploy_page"]
    (page,) = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    os.kill(int(page), signal.SIGKILL)


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("what", "code", "text", "sits"),
    [
        ("stop", 0, "stopped by the operator", True),
        ("damp", 3, "stopped at once by the operator", False),
        ("kill", 0, "stopped by the operator", True),
    ],
)
def test_buttons_and_a_killed_page_stop_the_robot(
    emulate: Callable[..., Emulator], tmp_path: Path, what: str, code: int, text: str, sits: bool
):
    robot = emulate("--robot", "go2", "--ideal-sensors", "--set", "servo_kp=40", "servo_kd=1")
    words = ("--port", robot.port, "--browser", "--page-port", "0", "--out", str(tmp_path), "--json")
    deploy = subprocess.Popen([*SUREFOOT, "deploy", "go2-steer", *words], stdout=-1, stderr=-1, text=True)
    try:
        assert deploy.stderr is not None
        address = deploy.stderr.readline().split()[0]
        while "surefoot: run (" not in (line := deploy.stderr.readline()):
            assert line
        time.sleep(0.5)
        if what == "kill":
            kill_page(deploy)
        else:
            press(address, what)
        output, errors = deploy.communicate(timeout=30)
    finally:
        deploy.kill()
    (run,) = json.loads(output)["runs"]
    assert (deploy.returncode, run["ended"], run["what"]) == (code, "stopped", text)
    assert EpisodeTrace.load(run["trace"]).num_steps > 10
    assert ("surefoot: disarm" in errors) == sits
    assert ("page's process has ended" in errors) == (what == "kill")


def test_drive_page_rejects_incompatible_options():
    command = ("deploy", "go2-steer", "--port", "x", "--browser")
    assert_rejected(run_surefoot(*command, "--commands", "5555"), "commands come from one source")
    assert_rejected(run_surefoot(*command, "--lockstep"), "a page runs in real time")
