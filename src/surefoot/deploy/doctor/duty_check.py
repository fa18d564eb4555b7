"""Check of one motor without servo control: a short, small duty must turn only this motor, in the right direction.

It precedes the doctor's other motions, because a servo with an encoder of the wrong sign drives its motor away from the
target at full torque.
"""

from __future__ import annotations

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult
from surefoot.deploy.messages import Mode, State
from surefoot.deploy.motion_runner import MotionRunner
from surefoot.deploy.robot_link import RobotLink
from surefoot.deploy.safety import Act
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

MAX_DUTY = 0.2
"""Maximum duty of the check."""
MIN_MOTION, MAX_MOTION = 0.02, 0.3
"""Minimum motion that shows a direction, and motion above which the duty is switched off [rad]."""
MAX_REST_MOTION = 0.002
"""Maximum motion within `_REST_TIME` of legs that hang still [rad]."""
_PERIOD, _REST_TIME, _ATTEMPTS = 0.006, 0.3, 50


def try_duty(
    link: RobotLink, robot: RobotDescription, motor: int, duty: float, duration: float, operator: StopSignals
) -> CheckResult:
    """Apply a duty to one motor and check which motors turned; all motors are damped afterwards.

    Args:
        link: link to the robot, after the handshake; the robot must hang freely.
        robot: robot description.
        motor: index of the motor.
        duty: -`MAX_DUTY` to `MAX_DUTY`; for joint actuators, a fraction of the maximum torque.
        duration: maximum duration of the duty [s].
        operator: signals by which the operator can stop the motion.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the link is lost.
    """
    name = robot.motor_names[motor]
    runner = MotionRunner(link, robot, _PERIOD, operator, mode=Mode.PWM)
    # Without servo control the legs swing; wait until they hang still.
    for _ in range(_ATTEMPTS):
        start = runner.state.motor_angle.copy()
        runner.ping_until(lambda: False, _REST_TIME)
        if (np.abs(runner.state.motor_angle - start) < MAX_REST_MOTION).all():
            break
    else:
        return CheckResult(name, False, "the motors do not come to rest", "let the legs hang still")
    moved, moved_enough = np.zeros(robot.num_motors), False

    def compute(k: int, state: State, missed: int) -> Array:
        nonlocal moved, moved_enough
        # The largest motion of each motor: afterwards legs swing back.
        motion = state.motor_angle - start
        moved = np.where(np.abs(motion) > np.abs(moved), motion, moved)
        # Of any motor: if two motors are exchanged, the other one turns.
        moved_enough = moved_enough or bool((np.abs(motion) > MAX_MOTION).any())
        values = np.zeros(robot.num_motors)
        values[motor] = 0.0 if moved_enough or k >= steps else duty
        return values

    runner.arm()
    try:
        steps = runner.loop.num_steps(duration)
        verdict = runner.loop.run_phase(name, steps + runner.loop.num_steps(_REST_TIME), compute)
    finally:
        runner.release(damp=True)
    if verdict.act is not Act.GO:
        return CheckResult(name, False, verdict.text, "fix this, and try again")
    motion, farthest = float(moved[motor]), int(np.argmax(np.abs(moved)))
    message = f"a duty of {duty:g} turned it by {motion:.3f} rad"
    if abs(moved[farthest]) >= MIN_MOTION and farthest != motor:
        text = f"{message}, and {robot.motor_names[farthest]} by {moved[farthest]:.3f}"
        return CheckResult(name, False, text, "swap the two motors, or their encoders", motion)
    if abs(motion) < MIN_MOTION:
        rule = f"; at least {MIN_MOTION:g} is expected"
        remedy = "check the motor driver and the encoder, or use a larger duty"
        return CheckResult(name, False, f"{message}{rule}", remedy, motion)
    if motion * duty < 0:
        remedy = "negate the sign of the motor driver or of the encoder, not both; or swap two motors of the leg"
        return CheckResult(name, False, f"{message}: the wrong direction", remedy, motion)
    return CheckResult(name, True, message, value=motion)
