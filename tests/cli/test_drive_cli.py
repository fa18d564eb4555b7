"""Drive page in a real browser, with its effects measured in the simulation; and messages that it rejects."""

from __future__ import annotations

import http.client
import json
import socket
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

pytest.importorskip("mujoco")
pytest.importorskip("viser")
pytest.importorskip("playwright")

import websockets
from chromium import errors_of, hold_stick, in_browser, new_page, running_browser
from websockets.sync.client import connect

from surefoot.api.drive_page import DrivePage, serve
from surefoot.cli import drive as drive_command
from surefoot.deploy.command_sources import FileCommands
from surefoot.errors import SurefootError
from surefoot.evaluation.command_runs import DrivenStep
from surefoot.report.pages.server import PageServer, machine_addresses
from surefoot.report.pages.view import RobotView
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page


@dataclass
class Running:
    """Drive page that runs in a thread."""

    drive: DrivePage
    server: PageServer

    @property
    def last(self) -> DrivenStep:
        return self.drive.robot.rows[-1]

    def until(self, holds: Callable[[], object]) -> None:
        """Wait until a condition holds."""
        end = time.monotonic() + 60.0
        while not holds():
            assert time.monotonic() < end
            time.sleep(0.02)

    def measure(self, seconds: float) -> list[DrivenStep]:
        """Return the rows of the next control steps, for a simulated time [s]."""
        robot, begin = self.drive.robot, self.drive.robot.time
        self.until(lambda: robot.time >= begin + seconds)
        return [row for row in list(robot.rows) if row.time > begin]


@contextmanager
def drive_page(folder: Path) -> Iterator[Running]:
    """Context manager that runs a drive page."""
    drive, view, stop = DrivePage("go2-steer", "mujoco", recordings=folder), RobotView(), threading.Event()
    server = PageServer(None, 0, view.port)
    thread = threading.Thread(target=drive.run, args=(server, view, stop))
    thread.start()
    try:
        yield Running(drive, server)
    finally:
        stop.set()
        thread.join()
        server.stop()
        view.stop()


