"""Small ONNX files, written by hand (onnx.proto3), that find coloured dots, in the layouts of pose networks."""

import struct
from collections.abc import Sequence
from itertools import product

import numpy as np

DIRECTIONS = [np.array(d) / np.linalg.norm(d) for d in product((-1, 0, 1), repeat=3) if any(d)]
DIRECTIONS = [d for d in DIRECTIONS if d.sum() > -0.8]  # unlike the black beyond an image
COLOURS = [127.5 + 127 * d for d in DIRECTIONS]  # RGB of the dots of the first points
SEEN = len(COLOURS)
LEAST = 0.85  # cosine between the colours of two dots: less than this
MEAN, STANDARD = np.array([123.675, 116.28, 103.53]), np.array([58.395, 57.12, 57.375])
RADIUS = 4  # of the window that averages
Shape = Sequence[int | str]


def drawn(size_px: tuple[int, int], xy_px: np.ndarray, radius_px: float = 3.0) -> np.ndarray:
    """A picture (h, w, 3) float32 with dots at points (K, 2); NaN: none."""
    y, x = np.mgrid[0 : size_px[1], 0 : size_px[0]]
    picture = np.full((*x.shape, 3), 127.5)
    for at, colour in zip(xy_px, COLOURS):
        if np.isfinite(at).all():
            cover = np.clip(radius_px + 0.5 - np.hypot(x - at[0], y - at[1]), 0, 1)[..., None]
            picture = picture * (1 - cover) + colour * cover
    return picture.astype(np.float32)


