"""Check of the link: round trips, losses, and adapters that hold frames back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.robot_link import RobotLink

PINGS, PING_PERIOD = 200, 0.005
"""Pings, and the time [s] between two: short enough to see an adapter that gathers bytes for 16 ms."""
_ANSWER_TIME = 0.3
"""Time after the last ping [s] within which answers count."""
MAX_LOSS = 0.005
"""Share of frames that may be lost or damaged: one of 200 pings."""
MAX_BURST = 2.5
"""Answers in a burst, on average, from which something gathers them; one every `PING_PERIOD` comes alone."""
MAX_CLOCK_ERROR = 0.01
"""Relative error of the robot's clock: crystals differ by .0001, a slow emulator by more."""
LATE_STEPS = 2
"""Control steps within which 99 of 100 answers must come: a deployment damps the robot after three without one."""
TIMING_CHECKS = ("link, bursts", "link, round trip", "robot's clock")
_BURST_TIME = 5e-4
"""Frames that come within this time [s] of each other are a burst."""


@dataclass(frozen=True)
class LinkMetrics:
    """Results of pings. Times in s."""

    round_trips: Array
    """From sending a ping to reading its answer, of the pings that were answered."""
    lost: int
    """Pings without an answer."""
    damaged: int
    """Frames that were received damaged."""
    missing: int
    """Frames that the robot has numbered and that did not come."""
    unsent: int
    """Frames that the port did not take."""
    burst: float
    """Answers in a burst, on average."""
    gap: float
    """Median time between two bursts."""
    clock_rate: float
    """Seconds on the robot's clock for one of this computer's."""


def receive_until(link: RobotLink, end: float) -> None:
    """Receive each frame when it comes, until a time [s] of this computer's clock."""
    clock = link.clock
    if link.lockstep:
        clock.wait_until(end)
        link.update()
        return
    while (left := end - clock.now()) > 0:
        link.wait(left)
        link.update()


def measure_link(link: RobotLink, pings: int) -> LinkMetrics:
    """Send pings, one every `PING_PERIOD`, and receive the answers.

    Raises:
        LinkLostError: the port is gone.
    """
    clock, statistics = link.clock, link.statistics
    link.update()
    link.pongs.clear()
    before = (statistics.damaged, statistics.missing, statistics.unsent)
    start, sent = clock.now(), {}
    for index in range(pings):
        receive_until(link, start + index * PING_PERIOD)
        sent[link.ping()] = clock.now()
    receive_until(link, clock.now() + PING_PERIOD)
    end = clock.now() + _ANSWER_TIME
    while len(link.pongs.keys() & sent.keys()) < pings and clock.now() < end:
        receive_until(link, min(clock.now() + PING_PERIOD, end))
    answers = {token: arrival for token, arrival in link.pongs.items() if token in sent}
    arrivals = np.array([arrival.time for arrival in answers.values()])
    after = (statistics.damaged, statistics.missing, statistics.unsent)
    damaged, missing, unsent = (last - first for first, last in zip(before, after, strict=True))
    return LinkMetrics(
        np.array([arrival.time - sent[token] for token, arrival in answers.items()]),
        pings - len(answers),
        damaged,
        missing,
        unsent,
        *measure_bursts(arrivals),
        clock_rate(np.array([arrival.packet.time for arrival in answers.values()]), arrivals),
    )


def measure_bursts(arrivals: Array) -> tuple[float, float]:
    """Return the mean number of frames in a burst, and the median time [s] between two bursts."""
    if len(arrivals) < 2:
        return float(len(arrivals)), 0.0
    first = np.r_[True, np.diff(arrivals) > _BURST_TIME]
    gaps = np.diff(arrivals[first])
    return len(arrivals) / int(first.sum()), float(np.median(gaps)) if len(gaps) else 0.0


def clock_rate(sent: Array, received: Array) -> float:
    """Return the seconds on the robot's clock for one of this computer's, from times of frames on both.

    The quickest frames of the first and of the last third are compared, so that frames that were held back do not
    count.
    """
    third = len(received) // 3
    if third < 1:
        return 1.0
    delay = received - sent
    first, last = int(np.argmin(delay[:third])), len(delay) - third + int(np.argmin(delay[-third:]))
    return float((sent[last] - sent[first]) / (received[last] - received[first]))


def check_link(figures: LinkMetrics, lead: float, control_step: float, lockstep: bool) -> list[CheckResult]:
    """Judge the figures of a link.

    Args:
        figures: of `measure_link`.
        lead: how long before a control step the robot sends its state [s].
        control_step: of the policy [s].
        lockstep: the robot follows this computer's clock, so that frames take no time.
    """
    trips, pings = figures.round_trips, figures.lost + len(figures.round_trips)
    counts = (figures.lost, figures.damaged, figures.missing, figures.unsent)
    losses = judge(
        "link, losses",
        max(counts) <= MAX_LOSS * pings,
        "{} of {} pings lost, {} frames damaged, {} missing, {} not sent".format(counts[0], pings, *counts[1:]),
        f"; at most {MAX_LOSS:.1%} may be",
        "check the plug, a shorter or shielded cable, the same baud rate on both sides, and the robot's ground",
        figures.lost / pings,
    )
    if lockstep:
        return [losses, *skipped(TIMING_CHECKS, "in lockstep frames take no time", "run without --lockstep")]
    if not len(trips):
        return [losses, *skipped(TIMING_CHECKS, "no ping was answered")]
    median, late = map(float, np.percentile(trips, (50, 99)))
    clock_error = figures.clock_rate - 1
    return [
        losses,
        judge(
            "link, bursts",
            figures.burst < MAX_BURST,
            f"{figures.burst:.1f} answers together on average, every {1e3 * figures.gap:.1f} ms",
            f"; answers to pings {1e3 * PING_PERIOD:g} ms apart must come alone: the USB adapter gathers bytes "
            "(its latency timer, 16 ms by default)",
            "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer, or setserial /dev/ttyUSB0 "
            "low_latency (with your port's name); some adapters can't do it: take another",
            figures.burst,
        ),
        judge(
            "link, round trip",
            median <= lead and late <= LATE_STEPS * control_step,
            f"median {1e3 * median:.2f} ms, 99th percentile {1e3 * late:.2f} ms, jitter {1e3 * np.std(trips):.2f} ms",
            f"; the median must be within {1e3 * lead:g} ms, the time a state has to come, and the 99th percentile "
            f"within {LATE_STEPS} control steps, {1e3 * LATE_STEPS * control_step:g} ms",
            "close other programs, use a direct USB port, and set the adapter's latency timer to 1 ms",
            median,
        ),
        judge(
            "robot's clock",
            abs(clock_error) <= MAX_CLOCK_ERROR,
            f"runs {abs(clock_error):.2%} too {'fast' if clock_error > 0 else 'slow'}",
            f"; at most {MAX_CLOCK_ERROR:.0%} may be",
            "check the microcontroller's crystal and clock settings; an emulator that is slow needs a computer with "
            "less to do",
            figures.clock_rate,
        ),
    ]