@pytest.fixture(scope="module")
def running(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    with drive_page(tmp_path_factory.mktemp("recordings")) as page:
        yield page


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[Running]:
    """Yield a drive page that is not open in a browser."""
    with drive_page(tmp_path) as page:
        yield page


# These tests come first: their web sockets are in control only while no browser tab is open.


def open_socket(server: PageServer) -> Any:
    host = f"localhost:{server.port}"
    return connect(f"ws://{host}/socket", origin=f"http://{host}", close_timeout=0.2)  # type: ignore[arg-type]


def read_error(line: Any) -> str:
    while "error" not in (message := json.loads(line.recv(timeout=10))):
        pass
    return message["error"]


@pytest.mark.parametrize("path", ["socket", "viser"])
@pytest.mark.parametrize("origin", ["http://example.org", "http://localhost:1", "null"])
def test_socket_rejects_a_foreign_origin(running: Running, path: str, origin: str):
    with pytest.raises(websockets.InvalidStatus) as caught:
        connect(f"ws://localhost:{running.server.port}/{path}", origin=origin)  # type: ignore[arg-type]
    assert caught.value.response.status_code == 403


def test_the_view_of_another_server_is_not_shown(running: Running):
    # Its server could run scripts with the origin of this page, which may control the robot.
    own = f"localhost:{running.server.port}"
    for query, status in {
        "websocket=ws%3A%2F%2Fevil.example%2F": 403,
        f"websocket=ws%3A%2F%2F{own}%2Fviser&websocket=ws%3A%2F%2Fevil.example%2F": 403,
        f"websocket=ws%3A%2F%2F{own}%2Fviser&playbackPath=x": 403,
        "": 403,
        f"websocket=ws%3A%2F%2F{own}%2Fviser": 200,
    }.items():
        connection = http.client.HTTPConnection("localhost", running.server.port, timeout=10)
        connection.request("GET", f"/view?{query}")
        assert connection.getresponse().status == status, query
        connection.close()


def test_server_rejects_foreign_host_names_and_other_files(running: Running):
    url = f"http://127.0.0.1:{running.server.port}/"
    with pytest.raises(urllib.error.HTTPError, match="403"):
        urllib.request.urlopen(urllib.request.Request(url, headers={"Host": "example.org"}))
    with pytest.raises(urllib.error.HTTPError, match="404"):
        urllib.request.urlopen(f"{url}../page.html")


BAD = [
    *('{"command": [NaN, 0, 0]}', '{"command": [1e999, 0, 0]}', '{"command": "fast"}', '{"command": [null, 0, 0]}'),
    *('{"set": ["base_mass_ratio", 99]}', '{"set": ["control_step", 0.01]}', '{"set": [[], 1]}', '{"push": [1e9, 0]}'),
    *(
        '{"push": [10, 0]}',
        '{"push": [10, 0, 5]}',
        '{"push": [10, "0", 1]}',
        '{"export": "html"}',
        '{"export": "../x"}',
    ),
    *('{"ghost": "../../etc/passwd"}', '{"ghost": 1}', '{"ghost": ["x"]}', '{"record": {}, "export": []}'),
    *('{"policy": "../../etc/passwd"}', '{"policy": []}', '{"speed": 1e9}', '{"speed": {}}', '{"command": 3}'),
    *('{"terrain": ["lava"]}', '{"terrain": ["stairs", 9]}', '{"terrain": ["slope", "x"]}', '{"terrain": []}'),
    *('{"set": []}', '{"set": {}}', '{"set": ""}', '{"set": {"a": 1}}', '{"command": {}}', '{"stop": true}', "{}", "3"),
    *(f'{{"command": [{"9" * 400}, 0, 0]}}', f'{{"set": ["motor_strength", {"9" * 400}]}}', '{"restart": null}'),
    *("{", "[" * 999, "[" * 900 + "]" * 900, "\0"),
]


def test_invalid_messages_are_rejected_and_change_nothing(running: Running):
    with open_socket(running.server) as line:
        running.until(lambda: running.server.tabs > 0)
        for text in BAD:
            line.send(text)
            error = read_error(line)
            assert len(error) < 400
            assert "you are watching" not in error
        assert np.isfinite(running.measure(0.2)[-1].position).all()
    assert running.drive.robot.env.world.divergences == 0


def test_flood_of_messages_ends_the_connection_and_not_the_robot(running: Running):
    with open_socket(running.server) as line, pytest.raises(websockets.ConnectionClosed):  # noqa: PT012
        for _ in range(100_000):
            line.send('{"command": [0.1, 0, 0]}')
        line.recv(timeout=10)
    running.until(lambda: running.server.tabs == 0)
    with open_socket(running.server):
        assert len(running.measure(0.2)) > 5


@pytest.mark.realtime
def test_a_command_ends_unless_it_is_repeated(alone: Running):
    running = alone
    with open_socket(running.server) as line:
        running.until(lambda: running.server.tabs > 0)
        line.send('{"command": [0.5, 0, 0]}')
        running.until(lambda: running.drive.robot.rows and running.last.command[0] == 0.5)
        begin = time.monotonic()
        running.until(lambda: running.last.command[0] == 0.0)
        assert 2.0 < time.monotonic() - begin < 10.0


def test_file_of_commands_replaces_the_page(running: Running, tmp_path: Path):
    drive, file = running.drive, tmp_path / "commands.csv"
    file.write_text("time,forward,sideways,yaw_rate\n0,0.4,0,0\n")
    drive.source = FileCommands(file)
    try:
        with open_socket(running.server) as line:
            line.send('{"command": [-0.5, 0, 0]}')
            running.until(lambda: running.last.command[0] == 0.4)
            assert all(row.command[0] >= 0.0 for row in running.measure(0.2))
    finally:
        drive.source = None
        drive.robot.command([0.0, 0.0, 0.0])


def test_page_has_the_parameters_of_the_command_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    served: list[Any] = []
    monkeypatch.setattr("surefoot.api.drive_page.serve", lambda *arguments: served.append(arguments))
    assert drive_command.main(["go2-steer", "--set", "base_mass_ratio=1.5", "--commands", "walk.csv"]) == 0
    ((drive, host, _, commands),) = served
    assert drive.robot.env.world.params.base_mass_ratio.tolist() == [1.5]
    assert (host, commands) == (None, "walk.csv")


def test_policy_without_commands_rejects_a_source_of_them():
    with pytest.raises(SurefootError, match="'trot' follows no commands"):
        serve(DrivePage("trot", "mujoco"), None, 0, "5555")


def test_the_address_for_other_machines_contains_a_token():
    server = PageServer("127.0.0.1", 0, 1)
    try:
        assert len(server.address.split("/")[3]) > 20
        assert urllib.request.urlopen(server.address).status == 200
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"http://127.0.0.1:{server.port}/")
    finally:
        server.stop()


