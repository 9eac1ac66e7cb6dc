"""Reads a pickled DataFrame of pandas (`.pkl.gz`) as NumPy columns, without pandas and without running its code.

A pickle names functions, and a reader that calls all of them runs what its author wants. This one knows the names that
a table of numbers and texts has, of pandas 0.25 to 2, and stands in for each of pandas' classes with one that only
keeps its arguments.
"""

from __future__ import annotations

import gzip
import io
import pickle
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import LogError
from .tableio import require

__all__ = ["columns_of"]

MAX_BYTES = 1 << 30
"""Of a table after decompression; a sweep has 10 MB."""

_MODULES = ("pandas.core.", "pandas._libs.", "pandas.indexes.")


class _Frame:
    """Stands for DataFrame: its state has the manager of its blocks under `_data` or `_mgr`."""

    def __setstate__(self, state: Any) -> None:
        its = state if isinstance(state, dict) else {}
        self.manager = its.get("_mgr", its.get("_data"))


class _Manager:
    """Stands for BlockManager: blocks of columns, and the names of the columns."""

    def __init__(self, blocks: Any = (), axes: Any = ()) -> None:
        self.blocks, self.axes = blocks, axes

    def __setstate__(self, state: Any) -> None:
        # Until pandas 1.2: (axes, values, items, {"0.14.1": {"axes": .., "blocks": [{"values", "mgr_locs"}]}}).
        if isinstance(state, tuple) and len(state) >= 4:
            its = state[3]["0.14.1"]
            self.axes = its["axes"]
            self.blocks = [(one["values"], one["mgr_locs"]) for one in its["blocks"]]


class _Index:
    """Stands for every kind of index."""

    values: Any = None


def _new_index(_: Any, its: dict[str, Any]) -> _Index:
    made = _Index()
    made.values = its.get("data")
    return made


def _block(values: Any, places: Any, _dimensions: Any = None) -> tuple[Any, Any]:
    return values, places


def _encode(text: str, encoding: str = "latin1") -> bytes:
    """Bytes, as pickles of protocol 2 write them."""
    if encoding not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError(f"bytes in {encoding}")
    return text.encode("latin1")


_OF_PANDAS = {
    "DataFrame": _Frame,
    "BlockManager": _Manager,
    "_new_Index": _new_index,
    "_unpickle_block": _block,
    **dict.fromkeys(("Index", "RangeIndex", "Int64Index", "NumericIndex"), _Index),
}

_OF_NUMPY = ("_reconstruct", "_frombuffer", "scalar", "ndarray", "dtype")


class _Tables(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if module.startswith(_MODULES) and name in _OF_PANDAS:
            return _OF_PANDAS[name]
        if (module == "numpy" or module.startswith(("numpy.core.", "numpy._core."))) and name in _OF_NUMPY:
            return super().find_class(module, name)
        if (module, name) == ("builtins", "slice"):
            return slice
        if (module, name) == ("_codecs", "encode"):
            return _encode
        raise pickle.UnpicklingError(f"a pickle of {module}.{name}")


def columns_of(path: Path, names: list[str], what: str) -> dict[str, npt.NDArray[Any]]:
    """Columns by their names, as long as each other. Raises `LogError`, also for one that is not there."""
    fix = "download it again, or write it with pandas 1 or 2, in columns of numbers and objects"
    try:
        with gzip.open(require(path, what)) as file:
            data = file.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise LogError(path, f"more than {MAX_BYTES} bytes", "use a file of the documented schema")
        columns = _columns(_Tables(io.BytesIO(data)).load())
    except (pickle.UnpicklingError, OSError, EOFError, zlib.error) as error:
        raise LogError(path, f"no pickled table: {error}", fix) from None
    except (AttributeError, ImportError, IndexError, KeyError, MemoryError, TypeError, ValueError) as error:
        raise LogError(path, f"no pickled table: {type(error).__name__}: {error}", fix) from None
    missing = [name for name in names if name not in columns]
    if missing:
        raise LogError(path, f"no column {missing[0]}, only {', '.join(sorted(columns))}", "download it again")
    return {name: columns[name] for name in names}


def _columns(frame: Any) -> dict[str, npt.NDArray[Any]]:
    """Raises `ValueError` if it is no table."""
    if not isinstance(frame, _Frame) or not isinstance(frame.manager, _Manager):
        raise ValueError(f"a {type(frame).__name__}, and no DataFrame")
    columns, length = [str(name) for name in frame.manager.axes[0].values], None
    found: dict[str, npt.NDArray[Any]] = {}
    for values, places in frame.manager.blocks:
        rows = np.atleast_2d(values)
        for row, place in zip(rows, np.arange(len(columns))[places], strict=True):
            if length is not None and len(row) != length:
                raise ValueError("columns of different lengths")
            found[columns[place]], length = row, len(row)
    return found
