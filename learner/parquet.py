"""Parquet files; the only module that uses pyarrow.

The same columns give the same bytes with one release of it.
"""

import importlib.util
import json
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np

from farm.arrays import AnyArray
from farm.errors import writing
from learner.run import checkpoint as checkpoints

INSTALL: Final = "it needs pyarrow: pip install pyarrow"
"""Message if pyarrow is missing."""


def available() -> bool:
    """Whether pyarrow is installed."""
    return importlib.util.find_spec("pyarrow") is not None


def release() -> str:
    """Release of pyarrow."""
    return version("pyarrow")


def write(
    path: Path, columns: Mapping[str, "AnyArray | tuple[str, Sequence[Any]]"], index: str = ""
) -> None:
    """Write a table atomically; raises RunError if it cannot be written.

    Args:
      path: of the file.
      columns: by name, arrays with a row for each row of the table, (R,) or (R, ...); or values
        that may be None with their type: int, number, truth, text, or texts (lists of them).
      index: the column that pandas takes as the table's index, a text; its other columns are whole
          numbers.
    """
    import pyarrow
    from pyarrow import parquet

    kinds = {
        "int": pyarrow.int64(),
        "number": pyarrow.float64(),
        "truth": pyarrow.bool_(),
        "text": pyarrow.string(),
    }
    kinds["texts"] = pyarrow.list_(pyarrow.string())
    arrays = {
        name: _nested(values)
        if isinstance(values, np.ndarray)
        else pyarrow.array(list(values[1]), kinds[values[0]])
        for name, values in columns.items()
    }
    table = pyarrow.table(arrays)
    if index:
        table = table.replace_schema_metadata({"pandas": _pandas(list(columns), index)})
    content = pyarrow.BufferOutputStream()
    parquet.write_table(table, content)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        checkpoints.replace(path, content.getvalue().to_pybytes())


def read(path: Path, names: Sequence[str]) -> dict[str, list[Any]]:
    """Read some columns of a table."""
    from pyarrow import parquet

    columns: dict[str, list[Any]] = parquet.read_table(path, columns=list(names)).to_pydict()
    return columns


def _nested(values: AnyArray) -> Any:  # noqa: ANN401  pyarrow has no types
    """An array (R, ...) as a column of numbers, of lists of one length, or of lists of lists."""
    import pyarrow

    out = pyarrow.array(values.ravel())
    if values.ndim == 2:
        return pyarrow.FixedSizeListArray.from_arrays(out, values.shape[1])
    for axis in range(values.ndim - 1, 0, -1):
        rows = int(np.prod(values.shape[:axis]))
        out = pyarrow.ListArray.from_arrays(
            np.arange(rows + 1, dtype=np.int32) * values.shape[axis], out
        )
    return out


def _pandas(names: Sequence[str], index: str) -> str:
    """What pandas writes about a table's index."""
    texts = {"pandas_type": "unicode", "numpy_type": "object", "metadata": None}
    whole = {"pandas_type": "int64", "numpy_type": "int64", "metadata": None}
    columns = [
        {"name": each, "field_name": each, **(texts if each == index else whole)} for each in names
    ]
    return json.dumps(
        {
            "index_columns": [index],
            "column_indexes": [],
            "columns": columns,
            "pandas_version": "2.0.0",
        }
    )
