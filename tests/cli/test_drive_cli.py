"""The page of `surefoot drive` in a real browser, measured in the trace of the simulation; and what it refuses."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("viser")
pytest.importorskip("playwright")

import websockets
from chromium import errors_of, hold_stick, in_browser, running_browser
from websockets.sync.client import connect

from surefoot.cli import play
from surefoot.cli.helpers.drive_page import DrivePage, serve
from surefoot.deploy.command_sources import FileCommands
from surefoot.errors import SurefootError
from surefoot.evaluate.driven import DrivenStep
from surefoot.report.pages.server import PageServer
from surefoot.report.pages.view import RobotView

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@dataclass
class Running:
    """A drive that runs in a thread."""

    drive: DrivePage
    server: PageServer

    def until(self, holds: Callable[[], object], seconds: float = 20.0) -> None:
        """Wait until something holds."""
        end = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < end, "it did not happen"
            time.sleep(0.02)

    def measured(self, seconds: float) -> list[DrivenStep]:
        """Wait for some simulated time [s], and return its control steps."""
        robot, begin = self.drive.robot, self.drive.robot.time
        self.until(lambda: robot.time >= begin + seconds)
        return [row for row in list(robot.rows) if row.time > begin]


@pytest.fixture(scope="module")
def running() -> Iterator[Running]:
    drive, view, stop = DrivePage("go2-steer", "mujoco"), RobotView(), threading.Event()
    server = PageServer(None, 0, view.port)
    thread = threading.Thread(target=drive.run, args=(server, view, stop))
    thread.start()
    yield Running(drive, server)
    stop.set()
    thread.join()
    server.stop()
    view.stop()


# These come first: while no browser's tab is open, they drive.


def talk(server: PageServer, origin: str | None = None) -> Any:
    host = f"localhost:{server.port}"
    # Nobody reads what the page says, so that its answer to a closing line may never be seen.
    return connect(f"ws://{host}/socket", origin=origin or f"http://{host}", close_timeout=0.2)  # type: ignore[arg-type]


@pytest.mark.parametrize("path", ["socket", "viser"])
@pytest.mark.parametrize("origin", ["http://example.org", "http://localhost:1", "null"])
def test_a_foreign_origin_is_refused(running: Running, path: str, origin: str):
    with pytest.raises(websockets.InvalidStatus) as caught:
        connect(f"ws://localhost:{running.server.port}/{path}", origin=origin)  # type: ignore[arg-type]
    assert caught.value.response.status_code == 403


def test_a_name_of_another_site_that_leads_here_is_refused(running: Running):
    url = f"http://127.0.0.1:{running.server.port}/"
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "example.org"}))
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{url}../page.html")


BAD = [
    *('{"command": [NaN, 0, 0]}', '{"command": [1e999, 0, 0]}', '{"command": "fast"}', '{"command": [null, 0, 0]}'),
    *('{"set": ["base_mass_ratio", 99]}', '{"set": ["control_step", 0.01]}', '{"set": [[], 1]}', '{"push": [1e9, 0]}'),
    *('{"policy": "../../etc/passwd"}', '{"policy": []}', '{"speed": 1e9}', '{"speed": {}}', '{"command": 3}'),
    *("{", "[" * 999),
]


def test_what_is_no_good_is_refused_and_does_no_harm(running: Running):
    with talk(running.server) as line:
        running.until(lambda: running.server.tabs > 0)
        for text in BAD:
            line.send(text)
            while "error" not in (said := json.loads(line.recv(timeout=10))):
                pass
            assert len(said["error"]) < 400
            assert "you watch" not in said["error"]
        state = running.measured(0.2)
    assert np.isfinite(state[-1].position).all()
    assert running.drive.robot.env.world.divergences == 0


def flood(line: Any) -> None:
    for _ in range(100_000):
        line.send('{"command": [0.1, 0, 0]}')
    line.recv(timeout=10)


def test_a_flood_of_messages_ends_the_connection_and_not_the_robot(running: Running):
    with talk(running.server) as line, pytest.raises(websockets.ConnectionClosed):
        flood(line)
    running.until(lambda: running.server.tabs == 0)
    with talk(running.server):
        assert len(running.measured(0.2)) > 5


def test_a_command_that_is_not_repeated_ends(running: Running):
    with talk(running.server) as line:
        running.until(lambda: running.server.tabs > 0)
        line.send('{"command": [0.5, 0, 0]}')
        rows = running.drive.robot.rows
        running.until(lambda: rows and rows[-1].command[0] == 0.5)
        begin = time.monotonic()
        running.until(lambda: rows[-1].command[0] == 0.0)
        assert 2.0 < time.monotonic() - begin < 5.0


def test_a_file_of_commands_drives_in_place_of_the_page(running: Running, tmp_path: Path):
    drive, file = running.drive, tmp_path / "commands.csv"
    file.write_text("time,forward,sideways,yaw_rate\n0,0.4,0,0\n")
    drive.source = FileCommands(file)
    try:
        with talk(running.server) as line:
            line.send('{"command": [-0.5, 0, 0]}')
            running.until(lambda: drive.robot.rows[-1].command[0] == 0.4)
            assert all(row.command[0] >= 0.0 for row in running.measured(0.2))
    finally:
        drive.source = None
        drive.robot.command([0.0, 0.0, 0.0])


def test_play_in_the_browser_is_the_page_with_its_parameters(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    served: list[Any] = []
    monkeypatch.setattr("surefoot.cli.helpers.drive_page.serve", lambda *given: served.append(given))
    assert play.main(["go2-steer", "--browser", "--set", "base_mass_ratio=1.5", "--commands", "walk.csv"]) == 0
    ((drive, host, _, commands),) = served
    assert drive.robot.env.world.params.base_mass_ratio.tolist() == [1.5]
    assert (host, commands) == (None, "walk.csv")
    with pytest.raises(SurefootError, match="a page makes no MP4"):
        play.main(["go2-steer", "--browser", "--out", "x.mp4"])


def test_a_policy_without_commands_takes_none_from_elsewhere():
    with pytest.raises(SurefootError, match="'trot' has no commands to follow"):
        serve(DrivePage("trot", "mujoco"), None, 0, "5555")


def test_for_other_machines_the_address_holds_a_token(running: Running):
    server = PageServer("127.0.0.1", 0, 1)
    try:
        assert len(server.address.split("/")[3]) > 20
        assert urllib.request.urlopen(server.address).status == 200
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{server.port}/")
    finally:
        server.stop()


def test_a_port_that_is_taken_is_told_in_a_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = [sys.executable, "-m", "surefoot", "drive", "go2-steer", "--port", str(taken.getsockname()[1])]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "--port" in done.stderr


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def shared(running: Running, browser: Browser) -> Iterator[Page]:
    """Give a tab that drives; its errors fail the tests."""
    # A small picture, as it is drawn in software here.
    page = browser.new_page(viewport={"width": 600, "height": 420})
    wrong = errors_of(page)
    page.goto(running.server.address)
    page.wait_for_function("document.getElementById('state').textContent.includes('m/s')")
    page.frame_locator("#view").locator("canvas").first.wait_for()
    yield page
    page.close()
    assert wrong == []


@pytest.fixture
def page(running: Running, shared: Page) -> Page:
    """Give the tab that drives, with a robot that has just begun to stand, as its sheet says."""
    robot = running.drive.robot
    before = robot.restarts
    shared.locator("#restart").click()
    running.until(lambda: robot.restarts > before)
    return shared


def speed(rows: list[DrivenStep]) -> float:
    return float(np.mean([row.velocity[0] for row in rows]))


def torque(rows: list[DrivenStep]) -> float:
    return float(np.mean([np.abs(row.torque).mean() for row in rows]))


def height(rows: list[DrivenStep]) -> float:
    return float(np.mean([row.position[2] for row in rows]))


def heat(rows: list[DrivenStep]) -> float:
    return float(np.mean([row.heat for row in rows]))


@in_browser
@pytest.mark.realtime
def test_the_joystick_moves_the_robot_and_lets_it_stand(running: Running, page: Page):
    hold_stick(page, 0.4, 0.0)
    running.until(lambda: running.drive.robot.rows[-1].command[0] > 0.5)
    running.until(lambda: running.drive.robot.rows[-1].velocity[0] > 0.5)
    page.mouse.up()
    running.until(lambda: running.drive.robot.rows[-1].command[0] == 0.0)
    assert abs(speed(running.measured(1.0)[-20:])) < 0.3


def shift(rows: list[DrivenStep]) -> float:
    return float(max(np.linalg.norm(row.position[:2] - rows[0].position[:2]) for row in rows))


@in_browser
@pytest.mark.realtime
def test_sticks_of_a_gamepad_are_commands(running: Running, page: Page):
    pad = "navigator.getGamepads = () => [{ connected: true, axes: [0.05, -0.5, 1, 0] }]"
    page.evaluate(pad)
    rows, limits = running.drive.robot.rows, running.drive.robot.limits
    assert limits is not None
    half = pytest.approx(0.5 * limits.forward[1])
    # A stick that is almost in its middle is in it.
    running.until(lambda: rows[-1].command[0] == half and rows[-1].velocity[2] < -0.4)
    assert rows[-1].command[1] == 0.0
    page.evaluate("navigator.getGamepads = () => []")
    running.until(lambda: rows[-1].command[0] == 0.0)


@in_browser
@pytest.mark.realtime
def test_the_joystick_goes_sideways_if_it_is_told_to(running: Running, page: Page):
    page.locator("#strafe").check()
    hold_stick(page, 0.0, 0.5)
    rows = running.drive.robot.rows
    running.until(lambda: rows[-1].command[1] == pytest.approx(0.5, abs=0.02) and rows[-1].velocity[1] > 0.2)
    page.mouse.up()
    page.locator("#strafe").uncheck()
    running.until(lambda: rows[-1].command[1] == 0.0)


@in_browser
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("name", "value", "walks", "figure", "low", "high"),
    [
        ("base_mass_ratio", 1.8, False, torque, 1.2, 1.6),
        ("motor_strength", 0.4, False, height, 0.5, 0.95),
        ("control_latency", 0.08, True, heat, 1.3, 4.0),
        ("contact_friction", 0.05, False, shift, 1.5, 1000.0),
    ],
)
def test_a_slider_changes_the_motion_of_the_same_robot(
    running: Running,
    page: Page,
    name: str,
    value: float,
    walks: bool,
    figure: Callable[[list[DrivenStep]], float],
    low: float,
    high: float,
):
    robot, slider = running.drive.robot, page.locator(f"input[type=range][name={name}]")
    before = float(getattr(robot.env.world.params, name).mean())
    if walks:
        page.locator("#why").click()
        page.keyboard.down("w")
        running.until(lambda: robot.rows[-1].command[0] > 0.5)
    running.measured(1.0 if walks else 0.5)
    if figure is shift:
        page.locator("#force").fill("100")
        page.locator("#push").click()
    usual = figure(running.measured(0.6))
    slider.fill(str(value))
    running.until(lambda: getattr(robot.env.world.params, name).mean() == pytest.approx(value, rel=1e-3))
    running.measured(0.5)
    if figure is shift:
        page.locator("#push").click()
    changed = figure(running.measured(0.6))
    page.keyboard.up("w")
    slider.fill(str(before))
    running.until(lambda: getattr(robot.env.world.params, name).mean() == pytest.approx(before, rel=1e-3))
    assert low < changed / usual < high
    assert running.drive.robot is robot


@in_browser
@pytest.mark.realtime
def test_the_button_pushes_to_its_side(running: Running, page: Page):
    page.locator("#force").fill("150")
    page.locator("#direction").select_option("90")
    running.measured(0.3)
    page.locator("#push").click()
    running.until(lambda: max(row.velocity[1] for row in list(running.drive.robot.rows)[-40:]) > 0.3)


@in_browser
@pytest.mark.realtime
def test_time_is_slowed_and_stopped(running: Running, page: Page):
    page.locator("#speed").select_option("0.25")
    running.until(lambda: running.drive.speed == 0.25)
    begin, simulated = time.monotonic(), running.drive.robot.time
    running.until(lambda: time.monotonic() > begin + 1.0)
    assert 0.1 < (running.drive.robot.time - simulated) / (time.monotonic() - begin) < 0.3
    page.locator("#speed").select_option("1")
    page.locator("#pause").click()
    running.until(lambda: running.drive.paused)
    steps = running.drive.robot.steps
    page.wait_for_function("document.getElementById('state').textContent.includes('paused')")
    assert running.drive.robot.steps <= steps + 1
    page.locator("#pause").click()
    running.until(lambda: not running.drive.paused)


@in_browser
def test_a_second_tab_watches_and_drives_once_the_first_has_gone(running: Running, page: Page, browser: Browser):
    second = browser.new_page(viewport={"width": 300, "height": 300})
    second.goto(running.server.address)
    watches = "document.getElementById('role').textContent.includes('watching')"
    second.wait_for_function(watches)
    assert second.locator("#push").is_disabled()
    assert page.locator("#push").is_enabled()
    with talk(running.server) as line:
        line.send('{"pause": true}')
        while "error" not in (said := json.loads(line.recv(timeout=10))):
            pass
        assert "you watch" in said["error"]
    assert not running.drive.paused
    page.goto("about:blank")
    second.wait_for_function(f"!{watches}")
    second.locator("#pause").click()
    running.until(lambda: running.drive.paused)
    second.wait_for_function("document.getElementById('state').textContent.includes('paused')")
    second.locator("#pause").click()
    running.until(lambda: not running.drive.paused)
    page.goto(running.server.address)
    page.wait_for_function(watches)
    second.close()
    page.wait_for_function(f"!{watches}")
    running.until(lambda: running.server.tabs == 1)


@in_browser
def test_policies_and_worlds_change_while_it_runs(running: Running, page: Page):
    page.locator("#policy").select_option("go2-trot")
    running.until(lambda: running.drive.policy == "go2-trot")
    page.wait_for_function("document.getElementById('why').textContent.includes('follows no commands')")
    assert "off" in (page.locator("#stick").get_attribute("class") or "")
    assert running.measured(0.1)
    page.locator("#policy").select_option("go2-steer")
    running.until(lambda: running.drive.policy == "go2-steer")
    if "bullet" in running.drive.worlds:
        page.locator("#world").select_option("bullet")
        running.until(lambda: running.drive.world == "bullet")
        assert running.measured(0.1)
        page.locator("#world").select_option("mujoco")
        running.until(lambda: running.drive.world == "mujoco")


@in_browser
def test_closing_the_last_tab_stops_time(running: Running, page: Page):
    page.goto("about:blank")
    running.until(lambda: running.server.tabs == 0)
    time.sleep(0.05)
    steps = running.drive.robot.steps
    time.sleep(0.3)
    assert running.drive.robot.steps == steps
    page.goto(running.server.address)
    running.until(lambda: running.drive.robot.steps > steps)
