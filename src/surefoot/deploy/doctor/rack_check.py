"""Check of a freely hanging robot: one motor at a time makes a step of 0.05 rad, larger with friction, and back.

Legs with abduction are moved apart first, because they touch each other when they hang limp.

Which readings move shows the order and signs of the motors. The start of the motion shows the latency, and the rest of
the step response shows the servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if, skip_checks
from surefoot.deploy.doctor.doctor_motion import DoctorMotion, MotionStoppedError
from surefoot.deploy.doctor.rest_check import TimedState
from surefoot.deploy.doctor.step_response import WINDOW, fit_response
from surefoot.deploy.robot_link import RobotLink
from surefoot.policy.contract import Contract
from surefoot.robot import RobotDescription
from surefoot.robot.actuator import JointActuatorData
from surefoot.robot.randomization import mean_interval
from surefoot.stop_signals import StopSignals
from surefoot.task.contract_mapping import task_from_contract

NAMES = ("motors, one by one", "control latency", "servo response")
STEP = 0.05
"""Step of each motor [rad]: too small to do damage, and a hundred times the resolution of an encoder."""
FRICTION_STEPS, MAX_STEP = 5.0, 0.15
"""Minimum step of a joint actuator, relative to the angle at which its servo torque equals friction (a motor may stop
short of its target by that angle before and after the step); and the maximum step [rad]."""
MAX_ERROR = 0.1
"""Maximum deviation of a motor from its target, in addition to the step [rad]; a larger one damps all motors."""
APART_TIME, APART_ERROR = 2.0, 0.4
"""Time in which legs are moved apart [s], and the maximum deviation of a motor from its target during that motion
[rad], which is larger because legs that touch hold each other back."""
SETTLE_TIME, HOLD_TIME = 0.4, 0.35
"""Time for which the robot is held before the first step, and after each step [s]."""
STEP_RATIOS = (0.6, 1.4)
"""Minimum and maximum motion of the motor relative to the step: gravity and friction reduce it."""
MAX_OTHER_RATIO = 0.3
"""Maximum motion of any other motor, relative to the step."""
LATENCY_TOLERANCE = 0.006
"""Maximum difference of the latency from the latencies in training [s]: one control step of the paper, which is less
than policies trained at a single latency tolerate."""
MAX_RISE = 0.08
"""Maximum time for 63 % of a step [s]; half a stride of the trot takes 0.25 s."""
_SETTLED = 5
"""Number of last readings after a step that are averaged."""
_MAX_FIT_ERROR = 0.15
"""Maximum residual of a fitted step response, relative to the step."""
_MIN_READINGS = 8


@dataclass(frozen=True)
class MotorStep:
    """Response of the robot to a step of one motor, and to the step back."""

    motor: int
    """Index of the motor."""
    step: float
    """Commanded change, with sign [rad]."""
    moved: Array
    """Change of each motor's angle after settling (M,) [rad]."""
    age: Array
    """Time of n readings after both steps, since the command arrived at the robot (n,) [s]."""
    progress: Array
    """Fraction of the step that the motor had moved at each reading (n,)."""


