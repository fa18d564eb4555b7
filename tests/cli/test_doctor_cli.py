"""`surefoot doctor` on emulated robots."""

from __future__ import annotations

import functools
import json
import os
import pty
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from processes import Emulator, EmulatorHere, assert_rejected, emulators, run_surefoot, surefoot

pytest.importorskip("mujoco")
onnx = pytest.importorskip("onnx")


QUICK = ("--pings", "40", "--steps", "50")


@pytest.fixture(scope="module")
def port_of() -> Iterator[Callable[..., str]]:
    """Return a function from arguments of `surefoot emulate` to the port of a robot in lockstep, which is reused."""
    with emulators(EmulatorHere) as start:
        yield functools.cache(lambda *words: start("--lockstep", *words).port)


def doctor(
    policy: object, port: object, *words: str, run: Callable[..., subprocess.CompletedProcess[str]] = surefoot
) -> tuple[int, dict[str, dict[str, Any]]]:
    """Return the exit code, and the checks by name."""
    done = run("doctor", policy, "--port", port, *QUICK, "--json", *words)
    assert done.returncode in (0, 3), done.stderr
    data = json.loads(done.stdout)
    checks = {one["name"]: one for one in data["checks"]}
    assert data["passed"] == (done.returncode == 0) == all(one["passed"] is not False for one in checks.values())
    return done.returncode, checks


def failed(checks: dict[str, dict[str, Any]]) -> list[str]:
    return [name for name, one in checks.items() if one["passed"] is False]


# A healthy robot.


def test_a_healthy_robot_passes_all_on_its_rack(port_of: Callable[..., str]):
    done = surefoot("doctor", "trot", "--port", port_of("--rack"), "--lockstep", "--rack", "--yes")
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].startswith("policy 'trot' for minitaur, port /")
    assert not any("\x1b" in line or "FAIL" in line for line in lines)
    checks = {line[10:30].strip(): line for line in lines[1:-1]}
    assert len(checks) == len(lines) - 2
    for name in ("motor signs", "battery", "encoders", "IMU", "motors, one by one", "control latency"):
        assert checks[name].startswith("pass      ")
    assert checks["IMU, nose down"].startswith("not done  ")
    assert checks["IMU, nose down"].endswith("put the robot on flat ground and run with --ground")
    assert lines[-1] == "16 passed, 0 failed, 8 not done"


def test_a_healthy_robot_passes_all_on_the_ground(port_of: Callable[..., str]):
    code, checks = doctor("trot", port_of(), "--lockstep", "--ground", "--yes")
    assert (code, failed(checks)) == (0, [])
    assert checks["IMU, nose down"]["value"] == pytest.approx(0.075, abs=0.02)
    assert checks["IMU, left side down"]["value"] == pytest.approx(-0.17, abs=0.03)
    assert checks["IMU, rates"]["passed"]


@pytest.mark.realtime
def test_a_healthy_robot_passes_in_real_time(emulate: Callable[..., Emulator], tmp_path: Path):
    emulator = emulate("--rack")
    _, checks = doctor("trot", emulator.port, "--rack", "--yes", "--steps", "300", run=run_surefoot)
    assert not {name: checks[name]["message"] for name in failed(checks)}
    assert checks["control latency"]["passed"], checks["control latency"]["message"]
    assert checks["link, round trip"]["value"] < 0.003
    assert checks["control latency"]["value"] == pytest.approx(0.02, abs=0.006)
    assert checks["inference"]["value"] < 0.001


# Faulty robots.


@pytest.mark.parametrize(
    ("fault", "check", "why"),
    [
        ("other-robot", "robot", "it is 'not-minitaur'; the data sheet is for 'minitaur'"),
        ("other-order", "motors", "motor 0 is 'front_left_1_motor' (robot), 'front_left_2_motor' (data sheet)"),
        ("other-gains", "servo gains", "the robot's servos have kp 1.5 and kd 0.0225"),
        ("slow-servo", "servo period", "2 ms; the data sheet says 1 ms"),
    ],
)
def test_doctor_fails_on_another_robot_before_motion(fault: str, check: str, why: str, port_of: Callable[..., str]):
    _, checks = doctor("trot", port_of("--fault", fault), "--lockstep")
    assert failed(checks) == [check]
    assert why in checks[check]["message"]


@pytest.mark.parametrize(
    ("fault", "check", "why", "todo"),
    [
        (
            "swap-motors=2",
            "motors, one by one",
            "back_left_1_motor, commanded to move",
            "swapped: back_left_2_motor and back_left_1_motor",
        ),
        ("flip-sign=3", "motors, one by one", "back_left_1_motor moved", "the sign of this motor or encoder is wrong"),
        (
            "late-states=0.015",
            "control latency",
            "the policy was trained with 20 ms",
            "find out what delays the readings",
        ),
    ],
)
def test_faults_of_motors_fail_on_the_rack(fault: str, check: str, why: str, todo: str, port_of: Callable[..., str]):
    _, checks = doctor("trot", port_of("--rack", "--fault", fault), "--lockstep", "--rack", "--yes")
    assert failed(checks) == [check]
    assert why in checks[check]["message"]
    assert todo in checks[check]["remedy"]


def test_a_mirrored_encoder_fails_at_rest_or_when_motors_hold(port_of: Callable[..., str]):
    """On the ground the legs are folded, so a wrong reading is noticed; with hanging legs it may not be."""
    _, checks = doctor("trot", port_of("--fault", "flip-encoder=3"), "--lockstep")
    assert failed(checks) == ["encoders"]
    assert checks["encoders"]["message"].startswith("back_left reads")
    _, checks = doctor("trot", port_of("--rack", "--fault", "flip-encoder=3"), "--lockstep", "--rack", "--yes")
    assert failed(checks) in (["encoders"], ["motors, one by one"])


def test_an_imu_with_exchanged_axes_fails_on_the_ground(port_of: Callable[..., str]):
    _, checks = doctor("trot", port_of("--fault", "imu-flip=0"), "--lockstep", "--ground", "--yes")
    assert failed(checks) == ["IMU, nose down", "IMU, left side down"]
    assert all("x and y of the IMU are swapped" in checks[check]["remedy"] for check in failed(checks))


def test_a_line_that_damages_frames_fails(port_of: Callable[..., str]):
    _, checks = doctor("trot", port_of("--fault", "corrupt=0.05"), "--lockstep")
    assert checks["link, losses"]["passed"] is False
    assert "frames damaged" in checks["link, losses"]["message"]


@pytest.mark.parametrize(("option", "place"), [("--rack", "hang free"), ("--ground", "sit on flat ground")])
def test_without_a_terminal_motors_move_only_with_yes(option: str, place: str):
    with open(os.devnull) as nothing, mock.patch("sys.stdin", nothing):
        done = surefoot("doctor", "trot", "--port", "/dev/none", option)
    assert_rejected(done, f"motors will move and the robot must {place}")
    assert done.stderr.endswith("confirm it with --yes\n")


@pytest.mark.parametrize(
    ("answer", "message"), [(b"n\n", "not confirmed; nothing has moved"), (b"y\n", "can't be opened")]
)
def test_on_a_terminal_the_doctor_asks_before_motors_move(answer: bytes, message: str):
    ours, theirs = pty.openpty()
    os.write(ours, answer)
    with os.fdopen(theirs) as terminal, mock.patch("sys.stdin", terminal):
        done = surefoot("doctor", "trot", "--port", "/dev/none", "--rack")
    os.close(ours)
    assert done.returncode == 2
    assert "Motors will move. Does the robot hang freely, with its legs in the air? [y/N]" in done.stderr
    assert message in done.stderr
