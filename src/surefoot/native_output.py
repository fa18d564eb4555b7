"""Redirection of what C code prints: stdout holds results only, with `--json` one object."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from surefoot.errors import SurefootError


@contextmanager
def stdout_to_stderr() -> Iterator[None]:
    """Redirect stdout to stderr, for notes of a library while it is loaded."""
    with _redirect((1,), 2):
        yield


@contextmanager
def quiet() -> Iterator[None]:
    """Discard what C code prints to stdout or stderr."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    try:
        with _redirect((1, 2), nowhere):
            yield
    finally:
        os.close(nowhere)


@contextmanager
def mujoco_errors(path: Path) -> Iterator[None]:
    """Turn an error of MuJoCo's parser or compiler about a file into one line, and discard what it prints."""
    try:
        with quiet():
            yield
    except ValueError as error:
        raise SurefootError(f"{path}: MuJoCo refuses it: {' '.join(str(error).split())}") from error


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
