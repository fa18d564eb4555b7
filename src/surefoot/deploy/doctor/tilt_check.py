"""Check of the IMU of a robot on flat ground, which stands up and tilts its body with its legs.

Frame: x forward, y left, z up. Shorter front legs put the nose down, a rotation about +y, so pitch increases. Shorter
left legs put the left side down, a rotation about -x, so roll decreases.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if, skip_checks
from surefoot.deploy.doctor.doctor_motion import DoctorMotion, MotionStoppedError
from surefoot.deploy.doctor.rest_check import TimedState
from surefoot.deploy.robot_link import RobotLink
from surefoot.errors import choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

SETTLE_TIME, TILT_TIME = 0.6, 0.8
"""Time to settle, and to move into a tilt [s]."""
MAX_ERROR = 0.8
"""Maximum deviation of a motor from its target [rad]; legs that carry the robot yield by some 0.2 rad."""
MIN_TILT = 0.03
"""Minimum measured tilt [rad], at most half of the commanded tilt."""
MAX_CROSS_RATIO = 0.5
"""Maximum rotation about the other axis, relative to the tilt."""
RELATIVE_TOLERANCE, RATE_TOLERANCE = 0.3, 0.015
"""Maximum difference between the integral of the gyro and the change of the angle: relative, and absolute [rad]."""
_SETTLED = 25
"""Number of states before and after a tilt that are averaged."""
NAMES = ("IMU, nose down", "IMU, left side down", "IMU, rates")
AXES = ("roll", "pitch")
SIDES = ("front", "left")
"""Words that the names of the legs on these sides contain."""


@dataclass(frozen=True)
class TiltReading:
    """IMU readings of one tilt."""

    angles: Array
    """Change of roll and pitch (2,) [rad]."""
    integrated: Array
    """Integral of the rates about x and y, corrected for gyro bias (2,) [rad]."""


def tilt_robot(
    link: RobotLink,
    contract: Contract,
    robot: RobotDescription,
    operator: StopSignals,
    at_rest: Sequence[TimedState],
) -> list[CheckResult]:
    """Make a robot stand up, tilt to the front and to the left, sit down and disarm, and check its IMU.

    Args:
        link: link to a robot that sits on flat ground.
        contract: contract of the policy, with the standing pose.
        robot: robot description.
        operator: signals by which the operator can stop the motion.
        at_rest: states of the robot at rest, for the bias of its gyro.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the link is lost.
    """
    if not all(0 < sum(side in leg for leg in robot.leg_names) < len(robot.legs) for side in SIDES):
        message = f"the names of the legs ({choices(robot.leg_names)}) do not contain {' and '.join(SIDES)}"
        return skip_checks(NAMES, message, "use such names in the data sheet, for example front_left")
    gyro_bias = np.mean([timed.state.angular_velocity_base for timed in at_rest], axis=0)
    stand = robot.pose_angles(*contract.rest)
    motion = DoctorMotion(link, robot, contract.control_step, operator, MAX_ERROR)
    try:
        with motion:
            motion.rise(stand)
            tilts = []
            for side in SIDES:
                motion.hold(stand, SETTLE_TIME)
                first = len(motion.states) - _SETTLED
                tilted = _tilted_angles(robot, contract.rest, side)
                motion.go(tilted, TILT_TIME)
                motion.hold(tilted, SETTLE_TIME)
                tilts.append(read_tilt(motion.states[first:], gyro_bias))
                motion.go(stand, TILT_TIME)
    except MotionStoppedError as stopped:
        return stopped.results(NAMES)
    return check_tilts(*tilts)


def _tilted_angles(robot: RobotDescription, stand: Sequence[ArrayLike], side: str) -> Array:
    """Return the motor angles (M,) [rad] with shorter legs on one side and longer legs on the other side."""
    settings = robot.experiments
    *lateral, extension = (np.asarray(part, float) for part in stand)
    low, high = robot.leg_space["extension"]
    shorter = np.array([side in leg for leg in robot.leg_names])
    extensions = np.clip(np.where(shorter, extension - settings.shorter, extension + settings.longer), low, high)
    return robot.pose_angles(*lateral, extensions)


def read_tilt(timed_states: Sequence[TimedState], gyro_bias: Array) -> TiltReading:
    """Return the IMU readings of a tilt; the robot must be still in the first and last states."""
    angles = np.array([timed.state.roll_pitch_yaw[:2] for timed in timed_states])
    rates = np.array([timed.state.angular_velocity_base[:2] for timed in timed_states]) - gyro_bias[:2]
    times = np.array([timed.time for timed in timed_states])
    count = min(_SETTLED, len(timed_states) // 3 or 1)
    return TiltReading(angles[-count:].mean(axis=0) - angles[:count].mean(axis=0), np.trapezoid(rates, times, axis=0))


def check_tilts(front: TiltReading, left: TiltReading) -> list[CheckResult]:
    """Check the IMU by its readings of a tilt with the nose down and a tilt with the left side down."""
    rates, agree = [], True
    for axis, reading in ((1, front), (0, left)):
        angle, integrated = float(reading.angles[axis]), float(reading.integrated[axis])
        rates.append(f"{AXES[axis]} changed by {angle:+.3f} rad, its rate integrates to {integrated:+.3f}")
        agree &= abs(integrated - angle) <= max(RELATIVE_TOLERANCE * abs(angle), RATE_TOLERANCE)
    return [
        _check_tilt(NAMES[0], "front legs shorter", front.angles, 1, 1.0),
        _check_tilt(NAMES[1], "left legs shorter", left.angles, 0, -1.0),
        pass_if(
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
            "x and y of the IMU are swapped, or legs are: set the IMU's mounting in the firmware, and check the cables "
            "of the legs"
        )
    elif sign * main <= -MIN_TILT:
        remedy = (
            f"{AXES[axis]} of the IMU has the wrong sign, or the legs of both sides are swapped: check mounting and "
            "cables"
        )
    else:
        remedy = (
            "the legs did not tilt the robot: check the ground, the cables of the legs, and that the IMU is fixed to "
            "the body"
        )
    return pass_if(
        name,
        sign * main >= MIN_TILT and abs(other) <= MAX_CROSS_RATIO * abs(main),
        f"{condition}: {AXES[axis]} {main:+.3f}, {AXES[1 - axis]} {other:+.3f} rad",
        f"; {AXES[axis]} must {'increase' if sign > 0 else 'decrease'} by at least {MIN_TILT:g} rad, and "
        f"{AXES[1 - axis]} must not change",
        remedy,
        main,
    )
