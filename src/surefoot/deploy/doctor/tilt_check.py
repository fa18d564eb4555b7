"""Check of the IMU of a robot on flat ground: it stands up and tilts itself with its legs.

Frames: x forward, y left, z up. Shorter front legs put the nose down, a turn about +y: pitch grows. Shorter left legs
put the left side down, a turn about -x: roll falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.doctor.doctor_motion import DoctorMotion, MotionStoppedError
from surefoot.deploy.doctor.rest_check import TimedState
from surefoot.deploy.robot_link import RobotLink
from surefoot.errors import choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

RISE_TIME, SETTLE, TILT_TIME = 1.5, 0.6, 0.8
"""Time [s] to stand up, to settle, and to go into a tilt."""
MAX_ERROR = 0.8
"""Greatest difference of a motor's angle from its target [rad]: legs that carry the robot give way by some .2 rad."""
MIN_TILT = 0.03
"""Least tilt [rad]; half of what the legs give, or less."""
MAX_CROSS_RATIO = 0.5
"""Greatest turn about the other axis, as a share of the tilt."""
RELATIVE_TOLERANCE, RATE_TOLERANCE = 0.3, 0.015
"""Greatest difference of the gyro's integral from the change of the angle: as a share, and [rad]."""
_SETTLED = 25
NAMES = ("IMU, nose down", "IMU, left side down", "IMU, rates")
AXES = ("roll", "pitch")
SIDES = ("front", "left")
"""What the names of the legs on these sides contain."""


@dataclass(frozen=True)
class TiltReading:
    """Readings of the IMU in one tilt."""

    angles: Array
    """Change of roll and pitch (2,) [rad]."""
    turned: Array
    """Integral of the rates about x and y without the gyro's bias (2,) [rad]."""


def tilt_robot(
    link: RobotLink,
    contract: Contract,
    robot: RobotDescription,
    operator: StopSignals,
    at_rest: Sequence[TimedState],
) -> list[CheckResult]:
    """Let a robot stand up, tilt itself to the front and to the left, sit down and disarm, and judge its IMU.

    Args:
        link: to a robot that sits on flat ground.
        contract: has the standing pose.
        robot: its description.
        operator: may stop it.
        at_rest: states of the robot at rest, for the bias of its gyro.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the port is gone.
    """
    if not all(0 < sum(side in leg for leg in robot.leg_names) < len(robot.legs) for side in SIDES):
        message = f"the names of the legs ({choices(robot.leg_names)}) do not say which stand in front and which left"
        return skipped(NAMES, message, "name them so in the data sheet")
    gyro_bias = np.mean([timed.state.angular_velocity_base for timed in at_rest], axis=0)
    stand = robot.pose_angles(*contract.rest)
    motion = DoctorMotion(link, robot, contract.control_step, operator, MAX_ERROR, sits=True)
    try:
        with motion:
            motion.go(stand, RISE_TIME)
            tilts = []
            for side in SIDES:
                motion.hold(stand, SETTLE)
                first = len(motion.states) - _SETTLED
                tilted = _tilted_angles(robot, contract.rest, side)
                motion.go(tilted, TILT_TIME)
                motion.hold(tilted, SETTLE)
                tilts.append(read_tilt(motion.states[first:], gyro_bias))
                motion.go(stand, TILT_TIME)
    except MotionStoppedError as stopped:
        return stopped.results(NAMES)
    return check_tilts(*tilts)


def _tilted_angles(robot: RobotDescription, stand: Sequence[ArrayLike], side: str) -> Array:
    """Return the motor angles (M,) [rad] with shorter legs on one side and longer ones on the other."""
    settings = robot.experiments
    *lateral, extension = (np.asarray(part, float) for part in stand)
    low, high = robot.leg_space["extension"]
    shorter = np.array([side in leg for leg in robot.leg_names])
    extensions = np.clip(np.where(shorter, extension - settings.shorter, extension + settings.longer), low, high)
    return robot.pose_angles(*lateral, extensions)


def read_tilt(timed_states: Sequence[TimedState], gyro_bias: Array) -> TiltReading:
    """Return the IMU's readings of a tilt; the robot is still in the first and the last states."""
    angles = np.array([timed.state.roll_pitch_yaw[:2] for timed in timed_states])
    rates = np.array([timed.state.angular_velocity_base[:2] for timed in timed_states]) - gyro_bias[:2]
    times = np.array([timed.time for timed in timed_states])
    count = min(_SETTLED, len(timed_states) // 3 or 1)
    return TiltReading(angles[-count:].mean(axis=0) - angles[:count].mean(axis=0), np.trapezoid(rates, times, axis=0))


def check_tilts(front: TiltReading, left: TiltReading) -> list[CheckResult]:
    """Judge the IMU by its readings when the nose, and when the left side, went down."""
    rates, agree = [], True
    for axis, reading in ((1, front), (0, left)):
        angle, turned = float(reading.angles[axis]), float(reading.turned[axis])
        rates.append(f"{AXES[axis]} changed by {angle:+.3f} rad, its rate says {turned:+.3f}")
        agree &= abs(turned - angle) <= max(RELATIVE_TOLERANCE * abs(angle), RATE_TOLERANCE)
    return [
        _check_tilt(NAMES[0], "front legs shorter", front.angles, 1, 1.0),
        _check_tilt(NAMES[1], "left legs shorter", left.angles, 0, -1.0),
        judge(
            NAMES[2],
            agree,
            "; ".join(rates),
            f"; they must agree within {RELATIVE_TOLERANCE:.0%}",
            "check axes, signs and units (rad/s) of the gyro in the firmware",
        ),
    ]


def _check_tilt(name: str, condition: str, angles: Array, axis: int, sign: float) -> CheckResult:
    main, other = float(angles[axis]), float(angles[1 - axis])
    if abs(other) >= MIN_TILT and abs(main) <= MAX_CROSS_RATIO * abs(other):
        remedy = (
            "the IMU's x and y are exchanged, or legs are: set its mounting in the firmware, and check the legs' cables"
        )
    elif sign * main <= -MIN_TILT:
        remedy = (
            f"the IMU's {AXES[axis]} is mirrored, or the legs of both sides are exchanged: check mounting and cables"
        )
    else:
        remedy = (
            "the legs did not tilt the robot: check the ground, the legs' cables, and that the IMU is fixed to the body"
        )
    return judge(
        name,
        sign * main >= MIN_TILT and abs(other) <= MAX_CROSS_RATIO * abs(main),
        f"{condition}: {AXES[axis]} {main:+.3f}, {AXES[1 - axis]} {other:+.3f} rad",
        f"; {AXES[axis]} must {'grow' if sign > 0 else 'fall'} by {MIN_TILT:g} rad or more, {AXES[1 - axis]} stay",
        remedy,
        main,
    )
