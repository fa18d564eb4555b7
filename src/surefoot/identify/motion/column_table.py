"""Reader of numeric tables in third-party files: NPZ, CSV, pickle, torch tensors, Parquet, MCAP and ROS bags.

Each element of a multidimensional array becomes a column: `name[3]`, `name[1,2]`. A message field becomes
`topic.field[3]`. Files are not trusted: a pickle may contain only numbers, strings, lists, dictionaries and arrays.
"""

from __future__ import annotations

import csv
import io
import itertools
import pickle
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from surefoot.arrays import Array
from surefoot.errors import SurefootError, choices, describe_os_errors
from surefoot.files import check_readable
from surefoot.identify.motion.parquet_file import read_parquet
from surefoot.identify.motion.torch_file import read_tensors
from surefoot.npz import read_npz

FILE_BYTES = 1 << 28
"""Maximum size of a file [bytes]."""
MAX_COLUMNS = 4096
MAX_NUMBERS = 1 << 27
MAX_ITEMS = 1 << 24
"""Maximum number of objects in a pickle, counted with repetition: a few bytes can refer to a list many times."""
_MAX_DEPTH = 8
_MAX_LISTED = 30
"""Maximum number of column names listed in a message."""


@dataclass(frozen=True)
class ColumnTable:
    """Table of T rows of numbers, with named columns."""

    columns: dict[str, Array]
    """Columns (T,) by name."""
    time: Array | None = None
    """Time stamps of the recorder (T,) [s], if the file is a bag."""

    @property
    def rows(self) -> int:
        """Number of rows T."""
        return len(next(iter(self.columns.values())))

    def where(self, values: Mapping[str, float]) -> ColumnTable:
        """Return the rows in which columns have these values.

        Raises:
            SurefootError: no such column, or no such row.
        """
        table = self
        for name, value in values.items():
            rows = table.column(name) == value
            if not rows.any():
                seen = np.unique(table.column(name))
                raise SurefootError(f"has no rows with {name} {value:g}; {name} is {seen[0]:g} to {seen[-1]:g}")
            columns = {key: column[rows] for key, column in table.columns.items()}
            table = ColumnTable(columns, None if table.time is None else table.time[rows])
        return table

    def column(self, name: str) -> Array:
        """Return a column (T,).

        Raises:
            SurefootError: no column of this name.
        """
        if name not in self.columns:
            raise self.lacks(f"'{name}'")
        return self.columns[name]

    def lacks(self, what: str) -> SurefootError:
        """Return the error of a missing column, which lists the columns that there are."""
        return SurefootError(f"has no column {what}; columns: {choices(list(self.columns)[:_MAX_LISTED])}")


def read_table(path: Path) -> ColumnTable:
    """Read a table from a file of the kind given by its suffix.

    Raises:
        SurefootError: the file is missing, of another kind, or holds no table. The message does not name the path.
    """
    suffix = path.suffix.lower()
    if is_bag(path):
        return _read_bag(path)
    readers = {".npz": _read_npz, ".csv": read_csv, ".pkl": _read_pickle, ".pickle": _read_pickle}
    readers |= dict.fromkeys((".pt", ".pth"), _read_torch) | {".parquet": _read_parquet}
    if suffix not in readers:
        raise SurefootError(f"is of kind '{suffix}'; kinds: {', '.join(readers)}, .mcap, .bag, or the folder of a bag")
    with describe_os_errors("it"):
        check_readable(path, FILE_BYTES)
        return readers[suffix](path)


def is_bag(path: Path) -> bool:
    """Return whether a path is a bag: a folder, or a file with the suffix of a bag."""
    return path.is_dir() or path.suffix.lower() in (".mcap", ".bag", ".db3")


def _read_npz(path: Path) -> ColumnTable:
    return _table_from_arrays(read_npz(path))


def _read_torch(path: Path) -> ColumnTable:
    return _table_from_arrays(
        {name: value for name, value in read_tensors(path).items() if isinstance(value, np.ndarray)}
    )


def _read_parquet(path: Path) -> ColumnTable:
    return _table_from_arrays(read_parquet(path, MAX_NUMBERS))


def _table_from_arrays(arrays: Mapping[Any, Any]) -> ColumnTable:
    """Return a table of the numeric arrays that have the most common length; other arrays are left out."""
    numbers = {str(key): np.asarray(value) for key, value in arrays.items()}
    numbers = {key: array for key, array in numbers.items() if array.dtype.kind in "biuf" and array.ndim and array.size}
    lengths = [len(array) for array in numbers.values()]
    if not lengths:
        raise SurefootError("holds no arrays of numbers")
    rows = max(lengths, key=lengths.count)
    columns: dict[str, Array] = {}
    for name, array in numbers.items():
        if len(array) != rows:
            continue
        if array.size > rows * MAX_COLUMNS or array.size > MAX_NUMBERS:
            raise SurefootError(f"{name} has shape {array.shape}, which is too large")
        flat = array.reshape(rows, -1).astype(float)
        columns |= {_element_name(name, index): flat[:, k] for k, index in enumerate(np.ndindex(array.shape[1:]))}
    return ColumnTable(columns)


