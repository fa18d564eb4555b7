"""Tables of numbers in files of other people's making: NPZ, CSV, pickle, MCAP and ROS bags.

An array of several dimensions is one column for each of its places: `name[3]`, `name[1,2]`. A message's field is
`topic.field[3]`. All files are hostile: of pickles nothing is built but numbers, texts, lists, tables and arrays.
"""

from __future__ import annotations

import csv
import io
import itertools
import pickle
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from surefoot.arrays import Array
from surefoot.errors import SurefootError, describe_os_errors
from surefoot.files import check_readable
from surefoot.identify.logs.robot_log import read_arrays

FILE_BYTES = 1 << 28
"""Size of the largest file that is read."""
MOST_COLUMNS = 4096
MOST_NUMBERS = 1 << 27
MOST_ITEMS = 1 << 24
"""Numbers, texts, lists and tables of a pickle: a few bytes of it can name a list many times over."""
_DEPTH = 8


@dataclass(frozen=True)
class Table:
    """Columns of numbers (T,) by name."""

    columns: dict[str, Array]
    time: Array | None = None
    """The recorder's own times (T,) [s], of a bag."""

    @property
    def rows(self) -> int:
        """Number of rows T."""
        return len(next(iter(self.columns.values())))


def read_table(path: Path) -> Table:
    """Read a file by the kind that its name tells.

    Raises:
        SurefootError: no such file, another kind, or one that holds no table; without its path.
    """
    suffix = path.suffix.lower()
    if path.is_dir() or suffix in (".mcap", ".bag", ".db3"):
        return _read_bag(path)
    readers = {".npz": _read_npz, ".csv": _read_csv, ".pkl": _read_pickle, ".pickle": _read_pickle}
    if suffix not in readers:
        raise SurefootError(f"is of kind '{suffix}'; kinds: {', '.join(readers)}, .mcap, .bag, or the folder of a bag")
    with describe_os_errors("it"):
        check_readable(path, FILE_BYTES)
    return readers[suffix](path)


def _read_npz(path: Path) -> Table:
    return _table(read_arrays(path))


def _table(arrays: Mapping[Any, Any]) -> Table:
    """Return arrays by name as a table; those that are not a row for each time are left out."""
    numbers = {str(k): np.asarray(v) for k, v in arrays.items() if np.asarray(v).dtype.kind in "biuf"}
    lengths = [len(array) for array in numbers.values() if array.ndim and array.size]
    if not lengths:
        raise SurefootError("holds no arrays of numbers")
    rows = max(lengths, key=lengths.count)
    columns: dict[str, Array] = {}
    for name, array in numbers.items():
        if not array.ndim or not array.size or len(array) != rows:
            continue
        if array.size > rows * MOST_COLUMNS or array.size > MOST_NUMBERS:
            raise SurefootError(f"{name} has shape {array.shape}; it is too large")
        flat = array.reshape(rows, -1).astype(float)
        for k, place in enumerate(np.ndindex(array.shape[1:])):
            columns[name + (f"[{','.join(map(str, place))}]" if place else "")] = flat[:, k]
    return Table(columns)


def _read_csv(path: Path) -> Table:
    with describe_os_errors("it"):
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    lines = csv.reader(io.StringIO(text))
    try:
        names = [name.strip() for name in next(lines, [])]
        rows = [line for line in lines if line]
    except csv.Error as error:
        raise SurefootError(f"is no CSV file: {error}") from error
    if not names or not rows or len(names) > MOST_COLUMNS:
        raise SurefootError(f"has {len(names)} columns and {len(rows)} rows; the first line names 1 to {MOST_COLUMNS}")
    if len(set(names)) != len(names):
        raise SurefootError("has columns of one name; names must differ")
    for number, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise SurefootError(f"line {number} has {len(row)} values; the first line names {len(names)}")
    return Table({name: np.array([_number(row[k]) for row in rows]) for k, name in enumerate(names)})


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return float("nan")


class _Blank:
    """Stands for numpy's ndarray class in a pickle, which only names it."""


class _Array:
    """An array of a pickle, filled by its state: version, shape, dtype, order, bytes."""

    def __init__(self, *_: Any) -> None:
        self.value = np.zeros(0)

    def __setstate__(self, state: Any) -> None:
        _, shape, kind, fortran, content = state
        if not isinstance(kind, np.dtype) or kind.hasobject or not isinstance(content, bytes):
            raise pickle.UnpicklingError("arrays of objects are not read")
        self.value = np.frombuffer(content, kind).reshape(shape, order="F" if fortran else "C")


def _buffered(content: Any, kind: Any, shape: Any, order: Any) -> _Array:
    made = _Array()
    content = bytes(content) if isinstance(content, bytearray) else content
    made.__setstate__((1, shape, kind, order == "F", content))
    return made


def _scalar(kind: Any, content: Any = b"") -> float:
    if not isinstance(kind, np.dtype) or kind.hasobject or not isinstance(content, bytes):
        raise pickle.UnpicklingError("objects are not read")
    return float(np.frombuffer(content, kind)[0])


def _dtype(name: Any, *_: Any) -> Any:
    if not isinstance(name, str) or len(name) > 8 or np.dtype(name).hasobject:
        raise pickle.UnpicklingError("objects are not read")
    return np.dtype(name)


_SAFE: dict[tuple[str, str], Any] = {
    **{
        (f"numpy.{core}.{module}", name): value
        for core in ("core", "_core")
        for module, name, value in (
            ("multiarray", "_reconstruct", _Array),
            ("multiarray", "scalar", _scalar),
            ("numeric", "_frombuffer", _buffered),
        )
    },
    ("numpy", "ndarray"): _Blank,
    ("numpy", "dtype"): _dtype,
    ("_codecs", "encode"): lambda text, kind="latin1": str(text).encode("latin1"),
    ("collections", "OrderedDict"): dict,
}


