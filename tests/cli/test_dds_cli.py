"""`surefoot deploy` and `surefoot doctor` over DDS, with a robot emulated by a process."""

from __future__ import annotations

import contextlib
import io
import json
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from fault_bench import QUICK
from processes import surefoot

pytest.importorskip("cyclonedds")
from go2_robot import Go2, worker_domain

from surefoot.cli.main import main
from surefoot.task.trace import EpisodeTrace

DOMAIN = worker_domain(120)
LINK = ("--link", "dds", "--interface", "lo", "--domain", str(DOMAIN))


@pytest.fixture(scope="module")
def robot_process() -> Iterator[Go2]:
    body = Go2(DOMAIN)
    yield body
    body.close()


@pytest.fixture
def body(robot_process: Go2) -> Go2:
    robot_process.reset()
    return robot_process


def deploy(folder: Path, *words: str, event: Callable[[], object] | None = None) -> tuple[int, dict[str, Any], str]:
    """Run `surefoot deploy` in this process, and trigger an event while the policy runs."""
    out, err = io.StringIO(), io.StringIO()
    running = threading.Event()

    class Watch(io.StringIO):
        def write(self, text: str) -> int:
            if "surefoot: run" in text:
                running.set()
            return err.write(text)

    def act() -> None:
        if event is not None and running.wait(30):
            time.sleep(0.2)
            event()

    thread = threading.Thread(target=act)
    thread.start()
    with (
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(Watch()),
        mock.patch.multiple("surefoot.deploy.motion_runner", **QUICK),
        mock.patch.multiple("surefoot.deploy.deployment", TIMING_STEPS=20),
    ):
        code = main(["deploy", "go2-steer", *LINK, "--out", str(folder), "--json", *words])
    running.set()
    thread.join()
    return code, json.loads(out.getvalue()) if out.getvalue() else {}, err.getvalue()


@pytest.mark.realtime
def test_a_run_is_recorded_and_ended_by_the_remote_control_or_the_own_controller(body: Go2, tmp_path: Path) -> None:
    body.set(controller="mcf")
    words = ("--duration", "20", "--world-name", "a floor", "--release", "--hand-back")
    code, result, messages = deploy(tmp_path, *words, event=lambda: body.set(stick=0.9))
    assert code == 0, (result, messages)
    (run,) = result["runs"]
    assert run["ended"] == "stopped"
    assert run["what"].startswith("stopped with the remote control")
    trace = EpisodeTrace.load(tmp_path / "run_000.npz")
    assert trace.meta["world"] == "a floor"
    assert np.isfinite(trace.motor_angle).all()
    frames = body.read()
    held = [frame for frame in frames if not frame.damps]
    assert {(frame.kp, frame.kd) for frame in held} == {(40.0, 1.0)}  # the policy's
    assert held[0].jump < 0.1
    damped = next(k for k, frame in enumerate(frames) if frame.damps)
    assert all(frame.damps for frame in frames[damped:])  # the robot sat down before it was disarmed
    assert result["frames"]["damaged"] == 0
    assert body.settings.controller == "mcf"


@pytest.mark.realtime
def test_a_fault_is_reported_and_ends_the_run(body: Go2, tmp_path: Path) -> None:
    code, result, _ = deploy(tmp_path, "--duration", "20", event=lambda: body.set(mode=0))
    (run,) = result["runs"]
    assert code == 3
    assert (run["ended"], run["reason"]) == ("fault", "robot motor off")
    assert run["what"] == "the robot has damped its motors (motor off): FR_hip_joint is off (mode 0)"
    assert run["trace"] is not None


@pytest.mark.realtime
def test_a_robot_is_not_armed_before_it_has_passed_the_checks(body: Go2, tmp_path: Path) -> None:
    body.set(controller="mcf")
    code, _, messages = deploy(tmp_path)
    assert code == 2
    assert messages.splitlines()[-1].startswith(
        "surefoot: error: the robot is not armed: own controller: 'mcf' is active and commands the motors; let"
    )
    body.reset()
    done = surefoot("doctor", "go2-steer", *LINK, "--json", "--steps", "50", "--pings", "20")
    checks = {check["name"]: check for check in json.loads(done.stdout)["checks"]}
    names = ["interface", "states", "own controller", "other programs", "drives", "cells", "drive gains", "pose"]
    assert list(checks)[: len(names)] == names
    assert all(checks[name]["passed"] for name in [*names, "gravity", "servo gains", "control step"])
    assert body.read() == []