def test_all_addresses_of_the_machine_are_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    entries = [
        (socket.AF_INET, socket.SOCK_STREAM, 6, "", (name, 0)) for name in ("127.0.1.1", "192.0.2.7", "127.0.0.1")
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: entries)
    addresses = machine_addresses("0.0.0.0")
    assert "192.0.2.7" in addresses
    assert not any(address.startswith(("0.", "127.")) for address in addresses)
    assert machine_addresses("10.0.0.3") == ["10.0.0.3"]
    monkeypatch.undo()
    assert all(":" in address for address in machine_addresses("::"))
    with pytest.raises(SurefootError, match="--host is empty"):
        PageServer("", 0, 1)
    server = PageServer("0.0.0.0", 0, 1)
    try:
        server.print_addresses()
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines] == server.addresses
        for address in server.addresses:
            assert urllib.request.urlopen(address).status == 200
    finally:
        server.stop()


def test_a_port_in_use_is_reported_in_one_line():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        words = [sys.executable, "-m", "surefoot", "drive", "go2-steer", "--page-port", str(taken.getsockname()[1])]
        done = subprocess.run(words, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "--page-port" in done.stderr


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


@pytest.fixture(scope="module")
def shared(running: Running, browser: Browser) -> Iterator[Page]:
    """Yield a controlling tab; its errors fail the tests."""
    page = new_page(browser, 600, 420)
    wrong = errors_of(page)
    page.goto(running.server.address)
    page.wait_for_function("document.getElementById('state').textContent.includes('m/s')")
    page.frame_locator("#view").locator("canvas").first.wait_for()
    yield page
    page.close()
    assert wrong == []


@pytest.fixture
def page(running: Running, shared: Page) -> Page:
    """Return the controlling tab, with a robot that has just been restarted."""
    robot = running.drive.robot
    before = robot.restarts
    shared.locator("#restart").click()
    running.until(lambda: robot.restarts > before)
    return shared


def set_push(page: Page, share: float) -> None:
    """Set the force of pushes, relative to the robot's weight."""
    page.locator("#share").fill(str(share))
    page.locator("#duration").select_option("0.1")


FIGURES: dict[str, Callable[[list[DrivenStep]], Any]] = {
    "height": lambda rows: np.mean([row.position[2] for row in rows]),
    "heat": lambda rows: np.mean([row.heat for row in rows]),
    "shift": lambda rows: max(np.linalg.norm(row.position[:2] - rows[0].position[:2]) for row in rows),
}


@in_browser
@pytest.mark.realtime
def test_joystick_moves_the_robot_until_it_is_released(running: Running, page: Page):
    hold_stick(page, 0.4, 0.0)
    running.until(lambda: running.last.command[0] > 0.5)
    running.until(lambda: running.last.velocity[0] > 0.5)
    page.mouse.up()
    running.until(lambda: running.last.command[0] == 0.0)
    assert abs(np.mean([row.velocity[0] for row in running.measure(1.0)[-20:]])) < 0.3


@in_browser
@pytest.mark.realtime
def test_gamepad_gives_commands_with_a_dead_zone(running: Running, page: Page):
    page.evaluate("navigator.getGamepads = () => [{ connected: true, axes: [0.05, -0.5, 1, 0] }]")
    assert running.drive.robot.limits is not None
    half = pytest.approx(0.5 * running.drive.robot.limits.forward[1])
    running.until(lambda: running.last.command[0] == half and running.last.velocity[2] < -0.4)
    assert running.last.command[1] == 0.0
    page.evaluate("navigator.getGamepads = () => []")
    running.until(lambda: running.last.command[0] == 0.0)


@in_browser
@pytest.mark.realtime
def test_joystick_commands_sideways_motion_with_its_box_checked(running: Running, page: Page):
    page.locator("#strafe").check()
    hold_stick(page, 0.0, 0.5)
    running.until(lambda: running.last.command[1] == pytest.approx(0.5, abs=0.02) and running.last.velocity[1] > 0.2)
    page.mouse.up()
    page.locator("#strafe").uncheck()
    running.until(lambda: running.last.command[1] == 0.0)


@in_browser
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("name", "value", "walks", "figure", "low", "high"),
    [
        ("motor_strength", 0.4, False, "height", 0.5, 0.95),
        ("control_latency", 0.08, True, "heat", 1.3, 4.0),
        ("contact_friction", 0.05, False, "shift", 1.5, 1000.0),
    ],
)
def test_slider_changes_the_motion_of_the_same_robot(
    running: Running, page: Page, name: str, value: float, walks: bool, figure: str, low: float, high: float
):
    robot, slider = running.drive.robot, page.locator(f"input[type=range][name={name}]")
    before = float(getattr(robot.env.world.params, name).mean())
    page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")

    def measure() -> float:
        if figure == "shift":
            page.locator("#push-front").click()
        return float(FIGURES[figure](running.measure(2.0 if walks else 0.6)))

    def set_value(value: float) -> None:
        slider.fill(str(value))
        running.until(lambda: getattr(robot.env.world.params, name).mean() == pytest.approx(value, rel=1e-3))

    set_push(page, 0.6)
    if walks:
        page.locator("#why").click()
        page.keyboard.down("w")
        running.until(lambda: running.last.command[0] > 0.5)
    running.measure(1.0 if walks else 0.5)
    nominal = measure()
    set_value(value)
    running.measure(0.5)
    changed = measure()
    page.keyboard.up("w")
    set_value(before)
    assert low < changed / nominal < high
    assert running.drive.robot is robot


