"""Monitor of a Go2's states: readings, and hazards that stop the motors, on recorded states of a Go2."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from surefoot.deploy.board.signals import Vitals
from surefoot.deploy.dds.low_level import LOW_STATE, Record, RemoteControl, encode, new_record
from surefoot.deploy.dds.state_monitor import HAZARD_HOLD, MAX_LOST, MIN_POLLS, STATE_TIMEOUT, StateMonitor
from surefoot.deploy.messages import Reason

RECORDED = json.loads((Path(__file__).parent / "recorded_messages.json").read_text())["low_state"]
STEP = 2000
"""Period of states [us]."""


def fill(record: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        if isinstance(value, dict):
            fill(record[name], value)
        elif isinstance(value, list) and isinstance(value[0], dict):
            for k, entry in enumerate(value):
                fill(record[name][k], entry)
        else:
            record[name] = value


class Bench:
    """A robot that sends the recorded state every 2 ms with an increasing tick."""

    def __init__(self) -> None:
        self.monitor, self.now = StateMonitor(), 0
        self.state: Record = new_record(LOW_STATE)
        fill(self.state, RECORDED)
        self.tick_step = 2

    def run(self, seconds: float, damage: Callable[[bytes], bytes | None] = lambda data: data) -> Vitals:
        """Run for a time [s]; return the vitals at the end."""
        for _ in range(round(seconds * 1e6 / STEP)):
            self.now += STEP
            self.state["tick"] += self.tick_step
            data = damage(encode(self.state))
            self.monitor.update(self.now, [] if data is None else [data])
        return self.monitor.vitals(self.now)


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_readings_of_a_recorded_state(bench: Bench) -> None:
    vitals = bench.run(1.0)
    assert vitals.hazard is None
    assert vitals.sit is None
    sensors, motors = bench.monitor.sensors(), RECORDED["motor_state"]
    np.testing.assert_allclose(sensors.motor_angle, [m["q"] for m in motors[:12]], rtol=1e-6)
    np.testing.assert_allclose(sensors.motor_velocity, [m["dq"] for m in motors[:12]], rtol=1e-6)
    np.testing.assert_allclose(sensors.motor_torque, [m["tau_est"] for m in motors[:12]], rtol=1e-6)
    np.testing.assert_allclose(sensors.roll_pitch_yaw, RECORDED["imu_state"]["rpy"], atol=1e-5)
    np.testing.assert_allclose(sensors.angular_velocity_base, RECORDED["imu_state"]["gyroscope"], rtol=1e-6)
    np.testing.assert_allclose(sensors.accelerometer, RECORDED["imu_state"]["accelerometer"], rtol=1e-6)
    assert sensors.voltage == pytest.approx(30.668)  # eight cells; power_v is 29.5 V at the end of a cable
    assert vitals.temperature == 78
    power = abs(sum(m["tau_est"] * m["dq"] for m in motors[:12]))
    assert sensors.energy == pytest.approx(power * 0.998, rel=1e-3)


def test_a_battery_without_cells_has_the_voltage_of_the_board(bench: Bench) -> None:
    bench.state["bms_state"]["cell_vol"] = 0
    for _ in range(10):  # it is read again every 50 ms
        bench.run(0.025)
        assert bench.monitor.voltage == pytest.approx(RECORDED["power_v"])


def test_the_motors_must_not_move_before_the_first_state(bench: Bench) -> None:
    assert bench.run(0.1, lambda data: None).hazard == (Reason.STATES_LATE, "no state has arrived")


def silence(_: bytes) -> None:
    return None


def flip(data: bytes) -> bytes:
    return data[:200] + bytes([data[200] ^ 4]) + data[201:]


def cut(data: bytes) -> bytes:
    return data[:-8]


@pytest.mark.parametrize(
    ("damage", "reason"),
    [(silence, Reason.STATES_LATE), (flip, Reason.STATES_DAMAGED), (cut, Reason.STATES_DAMAGED)],
)
def test_missing_or_damaged_states_are_a_hazard(bench: Bench, damage: Callable[[bytes], bytes], reason: Reason) -> None:
    assert bench.run(0.1).hazard is None
    assert bench.run(1e-6 * (STATE_TIMEOUT - STEP), damage).hazard is None
    hazard = bench.run(1e-6 * STEP, damage).hazard
    assert hazard is not None
    assert hazard[0] == reason
    assert bench.run(0.002).hazard is None


def test_occasional_damaged_states_are_skipped(bench: Bench) -> None:
    count = 0

    def every_third(data: bytes) -> bytes:
        nonlocal count
        count += 1
        return data if count % 3 else flip(data)

    bench.run(0.1)
    for _ in range(100):
        assert bench.run(0.002, every_third).hazard is None
    assert bench.monitor.damaged == 33


def test_repeated_states_are_a_hazard(bench: Bench) -> None:
    bench.run(0.1)
    bench.tick_step = 0
    hazard = bench.run(1e-6 * STATE_TIMEOUT).hazard
    assert hazard is not None
    assert hazard[0] == Reason.STATES_FROZEN


def test_a_delayed_monitor_polls_before_it_reports_late_states(bench: Bench) -> None:
    bench.run(0.1)
    bench.now += 5 * STATE_TIMEOUT
    for _ in range(MIN_POLLS - 1):
        bench.now += STEP
        bench.monitor.update(bench.now, [])
        assert bench.monitor.vitals(bench.now).hazard is None
    bench.monitor.update(bench.now, [])
    assert bench.monitor.vitals(bench.now).hazard is not None


def test_a_restart_of_the_robot_is_a_hazard(bench: Bench) -> None:
    bench.run(1.0)
    bench.state["tick"] = 0
    hazard = bench.run(0.002).hazard
    assert hazard is not None
    assert hazard[0] == Reason.RESTARTED
    assert bench.run(1e-6 * HAZARD_HOLD).hazard is None


def test_states_out_of_order_are_skipped(bench: Bench) -> None:
    bench.run(0.1)
    old = encode(bench.state)
    bench.run(0.01)
    bench.monitor.update(bench.now, [old])
    assert bench.monitor.vitals(bench.now).hazard is None
    assert bench.monitor.tick == bench.state["tick"]


def test_a_tick_overflow_is_not_a_restart(bench: Bench) -> None:
    bench.state["tick"] = 2**32 - 20
    for _ in range(20):
        assert bench.run(0.002).hazard is None


@pytest.mark.parametrize(
    ("part", "field", "at", "value"),
    [
        ("motor_state", "q", 7, np.nan),
        ("motor_state", "dq", 7, np.inf),
        ("motor_state", "tau_est", 7, -np.inf),
        ("imu_state", "gyroscope", 2, np.nan),
        ("imu_state", "accelerometer", 2, np.nan),
    ],
)
def test_readings_that_are_not_finite_are_a_hazard(bench: Bench, part: str, field: str, at: int, value: float) -> None:
    bench.run(0.1)
    bench.state[part][field][at] = value
    hazard = bench.run(0.002).hazard
    assert hazard is not None
    assert hazard[0] == Reason.NOT_FINITE


def test_an_imu_that_sends_zeros_is_a_hazard(bench: Bench) -> None:
    bench.state["imu_state"]["quaternion"] = 0
    hazard = bench.run(0.002).hazard
    assert hazard == (Reason.NOT_FINITE, "the IMU's quaternion has norm 0; it must be 1")


def test_a_motor_that_is_off_is_a_hazard(bench: Bench) -> None:
    bench.run(0.1)
    bench.state["motor_state"]["mode"][5] = 0
    assert bench.run(0.002).hazard == (Reason.MOTOR_OFF, "FL_calf_joint is off (mode 0)")


def test_lost_messages_of_a_motor_are_a_hazard(bench: Bench) -> None:
    assert bench.run(1.0).hazard is None  # constant counts of 5 to 12
    count, hazard = 0, None
    while hazard is None:
        count += 1
        bench.state["motor_state"]["lost"][3] += 1
        hazard = bench.run(0.002).hazard
    assert hazard[0] == Reason.MOTOR_OFF
    assert "FL_hip_joint has lost 10 messages" in hazard[1]
    assert count == MAX_LOST


def test_lost_messages_are_counted_over_a_sliding_window(bench: Bench) -> None:
    bench.run(0.15)
    for lost in (9, 9):
        hazard = None
        for _ in range(lost):
            bench.state["motor_state"]["lost"][3] += 1
            hazard = hazard or bench.run(0.008).hazard
    assert hazard is not None
    assert "FL_hip_joint has lost 10 messages in 200 ms" in hazard[1]


def test_a_reading_that_is_not_finite_does_not_stay_in_the_energy(bench: Bench) -> None:
    bench.run(0.1)
    torque = bench.state["motor_state"]["tau_est"][3]
    bench.state["motor_state"]["tau_est"][3] = np.nan
    assert bench.run(0.002).hazard[0] == Reason.NOT_FINITE
    bench.state["motor_state"]["tau_est"][3] = torque
    assert bench.run(0.1).hazard is None
    assert np.isfinite(bench.monitor.energy)


def test_occasional_lost_messages_of_a_motor_are_tolerated(bench: Bench) -> None:
    for _ in range(20):
        bench.state["motor_state"]["lost"][3] += 1
        assert bench.run(0.1).hazard is None


def test_the_remote_control(bench: Bench) -> None:
    def press(*buttons: str, stick: float = 0.0) -> Vitals:
        bench.state["wireless_remote"] = RemoteControl(frozenset(buttons), 0.0, 0.0, stick, 0.0).encode()
        return bench.run(0.002)

    assert press("L2").hazard is None
    assert press("L2", "B").hazard == (Reason.REMOTE, "L2 and B of the remote control are pressed")
    assert press(stick=0.4).sit is None
    assert press(stick=-0.6).sit == (Reason.REMOTE, "a stick of the remote control was moved")
    assert press(stick=float("nan")).sit is None
