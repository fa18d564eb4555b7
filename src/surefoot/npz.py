"""Array files (.npz) with metadata as JSON under the name `meta`."""

from __future__ import annotations

import json
import math
import zipfile
import zlib
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError
from surefoot.files import DATA_BYTES, atomic_write, check_readable


def write_npz(path: Path, arrays: Mapping[str, Any], meta: Mapping[str, Any]) -> None:
    """Write arrays and JSON metadata atomically; the file's folder is created if necessary."""
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = BytesIO()
    np.savez_compressed(buffer, meta=np.array(json.dumps(meta)), **arrays)
    atomic_write(path, buffer.getvalue())


def read_npz(path: Path, limit: int = DATA_BYTES, unpacked: int = DATA_BYTES) -> dict[str, NDArray[Any]]:
    """Read all arrays of an .npz file completely, so that the checksum of each member is verified.

    Args:
        path: the file.
        limit: maximum size of the file [bytes].
        unpacked: maximum uncompressed size of its arrays [bytes].

    Raises:
        SurefootError: the file does not exist, is damaged or too large, or contains Python objects. The message does
            not name the path.
    """
    try:
        check_readable(path, limit)
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > unpacked:
                raise ValueError(f"it unpacks to more than {unpacked} bytes")
            return {name.removesuffix(".npy"): _read_array(archive.read(name)) for name in archive.namelist()}
    except OSError as error:
        raise SurefootError(f"can't be read: {error.strerror or error}") from error
    # RuntimeError: a flipped bit can make a member look encrypted, or compressed by another method.
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, MemoryError) as error:
        raise SurefootError(
            f"is cut off, damaged or no file of arrays (.npz): {' '.join(str(error).split())}"
        ) from error


def pop_meta(arrays: dict[str, NDArray[Any]]) -> dict[str, Any] | None:
    """Remove `meta` from a file's arrays and return it as a dict, or None if it is not a JSON object."""
    try:
        meta = json.loads(str(arrays.pop("meta", None)))
    except (ValueError, RecursionError):
        return None
    return meta if isinstance(meta, dict) else None


def pack_bytes(name: str, content: bytes) -> dict[str, NDArray[Any]]:
    """Return bytes as an array by name; an empty dict for empty content."""
    return {name: np.frombuffer(content, np.uint8)} if content else {}


def pop_bytes(arrays: dict[str, NDArray[Any]], name: str) -> bytes:
    """Remove an array of bytes from a file's arrays and return its content; empty if there is none.

    Raises:
        SurefootError: the array does not contain bytes.
    """
    array = arrays.pop(name, np.empty(0, np.uint8))
    if array.dtype != np.uint8 or array.ndim != 1:
        raise SurefootError(f"{name} must hold bytes")
    return array.tobytes()


def _read_array(content: bytes) -> NDArray[Any]:
    """Parse the content of an .npy file, whose size must match its header."""
    file = BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read_header(file)
    if not kind.hasobject and math.prod(shape) * kind.itemsize > len(content):
        raise ValueError(f"an array of shape {shape} is longer than its file")
    file.seek(0)
    return np.lib.format.read_array(file)
