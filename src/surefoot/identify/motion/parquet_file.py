"""Numbers in a Parquet file, such as an episode of LeRobot's: `action`, `observation.state`, `timestamp`.

Numbers, and lists of them that are equally long in every row, are read; texts, pictures and all else are left out. The
number of values is in the file's footer, and is checked before anything is read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from surefoot.errors import SurefootError


def read_parquet(path: Path, limit: int) -> dict[str, NDArray[Any]]:
    """Return the columns of numbers by name: arrays of one row for each time, NaN where a number is missing.

    Args:
        path: the file.
        limit: maximum number of values.

    Raises:
        SurefootError: pyarrow is not installed, or a file that is damaged or too large; without its path.
    """
    try:
        from pyarrow import parquet
    except ImportError as error:
        raise SurefootError(
            "is a Parquet file, and reading it needs pyarrow: pip install pyarrow, or save the log as CSV"
        ) from error
    try:
        with parquet.ParquetFile(path, page_checksum_verification=True) as file:
            footer = file.metadata
            groups = (footer.row_group(k) for k in range(footer.num_row_groups))
            count = sum(group.column(k).num_values for group in groups for k in range(group.num_columns))
            if max(count, footer.num_rows) > limit:
                raise SurefootError(f"holds {max(count, footer.num_rows)} values; at most {limit} are read")
            names = [field.name for field in file.schema_arrow if _holds_numbers(field.type)]
            table = file.read(names, use_threads=False)
        arrays = {name: _as_array(table.column(name).combine_chunks()) for name in names}
    except SurefootError:
        raise
    except Exception as error:  # pyarrow has errors of many kinds, and their texts may have several lines
        raise SurefootError(f"is no Parquet file that can be read: {' '.join(str(error).split())}") from error
    return {name: array for name, array in arrays.items() if array is not None}


def _holds_numbers(kind: Any) -> bool:
    """Return whether an Arrow type holds numbers, or lists of numbers."""
    from pyarrow import types

    while types.is_list(kind) or types.is_large_list(kind) or types.is_fixed_size_list(kind):
        kind = kind.value_type
    return bool(types.is_integer(kind) or types.is_floating(kind) or types.is_boolean(kind))


def _as_array(column: Any) -> NDArray[Any] | None:
    """Return a column of numbers, or of lists of them, as an array; None if its lists differ in length or are missing.

    A list that is missing has no length, and so no place for a NaN.
    """
    from pyarrow import compute, types

    shape = [len(column)]
    while not types.is_primitive(column.type):
        lengths = compute.unique(compute.list_value_length(column)).to_pylist()
        if len(lengths) != 1 or not lengths[0]:
            return None
        shape.append(lengths[0])
        column = column.flatten()
    return np.asarray(column.to_numpy(zero_copy_only=False), float).reshape(shape)
