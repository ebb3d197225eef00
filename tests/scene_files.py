"""Small FBX and glTF files, sound and otherwise."""

import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

PIECE = 8 << 20  # bytes
MAGIC = b"Kaydara FBX Binary  \0\x1a\0"


def text(words: bytes) -> bytes:
    """A text as a value of a record."""
    return b"S" + struct.pack("<I", len(words)) + words


def number(value: int) -> bytes:
    """A whole number as a value of a record."""
    return b"L" + struct.pack("<q", value)


def zeros(count: int, claimed: int | None = None) -> bytes:
    """An array of doubles, compressed; `claimed`: the number that it pretends to have."""
    data = deflated_zeros(8 * count)
    return b"d" + struct.pack("<III", count if claimed is None else claimed, 1, len(data)) + data


def deflated_zeros(size: int) -> bytes:
    """So many zeros in zlib's format: one compressed piece again and again, for a gigabyte takes seconds to compress."""
    piece, rest = (zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS) for _ in range(2))
    again = piece.compress(bytes(PIECE)) + piece.flush(zlib.Z_FULL_FLUSH)
    end = rest.compress(bytes(size % PIECE)) + rest.flush()
    checksum = (size % 65521) << 16 | 1  # Adler-32
    return b"\x78\xda" + size // PIECE * again + end + checksum.to_bytes(4, "big")


def record(name: bytes, values: list[bytes], inner: list[Any] | None = None, claimed: int | None = None) -> list[Any]:
    """A record; `claimed`: the number of values that it pretends to have."""
    return [name, values, inner or [], len(values) if claimed is None else claimed]


def model(uid: int) -> list[Any]:
    return record(b"Model", [number(uid), text(b"n%d\0\1Model" % uid), text(b"Null")])


def packed(node: list[Any], at: int, head: str) -> bytes:
    """The bytes of a record that begins at `at`."""
    name, values, inner, claimed = node
    body = name + b"".join(values)
    start = at + struct.calcsize(head) + len(body)
    records = b""
    for one in inner:
        records += packed(one, start + len(records), head)
    records += b"\0" * struct.calcsize(head) if inner else b""
    return struct.pack(head, start + len(records), claimed, len(body) - len(name), len(name)) + body + records


def write_fbx(path: Path, objects: list[Any], version: int = 7400, joined: Sequence[tuple[int, int]] = ((1, 0),)) -> Path:
    """A file with those objects and connections (of child and parent), for Blender's importer, too."""
    scale = [text(b"UnitScaleFactor"), text(b"double"), text(b"Number"), text(b""), b"D" + struct.pack("<d", 1.0)]
    settings = record(b"GlobalSettings", [], [record(b"Properties70", [], [record(b"P", scale)])])
    connections = record(b"Connections", [], [record(b"C", [text(b"OO"), number(a), number(b)]) for a, b in joined])
    data, head = MAGIC + struct.pack("<I", version), "<QQQB" if version >= 7500 else "<IIIB"
    for top in (settings, record(b"Objects", [], objects), connections):
        data += packed(top, len(data), head)
    path.write_bytes(data + b"\0" * (struct.calcsize(head) + 200))
    return path


def write_gltf(path: Path, **parts: Any) -> Path:
    """A .glb (binary) or .gltf file with a node, a mesh of three points, and `parts` of the table changed."""
    table = {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"name": "a", "mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"componentType": 5126, "count": 3, "type": "VEC3", "bufferView": 0}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}], "buffers": [{"byteLength": 36}],
    } | parts  # fmt: skip
    data = json.dumps(table).encode()
    if path.suffix == ".gltf":
        path.write_bytes(data)
        return path
    data += b" " * (-len(data) % 4)
    points = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
    body = struct.pack("<I4s", len(data), b"JSON") + data + struct.pack("<I4s", len(points), b"BIN\0") + points
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(body)) + body)
    return path
