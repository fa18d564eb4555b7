"""Digests of logs by their contents, independent of file names."""

from __future__ import annotations

from collections.abc import Sequence

from surefoot.identify.motion.recorded import RecordedMotion
from surefoot.identify.recording import digest_arrays

_COLUMNS = ("time", "command", "motor_angle")


def motion_digest(motion: RecordedMotion) -> str:
    """Return the SHA-256 of the times, commands and motor angles of a log."""
    return digest_arrays({name: getattr(motion, name) for name in _COLUMNS})


def all_digest(motions: Sequence[RecordedMotion]) -> str:
    """Return the SHA-256 of several logs in the given order."""
    return digest_arrays({f"{k:03d} {name}": getattr(one, name) for k, one in enumerate(motions) for name in _COLUMNS})