def step_motors(
    link: RobotLink, contract: Contract, robot: RobotDescription, operator: StopSignals
) -> list[CheckResult]:
    """Arm a robot on its rack, step each motor, disarm, and check the responses.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the link is lost.
    """
    state, handshake = link.state, link.handshake
    if state is None or handshake is None:
        return [CheckResult(NAMES[0], False, "the robot has sent no state", "switch it off and on")]
    start = np.clip(state.motor_angle, handshake.angle_low, handshake.angle_high)
    steps: list[MotorStep] = []
    command, sizes = "all motors were commanded to hold", step_sizes(robot, handshake.servo_kp)
    motion = DoctorMotion(link, robot, contract.control_step, operator, float(sizes.max()) + MAX_ERROR)
    try:
        with motion:
            motion.hold(start, SETTLE_TIME)
            if "abduction" in robot.coordinates:
                command, abduction = "legs were moved apart", robot.leg_motor_index[:, 0]
                start[abduction] = robot.pose_angles(*robot.poses.sit)[abduction]
                motion.max_error, max_step_error = APART_ERROR, motion.max_error
                motion.go(start, APART_TIME)
                motion.hold(start, SETTLE_TIME)
                motion.max_error = max_step_error
            for motor, middle in enumerate((handshake.angle_low + handshake.angle_high) / 2):
                command = f"{robot.motor_names[motor]} was commanded to move"
                steps.append(_step_motor(motion, start, motor, float(np.copysign(sizes[motor], middle - start[motor]))))
    except MotionStoppedError as stopped:
        failed = None
        if motion.tracking_error is not None:
            motor, error = motion.tracking_error
            name = robot.motor_names[motor]
            failed = CheckResult(
                NAMES[0],
                False,
                f"{name} moved {error:+.2f} rad away from its target while {command}; motors were damped",
                "the sign of this motor or encoder is wrong, or its commands reach another motor: check cables and "
                "firmware",
                name,
            )
        return stopped.results(NAMES, failed)
    trained = _trained_latencies(contract, robot)
    return [check_motors(steps, robot), *check_response(steps, trained, handshake.servo_period, link.lead)]


def step_sizes(robot: RobotDescription, kp: Array) -> Array:
    """Return the size of each motor's step (M,) [rad] for servo gains (M,)."""
    friction = robot.actuator.friction if isinstance(robot.actuator, JointActuatorData) else 0.0
    sizes: Array = np.clip(FRICTION_STEPS * np.broadcast_to(friction, robot.num_motors) / kp, STEP, MAX_STEP)
    return sizes


def _step_motor(motion: DoctorMotion, start: Array, motor: int, step: float) -> MotorStep:
    before = _settled_angles(motion.states)
    target = start.copy()
    target[motor] += step
    command, states = motion.hold(target, HOLD_TIME)
    after = _settled_angles(states)
    points = _response_points(states, command, before[motor], motor, step, motion.control_step)
    command, states = motion.hold(start, HOLD_TIME)
    points += _response_points(states, command, after[motor], motor, -step, motion.control_step)
    # Responses are fitted after the robot is disarmed, because a fit takes longer than a robot waits for commands.
    age, progress = np.array(points or np.empty((0, 2))).T
    return MotorStep(motor, step, after - before, age, progress)


def _settled_angles(states: Sequence[TimedState]) -> Array:
    return np.mean([timed.state.motor_angle for timed in states[-_SETTLED:]], axis=0)


def _response_points(
    states: Sequence[TimedState], command: int, before: float, motor: int, step: float, period: float
) -> list[tuple[float, float]]:
    """Return the step response: time since the command reached the robot [s] and fraction of the step, per state."""
    arrivals = (
        timed.time - timed.state.command_age - (timed.state.command - command) * period
        for timed in states
        if 0 <= timed.state.command - command < 4
    )
    arrived = next(arrivals, np.inf)
    points = [(timed.time - arrived, (timed.state.motor_angle[motor] - before) / step) for timed in states]
    return [point for point in points if 0 <= point[0] <= WINDOW]