@in_browser
@pytest.mark.realtime
def test_button_pushes_to_the_chosen_side(running: Running, page: Page):
    set_push(page, 1.0)
    weight = running.drive.robot.robot.weight
    assert page.locator("#force").text_content() == f"1.00 × weight = {weight:.0f} N"
    running.measure(0.3)
    page.locator("#push-left").click()
    running.until(lambda: np.linalg.norm(running.drive.robot.push_force_world) == pytest.approx(weight, rel=1e-3))
    running.until(lambda: max(row.velocity[1] for row in list(running.drive.robot.rows)[-40:]) > 0.3)


@in_browser
@pytest.mark.realtime
def test_page_slows_and_pauses_the_simulation(running: Running, page: Page):
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
def test_second_tab_watches_until_the_first_is_closed(running: Running, page: Page, browser: Browser):
    second = new_page(browser, 300, 300, view=False)
    second.goto(running.server.address)
    watches = "document.getElementById('role').textContent.includes('watching')"
    second.wait_for_function(watches)
    assert second.locator("#push-front").is_disabled()
    assert page.locator("#push-front").is_enabled()
    assert second.locator("#camera-side").is_enabled()
    with open_socket(running.server) as line:
        line.send('{"pause": true}')
        assert "you are watching" in read_error(line)
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
def test_typed_command_holds_until_the_joystick_is_used_and_applies_to_the_ghost(running: Running, page: Page):
    page.locator("#c0").fill("0.4")
    page.keyboard.press("Enter")
    running.until(lambda: running.last.command[0] == 0.4)
    page.locator("#ghost").select_option("go2-steer")
    running.until(lambda: running.drive.ghost is not None)
    ghost = running.drive.ghost
    assert ghost is not None
    page.wait_for_function("document.getElementById('other0').textContent !== '–'")
    # Started together with the same policy, both robots move identically: command, push and slider act on both.
    page.evaluate("send({ push: [60, 90, .3], set: ['base_mass_ratio', 1.2] })")
    rows = running.measure(0.5)
    assert [row.command[0] for row in rows][-1] == 0.4
    assert ghost.env.world.params.base_mass_ratio.tolist() == [1.2]
    mine = {round(row.time, 6): row.position for row in list(running.drive.robot.rows)}
    others = [row for row in list(ghost.rows) if round(row.time + running.drive._ghost_offset, 6) in mine]
    assert len(others) > 20
    for row in others:
        assert row.position.tolist() == mine[round(row.time + running.drive._ghost_offset, 6)].tolist()
    # The command is still active, and ends when the joystick is used.
    page.locator("#ghost").select_option("")
    running.until(lambda: running.drive.ghost is None)
    assert running.drive.robot.commanded[0] == 0.4
    page.evaluate("send({ set: ['base_mass_ratio', 1] })")
    page.locator("#why").click()
    page.keyboard.press("s")
    running.until(lambda: running.drive.robot.commanded[0] == 0.0)
    page.wait_for_function("document.getElementById('c0').value === '0.00'")


