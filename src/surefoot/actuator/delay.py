"""Delay of readings: a history of timestamped samples, read with linear interpolation.

Tan et al. 2018, section V-A: with samples (t_i, O_i), a reader at time t with latency L gets O at
t - L, interpolated between the two samples around it. Read with samples taken at t = 0, 1, 2 (in servo
steps):

    latency   at t = 0   at t = 1            at t = 2
    0         O_0        O_1                 O_2
    1         O_0 (*)    O_0                 O_1
    1.5       O_0 (*)    O_0 (*)             (O_0 + O_1) / 2
    (*) before history exists, the oldest sample is held
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray

from surefoot.actuator.compiled import kernel
from surefoot.errors import SurefootError

Array = NDArray[np.float64]


@kernel
def push_kernel(times: Array, samples: Array, count: int, time: float, sample: Array) -> None:
    """Store the sample number `count` in one robot's ring buffers, times (H,) and samples (H, D)."""
    slot = count % len(times)
    times[slot] = time
    for j in range(len(sample)):
        samples[slot, j] = sample[j]


@kernel
def read_kernel(times: Array, samples: Array, count: int, time: float, width: int, out: Array) -> None:
    """Write the first `width` entries of one robot's reading at `time` to `out`, after `count` pushes.

    A time before the oldest sample kept reads the oldest; one after the newest reads the newest.
    """
    size = len(times)
    newest = count - 1
    oldest = max(0, count - size)
    later = newest
    while later > oldest and times[(later - 1) % size] > time:
        later -= 1
    # Now `later` is the oldest sample whose predecessor is not after `time`.
    b = later % size
    if later == oldest or times[b] <= time:
        for j in range(width):
            out[j] = samples[b, j]
        return
    a = (later - 1) % size
    share = (time - times[a]) / (times[b] - times[a])
    for j in range(width):
        out[j] = samples[a, j] + share * (samples[b, j] - samples[a, j])


@njit(cache=True)
def _push_all(times: Array, samples: Array, count: NDArray[np.int64], now: Array, sample: Array) -> None:
    for i in range(len(count)):
        push_kernel(times[i], samples[i], count[i], now[i], sample[i])
        count[i] += 1


@njit(cache=True)
def _read_all(times: Array, samples: Array, count: NDArray[np.int64], at: Array, out: Array) -> None:
    for i in range(len(count)):
        read_kernel(times[i], samples[i], count[i], at[i], out.shape[1], out[i])


class DelayLine:
    """History of timestamped samples for a batch of robots, each with clock and latency of its own.

    Args:
        num_envs: number of robots.
        width: numbers in a sample.
        capacity: samples kept; the longest latency that can be read is the time they span.
    """

    def __init__(self, num_envs: int, width: int, capacity: int = 64) -> None:
        if capacity < 2:
            raise SurefootError(f"capacity is {capacity}; a delay line interpolates between 2 samples or more")
        self.times: Array = np.zeros((num_envs, capacity))
        self.samples: Array = np.zeros((num_envs, capacity, width))
        self.count: NDArray[np.int64] = np.zeros(num_envs, np.int64)

    def clear(self, index: ArrayLike = slice(None)) -> None:  # type: ignore[assignment]
        """Clear the history of the robots at `index` (all, if none is given)."""
        self.count[index] = 0  # type: ignore[index]

    def push(self, time: ArrayLike, sample: ArrayLike) -> None:
        """Add a sample (num_envs, width) taken at `time` [s], one time for all robots or one each.

        Raises:
            SurefootError: a robot's time does not go forward.
        """
        now = np.broadcast_to(np.asarray(time, float), self.count.shape)
        newest = self.times[np.arange(len(self.count)), (self.count - 1) % self.times.shape[1]]
        if np.any((self.count > 0) & (now <= newest)):
            raise SurefootError("a sample is not newer than the last one; times must go forward")
        _push_all(self.times, self.samples, self.count, now, np.asarray(sample, float))

    def read(self, time: ArrayLike, latency: ArrayLike) -> Array:
        """Return samples (num_envs, width) as read at `time` [s], `latency` [s] old.

        Raises:
            SurefootError: a latency below zero, longer than the history's capacity, or no sample yet.
        """
        late = np.broadcast_to(np.asarray(latency, float), self.count.shape)
        if not np.all(late >= 0):
            raise SurefootError(f"latency is {late.min():g} s; it must not be below 0")
        if np.any(self.count == 0):
            raise SurefootError("nothing was pushed yet; a delay line needs a first sample before it is read")
        at = np.broadcast_to(np.asarray(time, float), self.count.shape) - late
        size = self.times.shape[1]
        oldest = self.times[np.arange(len(self.count)), np.maximum(self.count - size, 0) % size]
        if np.any((self.count > size) & (at < oldest - 1e-12)):
            raise SurefootError(f"latency is {late.max():g} s; {size} samples do not reach that far back")
        out = np.empty((len(self.count), self.samples.shape[2]))
        _read_all(self.times, self.samples, self.count, at, out)
        return out
