"""docs/safety.md and docs/emulator.md agree with the code: limits, phases, faults, assumed hardware."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

import pytest

from surefoot.deploy.safety import SafetyLimits
from surefoot.robot import RobotDescription


@pytest.fixture(scope="module")
def document(repository: Path) -> str:
    return (repository / "docs" / "safety.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def emulator_page(repository: Path) -> str:
    return (repository / "docs" / "emulator.md").read_text(encoding="utf-8")


def test_the_hosts_limits_agree_with_the_code(document: str, robot: RobotDescription):
    rows = re.findall(r"^\| `([a-z_]+)` \| ([\d.]+) \w", document, re.MULTILINE)
    assert {name: float(number) for name, number in rows} == asdict(SafetyLimits.from_robot(robot))


def test_the_limits_of_a_go2_are_from_its_data_sheet(document: str, emulator_page: str):
    robot = RobotDescription.load("go2")
    battery, heat, text = robot.battery, robot.heat, " ".join(document.split())
    assert (
        f"On a Go2, surefoot warns at {battery.warn:g} V and {heat.warn:g} degC, sits it down at {battery.low:g} V and "
        f"{heat.high:g} degC, and damps its motors at {battery.empty:g} V and {heat.limit:g} degC"
    ) in text
    milliohm = 1e3 * battery.resistance
    stated = f"{milliohm:g} mOhm, {battery.capacity:g} Ah, {heat.capacity:g} J/K and {heat.resistance:g} K/W"
    assert stated in " ".join(emulator_page.split())


def test_the_robots_limits_agree_with_the_emulator(document: str, robot: RobotDescription):
    pytest.importorskip("numba")
    from surefoot.deploy.board.limits import Limits

    limits = Limits.from_robot(robot)
    paragraph = re.search(r"^The robot's own.*?\n\n", document, re.MULTILINE | re.DOTALL)
    assert paragraph is not None
    text = " ".join(paragraph[0].split())
    for number in (
        f"{1e3 * limits.command_timeout:g} ms without a command",
        f"{limits.stale_drops:g} commands in a row dropped",
        f"older than {limits.stale_after:g} control steps",
        f"{limits.tilt:g} rad of roll or pitch",
        f"{limits.voltage:g} V for {limits.voltage_time:g}",
        f"{limits.temperature:g} degC",
        f"{1e3 * limits.rearm_after:g} ms of clean link",
        f"over {1e3 * limits.clean_gap:g} ms",
        f"{limits.owner_timeout:g} s of silence",
    ):
        assert number in text, number


def test_the_assumed_hardware_agrees_with_the_emulator(emulator_page: str):
    pytest.importorskip("numba")
    from surefoot.emulator.hardware import PowerConfig, SensorConfig

    sensors, power = SensorConfig(), PowerConfig()
    text = " ".join(emulator_page.split())
    for number in (
        f"noise of {sensors.speed_noise:g} rad/s on motor speeds",
        f"gyro noise of {sensors.gyro_noise:g} rad/s and bias of {sensors.gyro_bias:g} rad/s",
        f"{1e3 * power.battery_resistance:g} mOhm and {power.battery_capacity / 3600:g} Ah",
        f"{power.heat_capacity:g} J/K and {power.heat_resistance:g} K/W",
    ):
        assert number in text, number


def test_every_fault_of_the_emulator_is_on_its_page(emulator_page: str):
    pytest.importorskip("numba")
    from surefoot.emulator.fault_table import FAULTS

    listed = emulator_page.partition("## Faults")[2].partition("## ")[0]
    assert sorted(re.findall(r"`([a-z-]+)`", listed)) == sorted(FAULTS)


def test_every_phase_of_a_run_is_in_the_table(document: str):
    from surefoot.deploy import motion_runner as motion
    from surefoot.deploy.deployment import TIMING_STEPS

    assert f"| check timing | {TIMING_STEPS * 0.006:.1f} s |" in document
    flat, fold, pause = motion.LAY_FLAT_TIME, motion.FOLD_TIME, motion.PAUSE_TIME
    assert f"| lay legs flat, draw legs in, sit | {flat + fold + pause:.1f} s |" in document
    assert f"| stand up, stand | {motion.RISE_TIME + motion.STAND_TIME:.1f} s |" in document


def test_tests_and_modules_that_the_pages_name_exist(document: str, emulator_page: str, repository: Path):
    names = re.findall(r"`((?:tests|src)/[a-z_/]+(?:\.py)?)`", document + emulator_page)
    assert len(names) > 5
    assert [name for name in names if not (repository / name).exists()] == []