def _element_name(name: str, index: tuple[int, ...]) -> str:
    return name + (f"[{','.join(map(str, index))}]" if index else "")


def read_csv(path: Path, names: Sequence[str] | None = None) -> ColumnTable:
    """Read a CSV file. Column names default to the first line; text that is not a number becomes NaN."""
    lines = csv.reader(io.StringIO(path.read_text(encoding="utf-8-sig", errors="replace")))
    first, rule = (2, "the first line names") if names is None else (1, "it must have")
    try:
        names = [name.strip() for name in next(lines, [])] if names is None else names
        rows = [line for line in lines if line]
    except csv.Error as error:
        raise SurefootError(f"is not a CSV file: {error}") from error
    if not names or not rows or len(names) > MAX_COLUMNS:
        raise SurefootError(f"has {len(names)} columns and {len(rows)} rows; the first line names 1 to {MAX_COLUMNS}")
    if len(set(names)) != len(names):
        raise SurefootError("has several columns with the same name; names must differ")
    for number, row in enumerate(rows, first):
        if len(row) != len(names):
            raise SurefootError(f"line {number} has {len(row)} values; {rule} {len(names)}")
    return ColumnTable({name: np.array([_number(row[k]) for row in rows]) for k, name in enumerate(names)})


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


class _NdarrayClass:
    """Placeholder for NumPy's ndarray class, which pickles only refer to."""


class _PickledDtype:
    """Type of numbers in a pickle. NumPy's own class would take any layout from the file, also one beyond the data."""

    def __init__(self, name: Any, *_: Any) -> None:
        if not isinstance(name, str) or not re.fullmatch(r"[biuf]\d{1,2}", name):
            raise pickle.UnpicklingError("objects are not read")
        self.value = np.dtype(name)

    def __setstate__(self, state: Any) -> None:
        _, order, *structure = state[:5]
        if order not in ("<", ">", "|", "=") or structure != [None] * 3:
            raise pickle.UnpicklingError("objects are not read")
        self.value = self.value.newbyteorder(order)


def _numbers(content: Any, kind: Any) -> np.ndarray[Any, Any]:
    if not isinstance(kind, _PickledDtype) or not isinstance(content, bytes):
        raise pickle.UnpicklingError("arrays of objects are not read")
    return np.frombuffer(content, kind.value)


class _PickledArray:
    """Array of a pickle, filled from its pickled state: version, shape, dtype, order, bytes."""

    def __init__(self, *_: Any) -> None:
        self.value = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        self.value = _numbers(content, kind).reshape(shape, order="F" if fortran else "C")


def _from_buffer(content: Any, kind: Any, shape: Any, order: Any) -> _PickledArray:
    array = _PickledArray()
    array.__setstate__((1, shape, kind, order == "F", bytes(content) if isinstance(content, bytearray) else content))
    return array


def _scalar(kind: Any, content: Any = b"") -> float:
    return float(_numbers(content, kind)[0])


def _encode(text: Any, _: Any = "latin1") -> bytes:
    if not isinstance(text, str):
        raise pickle.UnpicklingError("it encodes something other than text")
    return text.encode("latin1")


_SAFE_CLASSES: dict[tuple[str, str], Any] = {
    **{(f"numpy.{core}.multiarray", "_reconstruct"): _PickledArray for core in ("core", "_core")},
    **{(f"numpy.{core}.multiarray", "scalar"): _scalar for core in ("core", "_core")},
    **{(f"numpy.{core}.numeric", "_frombuffer"): _from_buffer for core in ("core", "_core")},
    ("numpy", "ndarray"): _NdarrayClass,
    ("numpy", "dtype"): _PickledDtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): dict,
}


