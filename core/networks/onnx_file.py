"""What an ONNX file says about its input, read from its protocol buffer; OpenCV does not tell it.

Only four kinds of fields are looked at (onnx.proto3): ModelProto.graph, GraphProto.input and .initializer, and the dimensions of an input.
"""

from collections.abc import Iterator
from pathlib import Path

from ..foundation import bounded
from ..foundation.errors import InputError

ONNX_BYTES = 1 << 30
GRAPH, INITIALIZER, INPUT = 7, 5, 11  # fields of ModelProto and GraphProto
NAME, TYPE = 1, 2  # of ValueInfoProto
TENSOR_NAME = 8  # of TensorProto
VALUE, TEXT = 1, 2  # dim_value and dim_param of a dimension
VARINT, BIT64, BYTES, BIT32 = 0, 1, 2, 5  # wire types
MOST_BITS = 64
Field = tuple[int, int | memoryview]


def read_onnx(path: Path) -> bytes:
    """The content of an ONNX file.

    Raises:
        InputError: it cannot be read, or is too large.
    """
    try:
        return bounded.bytes_of(path, ONNX_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error


def input_shape(data: bytes, path: Path) -> tuple[int, ...]:
    """The sizes of the only input of a network, 0 where it leaves them open. `path` is named in messages.

    Raises:
        InputError: the data are no ONNX file, or have several inputs.
    """
    try:
        shapes = _input_shapes(memoryview(data))
    except ValueError as error:
        raise InputError(f"{path} is no ONNX file, or it is damaged: {error}.") from error
    if len(shapes) != 1:
        raise InputError(f"{path} is a network with {len(shapes)} inputs; give one that takes an image, such as RTMPose's.")
    return shapes[0]


def _input_shapes(data: memoryview) -> list[tuple[int, ...]]:
    """The shapes of the graph's inputs that are no stored weights."""
    graphs = [value for number, value in _fields(data) if number == GRAPH and isinstance(value, memoryview)]
    if not graphs:
        raise ValueError("it has no graph")
    inputs, stored = dict[bytes, tuple[int, ...]](), set[bytes]()
    for number, value in _fields(graphs[0]):
        if isinstance(value, int):
            continue
        if number == INITIALIZER:
            stored |= {bytes(name) for field, name in _fields(value) if field == TENSOR_NAME and isinstance(name, memoryview)}
        elif number == INPUT:
            name, shape = _named_shape(value)
            inputs[name] = shape
    return [shape for name, shape in inputs.items() if name not in stored]


def _named_shape(info: memoryview) -> tuple[bytes, tuple[int, ...]]:
    name, shape = b"", list[int]()
    for number, value in _fields(info):
        if number == NAME and isinstance(value, memoryview):
            name = bytes(value)
        elif number == TYPE and isinstance(value, memoryview):
            for tensor in _inner(value, 1):
                for sizes in _inner(tensor, 2):
                    for size in _inner(sizes, 1):
                        given = [n for field, n in _fields(size) if field == VALUE and isinstance(n, int)]
                        shape.append(given[0] if given else 0)
    return name, tuple(shape)


def _inner(data: memoryview, number: int) -> list[memoryview]:
    """The messages in a field of a message."""
    return [value for field, value in _fields(data) if field == number and isinstance(value, memoryview)]


def _fields(data: memoryview) -> Iterator[Field]:
    """The fields of a message: their numbers, and their numbers or bytes."""
    at = 0
    while at < len(data):
        key, at = _varint(data, at)
        kind = key & 7
        if kind == VARINT:
            value, at = _varint(data, at)
            yield key >> 3, value
            continue
        size = {BIT64: 8, BIT32: 4}.get(kind, -1)
        if kind == BYTES:
            size, at = _varint(data, at)
        if size < 0 or at + size > len(data):
            raise ValueError("a field goes beyond its end")
        yield key >> 3, data[at : at + size]
        at += size


def _varint(data: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, MOST_BITS, 7):
        if at >= len(data):
            break
        value |= (data[at] & 127) << shift
        at += 1
        if data[at - 1] < 128:
            return value, at
    raise ValueError("a number has no end")
