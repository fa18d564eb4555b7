"""The doctor: runs all checks of a policy, a link, this computer and a robot in order."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, pass_if, skip_checks
from surefoot.deploy.checks import GAINS_CHECK, check_contract
from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.doctor import rack_check, tilt_check
from surefoot.deploy.doctor.link_check import PINGS, check_link, measure_link
from surefoot.deploy.doctor.rest_check import check_rest, record_states
from surefoot.deploy.pacer import Pacer, real_time_priority
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.errors import SurefootError, choices
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

REST_ATTEMPTS = 5
"""Maximum number of one-second observations while the robot is not at rest."""
STEPS = 2000
"""Number of control steps of the timed loop, and of timed inferences."""
MAX_STEP_FRACTION = 0.5
"""Maximum of the 99.9th percentile of inference time and of lateness, as a fraction of the control step."""
MAX_MISSED = 0.001
"""Maximum fraction of missed control steps."""
_WARM_UP = 50


def examine(
    link: RobotLink,
    policy: PolicyRuntime,
    robot: RobotDescription,
    on_rack: bool = False,
    on_ground: bool = False,
    pings: int = PINGS,
    steps: int = STEPS,
) -> Iterator[CheckResult]:
    """Run all checks and yield their results. Nothing moves unless all previous checks passed.

    Args:
        link: link to the robot, before the handshake.
        policy: the policy, which must fit the robot description.
        robot: robot description.
        on_rack: whether to step the motors; the robot must hang freely, with its legs in the air.
        on_ground: whether to stand up and tilt; the robot must sit on flat ground.
        pings: number of pings of the link check.
        steps: number of control steps and inferences that are timed.

    Raises:
        SurefootError: there is no robot, or it does not answer.
    """
    contract = policy.contract
    failed: list[str] = []

    def note_failures(results: list[CheckResult]) -> list[CheckResult]:
        failed.extend(result.name for result in results if result.passed is False)
        return results

    try:
        yield from note_failures(link.preliminary_checks)
        handshake = link.connect()
        yield from note_failures(check_contract(contract, handshake, robot))
        # On the rack, weaker servos are how a new board's motors are tried.
        weaker = np.all(handshake.servo_kp <= contract.servo_kp) and np.all(handshake.servo_kd <= contract.servo_kd)
        metrics = measure_link(link, pings)
        yield from note_failures(check_link(metrics, link.lead, contract.control_step, link.lockstep))
        for _ in range(REST_ATTEMPTS):
            # A robot that was just put down or switched on has some time to come to rest.
            at_rest = record_states(link)
            results = check_rest(at_rest, robot, handshake, SafetyLimits.from_robot(robot))
            if all(result.passed for result in results):
                break
        yield from note_failures(results)
        if link.lockstep:
            message = "in lockstep nothing depends on the speed of this computer"
            yield from skip_checks(("inference", "control loop"), message, "run without --lockstep")
        else:
            inference = time_inference(policy, steps)
            yield from note_failures(check_computer(inference, *time_loop(policy, link, steps), contract.control_step))
        if link.detects_other_programs:
            link.listen()
            yield from note_failures([check_foreign_commands(link)])
        tilt_robot = partial(tilt_check.tilt_robot, at_rest=at_rest)
        hang, sit = "hang the robot up, legs in the air, and run with", "put the robot on flat ground and run with"
        for moves, names, motion, remedy in (
            (on_rack, rack_check.NAMES, rack_check.step_motors, f"{hang} --rack"),
            (on_ground, tilt_check.NAMES, tilt_robot, f"{sit} --ground"),
        ):
            if not moves:
                yield from skip_checks(names, "this check moves the motors", remedy)
                continue
            allowed = (GAINS_CHECK,) if weaker and names is rack_check.NAMES else ()
            if blocking := [name for name in failed if name not in allowed]:
                yield from skip_checks(names, f"nothing moves while a check fails ({choices(blocking)})")
                continue
            with real_time_priority(), StopSignals() as operator:
                try:
                    results = motion(link, contract, robot, operator)
                except SurefootError as error:
                    failure = CheckResult(names[0], False, str(error), "switch the robot off and on, and run it again")
                    results = [failure, *skip_checks(names[1:], "nothing has moved")]
            yield from results
    except LinkLostError as error:
        remedy = "check plug and cable; the robot damps its motors on its own"
        yield CheckResult("link", False, f"{error}; all further checks are skipped", remedy)


def check_foreign_commands(link: RobotLink) -> CheckResult:
    """Check whether another program has commanded the motors since the link was opened."""
    now, count = link.clock.now(), len(link.foreign_commands)
    message = f"no other program has commanded the motors in the {now - link.connected:.0f} s since the connection"
    error = None
    if count:
        last = now - link.foreign_commands[-1]
        error = f"{count} message{'s' if count > 1 else ''} of another program, the last {last:.1f} s ago"
    remedy = "stop the other program, also on the robot's own computer"
    return fail_if("foreign commands", error, message, remedy, count)


def time_inference(policy: PolicyRuntime, count: int) -> Array:
    """Return the durations [s] of `count` inferences with random observations, after a warm-up."""
    width = policy.contract.width
    observations = np.random.default_rng(0).normal(scale=0.3, size=(64, 1, width)).astype(np.float32)
    times = np.empty(count + _WARM_UP)
    with real_time_priority():
        for index in range(count + _WARM_UP):
            start = time.perf_counter()
            policy.feedback(observations[index % 64])
            times[index] = time.perf_counter() - start
    return times[_WARM_UP:]


def time_loop(policy: PolicyRuntime, link: RobotLink, steps: int) -> tuple[Array, int]:
    """Run a real-time control loop; return the lateness of each step [s] and the number of missed steps.

    Like a deployment, the loop reads the port, runs the policy in each control step, and sends a packet (here a ping).

    Raises:
        LinkLostError: the link is lost.
    """
    observation = np.zeros((1, policy.contract.width), np.float32)
    lateness: list[float] = []
    missed = 0
    with real_time_priority():
        pacer = Pacer(MonotonicClock(), policy.contract.control_step)
        while pacer.index < steps - 1:
            tick = pacer.next()
            link.update()
            policy.feedback(observation)
            link.ping()
            lateness.append(tick.late)
            missed += tick.missed
    return np.array(lateness), missed


def check_computer(inference: Array, lateness: Array, missed: int, control_step: float) -> list[CheckResult]:
    """Check the results of `time_inference` and `time_loop`."""
    median, slow = map(float, np.percentile(inference, (50, 99.9)))
    median_late, worst_late = map(float, np.percentile(lateness, (50, 99.9)))
    steps = len(lateness) + missed
    return [
        pass_if(
            "inference",
            slow <= MAX_STEP_FRACTION * control_step,
            f"median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * slow:.3f} ms; the control step is "
            f"{1e3 * control_step:g} ms",
            f"; at most {MAX_STEP_FRACTION:.0%} of it",
            "close other programs, take a faster computer, or train a smaller network",
            median,
        ),
        pass_if(
            "control loop",
            worst_late <= MAX_STEP_FRACTION * control_step and missed <= MAX_MISSED * steps,
            f"lateness: median {1e3 * median_late:.3f} ms, 99.9th percentile {1e3 * worst_late:.3f} ms; "
            f"{missed} of {steps} steps missed",
            f"; at most {1e3 * MAX_STEP_FRACTION * control_step:g} ms late and {MAX_MISSED:.1%} missed",
            "close other programs, allow real-time priority (sudo setcap cap_sys_nice+ep on Python, or an rtprio "
            "limit), and turn power saving off",
            worst_late,
        ),
    ]
