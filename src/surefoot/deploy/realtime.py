"""As little as possible between the control loop and its moment."""

from __future__ import annotations

import contextlib
import gc
import os
import sys
from collections.abc import Iterator

PRIORITY = 20
"""Of 1 to 99 among real-time processes: above everything ordinary, below the kernel's own helpers at 50."""
_NICE = -10
_SWITCH = 1e-4
"""Longest time [s] for which another thread of this process keeps the loop's thread from running."""


@contextlib.contextmanager
def undisturbed() -> Iterator[None]:
    """No garbage collection, and the highest priority that this process may have, while it lasts.

    Quietly does with less where it has no right to more. Children start with ordinary priority.
    """
    before = sys.getswitchinterval(), gc.isenabled()
    gc.collect()
    gc.disable()
    sys.setswitchinterval(_SWITCH)
    raised = _raise_priority()
    try:
        yield
    finally:
        if raised:
            with contextlib.suppress(OSError):
                os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        sys.setswitchinterval(before[0])
        if before[1]:
            gc.enable()


def _raise_priority() -> bool:
    """Ask for real time, or else for more of the ordinary; whether it is real time."""
    if not hasattr(os, "sched_setscheduler"):
        return False
    policy = os.SCHED_FIFO | getattr(os, "SCHED_RESET_ON_FORK", 0)
    try:
        os.sched_setscheduler(0, policy, os.sched_param(PRIORITY))
    except OSError:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, 0, _NICE)
        return False
    return True