class _Unpickler(pickle.Unpickler):
    """Unpickler that builds only numbers, strings, lists, dictionaries and arrays."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _SAFE_CLASSES:
            raise pickle.UnpicklingError(f"it refers to {module}.{name}, which is not allowed")
        return _SAFE_CLASSES[module, name]


def _read_pickle(path: Path) -> ColumnTable:
    content = path.read_bytes()
    try:
        data = _unwrap_arrays(_Unpickler(io.BytesIO(content)).load(), itertools.count())
    except Exception as error:  # a pickle is a program: any error is possible
        raise SurefootError(f"is not a pickle of numbers: {' '.join(str(error).split())}") from error
    try:
        if isinstance(data, list) and data and all(isinstance(row, dict) for row in data):
            return _table_from_rows(data)
        return _table_from_arrays(data if isinstance(data, dict) else {"data": np.asarray(data, float)})
    except (TypeError, ValueError, OverflowError) as error:
        raise SurefootError(f"is not a table: {' '.join(str(error).split())}") from error


def _table_from_rows(data: Sequence[Mapping[Any, Any]]) -> ColumnTable:
    rows = [dict(_flatten(row)) for row in data]
    names = list(dict.fromkeys(name for row in rows for name in row))[:MAX_COLUMNS]
    if not names:
        raise SurefootError("holds no numbers")
    if len(rows) * len(names) > MAX_NUMBERS:
        raise SurefootError(f"is a table of {len(rows)} x {len(names)} numbers; at most {MAX_NUMBERS} are read")
    return ColumnTable({name: np.array([row.get(name, np.nan) for row in rows]) for name in names})


def _unwrap_arrays(data: Any, items: Iterator[int], depth: int = 0) -> Any:
    """Replace each `_PickledArray` in a pickle's data by its NumPy array.

    Raises:
        ValueError: the data are nested too deeply or hold too many items.
    """
    if depth > _MAX_DEPTH or next(items) >= MAX_ITEMS:
        raise ValueError("it is nested too deeply" if depth > _MAX_DEPTH else f"it holds more than {MAX_ITEMS} items")
    if isinstance(data, _PickledArray):
        return data.value
    if isinstance(data, dict):
        return {key: _unwrap_arrays(value, items, depth + 1) for key, value in data.items()}
    return [_unwrap_arrays(value, items, depth + 1) for value in data] if isinstance(data, list | tuple) else data


def _flatten(data: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """Yield the name and value of each number in a dictionary, message, list or array."""
    if depth > _MAX_DEPTH:
        return
    if isinstance(data, bool | int | float | np.number):
        yield name, float(data)
    elif isinstance(data, np.ndarray) and data.dtype.kind in "biuf" and data.size <= MAX_COLUMNS:
        yield from ((_element_name(name, index), float(data[index])) for index in np.ndindex(data.shape))
    elif isinstance(data, list | tuple) and len(data) <= MAX_COLUMNS:
        for k, value in enumerate(data):
            yield from _flatten(value, f"{name}[{k}]", depth + 1)
    elif isinstance(data, Mapping) or is_dataclass(data):
        items = {item.name: getattr(data, item.name) for item in fields(data)} if is_dataclass(data) else data
        for key, value in items.items():
            yield from _flatten(value, f"{name}.{key}" if name else str(key), depth + 1)


@contextmanager
def open_bag(path: Path) -> Iterator[Any]:
    """Open a bag (folder of a ROS 2 bag, MCAP file, or ROS 1 bag file) and yield an `AnyReader` of rosbags.

    Raises:
        SurefootError: the bag is missing or can't be read, also while it is iterated. The message does not name the
            path.
    """
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    with describe_os_errors("it"):
        if not path.exists():
            raise SurefootError("does not exist")
        if path.is_file():
            check_readable(path, FILE_BYTES)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
            yield reader
    except SurefootError:
        raise
    except Exception as error:  # rosbags raises errors of many types, not only its own
        raise SurefootError(f"is not a bag: {' '.join(str(error).split())}") from error


def _read_bag(path: Path) -> ColumnTable:
    """Read a bag: one row per message, with the newest value of every column, or NaN before its first message."""
    rows: list[tuple[float, dict[str, float]]] = []
    with open_bag(path) as reader:
        for connection, stamp, raw in reader.messages():
            message = reader.deserialize(raw, connection.msgtype)
            rows.append((stamp * 1e-9, dict(_flatten(message, connection.topic.strip("/")))))
            if len(rows) * len(rows[-1][1]) > MAX_NUMBERS:
                raise SurefootError("has too many messages")
    names = list(dict.fromkeys(name for _, row in rows for name in row))
    if not names or len(names) > MAX_COLUMNS:
        raise SurefootError(f"has {len(names)} columns of numbers; 1 to {MAX_COLUMNS} are read")
    newest = dict.fromkeys(names, float("nan"))
    values = np.empty((len(rows), len(names)))
    for k, (_, row) in enumerate(rows):
        newest |= row
        values[k] = list(newest.values())
    time = np.array([time for time, _ in rows])
    return ColumnTable(dict(zip(names, values.T, strict=True)), time - time[0])
