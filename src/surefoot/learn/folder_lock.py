"""Lock of a run folder, so that only one process trains in it. This module does not need torch."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from surefoot.errors import SurefootError
from surefoot.files import remove_abandoned


@contextmanager
def folder_lock(path: Path, timeout: float = 0.0, purpose: str = "trains") -> Iterator[None]:
    """Lock a folder, so that no other process trains in it, and remove unfinished files of killed processes.

    The operating system releases the lock when a process ends or is killed. The file `lock` stays and contains the
    process id.

    Args:
        path: the folder.
        timeout: maximum time to wait for another process [s].
        purpose: what the process does with the folder, for messages.

    Raises:
        SurefootError: another process holds the lock, or the folder is not writable.
    """
    lock = FileLock(path / "lock", timeout, thread_local=False, fallback_to_soft=False)
    try:
        held = lock.acquire()
        Path(lock.lock_file).write_text(f"{os.getpid()}\n")
    except Timeout:
        raise SurefootError(f"{path}: another process {purpose} in this folder; wait for it, or end it") from None
    except OSError as error:
        raise SurefootError(f"{path}: can't be locked: {error.strerror}") from error
    with held:
        for folder in (path, path / "checkpoints"):
            remove_abandoned(folder)
        yield
