"""Reader of tensors in files of `torch.save` without torch, such as PACE's logs (`time`, `dof_pos`, `des_dof_pos`).

Such a file is a ZIP archive with a pickle and the bytes of each storage. Only dictionaries, lists, numbers, strings and
tensors are built from the pickle. Everything else that it refers to is rejected, so that no code of the file runs.
"""

from __future__ import annotations

import io
import pickle
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError

FILE_BYTES = 1 << 28
"""Maximum size of a file, and of the unpacked archive [bytes]."""
_STORAGES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "ByteStorage": "<u1",
    "CharStorage": "<i1",
    "BoolStorage": "?",
}


class _StorageKind:
    """Placeholder for a torch storage class in the pickle: its NumPy data type."""

    def __init__(self, kind: str) -> None:
        self.kind = kind


def _rebuild_tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> NDArray[Any]:
    """Return the elements of a tensor in a storage (N,); offset and strides are in elements."""
    sizes = [*shape, *strides, offset]
    if not isinstance(storage, np.ndarray) or storage.ndim != 1 or len(shape) != len(strides):
        raise pickle.UnpicklingError("a tensor without its storage")
    if not all(isinstance(size, int) and size >= 0 for size in sizes):
        raise pickle.UnpicklingError("a tensor with an invalid shape")
    if 0 in shape:
        return np.zeros(shape, storage.dtype)
    last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
    if last >= len(storage) or np.prod([float(size) for size in shape]) > len(storage):
        raise pickle.UnpicklingError("a tensor that reaches beyond its storage")
    steps = [stride * storage.itemsize for stride in strides]
    return np.lib.stride_tricks.as_strided(storage[offset:], shape, steps, writeable=False).copy()


def _rebuild_parameter(tensor: Any, *_: Any) -> Any:
    return tensor


class _TensorUnpickler(pickle.Unpickler):
    """Unpickler that builds only dictionaries, lists, numbers, strings and tensors."""

    def __init__(self, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(io.BytesIO(archive.read(f"{folder}data.pkl")))
        self._archive, self._folder = archive, folder
        self._storages: dict[tuple[str, str], NDArray[Any]] = {}
        self._left = FILE_BYTES

    def find_class(self, module: str, name: str) -> Any:
        if module in ("torch", "torch.storage") and name in _STORAGES:
            return _StorageKind(_STORAGES[name])
        allowed = {
            ("torch._utils", "_rebuild_tensor_v2"): self._tensor,
            ("torch._utils", "_rebuild_parameter"): _rebuild_parameter,
            ("collections", "OrderedDict"): dict,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not allowed")
        return allowed[module, name]

    def _tensor(self, storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> NDArray[Any]:
        """Return a tensor as `_rebuild_tensor` does; all tensors of a file have limited memory."""
        tensor = _rebuild_tensor(storage, offset, shape, strides)
        self._left -= tensor.nbytes
        if self._left < 0:
            raise pickle.UnpicklingError(f"its tensors have over {FILE_BYTES >> 20} MiB")
        return tensor

    def persistent_load(self, pid: Any) -> Any:
        if not (isinstance(pid, tuple) and len(pid) == 5 and pid[0] == "storage" and isinstance(pid[1], _StorageKind)):
            raise pickle.UnpicklingError("it refers to something that is not a storage")
        key = str(pid[2]), str(pid[1].kind)
        if key not in self._storages:
            self._storages[key] = np.frombuffer(self._archive.read(f"{self._folder}data/{key[0]}"), key[1])
        return self._storages[key]


def read_tensors(path: Path) -> dict[str, Any]:
    """Return the dictionary in a file of `torch.save`, with arrays instead of tensors.

    Raises:
        SurefootError: the file is of another kind, or holds anything other than a dictionary of tensors and numbers.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if sum(item.file_size for item in archive.infolist()) > FILE_BYTES:
                raise SurefootError(f"holds more than {FILE_BYTES >> 20} MiB")
            pickles = [name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl"]
            if len(pickles) != 1:
                raise SurefootError("is not a file of torch.save: it holds no data.pkl")
            order = f"{pickles[0].removesuffix('data.pkl')}byteorder"
            if order in archive.namelist() and archive.read(order).strip() != b"little":
                raise SurefootError("is in big-endian byte order; save it on another machine")
            data = _TensorUnpickler(archive, pickles[0].removesuffix("data.pkl")).load()
    except SurefootError:
        raise
    except Exception as error:  # a pickle is a program: any error is possible
        raise SurefootError(f"is not a file of torch.save with tensors: {' '.join(str(error).split())}") from error
    if not isinstance(data, dict):
        raise SurefootError(f"holds a {type(data).__name__}; a log must be a dictionary of tensors")
    return data
