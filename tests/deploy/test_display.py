"""The live display: its content, and that it never delays the control loop."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest

from surefoot.deploy.display import LiveDisplay, PlainLines, StatusPanel, draw_messages
from surefoot.deploy.loop import Snapshot


@pytest.fixture
def snapshot(a_state) -> Snapshot:
    return Snapshot(
        phase="run",
        left=3.25,
        rate=166.7,
        lateness=(1e-5, 2e-5, 1.5e-3),
        inference=9.5e-5,
        missed=1,
        state_age=0.0012,
        state=a_state,
        dropped=2,
    )


def test_the_panel_shows_the_contents_of_messages():
    panel = StatusPanel()
    assert dict(panel.rows())["loop"] == dict(panel.rows())["lateness"] == "-"
    panel.update({"title": "trot on minitaur", "recording": "recording to run_000.npz"})
    panel.update({"phase": "run", "left": 2.0, "rate": 166.7, "lateness": [0.01] * 98 + [1.0, 3.0], "inference": 0.09})
    panel.update({"missed": 1, "dropped": 2, "state_age": 1.2, "voltage": 15.7, "temperature": 31.0})
    assert dict(panel.rows())["estimated speed"] == "-"
    panel.update({"speed": [0.42, -0.03, 3.24]})
    panel.update({"roll": -0.02, "pitch": 0.11, "warning": "battery below 14.4 V"})
    rows = dict(panel.rows())
    assert rows["phase"] == "run, 2.0 s left"
    assert rows["loop"] == "166.7 Hz"
    assert rows["lateness"].startswith("0.01 median, ")
    assert rows["lateness"].endswith("3.00 max ms")
    assert rows["battery"] == "15.7 V"
    assert rows["hottest motor"] == "31 degC"
    assert rows["roll, pitch"] == "-0.02, +0.11 rad"
    assert rows["estimated speed"] == "0.42 forward, -0.03 left m/s, 3.2 m"
    assert rows["recording"] == "to run_000.npz"
    assert panel.warnings == ["battery below 14.4 V"]


def test_lines_are_drawn_and_other_lines_skipped():
    stream = io.StringIO()
    lines = (
        '{"title": "trot on minitaur"}',
        "no json",
        "[1]",
        '{"phase": "stand up", "left": 1.5}',
        '{"warning": "hot"}',
    )
    draw_messages(lines, stream)
    for text in ("trot on minitaur", "stand up, 1.5 s left", "! hot"):
        assert text in stream.getvalue()


def test_messages_reach_the_displays_process(snapshot, monkeypatch):
    sent, (read, write) = [], os.pipe()
    process = SimpleNamespace(stdin=os.fdopen(write, "wb"), wait=lambda timeout: os.close(read))
    monkeypatch.setattr(subprocess, "Popen", lambda *a, **k: process)
    display = LiveDisplay("title")
    monkeypatch.setattr(os, "write", lambda file, data: sent.append(data) or len(data))
    display.tick(snapshot)
    message = json.loads(sent[0])
    assert message["lateness"] == [0.01, 0.02, 1.5]
    assert message["inference"] == 0.095
    # A hundred steps fit into one message of 4096 bytes, which a pipe accepts as a whole.
    display.tick(replace(snapshot, lateness=(1.234567,) * 100))
    assert len(json.loads(sent[1])["lateness"]) == 100
    assert all(len(data) <= 4096 for data in sent)
    display.close()


@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_a_display_that_hangs_or_dies_does_not_block(number, snapshot):
    display = LiveDisplay("title")
    os.kill(display._process.pid, number)
    started = time.monotonic()
    for _ in range(2000):
        display.tick(snapshot)
    assert time.monotonic() - started < 5.0
    display._process.kill()
    display.close()


def test_the_displays_process_ends_with_its_input():
    process = subprocess.Popen(
        [sys.executable, "-m", "surefoot.deploy.display"], stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    _, drawn = process.communicate('{"title": "trot"}\n{"phase": "run", "voltage": 15.71}\n', timeout=60)
    assert process.returncode == 0
    assert "trot" in drawn
    assert "15.7 V" in drawn


def test_plain_lines_print_phases_and_warnings(snapshot, capsys):
    lines = PlainLines()
    lines.phase("arm", 0.0)
    lines.phase("run", 6.0)
    lines.tick(snapshot)
    lines.warn("battery below 14.4 V")
    lines.recording("recording stopped: No space left on device")
    lines.close()
    assert capsys.readouterr().err.splitlines() == [
        "surefoot: arm",
        "surefoot: run (6.0 s)",
        "surefoot: warning: battery below 14.4 V",
        "surefoot: recording stopped: No space left on device",
    ]


def test_plain_lines_survive_a_closed_terminal(monkeypatch):
    stream = io.StringIO()
    stream.close()
    monkeypatch.setattr(sys, "stderr", stream)
    PlainLines().phase("run", 6.0)
