"""Checks of a Go2 before it moves: on recorded states, and against a robot in another process."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.check_result import CheckResult
from surefoot.deploy.dds.low_level import LOW_STATE, Record, new_record
from surefoot.deploy.pacer import real_time_priority
from surefoot.errors import SurefootError
from surefoot.robot import RobotDescription

pytest.importorskip("cyclonedds")
from go2_robot import Go2, worker_domain

from surefoot.deploy.dds import bus, inspection, motion_service, types
from surefoot.deploy.dds.inspection import Inspection, ReceivedMessages

RECORDED = json.loads((Path(__file__).parent / "recorded_messages.json").read_text())["low_state"]
DOMAIN, EMPTY = worker_domain(80), worker_domain(100)


def recorded(tick: int = 0) -> Record:
    """Return a recorded state of a standing Go2, with another tick."""
    record = new_record(LOW_STATE)
    for part in ("imu_state", "bms_state"):
        for name, value in RECORDED[part].items():
            record[part][name] = value
    for motor, values in enumerate(RECORDED["motor_state"]):
        for name, value in values.items():
            record["motor_state"][name][motor] = value
    record["tick"], record["power_v"] = tick, RECORDED["power_v"]
    return record


def observed(**changes: Any) -> ReceivedMessages:
    """Return half a second of states at 500 Hz."""
    seen = {"time": 0.5, "records": [recorded(2 * k) for k in range(250)], "damaged": [], "commands": 0, "sport": 0}
    return ReceivedMessages(**{**seen, **changes})


def test_states_of_a_recorded_robot_pass() -> None:
    go2, records = RobotDescription.load("go2"), observed().records
    angles = records[0]["motor_state"]["q"][:12].astype(float)
    results = [
        inspection.check_states(observed()),
        inspection.check_motors(records),
        inspection.check_cells(records[0], 25.6),
        inspection.check_gravity(records),
        inspection.check_pose(angles, go2),
        inspection.check_gains(go2.actuator.kp, go2.actuator.kd),
    ]
    assert all(result.passed for result in results), results
    assert results[2].message == "8 cells, 3.82 to 3.84 V, 63 %"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"records": [recorded(4 * k) for k in range(125)]}, "250 per second; it must be 500 within 10%"),
        ({"records": [recorded(2 * (k // 2)) for k in range(250)]}, "125 of 250 states have a repeated"),
        ({"records": [recorded(k) for k in range(250)]}, "ticks increase by 498 ms per second; a tick"),
        ({"damaged": ["the checksum is 0"] * 5}, "5 of 255 messages are damaged: the checksum is 0"),
    ],
)
def test_states_with_a_wrong_rate_tick_or_checksum_fail(changes: dict[str, Any], message: str) -> None:
    result = inspection.check_states(observed(**changes))
    assert result.passed is False
    assert message in result.message


def test_a_motor_that_is_off_or_loses_messages_fails() -> None:
    records = observed().records
    records[-1]["motor_state"]["mode"][4] = 0
    assert inspection.check_motors(records).message == "FL_thigh_joint: mode 0; it must be 1"
    records[-1]["motor_state"]["mode"][4] = 1
    records[-1]["motor_state"]["lost"][4] += 12
    assert inspection.check_motors(records).message == "FL_thigh_joint has lost 12 messages in 0.5 s"


def test_a_low_battery_cell_fails_and_missing_cells_warn() -> None:
    record = recorded()
    record["bms_state"]["cell_vol"][3] = 3100
    result = inspection.check_cells(record, 25.6)
    assert result.message == "8 cells, 3.10 to 3.84 V, 63 %; each must have at least 3.20 V"
    record["bms_state"]["cell_vol"] = 0
    assert inspection.check_cells(record, 25.6).passed is None


BAD_GAINS = [(0.0, 1.0), (150.0, 1.0), (40.0, 11.0), (np.nan, 1.0), (np.full(12, 40.0), -1.0)]


@pytest.mark.parametrize(("kp", "kd"), BAD_GAINS)
def test_gains_beyond_the_drives_limits_fail(kp: Any, kd: Any) -> None:
    assert inspection.check_gains(kp, kd).passed is False


@pytest.mark.parametrize("order", [[2, 1, 0], [1, 2, 0]])
def test_another_joint_order_violates_joint_limits(order: list[int]) -> None:
    go2 = RobotDescription.load("go2")
    angles = recorded()["motor_state"]["q"][:12].astype(float).reshape(4, 3)[:, order].ravel()
    assert inspection.check_pose(angles, go2).passed is False


def test_mirrored_knees_violate_joint_limits() -> None:
    angles = recorded()["motor_state"]["q"][:12] * np.tile([1.0, 1.0, -1.0], 4)
    result = inspection.check_pose(angles, RobotDescription.load("go2"))
    assert result.passed is False
    assert "_calf_joint is at 1.5" in result.message
    assert "its range is -2.72 to -0.84" in result.message


@pytest.mark.parametrize(("axis", "factor"), [(2, -1.0), (2, 0.8)])
def test_an_accelerometer_that_disagrees_with_the_orientation_fails(axis: int, factor: float) -> None:
    records = observed().records
    for record in records:
        record["imu_state"]["accelerometer"][axis] *= factor
    assert inspection.check_gravity(records).passed is False


# Against a robot.


@pytest.fixture(scope="module")
def body() -> Iterator[Go2]:
    body = Go2(DOMAIN)
    yield body
    body.close()


@pytest.fixture(scope="module")
def listener(body: Go2) -> Iterator[Inspection]:
    """Listen with real-time priority, threads of DDS included: a busy computer must not make states late."""
    with real_time_priority(threads=True):
        here = bus.Bus("lo", DOMAIN)
        yield Inspection(here, "lo", DOMAIN)
        here.close()


def inspect(listener: Inspection, release: bool = False) -> dict[str, CheckResult]:
    go2 = RobotDescription.load("go2")
    results = listener.inspect(go2, go2.actuator.kp, go2.actuator.kd, lambda name: release)
    return {result.name: result for result in results}


@pytest.mark.realtime
def test_a_ready_robot_passes_even_if_this_computer_is_late(
    listener: Inspection, body: Go2, monkeypatch: pytest.MonkeyPatch
) -> None:
    body.reset()
    results = inspect(listener)
    assert not [result for result in results.values() if not result.passed]
    assert results["interface"].message == "lo, 127.0.0.1"
    monkeypatch.setattr(inspection, "_POLL_PERIOD", 0.08)
    seen = listener.observe(0.5)
    assert seen.time >= 0.56
    assert inspection.check_states(seen).passed, inspection.check_states(seen).message


def test_the_own_controller_is_released_and_selected_again(listener: Inspection, body: Go2) -> None:
    body.reset()
    body.set(controller="mcf", sport=True)
    assert inspect(listener)["own controller"].message == "'mcf' is active and commands the motors"
    assert body.settings.controller == "mcf"
    assert inspect(listener, release=True)["own controller"].passed
    assert body.settings.controller == ""
    listener.service.hand_back()
    assert body.settings.controller == "mcf"


def test_a_standing_robot_is_not_released(listener: Inspection, body: Go2, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_service, "LIE_DOWN_TIMEOUT", 0.1)
    body.reset()
    body.set(controller="mcf", angle=np.tile([0.0, 0.67, -1.3], 4))
    with pytest.raises(SurefootError, match=r"does not lie down within 0\.1 s; its controller was not released"):
        inspect(listener, release=True)
    assert body.settings.controller == "mcf"


def test_another_program_or_another_layout_fails(
    listener: Inspection, body: Go2, monkeypatch: pytest.MonkeyPatch
) -> None:
    body.reset()
    observe = Inspection.observe

    def disturbed(self: Inspection, duration: float) -> ReceivedMessages:
        seen = observe(self, duration)
        seen.commands = 3
        return seen

    monkeypatch.setattr(Inspection, "observe", disturbed)
    assert inspect(listener)["other programs"].message.startswith(
        "3 messages on rt/lowcmd in 0.5 s; no other program may"
    )
    monkeypatch.undo()
    body.set(short=True)
    with pytest.raises(SurefootError, match=r"no state of a Go2 arrives on rt/lowstate: the message has 1176 bytes"):
        inspect(listener)


def test_commands_of_another_program_are_counted(listener: Inspection, body: Go2) -> None:
    script = """
