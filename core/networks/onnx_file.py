"""What an ONNX file says about its input, how many nodes it has, and whether it names other files, read from its protocol buffer; OpenCV
does not tell it, and reads weights from any file of the system that a network names.

Only a few fields are looked at (onnx.proto3): those of INSIDE, and of an input the dimensions. A field that may be there once, such as
ModelProto.graph, may be there in several parts, which readers put together.
"""

from collections.abc import Iterator
from pathlib import Path

from ..foundation import bounded
from ..foundation.errors import InputError

ONNX_BYTES = 1 << 30
MOST_NODES = 10_000  # ten times as many as pose networks have; OpenCV needs 20 µs for one, with every image
MOST_MESSAGES = 100_000  # nodes, their attributes, tensors, and inputs
GRAPH, INITIALIZER, INPUT = 7, 5, 11  # fields of ModelProto and GraphProto
NAME, TYPE = 1, 2  # of ValueInfoProto
TENSOR_NAME, EXTERNAL_DATA, DATA_LOCATION = 8, 13, 14  # of TensorProto
INSIDE: dict[str, dict[int, str]] = {  # the messages in which there may be tensors, by their fields
    "model": {GRAPH: "graph", 20: "training", 25: "function"},
    "training": {1: "graph", 2: "graph"},
    "function": {7: "node", 11: "attribute"},
    "graph": {1: "node", INITIALIZER: "tensor", INPUT: "input", 15: "sparse"},
    "input": {},
    "node": {5: "attribute"},
    "attribute": {5: "tensor", 6: "graph", 10: "tensor", 11: "graph", 22: "sparse", 23: "sparse"},
    "sparse": {1: "tensor", 2: "tensor"},
}
LARGEST_FIELD = (1 << 29) - 1  # number of a field
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
        InputError: the data are no ONNX file, have several inputs or too many nodes, or name other files.
    """
    try:
        external, nodes = _inside(memoryview(data))
        shapes = _input_shapes(memoryview(data)) if nodes <= MOST_NODES else []
    except ValueError as error:
        raise InputError(f"{path} is no ONNX file, or it is damaged: {error}.") from error
    if external:
        raise InputError(f"{path} has its weights in other files; save the network as one file, without external data.")
    if nodes > MOST_NODES:
        raise InputError(f"{path} is a network of more than {MOST_NODES} nodes; use a smaller one.")
    if len(shapes) != 1:
        raise InputError(f"{path} is a network with {len(shapes)} inputs; give one that takes an image, such as RTMPose's.")
    return shapes[0]


def _input_shapes(data: memoryview) -> list[tuple[int, ...]]:
    """The shapes of the graph's inputs that are no stored weights."""
    graphs = [value for number, value in _fields(data) if number == GRAPH and isinstance(value, memoryview)]
    if not graphs:
        raise ValueError("it has no graph")
    inputs, stored = dict[bytes, tuple[int, ...]](), set[bytes]()
    for number, value in (field for graph in graphs for field in _fields(graph)):
        if isinstance(value, int):
            continue
        if number == INITIALIZER:
            stored |= {bytes(name) for field, name in _fields(value) if field == TENSOR_NAME and isinstance(name, memoryview)}
        elif number == INPUT:
            name, shape = _named_shape(value)
            inputs[name] = shape
    return [shape for name, shape in inputs.items() if name not in stored]


def _inside(model: memoryview) -> tuple[bool, int]:
    """Whether any tensor of a network is in another file, and how many nodes there are, those in other nodes included; more than MOST_NODES
    are not counted.

    Raises:
        ValueError: it is damaged, or has more than MOST_MESSAGES parts.
    """
    waiting, external, nodes, messages = [("model", model)], False, 0, 0
    while waiting and nodes <= MOST_NODES:
        kind, message = waiting.pop()
        nodes += kind == "node"
        for number, value in _fields(message):
            if kind == "tensor":
                external |= number in (EXTERNAL_DATA, DATA_LOCATION) and bool(value)
            elif isinstance(value, memoryview) and (inner := INSIDE[kind].get(number)):
                waiting.append((inner, value))
                messages += 1
                if messages > MOST_MESSAGES:
                    raise ValueError(f"it has more than {MOST_MESSAGES} nodes, tensors and inputs")
    return external, nodes


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
        key, at = (data[at], at + 1) if data[at] < 128 else _varint(data, at)
        kind = key & 7
        if not 0 < key >> 3 <= LARGEST_FIELD:
            raise ValueError("a field has no number")
        if kind == VARINT:
            value, at = (data[at], at + 1) if at < len(data) and data[at] < 128 else _varint(data, at)
            yield key >> 3, value
            continue
        size = {BIT64: 8, BIT32: 4}.get(kind, -1)
        if kind == BYTES:
            size, at = (data[at], at + 1) if at < len(data) and data[at] < 128 else _varint(data, at)
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
