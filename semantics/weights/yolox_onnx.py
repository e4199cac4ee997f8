"""The published YOLOX-Nano ONNX file as weights of this project's network.

An ONNX file is a Protocol Buffers message. The few fields that hold convolutions and their weights
are read here, so that no package is needed for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from bmask_slam.graph.errors import InputError
from bmask_slam.graph.files.reading import in_short, read_bytes
from bmask_slam.semantics.network.yolox.layers import convolutions
from bmask_slam.semantics.network.yolox.network import YoloxNano

MODEL_GRAPH, GRAPH_NODE, GRAPH_WEIGHTS = 7, 1, 5
NODE_INPUT, NODE_OPERATION = 1, 4
TENSOR_SIZE, TENSOR_TYPE, TENSOR_NAME, TENSOR_BYTES = 1, 2, 8, 9
FLOAT = 1
"""Numbers of the fields, and of the type, in onnx.proto."""
_VARINT, _FIXED_64, _BYTES, _FIXED_32 = 0, 1, 2, 5
_VARINT_BYTES = 10
"""Of the longest number, which has 64 bits."""
_FOCUS_SHAPE = (16, 12, 3, 3)
"""Of the published first layer's weights."""


@dataclass(frozen=True)
class _Field:
    """A field of a message: a number, or the bytes of a text, an array or another message."""

    number: int
    value: int | memoryview


def load_onnx(path: Path) -> YoloxNano:
    """The network with the weights of the ONNX file, in evaluation mode.

    Raises:
        InputError: no such file, or not YOLOX-Nano for 80 classes with batch norm folded.
    """
    data = read_bytes(path, "give the published yolox_nano.onnx")
    try:
        found = _convolutions(memoryview(data))
    except (IndexError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: not an ONNX file that can be read ({in_short(error)}); get it again"
        ) from error
    with torch.device("meta"):
        model = YoloxNano()
    expected = convolutions(model)
    if len(found) == len(expected) and found[0][0].shape == _FOCUS_SHAPE:
        found[0] = (_with_stride(found[0][0]), found[0][1])
    shapes = [(w.shape, b.shape) for w, b in found]
    if shapes != [(c.weight.shape, c.bias.shape) for c in expected if c.bias is not None]:
        raise InputError(
            f"{path}: {len(found)} convolutions that are not those of YOLOX-Nano; give the "
            "published yolox_nano.onnx"
        )
    for conv, (weight, bias) in zip(expected, found, strict=True):
        conv.weight, conv.bias = (torch.nn.Parameter(part) for part in (weight, bias))
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    return model.eval()


def _with_stride(weight: Tensor) -> Tensor:
    """The first layer (16, 12, 3, 3) as (16, 3, 6, 6) with stride 2, red first.

    Its inputs are the pixels (0, 0), (1, 0), (0, 1) and (1, 1) of each 2x2 block (row, column),
    three channels each, blue first.
    """
    outputs = weight.shape[0]
    blocks = weight.reshape(outputs, 2, 2, 3, 3, 3)  # column, row, channel; kernel's y, x
    return blocks.permute(0, 3, 4, 2, 5, 1).reshape(outputs, 3, 6, 6).flip(1).contiguous()


def _convolutions(file: memoryview) -> list[tuple[Tensor, Tensor]]:
    """Weight and bias of every convolution, in the order in which they run."""
    (graph,) = (f.value for f in _fields(file) if f.number == MODEL_GRAPH)
    weights: dict[str, Tensor] = {}
    inputs: list[list[str]] = []
    for field in _fields(graph):
        if field.number == GRAPH_WEIGHTS:
            weights.update(_tensor(field.value))
        elif field.number == GRAPH_NODE:
            parts = list(_fields(field.value))
            if any(p.number == NODE_OPERATION and _text(p.value) == "Conv" for p in parts):
                inputs.append([_text(p.value) for p in parts if p.number == NODE_INPUT])
    return [(weights[weight], weights[bias]) for _, weight, bias in inputs]


def _tensor(message: int | memoryview) -> dict[str, Tensor]:
    """Name and values of a tensor of floats; nothing for one of another type."""
    fields = list(_fields(message))
    values = {f.number: f.value for f in fields}
    if values[TENSOR_TYPE] != FLOAT or TENSOR_BYTES not in values:
        return {}
    shape = [f.value for f in fields if f.number == TENSOR_SIZE and isinstance(f.value, int)]
    array = np.frombuffer(_bytes(values[TENSOR_BYTES]), "<f4").reshape(shape)
    return {_text(values[TENSOR_NAME]): torch.from_numpy(array.astype(np.float32))}


def _fields(content: int | memoryview) -> Iterator[_Field]:
    message, at = _bytes(content), 0
    while at < len(message):
        key, at = _varint(message, at)
        kind = key & 7
        if kind == _VARINT:
            number, at = _varint(message, at)
            yield _Field(key >> 3, number)
            continue
        if kind == _BYTES:
            size, at = _varint(message, at)
        elif kind in (_FIXED_32, _FIXED_64):
            size = 4 if kind == _FIXED_32 else 8
        else:
            raise ValueError(f"a field of kind {kind}")
        if at + size > len(message):
            raise ValueError("truncated")
        yield _Field(key >> 3, message[at : at + size])
        at += size


def _varint(message: memoryview, at: int) -> tuple[int, int]:
    """A number of seven bits a byte, the lowest first; and where the next field begins."""
    number = 0
    for k in range(_VARINT_BYTES):
        byte = message[at + k]
        number |= (byte & 0x7F) << (7 * k)
        if byte < 0x80:
            return number, at + k + 1
    raise ValueError("a number that does not end")


def _text(value: int | memoryview) -> str:
    return bytes(_bytes(value)).decode()


def _bytes(value: int | memoryview) -> memoryview:
    if isinstance(value, int):
        raise ValueError("a number where a text or a message is expected")
    return value
