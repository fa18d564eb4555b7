"""The doctor's look at the link: how long frames take, which ones are lost, and whether an adapter holds them back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from surefoot.arrays import Array
from surefoot.check_result import CheckResult, judge, skipped
from surefoot.deploy.robot_link import RobotLink

PINGS, PING_PERIOD = 200, 0.005
"""Pings, and the time [s] between two: often enough to see an adapter that gathers bytes for 16 ms."""
_PATIENCE = 0.3
"""How long after the last ping [s] answers may come."""
LOSS = 0.005
"""Share of frames that may be lost or damaged: one of 200 pings."""
BURST = 2.5
"""Answers in a burst, on average, from which something gathers them; one every `PING_PERIOD` comes alone."""
CLOCK_RATE = 0.01
"""How much faster or slower the robot's clock may be: crystals differ by .0001, a slow emulator by more."""
LATE_STEPS = 2
"""Control steps within which 99 of 100 answers must be there: a deployment damps the robot after three without one."""
TIMED = ("link, bursts", "link, round trip", "robot's clock")
_TOGETHER = 5e-4
"""Frames that come within this time [s] of each other have come together."""


@dataclass(frozen=True)
class LinkFigures:
    """What pings have shown. Times in s."""

    round_trips: Array
    """From sending a ping to reading its answer, in order of the pings that were answered."""
    lost: int
    """Pings without an answer."""
    damaged: int
    """Pieces between zeros that were no whole frame."""
    missing: int
    """Frames that the robot has numbered and that did not come."""
    unsent: int
    """Frames that the port did not take."""
    burst: float
    """Answers that came together, on average."""
    gap: float
    """Median time between two such bursts."""
    clock_rate: float
    """Seconds on the robot's clock for one of this computer's."""


def listen(link: RobotLink, until: float) -> None:
    """Take what comes until a moment [s] on this computer's clock, each frame when it comes."""
    clock = link.clock
    if link.lockstep:
        clock.wait_until(until)
        link.update()
        return
    while (left := until - clock.now()) > 0:
        link.wait(left)
        link.update()


def measure_link(link: RobotLink, pings: int = PINGS) -> LinkFigures:
    """Send pings, one every `PING_PERIOD`, and take the answers.

    Raises:
        LinkLostError: the port is gone.
    """
    clock, statistics = link.clock, link.statistics
    link.update()
    link.pongs.clear()
    before = (statistics.damaged, statistics.missing, statistics.unsent)
    start, sent = clock.now(), {}
    for index in range(pings):
        listen(link, start + index * PING_PERIOD)
        sent[link.ping()] = clock.now()
    listen(link, clock.now() + PING_PERIOD)
    end = clock.now() + _PATIENCE
    while len(link.pongs.keys() & sent.keys()) < pings and clock.now() < end:
        listen(link, min(clock.now() + PING_PERIOD, end))
    found = {token: arrival for token, arrival in link.pongs.items() if token in sent}
    arrivals = np.array([arrival.time for arrival in found.values()])
    burst, gap = bursts(arrivals)
    return LinkFigures(
        round_trips=np.array([arrival.time - sent[token] for token, arrival in found.items()]),
        lost=pings - len(found),
        damaged=statistics.damaged - before[0],
        missing=statistics.missing - before[1],
        unsent=statistics.unsent - before[2],
        burst=burst,
        gap=gap,
        clock_rate=rate(np.array([arrival.packet.time for arrival in found.values()]), arrivals),
    )


def bursts(arrivals: Array) -> tuple[float, float]:
    """How many frames come together on average, and the median time [s] between two bursts."""
    if len(arrivals) < 2:
        return float(len(arrivals)), 0.0
    first = np.r_[True, np.diff(arrivals) > _TOGETHER]
    gaps = np.diff(arrivals[first])
    return len(arrivals) / int(first.sum()), float(np.median(gaps)) if len(gaps) else 0.0


def rate(robot: Array, here: Array) -> float:
    """Seconds on the robot's clock for one of this computer's, from frames that came quickly.

    The quickest of the first and of the last third are compared, so that a frame that was held back counts for nothing.
    """
    third = len(here) // 3
    if third < 1:
        return 1.0
    way = here - robot
    first, last = int(np.argmin(way[:third])), len(way) - third + int(np.argmin(way[-third:]))
    return float((robot[last] - robot[first]) / (here[last] - here[first]))


def check_link(figures: LinkFigures, lead: float, control_step: float, lockstep: bool) -> list[CheckResult]:
    """Judge what was measured.

    Args:
        figures: what pings have shown.
        lead: how long before a control step the robot sends its state [s].
        control_step: of the policy [s].
        lockstep: the robot follows this computer's clock, so that frames take no time.
    """
    if lockstep or not len(figures.round_trips):
        why = "in lockstep frames take no time" if lockstep else "no ping was answered"
        todo = "run without --lockstep" if lockstep else "repair that first"
        return [_losses(figures), *skipped(TIMED, why, todo)]
    return [_losses(figures), _bursts(figures), _trips(figures, lead, control_step), _clock(figures)]


def _losses(figures: LinkFigures) -> CheckResult:
    pings = figures.lost + len(figures.round_trips)
    counts = (figures.lost, figures.damaged, figures.missing, figures.unsent)
    told = "{} of {} pings lost, {} frames damaged, {} missing, {} not sent".format(counts[0], pings, *counts[1:])
    todo = "check the plug, a shorter or shielded cable, the same baud rate on both sides, and the robot's ground"
    passed = max(counts) <= LOSS * pings
    return judge("link, losses", passed, told, f"; at most {LOSS:.1%} may be", todo, figures.lost / pings)


def _trips(figures: LinkFigures, lead: float, control_step: float) -> CheckResult:
    median, late = map(float, np.percentile(figures.round_trips, (50, 99)))
    jitter = float(np.std(figures.round_trips))
    told = f"median {1e3 * median:.2f} ms, 99th percentile {1e3 * late:.2f} ms, jitter {1e3 * jitter:.2f} ms"
    return judge(
        "link, round trip",
        median <= lead and late <= LATE_STEPS * control_step,
        told,
        f"; the median must be within {1e3 * lead:g} ms, the time a state has to come, and the 99th percentile "
        f"within {LATE_STEPS} control steps, {1e3 * LATE_STEPS * control_step:g} ms",
        "close other programs, use a direct USB port, and set the adapter's latency timer to 1 ms",
        median,
    )


def _bursts(figures: LinkFigures) -> CheckResult:
    told = f"{figures.burst:.1f} answers together on average, every {1e3 * figures.gap:.1f} ms"
    return judge(
        "link, bursts",
        figures.burst < BURST,
        told,
        f"; answers to pings {1e3 * PING_PERIOD:g} ms apart must come alone: the USB adapter gathers bytes "
        "(its latency timer, 16 ms by default)",
        "echo 1 | sudo tee /sys/bus/usb-serial/devices/ttyUSB0/latency_timer, or setserial /dev/ttyUSB0 low_latency "
        "(with your port's name); some adapters can't do it: take another",
        figures.burst,
    )


def _clock(figures: LinkFigures) -> CheckResult:
    off = figures.clock_rate - 1
    told = f"runs {abs(off):.2%} too {'fast' if off > 0 else 'slow'}"
    return judge(
        "robot's clock",
        abs(off) <= CLOCK_RATE,
        told,
        f"; at most {CLOCK_RATE:.0%} may be",
        "check the microcontroller's crystal and clock settings; an emulator that is slow needs a computer with less "
        "to do",
        figures.clock_rate,
    )
