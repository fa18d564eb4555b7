"""Reading of files with a size limit, and atomic writing."""

from __future__ import annotations

import errno
import json
import os
import re
import stat
import threading
from pathlib import Path
from typing import Any

CONFIGURATION_BYTES = 1 << 18
"""Maximum size of a configuration file [bytes]."""
DATA_BYTES = 1 << 30
"""Maximum uncompressed size of a data file [bytes]."""
_PARTIAL = re.compile(r"\..+\.(\d+)\.tmp")
"""Pattern of the names of unfinished files, which contain the id of the process that writes them."""


def check_readable(path: Path, limit: int = DATA_BYTES) -> None:
    """Check that a path is a regular file within the size limit [bytes].

    Raises:
        OSError: it is not, or it does not exist.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if status.st_size > limit:
        raise OSError(errno.EFBIG, f"it has {status.st_size} bytes; at most {limit} are read", str(path))


def read_configuration(path: Path) -> bytes:
    """Return the content of a configuration file, which must be a regular file of at most `CONFIGURATION_BYTES`.

    Raises:
        OSError: it is not a regular file, is larger, or can't be read.
    """
    check_readable(path, CONFIGURATION_BYTES)
    with path.open("rb") as file:
        # Files in /proc report a size of 0 bytes.
        content = file.read(CONFIGURATION_BYTES + 1)
    if len(content) > CONFIGURATION_BYTES:
        raise OSError(errno.EFBIG, f"it is larger than the {CONFIGURATION_BYTES} bytes that are read", str(path))
    return content


def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files left in a folder by processes that were killed."""
    for path in folder.glob(".*.tmp"):
        if (match := _PARTIAL.fullmatch(path.name)) is None:
            continue
        try:
            os.kill(int(match[1]), 0)
        except (ProcessLookupError, OverflowError):
            path.unlink(missing_ok=True)
        except PermissionError:
            continue  # The process runs, as another user.


def atomic_write(path: Path, content: str | bytes) -> None:
    """Write a file atomically: it is renamed to `path` once its content is on the disk.

    Several threads and processes may write the same file at once; the last one stays.
    """
    partial = path.with_name(f".{path.name}.{threading.get_ident()}.{os.getpid()}.tmp")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the objects in a file of JSON lines, up to a truncated line; empty if the file is missing."""
    rows: list[dict[str, Any]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:  # A training that starts over may remove its log at any time.
        return rows
    for line in lines:
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows
