"""The air experiment: commands within the limits of angle, speed and torque, from slow to fast."""

from __future__ import annotations

import numpy as np
import pytest

from surefoot.deploy.board.limits import Limits, make_handshake
from surefoot.errors import SurefootError
from surefoot.identify.motion.expected_accuracy import planned_motion
from surefoot.identify.plan import Plan
from surefoot.identify.rack.air_plan import FREQUENCY_BAND, LIMIT_MARGIN, SPEED_FRACTION, TORQUE_FRACTION, air_plan
from surefoot.identify.registry import EXPERIMENTS
from surefoot.robot import PhysicalParams, RobotDescription

PERIOD = 0.002


@pytest.fixture(scope="module", params=["go2", "pupper_v2"])
def serial(request: pytest.FixtureRequest) -> RobotDescription:
    return RobotDescription.load(request.param)


@pytest.fixture(scope="module")
def plan(serial: RobotDescription) -> Plan:
    return air_plan(serial)


def test_commands_stay_within_limits(serial: RobotDescription, plan: Plan):
    nominal = PhysicalParams.nominal(serial)
    message = make_handshake(serial, Limits.from_robot(serial), "", serial.timing.servo_step)
    speed_limit = np.broadcast_to(np.asarray(serial.actuator.speed_limit, float), serial.num_motors)
    last = serial.resting_angles
    for phase in plan.phases:
        start, signal = last, phase.signal
        values = np.array([signal(k * PERIOD, start) for k in range(round(phase.duration / PERIOD) + 1)])
        # There are no jumps within or between phases.
        assert np.abs(np.diff(values, axis=0, prepend=start[None])).max() < 0.05, phase.name
        last = values[-1]
        if phase.use == "transition":
            continue
        assert np.all(values >= plan.angle_low - 1e-9), phase.name
        assert np.all(values <= plan.angle_high + 1e-9), phase.name
        assert np.all(values >= message.angle_low), phase.name
        assert np.all(values <= message.angle_high), phase.name
        speed = np.abs(np.diff(values, axis=0)) / PERIOD
        # The fade adds a little to the speed of the sine.
        assert np.all(speed.max(axis=0) < 1.2 * SPEED_FRACTION * np.minimum(speed_limit, 20.0)), phase.name
    # At the fastest part of a chirp the servo demands at most its gain times the amplitude of the command.
    fast = planned_motion(plan).command[-90:-40]
    torque = nominal.servo_kp[0] * np.ptp(fast, axis=0) / 2
    assert np.all(torque < 1.3 * TORQUE_FRACTION * nominal.torque_limit[0])


def test_a_blocked_motor_exceeds_the_torque_that_ends_the_experiment(serial: RobotDescription, plan: Plan):
    own = PhysicalParams.nominal(serial).torque_limit[0]
    assert np.all(plan.limits.torque < own)
    assert np.all(plan.limits.torque > 1.3 * TORQUE_FRACTION * own)  # what the fastest part of a chirp demands


def test_joints_keep_clear_of_their_limits(serial: RobotDescription, plan: Plan):
    for motor, name in enumerate(serial.motor_names):
        limits = serial.urdf.joints[name].limits
        if limits is not None:
            low, high = sorted(serial.motor_sign[motor] * np.asarray(limits))
            assert plan.angle_low[motor] >= low + LIMIT_MARGIN - 1e-9
            assert plan.angle_high[motor] <= high - LIMIT_MARGIN + 1e-9


def test_kinds_of_joints_move_one_after_another_and_then_together(serial: RobotDescription, plan: Plan):
    moving = {}
    for phase in plan.phases:
        if phase.use == "fit":
            values = np.array([phase.signal(t, serial.resting_angles) for t in np.arange(0, phase.duration, 0.01)])
            moving[phase.name] = np.ptp(values, axis=0) > 0.05
    assert [int(moved.sum()) for moved in moving.values()] == [4, 4, 4, 12]
    assert np.all(np.sum(list(moving.values())[:3], axis=0) == 1)
    # From slow to fast: the reversals of a chirp get closer.
    chirp = plan.phases[1]
    times = np.arange(0, chirp.duration, PERIOD)
    angle = np.array([chirp.signal(t, serial.resting_angles)[serial.leg_motor_index[0, 0]] for t in times])
    turns = times[1:-1][np.diff(np.sign(np.diff(angle))) != 0]
    assert turns[1] - turns[0] > 5 * (turns[-2] - turns[-3])
    assert 1 / (2 * (turns[-3] - turns[-4])) == pytest.approx(FREQUENCY_BAND[1], rel=0.3)


def test_the_experiment_is_for_serial_legs_with_joint_actuators():
    minitaur = RobotDescription.load("minitaur")
    with pytest.raises(
        SurefootError, match="air takes robots with joint actuators and serial legs; minitaur has others"
    ):
        EXPERIMENTS["air"].plan(minitaur)
