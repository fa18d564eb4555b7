"""Lock of a folder in which one process trains. It needs no torch."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from surefoot.errors import SurefootError
from surefoot.files import remove_abandoned


@contextmanager
def folder_lock(path: Path, timeout: float = 0.0) -> Iterator[None]:
    """Lock a folder, so that no other process trains in it, and remove unfinished files of killed processes.

    Args:
        path: the folder.
        timeout: how long to wait for another process [s].

    Raises:
        SurefootError: another process has the lock, or nothing can be written there.
    """
    try:
        lock = (path / "lock").open("a+")
    except OSError as error:
        raise SurefootError(f"{path}: can't be trained in: {error.strerror}") from error
    with lock:
        end = time.monotonic() + timeout
        while True:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= end:
                    raise SurefootError(
                        f"{path}: another process trains in this folder; wait for it, or end it"
                    ) from None
                time.sleep(0.2)
        lock.truncate(0)
        lock.write(f"{os.getpid()}\n")
        lock.flush()
        for folder in (path, path / "checkpoints"):
            remove_abandoned(folder)
        yield
