"""The doctor's look at this computer: how long the policy takes, and how punctual the control loop is."""

from __future__ import annotations

import time

import numpy as np

from surefoot.arrays import Array
from surefoot.deploy.clock import MonotonicClock
from surefoot.deploy.connection import RobotConnection
from surefoot.deploy.findings import Finding, judged
from surefoot.deploy.pacer import Pacer
from surefoot.deploy.realtime import undisturbed
from surefoot.policy.runtime import PolicyRuntime

STEPS = 2000
"""Control steps of the loop that is timed, and inferences."""
SHARE = 0.5
"""Share of a control step within which the 99.9th percentile of inference, and of lateness, must be."""
MISSED = 0.001
"""Share of control steps that may be missed."""
NAMES = ("inference", "control loop")
_WARM_UP = 50


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


def time_loop(policy: PolicyRuntime, connection: RobotConnection, steps: int = STEPS) -> tuple[Array, int]:
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
            connection.update()
            policy.feedback(observation)
            connection.link.ping()
            late[done] = tick.late
            missed += tick.missed
            done += 1
    return late[:done], missed


def check_computer(inference: Array, late: Array, missed: int, control_step: float) -> list[Finding]:
    """Judge the times of `time_inference` and `time_loop`."""
    return [_inference(inference, control_step), _loop(late, missed, control_step)]


def _inference(taken: Array, control_step: float) -> Finding:
    median, slow = map(float, np.percentile(taken, (50, 99.9)))
    step = f"a control step has {1e3 * control_step:g}"
    told = f"median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * slow:.3f} ms; {step}"
    todo = "close other programs, take a faster computer, or train a smaller network"
    return judged("inference", slow <= SHARE * control_step, told, f"; at most {SHARE:.0%} of it", todo, median)


def _loop(late: Array, missed: int, control_step: float) -> Finding:
    median, worst = map(float, np.percentile(late, (50, 99.9)))
    steps = len(late) + missed
    told = (
        f"lateness: median {1e3 * median:.3f} ms, 99.9th percentile {1e3 * worst:.3f} ms; "
        f"{missed} of {steps} steps missed"
    )
    return judged(
        "control loop",
        worst <= SHARE * control_step and missed <= MISSED * steps,
        told,
        f"; at most {1e3 * SHARE * control_step:g} ms late and {MISSED:.1%} missed",
        "close other programs, let the process run in real time (sudo setcap cap_sys_nice+ep on Python, or a limit "
        "rtprio), and turn power saving off",
        worst,
    )
