"""Delay of readings: a history of timestamped samples, read with linear interpolation.

Tan et al. 2018, section V-A: with samples (t_i, O_i) and a latency L, the reading at time t is O at t - L, interpolated
between the two samples around it. With samples taken at t = 0, 1, 2 (in servo steps), the readings are:

    latency   at t = 0   at t = 1            at t = 2
    0         O_0        O_1                 O_2
    1         O_0 (*)    O_0                 O_1
    1.5       O_0 (*)    O_0 (*)             (O_0 + O_1) / 2
    (*) before history exists, the oldest sample is held
"""

from __future__ import annotations

import math

from surefoot.actuator.compiled import kernel
from surefoot.arrays import Array


@kernel
def push_kernel(times: Array, samples: Array, count: int, time: float, sample: Array) -> None:
    """Store sample number `count` (counted from 0) in one robot's ring buffers, times (H,) and samples (H, D)."""
    slot = count % len(times)
    times[slot] = time
    for j in range(len(sample)):
        samples[slot, j] = sample[j]


@kernel
def read_kernel(times: Array, samples: Array, count: int, time: float, width: int, yaw: int, out: Array) -> None:
    """Write the first `width` entries of one robot's reading at `time` to `out`, after `count` pushes.

    Entry `yaw` is an angle from -pi to pi, which is interpolated along the shorter way; -1 if there is none.
    Times before the oldest stored sample return the oldest sample; times after the newest return the newest.
    """
    size = len(times)
    newest = count - 1
    oldest = max(0, count - size)
    later = newest
    while later > oldest and times[(later - 1) % size] > time:
        later -= 1
    # Now `later` is the oldest sample whose predecessor is at or before `time`.
    b = later % size
    if later == oldest or times[b] <= time:
        for j in range(width):
            out[j] = samples[b, j]
        return
    a = (later - 1) % size
    weight = (time - times[a]) / (times[b] - times[a])
    for j in range(width):
        change = samples[b, j] - samples[a, j]
        if j == yaw and abs(change) > math.pi:
            change -= math.copysign(2.0 * math.pi, change)
        out[j] = samples[a, j] + weight * change
        if j == yaw and abs(out[j]) > math.pi:
            out[j] -= math.copysign(2.0 * math.pi, out[j])
