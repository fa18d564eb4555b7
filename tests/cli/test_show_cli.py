"""`surefoot show`: the page of recorded runs in a real browser, served and as one file; its kinds of arguments."""

from __future__ import annotations

import math
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

pytest.importorskip("viser")
pytest.importorskip("playwright")

from chromium import errors_of, in_browser, new_page, running_browser
from recordings import swinging

from surefoot.cli import show
from surefoot.cli.main import main
from surefoot.report.drawing.scene import poses
from surefoot.robot import RobotDescription
from surefoot.task.trace import EpisodeTrace

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

ROBOTS = ("go2", "minitaur")
MakeRun = Callable[..., EpisodeTrace]


def pushed(make_run: MakeRun, name: str, speed: float) -> EpisodeTrace:
    """Return a run whose base is constantly pushed to the left."""
    trace = swinging(make_run, name, speed).trace
    return replace(trace, push_force_world=np.tile([0.0, 30.0, 0.0], (trace.num_steps, 1)))


@pytest.fixture(scope="module")
def traces(make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("traces")
    return [
        pushed(make_run, name, speed).save(folder / f"{name}.npz")
        for name, speed in zip(ROBOTS, (0.5, 1.0), strict=True)
    ]


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with running_browser() as browser:
        yield browser


def opened(browser: Browser, url: str) -> Page:
    """Open a page, paused at time 0; it must not request anything else or raise errors."""
    tab, requests = new_page(browser, 480, 400), list[str]()
    wrong = errors_of(tab)
    tab.on("request", lambda request: requests.append(request.url))
    tab.goto(url)
    tab.evaluate("setPlaying(false)")
    tab.wait_for_function("document.body.dataset.ready === 'yes'")
    tab.evaluate("setTime(0)")
    assert wrong == []
    assert requests == [url]
    return tab


@pytest.fixture(scope="module")
def shared(traces: list[Path], browser: Browser, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """Yield a tab that shows the runs from a file."""
    file = tmp_path_factory.mktemp("shared") / "runs.html"
    assert main(["show", *map(str, traces), "--out", str(file)]) == 0
    assert file.stat().st_size < 1.5e6
    tab = opened(browser, file.as_uri())
    wrong = errors_of(tab)
    yield tab
    assert wrong == []


@pytest.fixture
def page(shared: Page) -> Page:
    """Return the tab with both robots side by side, paused at the start."""
    shared.locator("#layout").select_option("side")
    shared.locator("#time").fill("0")
    return shared


@contextmanager
def served(trace: Path, *words: str) -> Iterator[str]:
    """Serve a trace and yield the page's address. Ctrl-C must end the command although its parent ignores SIGINT."""
    process = subprocess.Popen(
        [sys.executable, "-m", "surefoot", "show", str(trace), "--page-port", "0", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),
    )
    try:
        assert process.stdout is not None
        yield process.stdout.readline().split()[0]
        process.send_signal(signal.SIGINT)
        noted = f"surefoot: {trace} is a recorded run\n"
        assert process.communicate(timeout=20)[1] == f"{noted}surefoot: interrupted\n"
    finally:
        process.kill()


def place(page: Page, node: str) -> list[float]:
    """Return the position of a scene frame relative to its parent [m]."""
    script = "node => document.getElementById('view').contentWindow.__viserMutable.nodePoseData[node].position"
    position: list[float] = page.evaluate(script, node)
    return position


@in_browser
def test_time_line_moves_each_robot_at_its_speed(page: Page):
    assert place(page, "/world/r0/base")[0] == pytest.approx(0.005, abs=1e-3)
    page.locator("#time").fill("1.5")
    assert place(page, "/world/r0/base")[0] == pytest.approx(0.75, abs=1e-3)
    assert place(page, "/world/r1/base")[0] == pytest.approx(1.5, abs=1e-3)
    assert place(page, "/world")[0] == pytest.approx(-(0.75 + 1.5) / 2, abs=1e-3)
    assert "1.50 of 2.00 s" in page.locator("#clock").inner_text()


@in_browser
@pytest.mark.parametrize("number", [0, 1])
def test_drawn_links_match_forward_kinematics(page: Page, number: int):
    """Compare the positions of all frames below the base in the browser with forward kinematics in Python."""
    page.locator("#time").fill("0.3")
    robot = RobotDescription.load(ROBOTS[number])
    angles = robot.resting_angles + 0.2 * math.sin(2 * math.pi * 0.3)
    expected = np.array([pose[0, :3, 3] for pose in poses(robot, np.zeros(3), [1, 0, 0, 0], angles).values()])
    drawn = page.evaluate(
        """async node => {
          const { nodeRefFromName } = document.getElementById("view").contentWindow.__viserMutable;
          await new Promise(done => setTimeout(done, 200));
          nodeRefFromName[node].updateWorldMatrix(true, true);
          const inverse = nodeRefFromName[node].matrixWorld.clone().invert(), place = name =>
            inverse.clone().multiply(nodeRefFromName[name].matrixWorld).elements.slice(12, 15);
          const below = Object.keys(nodeRefFromName).filter(name => name.startsWith(node));
          return below.filter(name => /(root|l[0-9]+)$/.test(name)).map(place);
        }""",
        f"/world/r{number}/base",
    )
    assert len(drawn) == len(robot.urdf.links)
    apart = np.linalg.norm(np.array(drawn)[:, None] - expected, axis=-1)
    assert apart.min(axis=0).max() < 1e-3
    assert apart.min(axis=1).max() < 1e-3


@in_browser
def test_layouts_position_and_hide_robots(page: Page):
    assert place(page, "/world/r0")[1] - place(page, "/world/r1")[1] > 0.5
    page.locator("#layout").select_option("over")
    assert place(page, "/world/r0")[1] == place(page, "/world/r1")[1] == 0.0
    page.locator("#layout").select_option("one")
    shown = "document.getElementById('view').contentWindow.__viserMutable.nodeRefFromName['{}'].visible === {}"
    page.wait_for_function(shown.format("/world/r1", "false"))
    page.locator("input[type=checkbox]").nth(1).click()
    page.wait_for_function(shown.format("/world/r0", "false"))
    page.wait_for_function(shown.format("/world/r1", "true"))
    assert not page.locator("input[type=checkbox]").nth(0).is_checked()


@in_browser
def test_page_plays_and_follows_a_click_into_a_plot(page: Page):
    page.locator("#speed").select_option("2")
    page.locator("#play").click()
    page.wait_for_function("+document.getElementById('time').value > 0.4")
    page.locator("#play").click()
    page.locator("#plots canvas").first.scroll_into_view_if_needed()
    box = page.locator("#plots canvas").first.bounding_box()
    assert box is not None
    middle = box["x"] + (page.evaluate("GUTTER") + box["width"]) / 2
    page.mouse.click(middle, box["y"] + 0.5 * box["height"])
    assert float(page.locator("#time").input_value()) == pytest.approx(1.0, abs=0.02)
    cursor = page.locator(".plot i").first.bounding_box()
    assert cursor is not None
    assert cursor["x"] == pytest.approx(middle, abs=2.0)


@in_browser
def test_keys_play_and_step_after_a_control_was_used(page: Page):
    page.locator("#time").fill("1")
    page.locator("#play").focus()
    page.keyboard.press("ArrowRight")
    rate = page.evaluate("DATA.rate")
    assert page.evaluate("now") == pytest.approx(1 + 1 / rate)
    page.locator("#time").focus()
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    assert page.evaluate("now") == pytest.approx(1 - 1 / rate)
    page.keyboard.press("Space")
    assert page.evaluate("playing")
    page.locator("#play").focus()
    page.keyboard.press("Space")
    assert not page.evaluate("playing")


@in_browser
def test_reduced_curves_keep_peaks_and_phases(page: Page):
    value = "i => [0, 9, 0, 1, -2, null, null, null, null, 5][i]"
    assert page.evaluate(f"extremes(0, 9, 3, {value})") == [[0, 0], [1, 9], [3, 1], [4, -2], [6, None], [9, 5]]
    assert page.evaluate(f"extremes(2, 4, 1, {value})") == [[2, 0], [3, 1], [4, -2]]
    assert page.evaluate("phases(1, 6, i => [1, 1, 1, 0, 0, 1, 1, 0][i])") == [[1, 1], [2, 1], [4, 0], [6, 1]]
    assert page.evaluate("phases(4, 3, i => 1)") == []


@in_browser
def test_a_drag_beyond_a_plot_stays_in_its_window(page: Page):
    page.evaluate("document.getElementById('span').append(new Option('half a second', '0.5'))")
    page.locator("#span").select_option("0.5")
    page.locator("#plots canvas").first.scroll_into_view_if_needed()
    box = page.locator("#plots canvas").first.bounding_box()
    assert box is not None
    y = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.9 * box["width"], y)
    page.mouse.down()
    for beyond in range(5):
        page.mouse.move(box["x"] + box["width"] + beyond, y)
    page.mouse.up()
    assert page.evaluate("now") == pytest.approx(0.5, abs=1e-3)
    page.locator("#span").select_option("")


@in_browser
def test_plots_show_values_at_the_cursor(page: Page):
    page.locator("#time").fill("1")
    figures = page.locator(".plot").filter(has_text="forward velocity").locator("output span").all_inner_texts()
    assert figures == ["0.50", "1.00"]
    assert page.locator(".plot").filter(has_text="push").locator("output span").all_inner_texts() == ["30.00", "30.00"]
    assert page.locator(".plot").filter(has_text="yaw rate").is_hidden()
    assert page.locator(".plot").filter(has_text="angle").is_hidden()
    page.locator("#motor").select_option("FL_hip_joint")
    (angle,) = page.locator(".plot").filter(has_text="angle").locator("output span").all_inner_texts()[:1]
    assert float(angle) == pytest.approx(0.0, abs=0.02)
    page.locator("#motor").select_option("")


@in_browser
def test_show_serves_the_page(traces: list[Path], browser: Browser):
    with served(traces[0]) as url:
        tab = opened(browser, url)
        tab.locator("#time").fill("1")
        assert place(tab, "/world/r0/base")[0] == pytest.approx(0.5, abs=1e-3)
        tab.close()


def test_page_for_other_machines_has_a_token(traces: list[Path]):
    with served(traces[0], "--host", "127.0.0.1") as url:
        assert urllib.request.urlopen(url).status == 200
        for inside in (re.sub(r"/[^/]+/$", "/", url), url + "socket", url + "viser"):
            with pytest.raises(urllib.error.HTTPError, match="404"):
                urllib.request.urlopen(inside)


def test_show_draws_the_given_height_map(make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    trace = swinging(make_run, terrain="hill.npz").trace.save(tmp_path / "run.npz")
    heights = np.zeros((41, 41))
    heights[30:] = 0.2
    np.savez(tmp_path / "hill.npz", heights=heights, cell=0.1)
    show = ["show", str(trace), "--out", str(tmp_path / "x.html")]
    assert main(show) == 0
    assert "the height map 'hill.npz' is not shown; give its file with --terrain" in capsys.readouterr().out
    level = len((tmp_path / "x.html").read_text())
    assert main([*show, "--terrain", str(tmp_path / "hill.npz")]) == 0
    assert "is not shown" not in capsys.readouterr().out
    assert len((tmp_path / "x.html").read_text()) != level


def test_show_draws_a_log_with_the_robot_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    time = 0.01 * np.arange(50)
    np.savez(tmp_path / "log.npz", time=time, command=np.tile(np.sin(time)[:, None], (1, 12)), imu=np.zeros((50, 4)))
    assert main(["show", str(tmp_path / "log.npz"), "--robot", "go2", "--out", str(tmp_path / "log.html")]) == 0
    assert "wrote" in capsys.readouterr().out
    assert "12 of 12 motors were not read" in (tmp_path / "log.html").read_text()


def test_show_films_a_single_run(traces: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    pytest.importorskip("imageio_ffmpeg")
    assert main(["show", str(traces[0]), "--out", str(tmp_path / "run.mp4")]) == 0
    assert capsys.readouterr().out == f"wrote {tmp_path / 'run.mp4'}\n"
    assert (tmp_path / "run.mp4").stat().st_size > 1000


@pytest.mark.parametrize(
    ("files", "word", "is_recorded"),
    [
        (["run_000.npz"], "run_000.npz", True),
        ([], "none.npz", True),
        (["cut.npz.partial"], "cut.npz.partial", True),
        (["gap/a.npz"], "gap", True),
        (["run/policy.onnx", "run/figures/episode.npz"], "run", False),
        (["run/run.json", "run/figures/episode.npz"], "run", False),
        (["runs/one/policy.onnx"], "runs", False),
        (["run/policy.onnx", "run/figures/episode.npz"], "run/figures", True),
        (["trot/a.npz"], "trot", False),
        ([], "gait.yaml", False),
    ],
)
def test_show_decides_by_the_argument(
    files: list[str], word: str, is_recorded: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    monkeypatch.chdir(tmp_path)
    called = []
    monkeypatch.setattr(show, "_show_policy", lambda argv: called.append((argv, False)) or 0)
    monkeypatch.setattr(show, "_show_runs", lambda argv: called.append((argv, True)) or 0)
    words = ["--terrain", "map.npz", word, "--out", "x.npz"]
    assert main(["show", *words]) == 0
    assert called == [(words, is_recorded)]


def test_the_help_of_show_has_the_options_of_policies_and_of_runs(capsys: pytest.CaptureFixture[str]):
    assert main(["show", "--help"]) == 0
    output = capsys.readouterr().out
    assert output.startswith("usage: surefoot show POLICY ...")
    assert all(option in output for option in ("--push-force", "--layout", "--page-port"))


def test_a_damaged_file_is_named_with_the_robot_option(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04 and no more")
    assert main(["show", str(tmp_path / "broken.npz"), "--robot", "minitaur"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"surefoot: error: {tmp_path / 'broken.npz'}: is cut off, damaged or no file of arrays")
    assert error.count("\n") == 1
