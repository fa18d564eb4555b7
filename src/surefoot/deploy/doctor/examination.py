"""The doctor: all checks of a policy, a link, this computer and a robot, in order."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, fail_if, judge, skipped
from surefoot.deploy.checks import check_contract
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
"""How often a robot that is not at rest is observed, for a second each time."""
STEPS = 2000
"""Control steps of the loop that is timed, and inferences."""
MAX_STEP_FRACTION = 0.5
"""Share of a control step within which the 99.9th percentile of inference, and of lateness, must be."""
MAX_MISSED = 0.001
"""Share of control steps that may be missed."""
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
    """Do all checks, one after another; nothing moves unless everything before it passed.

    Args:
        link: to the robot, before its handshake.
        policy: the policy, which fits the data sheet.
        robot: the data sheet.
        on_rack: step the motors: the robot hangs free, its legs in the air.
        on_ground: stand up and tilt: the robot sits on flat ground.
        pings: of the link's check.
        steps: of the control loop's check, and inferences.

    Raises:
        SurefootError: no robot, or one that does not answer or arm.
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
        figures = measure_link(link, pings)
        yield from note_failures(check_link(figures, link.lead, contract.control_step, link.lockstep))
        for _ in range(REST_ATTEMPTS):
            # A robot that was just put down, or switched on, has some time to come to rest.
            at_rest = record_states(link)
            results = check_rest(at_rest, robot, handshake, SafetyLimits.from_robot(robot))
            if all(result.passed for result in results):
                break
        yield from note_failures(results)
        if link.lockstep:
            message = "in lockstep nothing depends on how fast this computer is"
            yield from skipped(("inference", "control loop"), message, "run without --lockstep")
        else:
            inference = time_inference(policy, steps)
            yield from note_failures(check_computer(inference, *time_loop(policy, link, steps), contract.control_step))
        if link.hears_others:
            link.listen()
            yield from note_failures([check_foreign_commands(link)])
        tilt_robot = partial(tilt_check.tilt_robot, at_rest=at_rest)
        hang, sit = "hang the robot free, legs in the air, and run with", "put the robot on flat ground and run with"
        for moves, names, motion, remedy in (
            (on_rack, rack_check.NAMES, rack_check.step_motors, f"{hang} --rack"),
            (on_ground, tilt_check.NAMES, tilt_robot, f"{sit} --ground"),
        ):
            if not moves:
                yield from skipped(names, "needs motors that move", remedy)
                continue
            if failed:
                yield from skipped(names, f"nothing moves while a check fails ({choices(failed)})")
                continue
            with real_time_priority(), StopSignals() as operator:
                try:
                    results = motion(link, contract, robot, operator)
                except SurefootError as error:
                    refusal = CheckResult(names[0], False, str(error), "switch the robot off and on, and run it again")
                    results = [refusal, *skipped(names[1:], "nothing has moved")]
            yield from results
    except LinkLostError as error:
        remedy = "check plug and cable; the robot damps its motors by itself"
        yield CheckResult("link", False, f"{error}; all further checks are left out", remedy)


def check_foreign_commands(link: RobotLink) -> CheckResult:
    """Judge whether another program has commanded the motors since the link was opened."""
    now, count = link.clock.now(), len(link.foreign_commands)
    message = f"in {now - link.connected:.0f} s since the connection nobody else has commanded the motors"
    error = None
    if count:
        last = now - link.foreign_commands[-1]
        error = f"{count} message{'s' if count > 1 else ''} of another program, the last {last:.1f} s ago"
    return fail_if("foreign commands", error, message, "end the other program, also on the robot's own computer", count)


def time_inference(policy: PolicyRuntime, count: int) -> Array:
    """Return the times [s] of inferences from random observations, after a warm-up."""
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
    """Return the lateness [s] of the steps of a control loop in real time, and the number of missed steps.

    As a deployment does, the loop reads the port, runs the policy at its control step and sends a packet, here a ping.

    Raises:
        LinkLostError: the port is gone.
    """
    observation = np.zeros((1, policy.contract.width), np.float32)
    late: list[float] = []
    missed = 0
    with real_time_priority():
        pacer = Pacer(MonotonicClock(), policy.contract.control_step)
        while pacer.index < steps - 1:
            tick = pacer.next()
            link.update()
            policy.feedback(observation)
            link.ping()
            late.append(tick.late)
            missed += tick.missed
    return np.array(late), missed


def check_computer(inference: Array, late: Array, missed: int, control_step: float) -> list[CheckResult]:
    """Judge the results of `time_inference` and `time_loop`."""
    median, slow = map(float, np.percentile(inference, (50, 99.9)))
    median_late, worst_late = map(float, np.percentile(late, (50, 99.9)))
    steps = len(late) + missed
    return [
        judge(
            "inference",
            slow <= MAX_STEP_FRACTION * control_step,
            f"median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * slow:.3f} ms; a control step has "
            f"{1e3 * control_step:g}",
            f"; at most {MAX_STEP_FRACTION:.0%} of it",
            "close other programs, take a faster computer, or train a smaller network",
            median,
        ),
        judge(
            "control loop",
            worst_late <= MAX_STEP_FRACTION * control_step and missed <= MAX_MISSED * steps,
            f"lateness: median {1e3 * median_late:.3f} ms, 99.9th percentile {1e3 * worst_late:.3f} ms; "
            f"{missed} of {steps} steps missed",
            f"; at most {1e3 * MAX_SHARE * control_step:g} ms late and {MAX_MISSED:.1%} missed",
            "close other programs, let the process run in real time (sudo setcap cap_sys_nice+ep on Python, or a limit "
            "rtprio), and turn power saving off",
            worst_late,
        ),
    ]
