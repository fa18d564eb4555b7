"""Check of a robot that hangs free: each motor alone makes a step of .05 rad, more against friction, and back.

Legs with abduction are moved apart before: where they hang limp they touch each other.

The readings that move show order and signs of the motors; the beginning of the motion shows the latency, its course the
servo.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
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
"""Step of each motor [rad]: too little to hurt, a hundred times the resolution of an encoder."""
FRICTION_STEPS, MAX_STEP = 5.0, 0.15
"""A step is at least so many times the angle at which a servo with a joint actuator has the torque of its friction,
since a motor may stop short of its target by that angle before the step and after; and the greatest step [rad]."""
MAX_ERROR = 0.1
"""Greatest difference of a motor's angle from its target, over the step [rad]; more damps all motors."""
APART_TIME, APART_ERROR = 2.0, 0.4
"""Time [s] in which legs are moved apart, and the greatest difference of a motor's angle from its target meanwhile
[rad]: legs that touch hold each other back."""
SETTLE, HOLD = 0.4, 0.35
"""Time [s] for which the robot is held before the first step, and after each."""
SHARES = (0.6, 1.4)
"""Least and greatest motion of the motor, in shares of the step: gravity and friction take some."""
MAX_OTHER_RATIO = 0.3
"""Greatest motion of any other motor, in shares of the step."""
LATENCY_TOLERANCE = 0.006
"""Greatest difference of the latency from those in training [s]: a control step of the paper, less than policies that
were trained at one latency bear."""
MAX_RISE = 0.08
"""Longest time [s] for 63 % of a step: half a stride of the trot takes .25 s."""
_SETTLED = 5
"""Last readings after a step, which are averaged."""
_MAX_FIT_ERROR = 0.15
_MIN_READINGS = 8


@dataclass(frozen=True)
class MotorStep:
    """Readings of one motor's step and the step back."""

    motor: int
    step: float
    """Commanded change [rad], with sign."""
    moved: Array
    """Change of each motor's angle, once settled (M,) [rad]."""
    age: Array
    """Of readings after both steps: time since the command arrived at the robot (n,) [s]."""
    share: Array
    """Share of the step that the motor had moved by then (n,)."""


def step_motors(
    link: RobotLink, contract: Contract, robot: RobotDescription, operator: StopSignals
) -> list[CheckResult]:
    """Arm a robot on its rack, step each motor, disarm, and judge.

    Raises:
        SurefootError: the robot does not arm.
        LinkLostError: the port is gone.
    """
    state, handshake = link.state, link.handshake
    if state is None or handshake is None:
        return [CheckResult(NAMES[0], False, "the robot has sent no state", "switch it off and on")]
    start = np.clip(state.motor_angle, handshake.angle_low, handshake.angle_high)
    steps: list[MotorStep] = []
    command, sizes = "all were asked to hold", step_sizes(robot, handshake.servo_kp)
    motion = DoctorMotion(link, robot, contract.control_step, operator, float(sizes.max()) + MAX_ERROR)
    try:
        with motion:
            motion.hold(start, SETTLE)
            if "abduction" in robot.coordinates:
                command, abduction = "legs were moved apart", robot.leg_motor_index[:, 0]
                start[abduction] = robot.pose_angles(*robot.poses.sit)[abduction]
                motion.max_error, allowed = APART_ERROR, motion.max_error
                motion.go(start, APART_TIME)
                motion.hold(start, SETTLE)
                motion.max_error = allowed
            for motor, middle in enumerate((handshake.angle_low + handshake.angle_high) / 2):
                command = f"{robot.motor_names[motor]} was asked to move"
                steps.append(_step_motor(motion, start, motor, float(np.copysign(sizes[motor], middle - start[motor]))))
    except MotionStoppedError as stopped:
        failed = None
        if motion.tracking_error is not None:
            motor, error = motion.tracking_error
            name = robot.motor_names[motor]
            failed = CheckResult(
                NAMES[0],
                False,
                f"{name} went {error:+.2f} rad from where it was sent while {command}; motors were damped",
                "its sign, of motor or encoder, is flipped, or its commands belong to another motor: check cables and "
                "firmware",
                name,
            )
        return stopped.results(NAMES, failed)
    trained = _trained_latencies(contract, robot)
    return [check_motors(steps, robot), *check_response(steps, trained, handshake.servo_period, link.lead)]


def step_sizes(robot: RobotDescription, kp: Array) -> Array:
    """Return the step of each motor (M,) [rad] for gains (M,) of the robot's servos."""
    friction = robot.actuator.friction if isinstance(robot.actuator, JointActuatorData) else 0.0
    sizes: Array = np.clip(FRICTION_STEPS * np.broadcast_to(friction, robot.num_motors) / kp, STEP, MAX_STEP)
    return sizes


def _step_motor(motion: DoctorMotion, start: Array, motor: int, step: float) -> MotorStep:
    before = _settled_angles(motion.states)
    target = start.copy()
    target[motor] += step
    command, states = motion.hold(target, HOLD)
    after = _settled_angles(states)
    points = _points(states, command, before[motor], motor, step, motion.control_step)
    command, states = motion.hold(start, HOLD)
    points += _points(states, command, after[motor], motor, -step, motion.control_step)
    # The fit has to wait until the robot is disarmed: it takes longer than a robot waits for commands.
    age, share = np.array(points or np.empty((0, 2))).T
    return MotorStep(motor, step, after - before, age, share)