@in_browser
def test_escape_stands_without_the_number_that_was_being_typed(running: Running, page: Page):
    page.locator("#c0").fill("0.5")
    page.keyboard.press("Escape")
    begin = running.drive.robot.steps
    running.until(lambda: running.drive.robot.steps > begin + 20)
    assert all(row.command[0] == 0.0 for row in list(running.drive.robot.rows)[-10:])
    assert running.drive.robot.commanded.tolist() == [0.0, 0.0, 0.0]
    assert page.locator("#c0").input_value() == "0.00"


@in_browser
@pytest.mark.parametrize("used", ["#share", "#speed", "#duration"])
def test_keys_steer_after_other_controls_were_used(running: Running, page: Page, used: str):
    if used == "#share":
        page.locator(used).click()
    else:
        page.locator(used).focus()
        page.locator(used).select_option({"#speed": "1", "#duration": "0.3"}[used])
    page.keyboard.down("w")
    running.until(lambda: running.drive.robot.commanded[0] > 0.5)
    page.keyboard.up("w")
    running.until(lambda: running.drive.robot.commanded[0] == 0.0)


@in_browser
def test_every_tab_shows_the_values_in_the_simulation(running: Running, page: Page, browser: Browser):
    watching, late = new_page(browser, 300, 300, view=False), new_page(browser, 300, 300, view=False)
    shown = "Math.abs(document.querySelector('input[type=range][name=contact_friction]')?.value - 0.05) < 1e-3"
    watching.goto(running.server.address)
    watching.wait_for_function("document.getElementById('role').textContent.includes('watching')")
    friction = running.drive.robot.env.world.params.contact_friction
    before = float(friction.mean())
    page.evaluate("document.querySelectorAll('details').forEach(one => { one.open = true; })")
    page.locator("input[type=range][name=contact_friction]").fill("0.05")
    running.until(lambda: friction.mean() == pytest.approx(0.05, rel=1e-3))
    watching.wait_for_function(shown)
    late.goto(running.server.address)
    late.wait_for_function(shown)
    page.locator("input[type=range][name=contact_friction]").fill(str(before))
    running.until(lambda: friction.mean() == pytest.approx(before, rel=1e-3))
    late.close()
    watching.close()


