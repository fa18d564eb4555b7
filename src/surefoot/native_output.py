"""Redirection of what C code prints: stdout holds results only, with `--json` one object."""

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
    """Redirect stdout to stderr, for notes of a library while it is loaded."""
    with _redirect((1,), 2):
        yield


@contextmanager
def discard_output() -> Iterator[None]:
    """Discard what C code prints to stdout or stderr."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        with _redirect((1, 2), nowhere):
            yield
    finally:
        os.close(nowhere)


def _refusal(message: str, path: Path) -> SurefootError:
    return SurefootError(f"{path}: MuJoCo refuses it: {' '.join(message.split())}")


@contextmanager
def mujoco_errors(path: Path, explain: Callable[[str, Path], SurefootError] = _refusal) -> Iterator[None]:
    """Turn an error of MuJoCo's parser or compiler about a file into one line.

    What it prints is discarded, and warnings too, which MuJoCo else writes to a file MUJOCO_LOG.TXT.

    Args:
        path: the file.
        explain: returns the error for MuJoCo's message.
    """
    import mujoco

    # A C function without effect. It stays: engines are made silent in the same way.
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
        ctypes.CDLL(None).fflush(None)  # C keeps what it prints to a pipe until later
        for descriptor, was in zip(descriptors, saved, strict=True):
            os.dup2(was, descriptor)
            os.close(was)