import sys, time
from surefoot.deploy.dds import bus, low_level, types
writer = bus.Bus("lo", int(sys.argv[1])).writer(bus.LOW_COMMAND_TOPIC, types.LowCmd)
end = time.monotonic() + 20
while time.monotonic() < end:
    writer.write(low_level.encode(low_level.new_command()))
    time.sleep(0.01)
"""
    body.reset()
    other = subprocess.Popen([sys.executable, "-c", script, str(DOMAIN)])
    try:
        assert any(listener.observe(0.2).commands for _ in range(50))
        (writer,) = listener._bus.writer_names(bus.LOW_COMMAND_TOPIC)
        assert f"(process {other.pid} on " in writer
    finally:
        other.kill()
        other.wait()


def test_a_domain_without_a_robot_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(inspection, "FIRST_STATE_TIMEOUT", 0.3)
    here = bus.Bus("lo", EMPTY)
    listener = Inspection(here, "lo", EMPTY)
    try:
        with pytest.raises(SurefootError, match=rf"lo, domain {EMPTY}: no state of a robot within 0\.3 s; check"):
            listener.await_robot()
        there = here.writer(bus.LOW_STATE_TOPIC, types.SportModeState)
        with pytest.raises(SurefootError, match=r"has type unitree_go::msg::dds_::SportModeState_; a Go2's is"):
            listener.await_robot()
        assert there.readers == 0
    finally:
        here.close()