@in_browser
def test_recording_is_downloaded_as_trace_and_as_page(running: Running, page: Page, tmp_path: Path):
    page.locator("#record").click()
    running.until(lambda: running.drive.recordings.is_recording)
    begin = running.drive.robot.steps
    running.measure(0.3)
    page.locator("#record").click()
    with page.expect_download() as trace_file:
        page.locator("#file-npz").click()
    trace = EpisodeTrace.load(trace_file.value.path().rename(tmp_path / "trace.npz"))
    assert 10 <= trace.num_steps <= running.drive.robot.steps - begin + 1
    assert (trace.meta["policy"], trace.meta["world"], trace.meta["robot"]) == ("go2-steer", "mujoco", "go2")
    with page.expect_download() as html_file:
        page.locator("#make-html").click()
    assert "go2 in mujoco" in html_file.value.path().read_text("utf-8")
    assert {path.suffix for path in running.drive.recordings.folder.iterdir()} == {".npz", ".html"}
    # The page has this origin, where its script could steer the robot, so a browser only downloads it.
    url = f"{running.server.address}files/{html_file.value.suggested_filename}"
    assert urllib.request.urlopen(url).headers["Content-Disposition"].startswith("attachment")


@in_browser
def test_camera_follows_the_heading_until_it_is_dragged(running: Running, page: Page):
    azimuth = "document.getElementById('view').contentWindow.__viserMutable.cameraControl.azimuthAngle"
    page.locator("#camera-side").click()
    page.wait_for_function(f"Math.abs(Math.sin({azimuth}) - 1) < .02")
    page.locator("#camera-behind").click()
    page.wait_for_function(f"Math.abs(Math.cos({azimuth}) - 1) < .02")
    page.mouse.move(200, 90)
    page.mouse.down()
    page.mouse.move(260, 95)
    page.mouse.up()
    page.wait_for_function("document.querySelector('#camera [aria-pressed=true]').textContent === 'free'")


@in_browser
def test_page_changes_policy_and_world(running: Running, page: Page):
    page.locator("#policy").select_option("go2-trot")
    running.until(lambda: running.drive.policy == "go2-trot")
    page.wait_for_function("document.getElementById('why').textContent.includes('follows no commands')")
    assert "off" in (page.locator("#stick").get_attribute("class") or "")
    assert running.measure(0.1)
    page.locator("#policy").select_option("go2-steer")
    running.until(lambda: running.drive.policy == "go2-steer")
    if "bullet" in running.drive.worlds:
        page.locator("#world").select_option("bullet")
        running.until(lambda: running.drive.world == "bullet")
        assert running.measure(0.1)
        page.locator("#world").select_option("mujoco")
        running.until(lambda: running.drive.world == "mujoco")


@in_browser
def test_page_changes_the_terrain_and_draws_it(running: Running, page: Page):
    page.locator("#terrain").select_option("slope")
    running.until(lambda: running.drive.terrain == "slope:15")
    page.locator("#size").fill("5")
    running.until(lambda: running.drive.terrain == "slope:5")
    ground, view = running.drive.robot.env.state.ground, "document.getElementById('view').contentWindow.__viserMutable"
    assert ground.height(np.array([2.0, 0.0])) == pytest.approx(np.tan(np.radians(5.0)))
    assert np.abs(running.measure(0.1)[0].position[:2]).max() < 0.05
    page.wait_for_function(
        f"{view}.nodeRefFromName['/world/ground0']?.getObjectByProperty('isMesh', true)?.material.map"
    )
    page.locator("#terrain").select_option("flat")
    running.until(lambda: running.drive.terrain == "flat")
    page.locator("#size").wait_for(state="hidden")
    assert running.drive.robot.env.state.ground.is_flat


@in_browser
def test_closing_the_last_tab_pauses_the_simulation(running: Running, page: Page):
    page.goto("about:blank")
    running.until(lambda: running.server.tabs == 0)
    time.sleep(0.05)
    steps = running.drive.robot.steps
    time.sleep(0.3)
    assert running.drive.robot.steps == steps
    page.goto(running.server.address)
    running.until(lambda: running.drive.robot.steps > steps)