def _settled_angles(states: Sequence[TimedState]) -> Array:
    return np.mean([timed.state.motor_angle for timed in states[-_SETTLED:]], axis=0)


def _points(
    states: Sequence[TimedState], command: int, before: float, motor: int, step: float, period: float
) -> list[tuple[float, float]]:
    """Return the step response: time since the command reached the robot [s] and share of the step, of each state."""
    arrivals = (
        timed.time - timed.state.command_age - (timed.state.command - command) * period
        for timed in states
        if 0 <= timed.state.command - command < 4
    )
    arrived = next(arrivals, np.inf)
    points = [(timed.time - arrived, (timed.state.motor_angle[motor] - before) / step) for timed in states]
    return [point for point in points if 0 <= point[0] <= WINDOW]


def check_motors(steps: Sequence[MotorStep], robot: RobotDescription) -> CheckResult:
    """Judge whether each motor moved by its step, and no other with it."""
    names, errors = robot.motor_names, []
    moved_instead: dict[int, int] = {}
    for step in steps:
        share, motor = step.moved / step.step, step.motor
        others = [m for m in range(len(names)) if m != motor and abs(share[m]) > MAX_OTHER_RATIO]
        if SHARES[0] <= share[motor] <= SHARES[1] and not others:
            continue
        if others and abs(share[motor]) <= MAX_OTHER_RATIO:
            other = moved_instead[motor] = max(others, key=lambda m: abs(share[m]))
            error = f"stayed, and {names[other]} went {step.moved[other]:+.3f}"
        else:
            error = f"went {step.moved[motor]:+.3f}"
            error += f" and took along {', '.join(names[m] for m in others)}" if others else ""
        errors.append(f"{names[motor]}, asked to go {step.step:+.3f} rad, {error}")
    shares = [float(step.moved[step.motor] / step.step) for step in steps]
    if not errors:
        message = (
            f"each went its own way, {100 * min(shares):.0f} to {100 * max(shares):.0f} % of the {_span(steps)} rad "
            "asked for, no other with it"
        )
        return CheckResult(NAMES[0], True, message, value=min(shares))
    exchanged = [f"{names[a]} with {names[b]}" for a, b in moved_instead.items() if a < b and moved_instead.get(b) == a]
    if exchanged:
        remedy = f"exchanged: {', '.join(exchanged)}; exchange their cables, or their places in the firmware"
    elif min(shares) < -MAX_OTHER_RATIO:
        remedy = "turn the sign of what goes the wrong way, of motor or encoder, in the firmware"
    else:
        remedy = "check cables, servo gains and what blocks the leg"
    more = f" (and {len(errors) - 2} more)" if len(errors) > 2 else ""
    return CheckResult(NAMES[0], False, "; ".join(errors[:2]) + more, remedy)


def _span(steps: Sequence[MotorStep]) -> str:
    low, high = (f"{limit(abs(step.step) for step in steps):.2g}" for limit in (min, max))
    return low if low == high else f"{low} to {high}"


def check_response(
    steps: Sequence[MotorStep], trained_latencies: tuple[float, float], servo_period: float, lead: float
) -> list[CheckResult]:
    """Judge latency and rise time of the motors' step responses.

    The delay from a command's arrival to the first motion in the readings, at the time when they are sent, is the age
    of these readings and the wait of the command for the servo's next step, half a period on average. The policy uses a
    state `lead` after it was sent. A state that travels longer is a control step late, which the check of round trips
    shows.

    Args:
        steps: of all motors.
        trained_latencies: least and greatest control latency in training [s].
        servo_period: of the robot [s].
        lead: time from sending a state to its use [s].
    """
    clear = [s for s in steps if len(s.age) >= _MIN_READINGS and s.moved[s.motor] / s.step > MAX_OTHER_RATIO]
    fits = [fit for fit in (fit_response(s.age, s.share) for s in clear) if fit.error < _MAX_FIT_ERROR]
    if len(fits) < max(len(steps) // 2, 1):
        return skipped(NAMES[1:], f"only {len(fits)} of {len(steps)} motors answered clearly")
    latency = float(np.median([fit.delay for fit in fits])) - servo_period / 2 + lead
    rise = float(np.median([fit.rise for fit in fits]))
    low, high = trained_latencies
    trained = f"{1e3 * low:g}" if low == high else f"{1e3 * low:g} to {1e3 * high:g}"
    return [
        judge(
            NAMES[1],
            low - LATENCY_TOLERANCE <= latency <= high + LATENCY_TOLERANCE,
            f"{1e3 * latency:.1f} ms (with {1e3 * lead:g} ms from sending to use); the policy was trained with "
            f"{trained} ms",
            f", and it must be within {1e3 * LATENCY_TOLERANCE:g} ms of that",
            "find what delays the readings (filters, averaging, a slow bus), or train with control_latency "
            f"{latency:.3f}",
            latency,
        ),
        judge(
            NAMES[2],
            rise <= MAX_RISE,
            f"63 % of a step in {1e3 * rise:.0f} ms",
            f"; at most {1e3 * MAX_RISE:g} ms",
            "check servo gains, battery and friction in the legs",
            rise,
        ),
    ]


def _trained_latencies(contract: Contract, robot: RobotDescription) -> tuple[float, float]:
    """Return the least and greatest control latency [s] in a policy's training."""
    nominal = contract.control_latency
    trained_range = task_from_contract(contract, robot).randomize.get("control_latency", (nominal, nominal))
    low, high = mean_interval(trained_range, np.array([nominal]))
    return min(low, nominal), max(high, nominal)
