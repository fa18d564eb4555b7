"""Removal of compiled code that is older than its sources.

numba caches compiled functions beside their source and checks only that file's age. A loop in one module into
which a law of another was inlined would keep the old law after an edit. So all caches of the kernels are dropped
whenever any of their sources has changed.
"""

from __future__ import annotations

import contextlib
import hashlib
from pathlib import Path

_FOLDERS = [Path(__file__).parent, Path(__file__).parents[1] / "world"]


def drop_stale_caches() -> None:
    """Delete the caches beside the kernels if the sources differ from those that they were compiled from."""
    sources = sorted(path for folder in _FOLDERS for path in folder.glob("*.py"))
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()
    stamp = _FOLDERS[0] / "__pycache__" / "kernels.sha256"
    # Where the folder can't be written, the package is installed and its sources do not change.
    with contextlib.suppress(OSError):
        if stamp.is_file() and stamp.read_text() == digest:
            return
        for folder in _FOLDERS:
            for pattern in ("*.nbi", "*.nbc"):
                for path in (folder / "__pycache__").glob(pattern):
                    path.unlink(missing_ok=True)
        stamp.parent.mkdir(exist_ok=True)
        stamp.write_text(digest)
