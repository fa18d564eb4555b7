"""Pages survive two hundred random messages generated from a grammar of their keys."""

from __future__ import annotations

import json
import random
import shutil
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mujoco")
pytest.importorskip("viser")

import websockets
from hostile_messages import LIMIT, draw_message, open_tab
from websockets.sync.client import ClientConnection

from surefoot.api.drive_page import DrivePage
from surefoot.cli.helpers.deploy_page import Page
from surefoot.cli.helpers.train_page import NewestPolicy
from surefoot.errors import SurefootError
from surefoot.report.pages.messages import DeployMessage, DriveMessage, TabMessage, read_message
from surefoot.report.pages.server import PageServer, robot_page
from surefoot.robot import RobotDescription

MESSAGES = 200
SEED = 66


@dataclass
class Running:
    """Page whose handlers run in a thread."""

    kind: type[TabMessage]
    server: PageServer
    thread: threading.Thread
    command: Callable[[], Any]
    """Function that returns the present command of the page."""


@contextmanager
def running(run: Callable[[threading.Event], None]) -> Iterator[threading.Thread]:
    stop = threading.Event()
    thread = threading.Thread(target=run, args=(stop,))
    thread.start()
    try:
        yield thread
    finally:
        stop.set()
        thread.join()


@pytest.fixture(params=["drive", "train", "deploy"])
def page(request: pytest.FixtureRequest, repository: Path, tmp_path: Path) -> Iterator[Running]:
    with ExitStack() as stack:
        if request.param == "deploy":
            server, view = stack.enter_context(robot_page(None, 0, messages=DeployMessage))
            limits = [[-1.0, 1.0]] * 3
            setup = {"robot": str(RobotDescription.load("go2").folder), "policy": "p", "limits": limits, "channel": 0}
            real = Page(setup, server, view, lambda **message: None)

            def serve(stop: threading.Event) -> None:
                while not stop.is_set():
                    real.step()
                    time.sleep(0.002)

            thread = stack.enter_context(running(serve))
            yield Running(DeployMessage, server, thread, lambda: real._command)
            return
        server, view = stack.enter_context(robot_page(None, 0))
        drive = DrivePage("go2-steer", "mujoco", recordings=tmp_path)
        if request.param == "train":
            newest = Path(shutil.copy(repository / "policies" / "go2-steer.onnx", tmp_path / "newest.onnx"))
            drive = NewestPolicy(newest, "mujoco")
        thread = stack.enter_context(running(lambda stop: drive.run(server, view, stop)))
        yield Running(DriveMessage, server, thread, lambda: drive.robot.commanded)


def refusal(kind: type[TabMessage], text: str | bytes) -> str:
    """Return why the schema rejects a message, or an empty text."""
    try:
        read_message(kind, text)
    except SurefootError as error:
        return str(error)
    return ""


def read_error(tab: ClientConnection, start: str) -> None:
    """Read messages up to the answer to a rejected message that starts with a given text."""
    while not (error := json.loads(tab.recv(timeout=20)).get("error", "")).startswith(start):
        pass
    assert len(error) <= 300


@pytest.mark.filterwarnings("error::pytest.PytestUnhandledThreadExceptionWarning")
def test_no_message_ends_a_page(page: Running):
    rng, refused = random.Random(SEED), 0
    tab = open_tab(page.server.address)
    for number in range(MESSAGES):
        text = draw_message(rng, page.kind)
        tab.send(text)
        if len(text) > LIMIT:
            with pytest.raises(websockets.ConnectionClosed, match="2000"):  # noqa: PT012
                while True:
                    tab.recv(timeout=20)
            tab = open_tab(page.server.address)
        elif why := refusal(page.kind, text):
            refused += 1
            read_error(tab, why[:100])
        # The next valid message takes effect.
        speed = 0.1 + 0.4 * number / MESSAGES
        tab.send(json.dumps({"command": [speed, 0, 0]}))
        end = time.monotonic() + 20.0
        while page.command()[0] != pytest.approx(speed):
            assert page.thread.is_alive(), text
            assert time.monotonic() < end, text
            time.sleep(0.001)
    tab.close()
    assert MESSAGES / 2 < refused < MESSAGES
