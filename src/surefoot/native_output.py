"""Redirection of output printed by C libraries, so that stdout holds only results (with `--json`, one object)."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from surefoot.errors import SurefootError


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect stdout to stderr, such as for messages that a library prints while it is loaded."""
    with _redirect((1,), 2):
        yield


@contextmanager
def discard_output() -> Iterator[None]:
    """Discard all output to stdout and stderr, also from C code."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        with _redirect((1, 2), nowhere):
            yield
    finally:
        os.close(nowhere)


def _rejection(message: str, path: Path) -> SurefootError:
    return SurefootError(f"{path}: MuJoCo rejects it: {' '.join(message.split())}")


@contextmanager
def mujoco_errors(path: Path, explain: Callable[[str, Path], SurefootError] = _rejection) -> Iterator[None]:
    """Convert an error of MuJoCo's parser or compiler about a file to a `SurefootError`.

    MuJoCo's output is discarded, including warnings, which it would otherwise write to a file MUJOCO_LOG.TXT.

    Args:
        path: the file.
        explain: function that returns the error for MuJoCo's message.
    """
    import mujoco

    # Any C function without side effects. It stays set, because the engines also silence warnings in this way.
    mujoco.set_mju_user_warning(ctypes.CDLL(None).strlen)
    try:
        with discard_output():
            yield
    except (ValueError, MemoryError, RecursionError, mujoco.FatalError) as error:
        raise explain(str(error) or type(error).__name__, path) from error


@contextmanager
def _redirect(descriptors: tuple[int, ...], to: int) -> Iterator[None]:
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    saved = [os.dup(descriptor) for descriptor in descriptors]
    try:
        for descriptor in descriptors:
            os.dup2(to, descriptor)
        yield
    finally:
        if sys.stdout is not None:
            sys.stdout.flush()
        ctypes.CDLL(None).fflush(None)  # C buffers output to a pipe
        for descriptor, original in zip(descriptors, saved, strict=True):
            os.dup2(original, descriptor)
            os.close(original)
