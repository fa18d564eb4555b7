"""`surefoot deploy --link dds` as a process, with a Go2 that uses the vendor's message classes and MuJoCo."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from fault_bench import QUICK, QUICK_UP
from processes import assert_rejected, run_surefoot
from shipped_variants import modified_policy

pytest.importorskip("cyclonedds")
pytest.importorskip("mujoco")
pytest.importorskip("unitree_sdk2py.idl.default", exc_type=ImportError)
from go2_robot import Go2, worker_domain
from go2_runs import Deploy, Robot, Witness, watch

from surefoot.deploy.dds import bus, types

pytestmark = pytest.mark.sdk
DOMAIN, EMPTY, VENDORS = worker_domain(140), worker_domain(160), worker_domain(180)
REACTION_MS = 60.0
PROGRAM = f"""
import sys
from unittest import mock
from surefoot.cli.main import main
with (
    mock.patch.multiple("surefoot.deploy.motion_runner", **{QUICK!r}),
    mock.patch.multiple("surefoot.deploy.deployment", TIMING_STEPS=20),
):
    sys.exit(main(sys.argv[1:]))
"""
"""Return a `surefoot` program that lets the robot stand up within a second."""


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., tuple[Robot, Witness, Deploy]]]:
    """Start a robot and a deployment, which are ended with the test."""
    started: list[Robot | Deploy] = []
    witnesses: list[Witness] = []

    def start(*words: object) -> tuple[Robot, Witness, Deploy]:
        robot = Robot("vendor", VENDORS, tmp_path)
        started.append(robot)
        witness = Witness(VENDORS)
        witnesses.append(witness)
        deploy = Deploy(VENDORS, tmp_path, *words, program=(sys.executable, "-c", PROGRAM))
        started.append(deploy)
        return robot, witness, deploy

    yield start
    for process in started:
        process.kill()
    for witness in witnesses:
        witness.close()


@pytest.mark.realtime
def test_a_robot_with_the_vendors_classes_stands_up_and_sits_down(
    start: Callable[..., tuple[Robot, Witness, Deploy]],
) -> None:
    robot, witness, deploy = start("--duration", "0.5")
    watch(deploy, witness, [], 60.0)
    code, report, errors = deploy.result()
    assert code == 0, errors
    assert report["runs"][0]["ended"] == "time"
    figures, commands, _ = robot.end()
    assert figures["bad_crc"] == 0
    armed = commands[commands["kp"] > 0]
    since = 1e-9 * (armed["time"] - armed["time"][0])
    assert armed["z"][(since > QUICK_UP) & (since < QUICK_UP + 0.5)].min() > 0.2
    assert commands["z"][-1] < 0.15
    assert commands["kp"][-1] == 0
    assert commands["kd"][-1] > 0
    assert np.median(np.diff(commands["written"].astype(np.int64))) == pytest.approx(2e6, rel=0.05)


@pytest.mark.realtime
def test_the_robot_is_damped_if_the_loop_is_killed_while_it_stands_up(
    start: Callable[..., tuple[Robot, Witness, Deploy]],
) -> None:
    robot, witness, deploy = start()
    killed: list[int] = []

    def kill() -> None:
        killed.append(time.monotonic_ns())
        os.kill(deploy.process.pid, signal.SIGKILL)

    watch(deploy, witness, [(QUICK_UP - 0.4, kill)], 60.0)
    _, commands, _ = robot.end()
    last = np.flatnonzero(commands["kp"] > 0)[-1]
    rest = commands[last + 1 :]
    assert 1e-6 * (int(rest["time"][0]) - killed[0]) < REACTION_MS
    assert (rest["kd"] > 0).all()
    assert len(rest) > 100


@pytest.fixture(scope="module")
def body() -> Iterator[Go2]:
    body = Go2(DOMAIN)
    yield body
    body.close()


def link(domain: int) -> tuple[str, ...]:
    return "--link", "dds", "--interface", "lo", "--domain", str(domain)


def test_a_domain_without_a_robot_is_rejected() -> None:
    assert_rejected(
        run_surefoot("deploy", "go2-steer", *link(EMPTY)), f"interface lo, domain {EMPTY}: no state of a robot"
    )


def test_messages_of_another_robot_type_are_rejected(tmp_path: Path) -> None:
    """A G1 sends `unitree_hg` messages on the same topic."""
    from unitree_sdk2py.idl.unitree_hg.msg.dds_ import LowState_

    other = bus.Bus("lo", EMPTY)
    writer = other.writer(bus.LOW_STATE_TOPIC, LowState_)
    done = run_surefoot("deploy", "go2-steer", *link(EMPTY))
    del writer
    other.close()  # a process has one domain
    assert_rejected(done, "rt/lowstate has type", "unitree_hg", types.GO_LOW_STATE)


def test_messages_of_another_length_are_rejected(body: Go2) -> None:
    body.set(short=True)
    assert_rejected(
        run_surefoot("deploy", "go2-steer", *link(DOMAIN)), "no state of a Go2 arrives on rt/lowstate", "bytes"
    )
    assert body.read() == []
    body.reset()


def test_a_policy_with_another_rate_is_rejected(body: Go2, tmp_path: Path) -> None:
    body.reset()
    policy = modified_policy(tmp_path / "p.onnx", lambda contract: contract.update(control_step=0.011), "go2-steer")
    done = run_surefoot("deploy", policy, *link(DOMAIN), cwd=tmp_path)
    assert done.returncode == 2
    phase, error = done.stderr.splitlines()
    assert phase == "surefoot: connect"
    assert "must not run on this robot: control step: 11 ms is 5.50 servo periods of 2 ms" in error
    assert body.read() == []
