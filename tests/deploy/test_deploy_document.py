"""docs/deploy.md says what the code does: limits, phases, names of faults and checks."""

from __future__ import annotations

import re
from dataclasses import asdict
from pathlib import Path

import pytest

from surefoot.deploy.safety import SafetyLimits
from surefoot.robot import RobotDescription


@pytest.fixture(scope="module")
def document(repository: Path) -> str:
    return (repository / "docs" / "deploy.md").read_text(encoding="utf-8")


def test_the_hosts_limits_are_those_of_the_code(document: str, robot: RobotDescription):
    rows = re.findall(r"^\| `([a-z_]+)` \| ([\d.]+) \w", document, re.MULTILINE)
    assert {name: float(number) for name, number in rows} == asdict(SafetyLimits.from_robot(robot))


def test_the_limits_of_a_go2_are_its_sheets(document: str):
    robot = RobotDescription.load("go2")
    battery, heat, text = robot.battery, robot.heat, " ".join(document.split())
    assert (
        f"A Go2 warns at {battery.warn:g} V and {heat.warn:g} degC, sits at {battery.low:g} V and {heat.high:g} degC, "
        f"and is damped at {battery.empty:g} V and {heat.limit:g} degC"
    ) in text
    milliohm = 1e3 * battery.resistance
    assert f"{milliohm:g} mOhm, {battery.capacity:g} Ah, {heat.capacity:g} J/K and {heat.resistance:g} K/W" in text


def test_the_robots_limits_are_those_of_the_emulator(document: str, robot: RobotDescription):
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
        f"{limits.voltage:g} V for {limits.voltage_time:g}".replace("0.", "."),
        f"{limits.temperature:g} degC",
        f"{1e3 * limits.rearm_after:g} ms of clean link",
        f"over {1e3 * limits.clean_gap:g} ms",
        f"{limits.owner_timeout:g} s of silence",
    ):
        assert number in text, number


def test_the_hardware_that_is_assumed_is_the_emulators(document: str):
    pytest.importorskip("numba")
    from surefoot.emulator.hardware import PowerConfig, SensorConfig

    sensors, power = SensorConfig(), PowerConfig()
    text = " ".join(document.split()).replace(" .", " 0.")
    for number in (
        f"noise of {sensors.speed_noise:g} rad/s on motor speeds",
        f"gyro noise of {sensors.gyro_noise:g} rad/s and bias of {sensors.gyro_bias:g} rad/s",
        f"{1e3 * power.battery_resistance:g} mOhm and {power.battery_capacity / 3600:g} Ah",
        f"{power.heat_capacity:g} J/K and {power.heat_resistance:g} K/W",
    ):
        assert number in text, number


def test_every_phase_of_a_run_stands_in_the_table(document: str):
    from surefoot.deploy import motion_runner as motion
    from surefoot.deploy.deployment import PUNCTUAL

    assert f"| check timing | {PUNCTUAL * 0.006:.1f} s |" in document
    flat, fold, pause = motion.FLAT, motion.FOLD, motion.PAUSE
    assert f"| lay legs flat, draw legs in, sit | {flat + fold + pause:.1f} s |" in document
    assert f"| stand up, stand | {motion.RISE + motion.HOLD:.1f} s |" in document


def test_links_of_the_document_lead_somewhere(document: str, repository: Path):
    names = re.findall(r"\]\(([^)#:]+)\)", document)
    assert names
    for name in (name for name in names if not name.startswith("reference/")):  # the site's, made from the code
        assert (repository / "docs" / name).exists(), name
    for path in re.findall(r"`((?:tests|examples|deploy|emulator)/[a-z_/]+\.py)`", document):
        inside = path if path.startswith(("tests", "examples")) else f"src/surefoot/{path}"
        assert (repository / inside).exists(), path
