"""The counter that compiled loops share between threads."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit

from surefoot.world.native import fetch_and_increment


@njit(nogil=True)
def _take_all(counter, taken, thread):
    while True:
        number = fetch_and_increment(counter.ctypes.data)
        if number >= taken.shape[1]:
            return
        taken[thread, number] += 1


def test_threads_that_share_a_counter_get_every_number_once():
    counter, taken = np.zeros(1, np.int64), np.zeros((4, 200_000), np.int64)
    _take_all(np.zeros(1, np.int64), taken[:, :0], 0)
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda thread: _take_all(counter, taken, thread), range(4)))
    assert (taken.sum(axis=0) == 1).all()
    assert counter[0] == taken.shape[1] + 4
