"""Files that are read within limits, and files that appear whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import re
import stat
from pathlib import Path
from typing import Any

CONFIGURATION_BYTES = 1 << 18
"""Size of the largest configuration file that is read."""
DATA_BYTES = 1 << 30
"""Size of the largest file of data that is read, unpacked."""
_PARTIAL = re.compile(r"\..+\.(\d+)\.tmp")
"""Names of unfinished files, with the number of the process that writes them."""


def check_readable(path: Path, limit: int = DATA_BYTES) -> None:
    """Refuse anything but a regular file, and a file that is too large.

    Raises:
        OSError: one of these, or the file can't be found.
    """
    status = path.stat()
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
    if not stat.S_ISREG(status.st_mode):
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if status.st_size > limit:
        raise OSError(errno.EFBIG, f"it has {status.st_size} bytes; at most {limit} are read", str(path))


def read_configuration(path: Path) -> bytes:
    """Read a configuration file, which is a regular file of `CONFIGURATION_BYTES` at most.

    Raises:
        OSError: it is another thing, is larger, or can't be read.
    """
    check_readable(path, CONFIGURATION_BYTES)
    with path.open("rb") as file:
        # Files in /proc report a size of 0 bytes.
        content = file.read(CONFIGURATION_BYTES + 1)
    if len(content) > CONFIGURATION_BYTES:
        raise OSError(errno.EFBIG, f"it is larger than the {CONFIGURATION_BYTES} bytes that are read", str(path))
    return content


def remove_abandoned(folder: Path) -> None:
    """Remove unfinished files that killed processes left in a folder."""
    for path in folder.glob(".*.tmp"):
        if (match := _PARTIAL.fullmatch(path.name)) is None:
            continue
        try:
            os.kill(int(match[1]), 0)
        except (ProcessLookupError, OverflowError):
            path.unlink(missing_ok=True)
        except PermissionError:
            continue  # Another user's process runs.


def atomic_write(path: Path, content: str | bytes) -> None:
    """Write a file whole or not at all: it takes the name `path` once everything is on the disk."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        with partial.open("wb") as file:
            file.write(content.encode() if isinstance(content, str) else content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def read_json_lines(path: Path) -> list[dict[str, Any]]:
    """Return the tables of a file of JSON lines; none if it is missing, and none after a line that was cut off."""
    rows: list[dict[str, Any]] = []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:  # A training that begins anew removes its log at any moment.
        return rows
    for line in lines:
        try:
            rows.append(json.loads(line))
        except ValueError:
            break
    return rows