def pose_graph(layout: str, count: int, size_px: tuple[int, int], *, batch: int | str = 1, seen: int = SEEN) -> bytes:
    """A network that sees the dots of the first points, `seen` of them: "heat maps", "simcc" or "mediapipe"."""
    width, height = size_px
    rows = [(LEAST, DIRECTIONS[k]) if k < seen else (9.0, DIRECTIONS[0]) for k in range(count)]
    if layout == "mediapipe":  # the image is divided by 255
        w, b = np.array([2 * d for _, d in rows]), np.array([-d.sum() - least for least, d in rows])
    else:
        w = np.array([d * STANDARD / 127.5 for _, d in rows])
        b = np.array([d @ (MEAN / 127.5 - 1) - least for least, d in rows])
    g = np.exp(-0.5 * (np.arange(-RADIUS, RADIUS + 1) / 2.0) ** 2)
    window = np.broadcast_to(np.outer(g, g) / g.sum() ** 2, (count, 1, len(g), len(g)))
    weights = {"w": (w / (1 - LEAST))[..., None, None], "b": b / (1 - LEAST), "window": window}
    step = 4 if layout == "heat maps" else 1
    maps = [
        _node("Conv", ["seen", "w", "b"], "points", kernel_shape=[1, 1]),
        _node("Relu", ["points"], "positive"),
        _node("Conv", ["positive", "window"], "maps", kernel_shape=[len(g)] * 2, pads=[RADIUS] * 4, strides=[step] * 2, group=count),
    ]
    if layout == "heat maps":
        nodes = [_node("Identity", ["image"], "seen"), *maps]
        return _model(nodes, (batch, 3, height, width), {"maps": (batch, count, height // step, width // step)}, weights)
    if layout == "simcc":
        reduced = [_node("ReduceMax", ["maps"], f"along_{a}", axes=[axis], keepdims=0) for a, axis in (("x", 2), ("y", 3))]
        nodes = [_node("Identity", ["image"], "seen"), *maps, *reduced]
        return _model(nodes, (batch, 3, height, width), {"along_x": (batch, count, width), "along_y": (batch, count, height)}, weights)
    y, x = np.mgrid[0:height, 0:width].reshape(2, -1)
    table = np.stack([x, y, 0 * x, 0 * x + 6, 0 * x + 6], axis=1).astype(float)
    weights |= {"flat": np.array([1, count, width * height]), "long": np.array([1, 5 * count]), "table": table, "sharp": np.array([60.0])}
    weights |= {"one": np.array([[0.9]]), "zero": np.array([[0.0]] * 5 * count)}
    nodes = [
        _node("Transpose", ["image"], "seen", perm=[0, 3, 1, 2]),
        *maps,
        _node("Reshape", ["maps", "flat"], "rows"),
        _node("Mul", ["rows", "sharp"], "sharper"),
        _node("Softmax", ["sharper"], "shares", axis=2),
        _node("MatMul", ["shares", "table"], "numbers"),
        _node("Reshape", ["numbers", "long"], "landmarks"),
        _node("MatMul", ["landmarks", "zero"], "nothing"),
        _node("Add", ["nothing", "one"], "person"),
    ]
    return _model(nodes, (1, height, width, 3), {"landmarks": (1, 5 * count), "person": (1, 1)}, weights)


def tiny_graph(shape: Shape, *, inputs: int = 1, outputs: int = 1) -> bytes:
    """A network of one or more inputs that returns the first as it is."""
    nodes = [_node("Relu", ["image"], f"out{i}") for i in range(outputs)]
    graph = b"".join(_field(1, n) for n in nodes) + _field(2, "g")
    graph += b"".join(_field(11, _value("image" if i == 0 else f"more{i}", shape)) for i in range(inputs))
    return _whole(graph + b"".join(_field(12, _value(f"out{i}", shape)) for i in range(outputs)))


def constant_maps(value: float) -> bytes:
    """A network whose heat maps are `value` everywhere."""
    weights = {"w": np.zeros((17, 3, 1, 1)), "value": np.array([value])}
    nodes = [_node("Conv", ["image", "w"], "points", kernel_shape=[1, 1]), _node("Add", ["points", "value"], "maps")]
    return _model(nodes, (1, 3, 64, 48), {"maps": (1, 17, 64, 48)}, weights)


def external_graph(location: str, *, parts: int = 1, branch: bool = False) -> bytes:
    """A network whose weights are in another file; they stand in another part of the model, or in a branch of its graph."""
    weights = b"".join(_field(1, n) for n in (17, 3, 1, 1)) + _field(2, 1) + _field(8, "w")
    weights = _field(5, weights + _field(13, _field(1, "location") + _field(2, location)) + _field(14, 1))
    if branch:
        weights = _field(1, _field(4, "If") + _field(5, _field(1, "then_branch") + _field(6, weights) + _field(20, 5)))
    graph = _field(1, _node("Conv", ["image", "w"], "maps", kernel_shape=[1, 1])) + _field(2, "g")
    graph += _field(11, _value("image", (1, 3, 64, 48))) + _field(12, _value("maps", (1, 17, 64, 48)))
    return _whole(graph) + _field(7, weights) if parts > 1 else _whole(graph + weights)


def greedy_graph(factor: float) -> bytes:
    """A network that needs `factor` numbers more where the image is not black in its colours."""
    weights = {"w": np.ones((17, 3, 1, 1)), "factor": np.array([factor]), "one": np.array([1.0]), "flat": np.array([1])}
    nodes = [
        _node("Conv", ["image", "w"], "points", kernel_shape=[1, 1]),
        _node("ReduceMax", ["image"], "most", axes=[0, 1, 2, 3], keepdims=1),
        _node("Abs", ["most"], "size"),
        _node("Mul", ["size", "factor"], "larger"),
        _node("Add", ["larger", "one"], "positive"),
        _node("Cast", ["positive"], "whole", to=7),
        _node("Reshape", ["whole", "flat"], "count"),
        _node("Expand", ["one", "count"], "many"),
        _node("ReduceMax", ["many"], "least", axes=[0], keepdims=1),
        _node("Add", ["points", "least"], "maps"),
    ]
    return _model(nodes, (1, 3, 64, 48), {"maps": (1, 17, 64, 48)}, weights)


def costly_graph(copies: int, layers: int) -> bytes:
    """A network of a few kilobytes that makes so many copies of its maps, and looks over them so many times."""
    weights = {"w": np.ones((17, 3, 1, 1)), "copies": np.array([copies, 17, 64, 48])}
    nodes = [_node("Conv", ["image", "w"], "points", kernel_shape=[1, 1]), _node("Expand", ["points", "copies"], "many")]
    nodes += [_node("Relu", ["many" if i == 0 else f"layer{i - 1}"], f"layer{i}") for i in range(layers)]
    nodes.append(_node("ReduceMax", [f"layer{layers - 1}" if layers else "many"], "maps", axes=[0], keepdims=1))
    return _model(nodes, (1, 3, 64, 48), {"maps": (1, 17, 64, 48)}, weights)


def _model(nodes: list[bytes], image: Shape, outputs: dict[str, Shape], weights: dict[str, np.ndarray]) -> bytes:
    graph = b"".join(_field(1, n) for n in nodes) + _field(2, "g") + b"".join(_field(5, _tensor(k, v)) for k, v in weights.items())
    return _whole(graph + _field(11, _value("image", image)) + b"".join(_field(12, _value(k, s)) for k, s in outputs.items()))


def _whole(graph: bytes) -> bytes:
    return _field(1, 8) + _field(7, graph) + _field(8, _field(1, "") + _field(2, 13))


def _node(op: str, inputs: list[str], output: str, **attributes: int | list[int]) -> bytes:
    said = b"".join(_field(1, i) for i in inputs) + _field(2, output) + _field(3, output) + _field(4, op)
    for name, value in attributes.items():
        one = _field(3, value) + _field(20, 2) if isinstance(value, int) else b"".join(_field(8, v) for v in value) + _field(20, 7)
        said += _field(5, _field(1, name) + one)
    return said


def _tensor(name: str, values: np.ndarray) -> bytes:
    whole = values.dtype.kind == "i"
    data = np.ascontiguousarray(values).astype("<i8" if whole else "<f4").tobytes()
    return b"".join(_field(1, n) for n in values.shape) + _field(2, 7 if whole else 1) + _field(8, name) + _field(9, data)


def _value(name: str, shape: Shape) -> bytes:
    sizes = b"".join(_field(1, _field(2, n) if isinstance(n, str) else _field(1, n)) for n in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, 1) + _field(2, sizes)))


def _field(number: int, value: int | str | bytes) -> bytes:
    if isinstance(value, int):
        return _varint(number << 3) + _varint(value)
    data = value.encode() if isinstance(value, str) else value
    return _varint(number << 3 | 2) + _varint(len(data)) + data


def _varint(value: int) -> bytes:
    rest = struct.unpack("<Q", struct.pack("<q", value))[0]
    found = bytearray()
    while rest > 127:
        found.append(rest & 127 | 128)
        rest >>= 7
    return bytes([*found, rest])
