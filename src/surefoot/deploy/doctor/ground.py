"""The doctor's look at a robot on flat ground: it stands up and tilts itself with its legs, and the IMU must agree.

Frames: x forward, y left, z up. Shorter front legs put the nose down, a turn about +y: pitch grows. Shorter left legs
put the left side down, a turn about -x: roll falls.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.doctor.leashed_robot import LeashedRobot, MotionStoppedError
from surefoot.deploy.doctor.rest import Sample
from surefoot.deploy.robot_link import RobotLink
from surefoot.errors import choices
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

RISE, SETTLE, TILT_TIME = 1.5, 0.6, 0.8
"""Time [s] to stand up, to settle, and to go into a tilt."""
LEASH = 0.8
"""How far [rad] a motor may be from where it was sent: legs that carry the robot give way by some .2 rad."""
LEAST = 0.03
"""Least tilt [rad] that must be seen; half of what legs give, or less."""
OTHER = 0.5
"""How much of that the other axis may turn, as a share."""
RATE_SHARE, RATE_LEAST = 0.3, 0.015
"""How far the gyro's integral may be from the change of the angle: as a share, and [rad]."""
_SETTLED = 25
NAMES = ("IMU, nose down", "IMU, left side down", "IMU, rates")
AXES = ("roll", "pitch")
SIDES = ("front", "left")
"""What the names of the legs on these sides contain."""


@dataclass(frozen=True)
class Tilted:
    """What the IMU said of one tilt."""

    angles: Array
    """Change of roll and pitch (2,) [rad]."""
    turned: Array
    """Integral of the rates about x and y, the gyro's bias taken off (2,) [rad]."""


def tilt_robot(
    link: RobotLink,
    contract: Contract,
    robot: RobotDescription,
    operator: StopSignals,
    at_rest: Sequence[Sample],
) -> list[CheckResult]:
    """Let a robot stand up and tilt itself to the front and to the left, sit down and disarm, and judge its IMU.

    Args:
        link: to a robot that sits on flat ground.
        contract: says how it stands.
        robot: as of `MotionRunner`.
        operator: as of `MotionRunner`.
        at_rest: states of the robot at rest, for the bias of its gyro.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the port is gone.
    """
    if not all(0 < sum(side in leg for leg in robot.leg_names) < len(robot.legs) for side in SIDES):
        why = f"the names of the legs ({choices(robot.leg_names)}) do not say which stand in front and which left"
        return skipped(NAMES, why, "name them so in the data sheet")
    gyro_bias = np.mean([sample.state.angular_velocity_base for sample in at_rest], axis=0)
    stand = robot.pose_angles(*contract.rest)
    leashed = LeashedRobot(link, robot, contract.control_step, operator, LEASH, sits=True)
    try:
        with leashed:
            leashed.go(stand, RISE)
            tilts = []
            for shorter in SIDES:
                leashed.hold(stand, SETTLE)
                first = len(leashed.samples) - _SETTLED
                lean = _leaning(robot, contract.rest, shorter)
                leashed.go(lean, TILT_TIME)
                leashed.hold(lean, SETTLE)
                tilts.append(tilted(leashed.samples[first:], gyro_bias))
                leashed.go(stand, TILT_TIME)
    except MotionStoppedError as stopped:
        if stopped.verdict.reason == "operator":
            return skipped(NAMES, "stopped by the operator", "run it again")
        failed = CheckResult(NAMES[0], False, stopped.verdict.text, "mend that, and run the doctor again")
        return [failed, *skipped(NAMES[1:], "the robot did not get so far")]
    return check_tilts(*tilts)


def _leaning(robot: RobotDescription, stand: tuple[float, ...], shorter: str) -> Array:
    """Motor angles (M,) of a robot whose front or left legs are shorter and whose others are longer."""
    use, (*sides, extension) = robot.experiments, stand
    low, high = robot.leg_space["extension"]
    side = np.array([shorter in leg for leg in robot.leg_names])
    extensions = np.clip(np.where(side, extension - use.shorter, extension + use.longer), low, high)
    return robot.pose_angles(*sides, extensions)


def tilted(samples: Sequence[Sample], gyro_bias: Array) -> Tilted:
    """What the IMU said from level to tilted; the first and the last samples are of a robot that is still."""
    angles = np.array([sample.state.roll_pitch_yaw[:2] for sample in samples])
    rates = np.array([sample.state.angular_velocity_base[:2] for sample in samples]) - gyro_bias[:2]
    times = np.array([sample.time for sample in samples])
    count = min(_SETTLED, len(samples) // 3 or 1)
    turned = (np.diff(times)[:, None] * (rates[1:] + rates[:-1]) / 2).sum(axis=0)
    return Tilted(angles[-count:].mean(axis=0) - angles[:count].mean(axis=0), turned)


def check_tilts(front: Tilted, left: Tilted) -> list[CheckResult]:
    """Judge what the IMU said when the nose, and when the left side, went down."""
    return [
        _tilt(NAMES[0], "front legs shorter", front.angles, 1, 1.0),
        _tilt(NAMES[1], "left legs shorter", left.angles, 0, -1.0),
        _rates(front, left),
    ]


def _tilt(name: str, what: str, angles: Array, axis: int, sign: float) -> CheckResult:
    main, other = float(angles[axis]), float(angles[1 - axis])
    told = f"{what}: {AXES[axis]} {main:+.3f}, {AXES[1 - axis]} {other:+.3f} rad"
    way = "grow" if sign > 0 else "fall"
    rule = f"; {AXES[axis]} must {way} by {LEAST:g} rad or more, {AXES[1 - axis]} stay"
    if abs(other) >= LEAST and abs(main) <= OTHER * abs(other):
        todo = (
            "the IMU's x and y are exchanged, or legs are: set its mounting in the firmware, and check the legs' cables"
        )
    elif sign * main <= -LEAST:
        todo = f"the IMU's {AXES[axis]} is mirrored, or the legs of both sides are exchanged: check mounting and cables"
    else:
        todo = (
            "the legs did not tilt the robot: check the ground, the legs' cables, and that the IMU is fixed to the body"
        )
    return judge(name, sign * main >= LEAST and abs(other) <= OTHER * abs(main), told, rule, todo, main)


def _rates(front: Tilted, left: Tilted) -> CheckResult:
    """The gyro's integral against the change of the angles; for tilts this small both are the same to a few percent."""
    name, told, wrong = NAMES[2], [], False
    for axis, one in ((1, front), (0, left)):
        angle, turned = float(one.angles[axis]), float(one.turned[axis])
        told.append(f"{AXES[axis]} changed by {angle:+.3f} rad, its rate says {turned:+.3f}")
        wrong |= abs(turned - angle) > max(RATE_SHARE * abs(angle), RATE_LEAST)
    todo = "check axes, signs and units (rad/s) of the gyro in the firmware"
    return judge(name, not wrong, "; ".join(told), f"; they must agree within {RATE_SHARE:.0%}", todo)
