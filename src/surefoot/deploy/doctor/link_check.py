"""Check of the link: round trips, losses, and adapters that buffer frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, pass_if, skip_checks
from surefoot.deploy.robot_link import RobotLink

PINGS, PING_PERIOD = 200, 0.005
"""Number of pings, and the time between two pings [s], which is short enough to detect an adapter that buffers bytes
for 16 ms."""
_ANSWER_TIME = 0.3
"""Time after the last ping within which answers are accepted [s]."""
MAX_LOSS = 0.005
"""Maximum fraction of frames that may be lost or damaged: one of 200 pings."""
MAX_BURST = 2.5
"""Mean number of answers per burst above which the adapter buffers bytes; without buffering, answers arrive one by one,
`PING_PERIOD` apart."""
MAX_CLOCK_ERROR = 0.01
"""Maximum relative error of the robot's clock: crystals differ by 0.0001, a slow emulator by more."""
LATE_STEPS = 2
"""Control steps within which 99 % of the answers must arrive; a deployment damps the robot after three without one."""
TIMING_CHECKS = ("link, bursts", "link, round trip", "robot's clock")
_BURST_TIME = 5e-4
"""Frames that arrive within this time of each other belong to one burst [s]."""


@dataclass(frozen=True)
class LinkMetrics:
    """Metrics of a link, measured with pings."""

    round_trips: Array
    """Time from sending a ping to reading its answer, for each answered ping [s]."""
    lost: int
    """Number of pings without an answer."""
    damaged: int
    """Number of damaged frames received."""
    missing: int
    """Number of frames that the robot sent, according to their numbering, but that did not arrive."""
    unsent: int
    """Number of frames that the port did not accept."""
    burst: float
    """Mean number of answers per burst."""
    gap: float
    """Median time between two bursts [s]."""
    clock_rate: float
    """Seconds on the robot's clock per second on this computer's clock."""


def receive_until(link: RobotLink, end: float) -> None:
    """Receive frames as they arrive, until a time [s] on this computer's clock."""
    clock = link.clock
    if link.lockstep:
        clock.wait_until(end)
        link.update()
        return
    while (left := end - clock.now()) > 0:
        link.wait(left)
        link.update()


def measure_link(link: RobotLink, pings: int) -> LinkMetrics:
    """Measure a link: send one ping every `PING_PERIOD` and receive the answers.

    Raises:
        LinkLostError: the link is lost.
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
    """Return the mean number of frames per burst, and the median time between two bursts [s]."""
    if len(arrivals) < 2:
        return float(len(arrivals)), 0.0
    first = np.r_[True, np.diff(arrivals) > _BURST_TIME]
    gaps = np.diff(arrivals[first])
    return len(arrivals) / int(first.sum()), float(np.median(gaps)) if len(gaps) else 0.0


def clock_rate(sent: Array, received: Array) -> float:
    """Return the seconds on the robot's clock per second on this computer's clock.

    The frames with the shortest delay in the first and in the last third are compared, so that delayed frames do not
    matter.

    Args:
        sent: time at which each frame was sent, on the robot's clock [s].
        received: time at which each frame was received, on this computer's clock [s].
    """
    third = len(received) // 3
    if third < 1:
        return 1.0
    delay = received - sent
    first, last = int(np.argmin(delay[:third])), len(delay) - third + int(np.argmin(delay[-third:]))
    return float((sent[last] - sent[first]) / (received[last] - received[first]))


def check_link(metrics: LinkMetrics, lead: float, control_step: float, lockstep: bool) -> list[CheckResult]:
    """Check the metrics of a link.

    Args:
        metrics: result of `measure_link`.
        lead: time by which the robot sends its state before a control step [s].
        control_step: control step of the policy [s].
        lockstep: whether the robot follows this computer's clock, so that frames take no time.
    """
    trips, pings = metrics.round_trips, metrics.lost + len(metrics.round_trips)
    counts = (metrics.lost, metrics.damaged, metrics.missing, metrics.unsent)
    losses = pass_if(
        "link, losses",
        max(counts) <= MAX_LOSS * pings,
        "{} of {} pings lost, {} frames damaged, {} missing, {} not sent".format(counts[0], pings, *counts[1:]),
        f"; at most {MAX_LOSS:.1%} are allowed",
        "check the plug, the baud rate on both sides, and the robot's ground; use a shorter or shielded cable",
        metrics.lost / pings,
    )
    if lockstep:
        return [losses, *skip_checks(TIMING_CHECKS, "in lockstep frames take no time", "run without --lockstep")]
    if not len(trips):
        return [losses, *skip_checks(TIMING_CHECKS, "no ping was answered")]
    median, late = map(float, np.percentile(trips, (50, 99)))
    clock_error = metrics.clock_rate - 1
    return [
        losses,
        pass_if(
            "link, bursts",
            metrics.burst < MAX_BURST,
            f"{metrics.burst:.1f} answers together on average, every {1e3 * metrics.gap:.1f} ms",
            f"; answers to pings {1e3 * PING_PERIOD:g} ms apart must arrive one by one: the USB adapter buffers bytes "
            "(its latency timer is 16 ms by default)",
            "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer, or setserial /dev/ttyUSB0 "
            "low_latency (with your port's name); if your adapter can't do this, use another one",
            metrics.burst,
        ),
        pass_if(
            "link, round trip",
            median <= lead and late <= LATE_STEPS * control_step,
            f"median {1e3 * median:.2f} ms, 99th percentile {1e3 * late:.2f} ms, jitter {1e3 * np.std(trips):.2f} ms",
            f"; the median must be within {1e3 * lead:g} ms, the time by which states are sent ahead, and the 99th "
            f"percentile within {LATE_STEPS} control steps, {1e3 * LATE_STEPS * control_step:g} ms",
            "close other programs, use a direct USB port, and set the adapter's latency timer to 1 ms",
            median,
        ),
        pass_if(
            "robot's clock",
            abs(clock_error) <= MAX_CLOCK_ERROR,
            f"runs {abs(clock_error):.2%} too {'fast' if clock_error > 0 else 'slow'}",
            f"; at most {MAX_CLOCK_ERROR:.0%} is allowed",
            "check the microcontroller's crystal and clock settings; a slow emulator needs a less busy computer",
            metrics.clock_rate,
        ),
    ]
