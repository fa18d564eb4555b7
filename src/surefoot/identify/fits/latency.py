"""The latency experiment's fit: spikes tell the readings' age directly, a replay tells that and the servo's delay."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.identify.fits.motor import fit_on_rack, rack_estimates
from surefoot.identify.quality import check_recording
from surefoot.identify.recording import Recording
from surefoot.identify.registry import FitProgress
from surefoot.identify.replay import stretch_of
from surefoot.identify.rest import rest_voltage
from surefoot.identify.result import Estimate, Identification, Series
from surefoot.identify.spikes import Spikes, measure_spikes
from surefoot.robot import PhysicalParams, RobotDescription

Array = NDArray[np.float64]

FEWEST = 8
"""Clear answers to spikes that are needed."""
DISAGREE = 0.001
"""Difference [s] between what spikes and the replay say of the readings' age from which on it is told."""


def fit_latency(
    robot: RobotDescription,
    recording: Recording,
    known: PhysicalParams,
    sensors: dict[str, Any],
    tell: FitProgress | None,
) -> Identification:
    """What the latency experiment tells.

    Raises:
        SurefootError: data too poor to tell anything.
    """
    notes = list(check_recording(recording, robot))
    spikes = measure_spikes(recording)
    if len(spikes.age) < FEWEST:
        raise SurefootError(
            f"only {len(spikes.age)} of {spikes.tried} answers to spikes are clear; at least {FEWEST} are needed: "
            f"do the motors move at all?"
        )
    lead = float(recording.meta["lead"])
    fitted = recording.phases("fit")
    stretch = stretch_of(recording, fitted[0], fitted[-1])
    fit, _ = fit_on_rack(robot, recording, stretch, known, tell, every=3)
    kept = ("servo_latency", "control_latency")
    estimates = [e for e in rack_estimates(robot, fit, known) if e.name in kept]
    direct = [_median("spike_at_robot", spikes.age), _median("spike_at_host", spikes.host)]
    found = next(e for e in estimates if e.name == "control_latency")
    if abs(direct[0].value + lead - found.value) > DISAGREE:
        notes.append(
            f"spikes say that readings are {1e3 * (direct[0].value + lead):.1f} ms old, the replay "
            f"{1e3 * found.value:.1f} ms"
        )
    notes.append(
        f"readings are {1e3 * direct[0].value:.2f} ms old when the robot sends them; from sending a spike to reading "
        f"of the motion {1e3 * direct[1].value:.2f} ms pass at this computer ({len(spikes.age)} of {spikes.tried} "
        f"spikes answered clearly); control_latency counts {1e3 * lead:g} ms from sending to use"
    )
    return Identification(
        "latency",
        robot.name,
        (*estimates, *direct, rest_voltage(recording)),
        (),
        tuple(pair for pair in fit.strongest_correlations(20) if any(name in pair for name in kept)),
        tuple(notes),
        (_series(spikes),),
        {},
        recording.digest,
        str(recording.meta["date"]),
    )


def _median(name: str, values: Array) -> Estimate:
    """Median, with the deviation that a median has: 1.25 times that of a mean, by the spread between quartiles."""
    spread = float(np.subtract(*np.percentile(values, [75, 25]))) / 1.349
    return Estimate(name, float(np.median(values)), 1.2533 * max(spread, 1e-6) / np.sqrt(len(values)), "s", low=0.0)


def _series(spikes: Spikes) -> Series:
    """How the spikes' answers spread."""
    edges = np.linspace(1e3 * spikes.age.min() - 0.2, 1e3 * spikes.age.max() + 0.2, 25)
    count, _ = np.histogram(1e3 * spikes.age, edges)
    middle = (edges[1:] + edges[:-1]) / 2
    nothing = np.full(len(middle), np.nan)
    return Series("answers to spikes", "age of readings [ms]", "spikes", middle, count.astype(float), nothing, nothing,
                  points=True)  # fmt: skip
