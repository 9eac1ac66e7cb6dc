"""Feather and Parquet files, by pyarrow."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pyarrow
import pyarrow.feather
import pyarrow.parquet

from .errors import LogError
from .tableio import require

__all__ = ["columns", "parquet_rows", "records"]

_BROKEN = "download the file again"


def columns(path: Path, names: list[str], what: str) -> dict[str, Any]:
    """Columns of a Feather file as NumPy arrays [n]. Raises `LogError` with the column that is missing."""
    try:
        table = pyarrow.feather.read_table(require(path, what), memory_map=False)
    except (pyarrow.ArrowInvalid, OSError) as error:
        raise LogError(path, f"not a Feather file: {error}", _BROKEN) from None
    missing = [name for name in names if name not in table.column_names]
    if missing:
        raise LogError(path, f"no column {missing[0]}", "use files of the documented schema")
    return {name: table.column(name).to_numpy(zero_copy_only=False) for name in names}


def records(path: Path, names: list[str], what: str) -> Iterator[dict[str, Any]]:
    """Rows of a small Feather file."""
    found = columns(path, names, what)
    for values in zip(*(found[name] for name in names), strict=True):
        yield dict(zip(names, values, strict=True))


def parquet_rows(path: Path, names: list[str], what: str, rows_at_once: int = 8) -> Iterator[dict[str, Any]]:
    """Rows of a Parquet file as Python values, a few at a time. Raises `LogError` with the column that is missing."""
    try:
        with pyarrow.parquet.ParquetFile(require(path, what)) as file:
            missing = [name for name in names if name not in file.schema_arrow.names]
            if missing:
                raise LogError(path, f"no column {missing[0]}", "use files of the documented schema")
            for batch in file.iter_batches(rows_at_once, columns=names):
                # Not `to_pylist`: of images and range images that would copy each value.
                arrays = [batch.column(name) for name in names]
                for index in range(batch.num_rows):
                    yield {name: its[index] for name, its in zip(names, arrays, strict=True)}
    except (pyarrow.ArrowInvalid, OSError) as error:
        raise LogError(path, f"not a Parquet file: {error}", _BROKEN) from None
