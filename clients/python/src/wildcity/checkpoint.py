"""Reads files of `torch.save` without PyTorch, and without running code from the file.

A checkpoint of PyTorch 1.6 or later is a zip archive of a pickle and the bytes of its tensors. A pickle is a
program that may call any function by name. This reader permits only the names that rebuild tensors and ordered
dictionaries, and the containers of OmegaConf, whose content is read as plain data. Every other class becomes an
`Opaque`, which holds nothing.
"""

from __future__ import annotations

import collections
import math
import pickle
import zipfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt

from .errors import WildCityError

PICKLE_BYTES = 64 << 20
"""Largest pickle that is read, in bytes; that of a gsplat checkpoint has 2 kB."""


class CheckpointError(WildCityError):
    """A file is not a readable checkpoint, or has no Gaussians."""


class Opaque:
    """Stands for an object of an unknown class, and holds nothing."""

    def __init__(self, *args: object, **kwargs: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        pass

    def __setitem__(self, key: object, value: object) -> None:
        pass

    def __call__(self, *args: object, **kwargs: object) -> Opaque:
        return self

    def append(self, item: object) -> None:
        pass

    def extend(self, items: object) -> None:
        pass


class _Node:
    """A node of OmegaConf: a container with `_content`, or a value with `_val`."""

    _state: Mapping[str, Any] = {}

    def __init__(self, *args: object, **kwargs: object) -> None:
        pass

    def __setstate__(self, state: object) -> None:
        if isinstance(state, Mapping):
            self._state = state


class ConfigMap(_Node, Mapping[Any, Any]):
    """A DictConfig. Values are read when they are asked for, because the pickle's nodes refer to their parents."""

    @property
    def is_readable(self) -> bool:
        """Whether it has content, and is neither None nor a reference to another part of the configuration."""
        return isinstance(self._state.get("_content"), Mapping)

    def _values(self) -> Mapping[Any, Any]:
        content = self._state.get("_content")
        return content if isinstance(content, Mapping) else {}

    def __getitem__(self, key: Any) -> Any:
        return _plain(self._values()[key])

    def __iter__(self) -> Iterator[Any]:
        return iter(self._values())

    def __len__(self) -> int:
        return len(self._values())


class ConfigList(_Node, Sequence[Any]):
    """A ListConfig, likewise."""

    def _values(self) -> Sequence[Any]:
        content = self._state.get("_content")
        return content if isinstance(content, (list, tuple)) else ()

    def __getitem__(self, index: Any) -> Any:
        found = self._values()[index]
        return [_plain(item) for item in found] if isinstance(index, slice) else _plain(found)

    def __len__(self) -> int:
        return len(self._values())


def _plain(value: Any) -> Any:
    """The value of a node, or the value itself."""
    if isinstance(value, _Node) and not isinstance(value, (ConfigMap, ConfigList)):
        return value._state.get("_val")
    return value


@dataclass(frozen=True)
class _Dtype:
    numpy: np.dtype[Any]
    is_bfloat16: bool = False


_DTYPES = {
    "DoubleStorage": _Dtype(np.dtype("<f8")),
    "FloatStorage": _Dtype(np.dtype("<f4")),
    "HalfStorage": _Dtype(np.dtype("<f2")),
    "BFloat16Storage": _Dtype(np.dtype("<u2"), is_bfloat16=True),
    "LongStorage": _Dtype(np.dtype("<i8")),
    "IntStorage": _Dtype(np.dtype("<i4")),
    "ShortStorage": _Dtype(np.dtype("<i2")),
    "CharStorage": _Dtype(np.dtype("i1")),
    "ByteStorage": _Dtype(np.dtype("u1")),
    "BoolStorage": _Dtype(np.dtype("?")),
}


@dataclass(frozen=True)
class _Storage:
    dtype: _Dtype
    values: npt.NDArray[Any]


def load(path: str | PathLike[str]) -> Any:
    """The saved objects: dictionaries, lists and numbers, with numpy arrays for tensors.

    Configurations of OmegaConf are mappings and sequences. bfloat16 becomes float32. Raises `CheckpointError` if
    the file cannot be read.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            return _load(archive)
    except CheckpointError as error:
        raise CheckpointError(f"{path}: {error}") from error
    except zipfile.BadZipFile as error:
        reason = "save it with PyTorch 1.6 or later, or copy it again"
        raise CheckpointError(f"{path} is not a zip archive ({error}): {reason}") from error
    except OSError as error:
        raise CheckpointError(f"cannot read {path}: {error}") from error
    except (pickle.UnpicklingError, EOFError, ValueError, TypeError, KeyError, IndexError) as error:
        raise CheckpointError(f"{path}: its pickle is damaged: {error!r}") from error
    except (AttributeError, OverflowError, RecursionError, NotImplementedError) as error:
        raise CheckpointError(f"{path}: its pickle is damaged: {error!r}") from error


def _load(archive: zipfile.ZipFile) -> Any:
    names = [name for name in archive.namelist() if name.rpartition("/")[2] == "data.pkl"]
    if len(names) != 1:
        raise CheckpointError(f"it has {len(names)} files data.pkl, not one, so torch.save did not write it")
    folder = names[0].removesuffix("data.pkl")
    if f"{folder}byteorder" in archive.namelist():
        order = _read(archive, f"{folder}byteorder")
        if order != b"little":
            raise CheckpointError(f"its byte order is {order!r}; only little-endian files can be read")
    if archive.getinfo(names[0]).file_size > PICKLE_BYTES:
        raise CheckpointError(f"its pickle is larger than {PICKLE_BYTES} bytes")
    with archive.open(names[0]) as file:
        return _Unpickler(file, archive, folder).load()


def _read(archive: zipfile.ZipFile, name: str) -> bytes:
    try:
        info = archive.getinfo(name)
    except KeyError as error:
        raise CheckpointError(f"{name} is missing") from error
    # torch.save never compresses. Data that is only stored cannot be larger than the file.
    if info.compress_type != zipfile.ZIP_STORED:
        raise CheckpointError(f"{name} is compressed, so torch.save did not write it")
    return archive.read(name)


class _Unpickler(pickle.Unpickler):
    def __init__(self, file: Any, archive: zipfile.ZipFile, folder: str) -> None:
        super().__init__(file, encoding="utf-8")
        self._archive = archive
        self._folder = folder
        self._storages: dict[str, _Storage] = {}

    def find_class(self, module: str, name: str) -> Any:
        if (module, name) == ("collections", "OrderedDict"):
            return collections.OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return _rebuild_tensor
        if (module, name) == ("torch._utils", "_rebuild_parameter"):
            return _rebuild_parameter
        if (module, name) == ("torch", "Size"):
            return tuple
        if module == "torch" and name in _DTYPES:
            return _DTYPES[name]
        if module.partition(".")[0] == "omegaconf" and name == "DictConfig":
            return ConfigMap
        if module.partition(".")[0] == "omegaconf" and name == "ListConfig":
            return ConfigList
        if module == "omegaconf.nodes":
            return _Node
        # A class and not an instance, because a pickle can also create objects with NEWOBJ.
        return type(name, (Opaque,), {})

    def persistent_load(self, pid: Any) -> _Storage:
        match pid:
            case ("storage", _Dtype() as dtype, str(key), _, int(_)):
                if key not in self._storages:
                    values = _read(self._archive, f"{self._folder}data/{key}")
                    size = dtype.numpy.itemsize
                    whole = values[: len(values) // size * size]
                    self._storages[key] = _Storage(dtype, np.frombuffer(whole, dtype.numpy))
                return self._storages[key]
        raise CheckpointError(f"it refers to a tensor's bytes as {pid!r}")


def _rebuild_tensor(
    storage: _Storage, offset: int, size: tuple[int, ...], stride: tuple[int, ...], *_: object
) -> npt.NDArray[Any]:
    numbers = [offset, *size, *stride]
    if not all(isinstance(number, int) and number >= 0 for number in numbers):
        raise CheckpointError(f"a tensor of size {size}, stride {stride}, offset {offset}")
    count = math.prod(size)
    held = len(storage.values)
    last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True))
    # A stride of 0 could make a huge tensor from a few numbers.
    if count > held or (count > 0 and last >= held):
        raise CheckpointError(f"a tensor of size {size} in {held} numbers")
    if count == 0:
        values = np.empty(size, storage.values.dtype)
    else:
        steps = [step * storage.values.itemsize for step in stride]
        values = np.lib.stride_tricks.as_strided(storage.values[offset:], size, steps)
    if storage.dtype.is_bfloat16:
        return (values.astype("<u4") << 16).view("<f4")
    return values


def _rebuild_parameter(data: npt.NDArray[Any], *_: object) -> npt.NDArray[Any]:
    return data
