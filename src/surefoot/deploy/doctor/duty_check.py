"""Check of one motor without a servo: a small duty for a moment must turn it the right way, and no other one.

It comes before the doctor's other motions: a servo whose encoder has the wrong sign drives its motor away from the
target, with all its strength.
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
"""Greatest duty that may be tried."""
MIN_MOTION, MAX_MOTION = 0.02, 0.3
"""Least motion that shows a direction, and motion [rad] from which the motor gets no duty any more."""
STILL = 0.002
"""Motion [rad] within `_REST_TIME` of legs that hang still."""
_PERIOD, _REST_TIME, _ATTEMPTS = 0.006, 0.3, 50


def try_duty(
    link: RobotLink, robot: RobotDescription, motor: int, duty: float, duration: float, operator: StopSignals
) -> CheckResult:
    """Give one motor a duty, and judge what turned; all motors are damped afterwards.

    Args:
        link: to the robot, after its handshake; it hangs free.
        robot: its description.
        motor: number of the motor.
        duty: -`MAX_DUTY` to `MAX_DUTY`; of joint actuators a share of the greatest torque.
        duration: for how long at most [s].
        operator: may stop it.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the port is gone.
    """
    name = robot.motor_names[motor]
    runner = MotionRunner(link, robot, _PERIOD, operator, mode=Mode.PWM)
    # Motors without a servo let the legs swing: they must hang still first.
    for _ in range(_ATTEMPTS):
        start = runner.state.motor_angle.copy()
        runner.ping_until(lambda: False, _REST_TIME)
        if (np.abs(runner.state.motor_angle - start) < STILL).all():
            break
    else:
        return CheckResult(name, False, "the motors do not come to rest", "let the legs hang still")
    far = False

    def compute(k: int, state: State, missed: int) -> Array:
        nonlocal far
        far = far or abs(state.motor_angle[motor] - start[motor]) > MAX_MOTION
        values = np.zeros(robot.num_motors)
        values[motor] = 0.0 if far or k >= steps else duty
        return values

    runner.arm()
    try:
        steps = runner.loop.num_steps(duration)
        verdict = runner.loop.follow(name, steps + runner.loop.num_steps(_REST_TIME), compute)
    finally:
        runner.release(damp=True)
    if verdict.act is not Act.GO:
        return CheckResult(name, False, verdict.text, "mend that, and try again")
    moved = runner.state.motor_angle - start
    own, most = float(moved[motor]), int(np.argmax(np.abs(moved)))
    message = f"a duty of {duty:g} turned it by {own:.3f} rad"
    if abs(moved[most]) >= MIN_MOTION and most != motor:
        text = f"{message}, and {robot.motor_names[most]} by {moved[most]:.3f}"
        return CheckResult(name, False, text, "exchange the two motors, or their encoders", own)
    if abs(own) < MIN_MOTION:
        rule = f"; at least {MIN_MOTION:g} is expected"
        return CheckResult(name, False, f"{message}{rule}", "check the drive, the encoder, or give a greater duty", own)
    if own * duty < 0:
        remedy = "negate the drive or the encoder, not both; or two motors of the leg are exchanged"
        return CheckResult(name, False, f"{message}: the wrong way", remedy, own)
    return CheckResult(name, True, message, value=own)
