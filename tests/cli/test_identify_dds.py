"""`surefoot identify air` from end to end on an emulated Go2 that hangs, over DDS in real time."""

from __future__ import annotations

import json
from pathlib import Path
from unittest import mock

import pytest
from processes import Emulator, emulators, surefoot

pytest.importorskip("cyclonedds")
pytest.importorskip("mujoco")
pytest.importorskip("matplotlib")
from go2_robot import worker_domain

from surefoot.identify.recording import COMPLETE

DOMAIN = worker_domain(200)
SHORT = {"SINGLE_TIME": 1.5, "COMBINED_TIME": 4.0, "CHECK_TIME": 2.0}
"""Lengths of the chirps [s]: a third of those that ship."""
TRUTH = {"control_latency": 0.014, "rotor_inertia": 0.030, "motor_friction": 0.4}
PASSING_ON = 0.004
"""Greatest time [s] from a command's arrival at the keeper until it acts: a cycle of it, and a servo step."""


@pytest.mark.realtime
@pytest.mark.slow
def test_air_identifies_an_emulated_go2(tmp_path: Path) -> None:
    link = ("--robot", "go2", "--link", "dds", "--interface", "lo")
    hidden = [f"{name}={value}" for name, value in TRUTH.items()]
    with emulators(Emulator) as start, mock.patch.multiple("surefoot.identify.rack.air_plan", **SHORT):
        start(*link, "--domain", DOMAIN, "--rack", "--set", *hidden)
        gains, out = ("servo_kp=40", "servo_kd=1.5"), tmp_path / "air"
        done = surefoot("identify", "air", *link, "--domain", DOMAIN, "--set", *gains, "--yes", "--json", "--out", out)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["ended"] == COMPLETE
    assert result["checks"][-1]["after"] < 0.5 * result["checks"][-1]["before"], result["checks"]
    found = {name: [one for one in result["estimates"] if one["name"] == name] for name in TRUTH}
    for name, value in TRUTH.items():
        assert found[name], name
        for one in found[name]:
            low, high = one["interval"]
            assert low <= value <= high, one
    (latency,) = found["control_latency"]
    assert TRUTH["control_latency"] - 0.001 < latency["value"] < TRUTH["control_latency"] + PASSING_ON
