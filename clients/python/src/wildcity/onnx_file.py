"""Writes a graph in the ONNX format: only what the exporters need, so that they need no package for it.

A file is a message of Protocol Buffers, whose field numbers are those of onnx.proto3 (onnx/onnx, version 1.16).
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Graph"]

IR_VERSION = 8
"""Of the format. onnxruntime reads it from version 1.10 on."""

_ELEMENTS = {"float32": 1, "int64": 7}
# Of AttributeProto.
_FLOAT, _INT, _INTS = 1, 2, 7


@dataclass
class Graph:
    """A graph while it is written: nodes in the order in which they run."""

    name: str
    opset: int = 17
    _parts: list[bytes] = field(default_factory=list)
    _names: set[str] = field(default_factory=set)

    def input(self, name: str, shape: Sequence[str | int]) -> str:
        """An input of f32. shape: numbers, and names of sizes that are not fixed."""
        self._parts.append(_field(11, _port(name, shape)))
        return name

    def output(self, name: str, shape: Sequence[str | int]) -> None:
        """An output of f32."""
        self._parts.append(_field(12, _port(name, shape)))

    def constant(self, name: str, values: npt.NDArray[Any]) -> str:
        """An array of f32 or i64, written once for each name."""
        if name not in self._names:
            self._names.add(name)
            little = values.dtype.newbyteorder("<")
            dims = b"".join(_field(1, side) for side in values.shape)
            kind = _field(2, _ELEMENTS[values.dtype.name])
            raw = np.ascontiguousarray(values, little).tobytes()
            self._parts.append(_field(5, dims + kind + _field(8, name) + _field(9, raw)))
        return name

    def node(self, kind: str, name: str, inputs: Iterable[str], **attributes: float | int | list[int]) -> str:
        """An operator with one output, which has the node's name."""
        return self.nodes(kind, [name], inputs, **attributes)[0]

    def nodes(
        self, kind: str, outputs: Sequence[str], inputs: Iterable[str], **attributes: float | int | list[int]
    ) -> Sequence[str]:
        """An operator with several outputs. It has the name of the first."""
        parts = [_field(1, name) for name in inputs] + [_field(2, name) for name in outputs]
        parts += [_field(3, outputs[0]), _field(4, kind)]
        parts += [_field(5, _attribute(name, value)) for name, value in attributes.items()]
        self._parts.append(_field(1, b"".join(parts)))
        return outputs

    def content(self) -> bytes:
        """The file."""
        graph = b"".join(self._parts) + _field(2, self.name)
        opset = _field(1, "") + _field(2, self.opset)
        return _field(1, IR_VERSION) + _field(2, "wildcity") + _field(7, graph) + _field(8, opset)


def _port(name: str, shape: Sequence[str | int]) -> bytes:
    dims = [_field(1, _field(1 if isinstance(side, int) else 2, side)) for side in shape]
    tensor = _field(1, _ELEMENTS["float32"]) + _field(2, b"".join(dims))
    return _field(1, name) + _field(2, _field(1, tensor))


def _attribute(name: str, value: float | int | list[int]) -> bytes:
    if isinstance(value, float):
        # f is a fixed32: wire type 5.
        return _field(1, name) + _varint(2 << 3 | 5) + struct.pack("<f", value) + _field(20, _FLOAT)
    if isinstance(value, int):
        return _field(1, name) + _field(3, value) + _field(20, _INT)
    return _field(1, name) + b"".join(_field(8, one) for one in value) + _field(20, _INTS)


def _field(number: int, value: str | bytes | int) -> bytes:
    """A field of a message: a number, or text or bytes with their length."""
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    if isinstance(value, str):
        value = value.encode()
    return _varint(number << 3 | 2) + _varint(len(value)) + value


def _varint(value: int) -> bytes:
    """Seven bits a byte, the lowest first. Negative numbers do not occur."""
    low = []
    while value > 127:
        low.append(value & 127 | 128)
        value >>= 7
    return bytes([*low, value])
