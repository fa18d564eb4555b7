"""The doctor: every check of a policy, a link, this computer and a robot, in the order in which they may be done."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.checks import check_contract
from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.doctor import ground, rack
from surefoot.deploy.doctor.link import PINGS, check_link, measure_link
from surefoot.deploy.doctor.rest import check_rest, watch
from surefoot.deploy.pacer import Pacer, undisturbed
from surefoot.deploy.robot_link import LinkLostError, RobotLink
from surefoot.deploy.safety import SafetyLimits
from surefoot.errors import SurefootError, choices
from surefoot.policy.runtime import PolicyRuntime
from surefoot.robot import RobotDescription
from surefoot.stop_signals import StopSignals

PATIENCE = 5
"""How often a robot that is not at rest is looked at, for a second each time."""
_ON_RACK = "hang the robot free, legs in the air, and run with --rack"
_ON_GROUND = "put the robot on flat ground and run with --ground"
STEPS = 2000
"""Control steps of the loop that is timed, and inferences."""
SHARE = 0.5
"""Share of a control step within which the 99.9th percentile of inference, and of lateness, must be."""
MISSED = 0.001
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
        link: to the robot, not greeted yet.
        policy: the policy.
        robot: the data sheet that it is for.
        on_rack: wiggle the motors: the robot hangs free, its legs in the air.
        on_ground: stand up and tilt: the robot sits on flat ground.
        pings: of the link's check.
        steps: of the control loop's check, and inferences.

    Raises:
        SurefootError: no robot, or one that does not answer or arm.
    """
    contract = policy.contract
    failed: list[str] = []

    def kept(results: list[CheckResult]) -> list[CheckResult]:
        failed.extend(result.name for result in results if result.passed is False)
        return results

    try:
        handshake = link.connect()
        yield from kept(check_contract(contract, handshake, robot, policy.digest))
        figures = measure_link(link, pings)
        yield from kept(check_link(figures, link.lead, contract.control_step, link.lockstep))
        for _ in range(PATIENCE):
            # A robot that was just put down, or switched on, is given some time to come to rest.
            samples = watch(link)
            at_rest = check_rest(samples, robot, handshake, SafetyLimits.from_robot(robot))
            if all(result.passed for result in at_rest):
                break
        yield from kept(at_rest)
        if link.lockstep:
            why = "in lockstep nothing depends on how fast this computer is"
            yield from skipped(("inference", "control loop"), why, "run without --lockstep")
        else:
            inference = time_inference(policy, steps)
            late, missed = time_loop(policy, link, steps)
            yield from kept(check_computer(inference, late, missed, contract.control_step))
        tilt_robot = partial(ground.tilt_robot, at_rest=samples)
        for wanted, names, need, motion in (
            (on_rack, rack.NAMES, _ON_RACK, rack.wiggle_motors),
            (on_ground, ground.NAMES, _ON_GROUND, tilt_robot),
        ):
            if not wanted:
                yield from skipped(names, "needs motors that move", need)
            elif failed:
                yield from skipped(names, f"nothing moves while a check fails ({choices(failed)})")
            else:
                with undisturbed(), StopSignals() as operator:
                    try:
                        found = motion(link, contract, robot, operator)
                    except SurefootError as error:
                        first = CheckResult(
                            names[0], False, str(error), "switch the robot off and on, and run it again"
                        )
                        found = [first, *skipped(names[1:], "nothing has moved")]
                yield from found
    except LinkLostError as error:
        todo = "check plug and cable; the robot damps its motors by itself"
        yield CheckResult("link", False, f"{error}; all further checks are left out", todo)


def time_inference(policy: PolicyRuntime, count: int = STEPS) -> Array:
    """Times [s] that the policy takes for observations drawn at random, warmed up."""
    width = policy.contract.width
    observations = np.random.default_rng(0).normal(scale=0.3, size=(64, 1, width)).astype(np.float32)
    taken = np.empty(count)
    with undisturbed():
        for index in range(-_WARM_UP, count):
            start = time.perf_counter()
            policy.feedback(observations[index % 64])
            taken[index if index >= 0 else 0] = time.perf_counter() - start
    return taken


def time_loop(policy: PolicyRuntime, link: RobotLink, steps: int = STEPS) -> tuple[Array, int]:
    """Lateness [s] of the steps of a control loop in real time, and how many steps were missed.

    The loop reads the port, runs the policy at its control step and sends a frame, as a deployment does; the frame is
    a ping.

    Raises:
        LinkLostError: the port is gone.
    """
    step, width = policy.contract.control_step, policy.contract.width
    observation = np.zeros((1, width), np.float32)
    late, missed, done = np.zeros(steps), 0, 0
    with undisturbed():
        pacer = Pacer(MonotonicClock(), step)
        while pacer.index < steps - 1:
            tick = pacer.next()
            link.update()
            policy.feedback(observation)
            link.ping()
            late[done] = tick.late
            missed += tick.missed
            done += 1
    return late[:done], missed


def check_computer(inference: Array, late: Array, missed: int, control_step: float) -> list[CheckResult]:
    """Judge the times of `time_inference` and `time_loop`."""
    return [_inference(inference, control_step), _loop(late, missed, control_step)]


def _inference(taken: Array, control_step: float) -> CheckResult:
    median, slow = map(float, np.percentile(taken, (50, 99.9)))
    step = f"a control step has {1e3 * control_step:g}"
    told = f"median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * slow:.3f} ms; {step}"
    todo = "close other programs, take a faster computer, or train a smaller network"
    return judge("inference", slow <= SHARE * control_step, told, f"; at most {SHARE:.0%} of it", todo, median)


def _loop(late: Array, missed: int, control_step: float) -> CheckResult:
    median, worst = map(float, np.percentile(late, (50, 99.9)))
    steps = len(late) + missed
    told = (
        f"lateness: median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * worst:.3f} ms; "
        f"{missed} of {steps} steps missed"
    )
    return judge(
        "control loop",
        worst <= SHARE * control_step and missed <= MISSED * steps,
        told,
        f"; at most {1e3 * SHARE * control_step:g} ms late and {MISSED:.1%} missed",
        "close other programs, let the process run in real time (sudo setcap cap_sys_nice+ep on Python, or a limit "
        "rtprio), and turn power saving off",
        worst,
    )