def check_motors(steps: Sequence[MotorStep], robot: RobotDescription) -> CheckResult:
    """Check whether each motor moved by its step, and no other motor moved with it."""
    names, errors = robot.motor_names, []
    moved_instead: dict[int, int] = {}
    for step in steps:
        ratio, motor = step.moved / step.step, step.motor
        others = [m for m in range(len(names)) if m != motor and abs(ratio[m]) > MAX_OTHER_RATIO]
        if STEP_RATIOS[0] <= ratio[motor] <= STEP_RATIOS[1] and not others:
            continue
        if others and abs(ratio[motor]) <= MAX_OTHER_RATIO:
            other = moved_instead[motor] = max(others, key=lambda m: abs(ratio[m]))
            error = f"did not move, but {names[other]} moved by {step.moved[other]:+.3f}"
        else:
            error = f"moved by {step.moved[motor]:+.3f}"
            error += f", together with {', '.join(names[m] for m in others)}" if others else ""
        errors.append(f"{names[motor]}, commanded to move by {step.step:+.3f} rad, {error}")
    ratios = [float(step.moved[step.motor] / step.step) for step in steps]
    if not errors:
        message = (
            f"each motor moved by {100 * min(ratios):.0f} to {100 * max(ratios):.0f} % of its step of {_span(steps)} "
            "rad, and no other motor moved with it"
        )
        return CheckResult(NAMES[0], True, message, value=min(ratios))
    swapped = [f"{names[a]} and {names[b]}" for a, b in moved_instead.items() if a < b and moved_instead.get(b) == a]
    if swapped:
        remedy = f"swapped: {', '.join(swapped)}; swap their cables, or their order in the firmware"
    elif min(ratios) < -MAX_OTHER_RATIO:
        remedy = "invert the sign of the motors or encoders that move in the wrong direction, in the firmware"
    else:
        remedy = "check cables and servo gains, and whether something blocks the leg"
    more = f" (and {len(errors) - 2} more)" if len(errors) > 2 else ""
    return CheckResult(NAMES[0], False, "; ".join(errors[:2]) + more, remedy)


def _span(steps: Sequence[MotorStep]) -> str:
    low, high = (f"{limit(abs(step.step) for step in steps):.2g}" for limit in (min, max))
    return low if low == high else f"{low} to {high}"


def check_response(
    steps: Sequence[MotorStep], trained_latencies: tuple[float, float], servo_period: float, lead: float
) -> list[CheckResult]:
    """Check the latency and rise time of the motors' step responses.

    The delay from a command's arrival to the first motion in the readings, at the time of sending them, is the sum of
    the age of the readings and the time until the next servo step, half a period on average. The policy uses a state
    `lead` after it was sent. A state that travels longer is one control step late, which the check of round trips
    shows.

    Args:
        steps: steps of all motors.
        trained_latencies: minimum and maximum control latency in training [s].
        servo_period: servo period of the robot [s].
        lead: time from sending a state to its use [s].
    """
    clear = [s for s in steps if len(s.age) >= _MIN_READINGS and s.moved[s.motor] / s.step > MAX_OTHER_RATIO]
    fits = [fit for fit in (fit_response(s.age, s.progress) for s in clear) if fit.error < _MAX_FIT_ERROR]
    if len(fits) < max(len(steps) // 2, 1):
        return skip_checks(NAMES[1:], f"only {len(fits)} of {len(steps)} motors responded clearly")
    latency = float(np.median([fit.delay for fit in fits])) - servo_period / 2 + lead
    rise = float(np.median([fit.rise for fit in fits]))
    low, high = trained_latencies
    trained = f"{1e3 * low:g}" if low == high else f"{1e3 * low:g} to {1e3 * high:g}"
    return [
        pass_if(
            NAMES[1],
            low - LATENCY_TOLERANCE <= latency <= high + LATENCY_TOLERANCE,
            f"{1e3 * latency:.1f} ms, including {1e3 * lead:g} ms from sending a state to its use; the policy was "
            f"trained with {trained} ms",
            f", and the latency must be within {1e3 * LATENCY_TOLERANCE:g} ms of that",
            "find out what delays the readings (filters, averaging, a slow bus), or train with control_latency "
            f"{latency:.3f}",
            latency,
        ),
        pass_if(
            NAMES[2],
            rise <= MAX_RISE,
            f"63 % of a step takes {1e3 * rise:.0f} ms",
            f"; at most {1e3 * MAX_RISE:g} ms",
            "check servo gains, battery and friction in the legs",
            rise,
        ),
    ]


def _trained_latencies(contract: Contract, robot: RobotDescription) -> tuple[float, float]:
    """Return the minimum and maximum control latency in a policy's training [s]."""
    nominal = contract.control_latency
    trained_range = task_from_contract(contract, robot).randomize.get("control_latency", (nominal, nominal))
    low, high = mean_interval(trained_range, np.array([nominal]))
    return min(low, nominal), max(high, nominal)
