"""Files of arrays (.npz) with a table of other values under `meta`."""

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
    """Write arrays and what JSON can hold, whole or not at all, with the file's folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    buffer = BytesIO()
    np.savez_compressed(buffer, meta=np.array(json.dumps(meta)), **arrays)
    atomic_write(path, buffer.getvalue())


def read_npz(path: Path, limit: int = DATA_BYTES, unpacked: int = DATA_BYTES) -> dict[str, NDArray[Any]]:
    """Read every array of an .npz file whole, so that each member's checksum is verified.

    Args:
        path: the file.
        limit: size of the largest file that is read [bytes].
        unpacked: the same of its arrays [bytes].

    Raises:
        SurefootError: no such file, or one that is damaged, too large or holds objects; without its path.
    """
    try:
        check_readable(path, limit)
        with zipfile.ZipFile(path) as archive:
            if sum(member.file_size for member in archive.infolist()) > unpacked:
                raise ValueError(f"it unpacks to more than {unpacked} bytes")
            return {name.removesuffix(".npy"): _read_array(archive.read(name)) for name in archive.namelist()}
    except OSError as error:
        raise SurefootError(f"can't be read: {error.strerror or error}") from error
    # RuntimeError: a flipped bit that makes a member look encrypted, or packed in another way.
    except (ValueError, EOFError, zipfile.BadZipFile, zlib.error, RuntimeError, MemoryError) as error:
        raise SurefootError(
            f"is cut off, damaged or no file of arrays (.npz): {' '.join(str(error).split())}"
        ) from error


def pop_meta(arrays: dict[str, NDArray[Any]]) -> dict[str, Any] | None:
    """Take `meta` out of a file's arrays; None if it is no table in JSON."""
    try:
        meta = json.loads(str(arrays.pop("meta", None)))
    except (ValueError, RecursionError):
        return None
    return meta if isinstance(meta, dict) else None


def pack_bytes(name: str, content: bytes) -> dict[str, NDArray[Any]]:
    """Return an array with bytes under its name; none for no bytes."""
    return {name: np.frombuffer(content, np.uint8)} if content else {}


def pop_bytes(arrays: dict[str, NDArray[Any]], name: str) -> bytes:
    """Take bytes out of a file's arrays; none, if they are not there.

    Raises:
        SurefootError: the array is one of other values.
    """
    array = arrays.pop(name, np.empty(0, np.uint8))
    if array.dtype != np.uint8 or array.ndim != 1:
        raise SurefootError(f"{name} must hold bytes")
    return array.tobytes()


def _read_array(content: bytes) -> NDArray[Any]:
    """Return the array of a .npy file, whose size must match its header."""
    file = BytesIO(content)
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, kind = read_header(file)
    if not kind.hasobject and math.prod(shape) * kind.itemsize > len(content):
        raise ValueError(f"an array of shape {shape} is longer than its file")
    file.seek(0)
    return np.lib.format.read_array(file)