class _Unpickler(pickle.Unpickler):
    """Builds numbers, texts, lists, tables and arrays, and nothing else."""

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _SAFE:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which is not read")
        return _SAFE[module, name]


def _read_pickle(path: Path) -> Table:
    with describe_os_errors("it"):
        content = path.read_bytes()
    try:
        data = _plain(_Unpickler(io.BytesIO(content)).load(), itertools.count())
    except Exception as error:  # a pickle is a program: whatever it does is its fault
        raise SurefootError(f"is no pickle of numbers: {' '.join(str(error).split())}") from error
    if isinstance(data, list) and data and all(isinstance(row, dict) for row in data):
        rows = [dict(_flat(row)) for row in data]
        names = list(dict.fromkeys(name for row in rows for name in row))[:MOST_COLUMNS]
        if not names:
            raise SurefootError("holds no numbers")
        return Table({name: np.array([row.get(name, np.nan) for row in rows]) for name in names})
    try:
        return _table(data if isinstance(data, dict) else {"data": np.asarray(data, float)})
    except (TypeError, ValueError) as error:
        raise SurefootError(f"is no table: {' '.join(str(error).split())}") from error


def _plain(data: Any, items: Iterator[int], depth: int = 0) -> Any:
    if depth > _DEPTH or next(items) >= MOST_ITEMS:
        raise ValueError("it is nested too deeply" if depth > _DEPTH else f"it holds more than {MOST_ITEMS} items")
    if isinstance(data, _Array):
        return data.value
    if isinstance(data, dict):
        return {key: _plain(value, items, depth + 1) for key, value in data.items()}
    return [_plain(value, items, depth + 1) for value in data] if isinstance(data, list | tuple) else data


def _flat(data: Any, name: str = "", depth: int = 0) -> Iterator[tuple[str, float]]:
    """Yield the numbers in a table, message or array, by name."""
    if depth > _DEPTH:
        return
    if isinstance(data, bool | int | float | np.number):
        yield name, float(data)
    elif isinstance(data, Mapping):
        for key, value in data.items():
            yield from _flat(value, f"{name}.{key}" if name else str(key), depth + 1)
    elif isinstance(data, np.ndarray) and data.dtype.kind in "biuf" and data.size <= MOST_COLUMNS:
        for place in np.ndindex(data.shape):
            yield f"{name}[{','.join(map(str, place))}]", float(data[place])
    elif isinstance(data, list | tuple) and len(data) <= MOST_COLUMNS:
        for k, value in enumerate(data):
            yield from _flat(value, f"{name}[{k}]", depth + 1)
    elif is_dataclass(data):
        yield from _flat({item.name: getattr(data, item.name) for item in fields(data)}, name, depth)


def _folder_of_mcap(path: Path, folder: Path) -> Path:
    """Make the folder of a ROS 2 bag around one MCAP file, which has all that stands in the folder's own file."""
    from rosbags.rosbag2.storage_mcap import McapReader

    mcap = McapReader(path)
    mcap.open()
    topics: list[dict[str, Any]] = [
        {
            "topic_metadata": {"name": one.topic, "type": one.msgtype, "serialization_format": "cdr"},
            "message_count": one.msgcount,
        }
        for one in mcap.connections
    ]
    mcap.close()
    (folder / "log.mcap").symlink_to(path.resolve())
    about = {
        "version": 5,
        "storage_identifier": "mcap",
        "relative_file_paths": ["log.mcap"],
        "duration": {"nanoseconds": 2**62},
        "starting_time": {"nanoseconds_since_epoch": 0},
        "message_count": sum(one["message_count"] for one in topics),
        "topics_with_message_count": topics,
    }
    (folder / "metadata.yaml").write_text(yaml.safe_dump({"rosbag2_bagfile_information": about}), encoding="utf-8")
    return folder


def _read_bag(path: Path) -> Table:
    """Read a bag: a row for each time of a message, each column with what came last; NaN before its first message."""
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    found: list[tuple[float, dict[str, float]]] = []
    with describe_os_errors("it"):
        if not path.exists():
            raise SurefootError("does not exist")
        if path.is_file():
            check_readable(path, FILE_BYTES)
    try:
        with ExitStack() as stack:
            folder = Path(stack.enter_context(TemporaryDirectory()))
            bag = _folder_of_mcap(path, folder) if path.suffix.lower() == ".mcap" else path
            reader = stack.enter_context(AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)))
            for connection, stamp, raw in reader.messages():
                message = reader.deserialize(raw, connection.msgtype)
                found.append((stamp * 1e-9, dict(_flat(message, connection.topic.strip("/")))))
                if len(found) * len(found[-1][1]) > MOST_NUMBERS:
                    raise SurefootError("has too many messages")
    except SurefootError:
        raise
    except Exception as error:  # the reader has errors of many kinds, not all of them its own
        raise SurefootError(f"is no bag: {' '.join(str(error).split())}") from error
    names = list(dict.fromkeys(name for _, row in found for name in row))
    if not names or len(names) > MOST_COLUMNS:
        raise SurefootError(f"has {len(names)} columns of numbers; 1 to {MOST_COLUMNS} are read")
    place = {name: k for k, name in enumerate(names)}
    values = np.full((len(found), len(names)), np.nan)
    for k, (_, row) in enumerate(found):
        if k:
            values[k] = values[k - 1]
        for name, number in row.items():
            values[k, place[name]] = number
    start = found[0][0]
    return Table(dict(zip(names, values.T, strict=True)), np.array([time - start for time, _ in found]))
