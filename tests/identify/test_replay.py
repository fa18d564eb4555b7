"""Replays of a recording from a robot with known parameters reproduce the recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("mujoco")

from surefoot.deploy.messages import Mode
from surefoot.errors import SurefootError
from surefoot.identify.plan import Plan
from surefoot.identify.recording import Recording
from surefoot.identify.replay import HOLD, ReplayedReadings, Replayer, Segment, segment_from_recording
from surefoot.robot import PhysicalParams, RobotDescription

TRUTH = {
    "motor_strength": 0.9,
    "motor_friction": 0.02,
    "motor_viscous_friction": 0.002,
    "resistance": 0.2,
    "voltage": 15.0,
    "servo_latency": 0.004,
    "control_latency": 0.0173,
    "leg_inertia_ratio": 1.2,
}


@pytest.fixture(scope="module")
def ideal(record: Callable[..., list[Recording]], make_plan: Callable[..., Plan]) -> Recording:
    """Recording of a robot on its rack with ideal sensors: unfold, sweep, steps, centre, duties, centre, sweep."""
    return record(TRUTH, make_plan())[0]


@pytest.fixture(scope="module")
def truth(robot: RobotDescription) -> PhysicalParams:
    return PhysicalParams.nominal(robot).with_values(robot, **TRUTH)


@pytest.fixture(scope="module")
def segment(ideal: Recording) -> Segment:
    return segment_from_recording(ideal, 1, 6)


@pytest.fixture(scope="module")
def one(robot: RobotDescription) -> Replayer:
    return Replayer(robot, 1)


@pytest.fixture(scope="module")
def readings(one: Replayer, segment: Segment, truth: PhysicalParams) -> ReplayedReadings:
    return one.run(segment, truth)


def test_segment_holds_commands_and_mode_changes(segment: Segment, ideal: Recording):
    # Sweep, steps and centre, then disarmed, armed for duties, disarmed, and armed for servos that first hold.
    changes = np.flatnonzero(np.diff(segment.kind, prepend=-9))
    position, pwm, off = int(Mode.POSITION), int(Mode.PWM), int(Mode.DISARMED)
    assert segment.kind[changes].tolist()[:6] == [position, off, pwm, off, HOLD, position]
    assert segment.command_tick[0] == 0
    assert np.all(np.diff(segment.command_tick) >= 0)
    np.testing.assert_array_equal(segment.voltage, 15.0)
    np.testing.assert_array_equal(segment.start, ideal.sent_value[ideal.sent_phase == 1][0])
    np.testing.assert_allclose(np.diff(segment.state_time), np.diff(ideal.time[segment.states]), atol=1e-12)
    assert segment.lead == 0.0
    assert np.ptp(segment.state_time) == pytest.approx(2.5, abs=0.3)


def test_a_replay_with_the_true_parameters_is_the_recording(
    readings: ReplayedReadings, segment: Segment, ideal: Recording
):
    # The robot had just unfolded, while the replayed robots start at rest; the difference decays within 0.4 s.
    settled = segment.state_time > 0.4
    kept = segment.states[settled]
    assert np.ptp(ideal.motor_angle[kept], axis=0).min() > 0.2
    # Within the resolution of states.
    assert np.abs(readings.motor_angle[0][settled] - ideal.motor_angle[kept]).max() < 2e-6
    assert np.abs(readings.motor_velocity[0][settled] - ideal.motor_velocity[kept]).max() < 1e-3
    assert np.abs(readings.motor_torque[0][settled] - ideal.motor_torque[kept]).max() < 3e-3


def test_control_latency_shifts_the_readings(
    one: Replayer, readings: ReplayedReadings, segment: Segment, truth: PhysicalParams, robot: RobotDescription
):
    # States are 2 ms apart: with 4 ms more latency, each equals the second state before it.
    late = truth.with_values(robot, control_latency=TRUTH["control_latency"] + 0.004)
    shifted = one.run(segment, late)
    for name in ("motor_angle", "motor_velocity"):
        ours, before = getattr(shifted, name)[0], getattr(readings, name)[0]
        np.testing.assert_allclose(ours[12:], before[10:-2], atol=1e-3)
    # Torques are not delayed by the control latency.
    np.testing.assert_array_equal(shifted.motor_torque, readings.motor_torque)
    ages = np.array([TRUTH["control_latency"], TRUTH["control_latency"] + 0.004, 0.0])
    together = one.angles_with_latencies(segment, truth, ages)
    np.testing.assert_array_equal(together[0], readings.motor_angle[0])
    np.testing.assert_array_equal(together[1], shifted.motor_angle[0])
    # Without latency, readings differ clearly.
    assert np.abs(together[2][:-10] - readings.motor_angle[0][:-10]).max() > 0.05


def test_the_lead_reduces_the_age_of_readings(
    one: Replayer, readings: ReplayedReadings, segment: Segment, truth: PhysicalParams, robot: RobotDescription
):
    late = truth.with_values(robot, control_latency=TRUTH["control_latency"] + 0.005)
    ahead = one.run(replace(segment, lead=0.005), late)
    np.testing.assert_allclose(ahead.motor_angle, readings.motor_angle, atol=1e-9)
    # No reading is from the future.
    soon = one.run(replace(segment, lead=1.0), truth)
    np.testing.assert_array_equal(soon.motor_angle[0], one.angles_with_latencies(segment, truth, np.zeros(1))[0])


def test_rows_of_a_batch_are_independent(
    readings: ReplayedReadings, ideal: Recording, truth: PhysicalParams, robot: RobotDescription, one: Replayer
):
    short = segment_from_recording(ideal, 3, 5)
    rows = truth.rows([0, 0, 0])
    rows.motor_strength[1], rows.servo_latency[2], rows.leg_mass_ratio[2] = 0.6, 0.001, 1.3
    three = Replayer(robot, 3)
    together, turned = three.run(short, rows), three.run(short, rows.rows([2, 0, 1]))
    pair = three.run(short, rows.rows([1, 2]))
    for name in vars(together):
        values = getattr(together, name)
        assert len(values) == 3
        np.testing.assert_array_equal(getattr(turned, name), values[[2, 0, 1]])
        np.testing.assert_array_equal(getattr(pair, name), values[[1, 2]])
        for row in range(3):
            np.testing.assert_array_equal(getattr(one.run(short, rows.rows([row])), name)[0], values[row])
    assert np.abs(together.motor_angle[0] - together.motor_angle[1]).max() > 1e-3


def test_segment_needs_commands(ideal: Recording):
    with pytest.raises(SurefootError, match="no commands of phases 9 to 11"):
        segment_from_recording(ideal, 9, 11)
