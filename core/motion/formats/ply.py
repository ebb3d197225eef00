"""PLY files, binary little-endian: clouds and meshes, written atomically; input is validated.

A cloud has the vertex properties x y z [m], sigma [m], nx ny nz and intensity, all float32, and optionally two uchars: rays, the number
of views in which each point was measured, and extended, 1 where it was measured from the surface of its neighbours. A mesh has x y z and
faces, each a list (uchar count, int indices). World coordinates.
Format: G. Turk, The PLY Polygon File Format, 1994.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError

KINDS = {
    "char": "i1",
    "int8": "i1",
    "uchar": "u1",
    "uint8": "u1",
    "short": "<i2",
    "int16": "<i2",
    "ushort": "<u2",
    "uint16": "<u2",
    "int": "<i4",
    "int32": "<i4",
    "uint": "<u4",
    "uint32": "<u4",
    "float": "<f4",
    "float32": "<f4",
    "double": "<f8",
    "float64": "<f8",
}
LONGEST_HEADER = 65536
LINES_AFTER = 64  # bytes behind the last element that may be line ends only
END = b"end_header\n"


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Ply:
    """The content of a PLY file: vertex properties by name, each (N,), in the file's types, and faces (F, K) of vertex indices;
    −1 fills the rows of faces with fewer corners than the largest."""

    vertex: Mapping[str, np.ndarray]
    faces: np.ndarray = field(default_factory=lambda: np.zeros((0, 3), dtype=np.int64))

    @property
    def xyz_m(self) -> np.ndarray:
        """Positions (N, 3), float64."""
        return np.stack([self.vertex[axis] for axis in "xyz"], axis=1).astype(np.float64)

    @property
    def triangles(self) -> np.ndarray:
        """The faces as triangles (M, 3), fanned from their first corners."""
        fans = [np.stack([self.faces[:, 0], self.faces[:, k], self.faces[:, k + 1]], axis=1) for k in range(1, self.faces.shape[1] - 1)]
        if not fans:
            return np.zeros((0, 3), dtype=np.int64)
        every = np.stack(fans, axis=1).reshape(-1, 3)
        return every[every.min(axis=1) >= 0]


def write_cloud(
    path: Path,
    *,
    xyz_m: np.ndarray,
    sigma_m: np.ndarray,
    normals: np.ndarray,
    intensity: np.ndarray,
    rays: np.ndarray | None = None,
    extended: np.ndarray | None = None,
) -> None:
    """Write a cloud of N points: positions (N, 3), their mean sigma (N,), unit normals (N, 3), grey values (N,), numbers of rays (N,), and
    which points are extended (N,).

    Raises:
        InputError: the file cannot be written.
    """
    names = ("x", "y", "z", "sigma", "nx", "ny", "nz", "intensity")
    columns = dict(zip(names, np.column_stack([xyz_m, sigma_m, normals, intensity]).astype("<f4").T))
    more = {"rays": rays, "extended": extended}
    _write_points(path, columns | {name: np.asarray(values, dtype=np.uint8) for name, values in more.items() if values is not None})


def write_tracked(path: Path, *, xyz_m: np.ndarray, sigma_m: np.ndarray, velocity_m_s: np.ndarray, track: np.ndarray) -> None:
    """Write N tracked points: positions (N, 3), their sigma (N,), velocities (N, 3), numbers of their trajectories (N,).

    Raises:
        InputError: the file cannot be written.
    """
    names = ("x", "y", "z", "sigma", "vx", "vy", "vz")
    columns = dict(zip(names, np.column_stack([xyz_m, sigma_m, velocity_m_s]).astype("<f4").T))
    _write_points(path, columns | {"track": np.asarray(track, dtype="<i4")})


WRITTEN = {"f": "float", "i": "int", "u": "uchar"}  # PLY's names of the numbers in columns, by numpy's kind


def _write_points(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Columns (N,) of 4-byte numbers or bytes as vertices."""
    rows = np.zeros(len(columns["x"]), dtype=[(name, column.dtype) for name, column in columns.items()])
    for name, column in columns.items():
        rows[name] = column
    kinds = {name: WRITTEN[column.dtype.kind] for name, column in columns.items()}
    store.write_bytes(Path(path), _header(len(rows), kinds) + rows.tobytes())


def write_mesh(path: Path, vertices_m: np.ndarray, faces: np.ndarray) -> None:
    """Write a mesh: vertices (V, 3) and faces (F, K), all with K corners (K at most 255).

    Raises:
        InputError: the file cannot be written.
    """
    vertices, faces = np.asarray(vertices_m).astype("<f4").reshape(-1, 3), np.asarray(faces)
    rows = np.zeros(len(faces), dtype=[("count", "u1"), ("index", "<i4", (faces.shape[1],))])
    rows["count"], rows["index"] = faces.shape[1], faces
    store.write_bytes(Path(path), _header(len(vertices), dict.fromkeys("xyz", "float"), len(faces)) + vertices.tobytes() + rows.tobytes())


def _header(vertices: int, kinds: Mapping[str, str], faces: int | None = None) -> bytes:
    lines = ["ply", "format binary_little_endian 1.0", "comment Tricap, metres", f"element vertex {vertices}"]
    lines += [f"property {kind} {name}" for name, kind in kinds.items()]
    if faces is not None:
        lines += [f"element face {faces}", "property list uchar int vertex_indices"]
    return ("\n".join(lines) + "\n").encode() + END


@dataclass(slots=True)
class _Element:
    name: str
    count: int
    scalars: list[tuple[str, str]] = field(default_factory=list)  # name, numpy type
    index_list: tuple[str, str] | None = None  # types of the count and of the indices


def read_ply(path: Path) -> Ply:
    """Read a binary little-endian PLY file.

    Raises:
        InputError: it cannot be read, is not such a file, is not as long as its header says, has vertices without coordinates, or its
            faces name missing vertices.
    """
    try:
        data = bounded.bytes_of(path, bounded.ARRAYS_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    elements, position = _read_header(data, path)
    vertex: dict[str, np.ndarray] = {}
    faces = np.zeros((0, 3), dtype=np.int64)
    for element in elements:
        if element.index_list is not None:
            faces, position = _read_faces(data, position, element, path)
            continue
        rows, position = _take(data, position, np.dtype(element.scalars), element, path)
        if element.name == "vertex":
            vertex = {name: rows[name].copy() for name, _ in element.scalars}
    if not {"x", "y", "z"} <= set(vertex):
        raise InputError(f"{path} has no vertices with x, y and z; export it again as a point cloud or mesh.")
    if data[position : position + LINES_AFTER].strip():
        raise InputError(f"{path} is longer than its header says; it is damaged, export it again.")
    n = len(vertex["x"])
    if not all(np.isfinite(vertex[axis]).all() for axis in "xyz"):
        raise InputError(f"{path} has vertices without coordinates (NaN or infinite); export it without them.")
    if faces.size and faces.max() >= n:
        raise InputError(f"{path} has faces that name vertices beyond its {n}; it is damaged, export it again.")
    return Ply(vertex=vertex, faces=faces)


def _read_header(data: bytes, path: Path) -> tuple[list[_Element], int]:
    if not data.startswith((b"ply\n", b"ply\r\n")):
        raise InputError(f"{path} is not a PLY file; its first line is not “ply”.")
    end = data.find(b"end_header", 0, LONGEST_HEADER)
    start = data.find(b"\n", end) + 1
    if end < 0 or start == 0:
        raise InputError(f"{path} is a PLY file without “end_header”; it is damaged, export it again.")
    elements: list[_Element] = []
    kind = ""
    for line in data[:end].decode("ascii", errors="replace").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            kind = " ".join(words[1:2])
        elif words and words[0] not in ("comment", "obj_info"):
            _declare(words, elements, path)
    if kind != "binary_little_endian":
        raise InputError(f"{path} is a PLY file of format “{kind or 'unknown'}”; export it as binary little-endian.")
    return elements, start


def _declare(words: list[str], elements: list[_Element], path: Path) -> None:
    if words[0] == "element" and len(words) == 3 and words[2].isdecimal() and len(words[2]) < 19:
        elements.append(_Element(words[1], int(words[2])))
        return
    types, element = words[1:-1], elements[-1] if elements else None
    if words[0] != "property" or element is None or not types or words[-1] in dict(element.scalars):
        raise InputError(f"{path} has the line “{' '.join(words)[:80]}” in its PLY header, which makes no sense; export it again.")
    unknown = [t for t in types if t not in KINDS and t != "list"]
    if unknown:
        raise InputError(f"{path} has a property “{words[-1]}” of the unknown type “{unknown[0]}”; export it with float or int.")
    kinds = [KINDS[t] for t in types if t != "list"]
    if types[0] != "list" and len(kinds) == 1 and element.index_list is None:
        element.scalars.append((words[-1], kinds[0]))
    elif (
        types[0] == "list"
        and len(kinds) == 2
        and element.name == "face"
        and not element.scalars
        and element.index_list is None
        and all(k[-2] in "iu" for k in kinds)
    ):
        element.index_list = (kinds[0], kinds[1])
    else:
        raise InputError(
            f"{path} has the property “{words[-1]}” of “{element.name}”, which is not supported;"
            " export vertices with plain properties and faces with one list of indices."
        )


def _take(data: bytes, position: int, kind: np.dtype, element: _Element, path: Path) -> tuple[np.ndarray, int]:
    size = element.count * kind.itemsize
    if position + size > len(data):
        raise InputError(
            f"{path} ends too early: its header promises {element.count} of “{element.name}”, which do not fit in"
            f" {len(data)} bytes; copy or export it again."
        )
    return (np.frombuffer(data, kind, element.count, position) if kind.itemsize else np.zeros(element.count, kind)), position + size


def _read_faces(data: bytes, position: int, element: _Element, path: Path) -> tuple[np.ndarray, int]:
    assert element.index_list is not None
    count_kind, index_kind = (np.dtype(k) for k in element.index_list)
    if element.count == 0:
        return np.zeros((0, 3), dtype=np.int64), position
    first, _ = _take(data, position, count_kind, _Element(element.name, 1), path)
    corners = int(first[0])
    row = np.dtype([("count", count_kind), ("index", index_kind, (max(corners, 0),))])
    if corners >= 3 and position + element.count * row.itemsize <= len(data):
        rows = np.frombuffer(data, row, element.count, position)
        if (rows["count"] == corners).all():
            return _not_negative(rows["index"].astype(np.int64), path), position + rows.nbytes
    return _read_mixed_faces(data, position, element, path)


def _not_negative(indices: np.ndarray, path: Path) -> np.ndarray:
    if indices.min() < 0:
        raise InputError(f"{path} has a face with a negative vertex index; it is damaged, export it again.")
    return indices


def _read_mixed_faces(data: bytes, position: int, element: _Element, path: Path) -> tuple[np.ndarray, int]:
    assert element.index_list is not None
    count_kind, index_kind = (np.dtype(k) for k in element.index_list)
    faces: list[np.ndarray] = []
    for _ in range(element.count):
        corners = int(np.frombuffer(data, count_kind, 1, position)[0]) if position + count_kind.itemsize <= len(data) else 0
        position += count_kind.itemsize
        if corners < 3 or position + corners * index_kind.itemsize > len(data):
            raise InputError(f"{path} is damaged or ends too early after face {len(faces)} of {element.count}; copy or export it again.")
        faces.append(_not_negative(np.frombuffer(data, index_kind, corners, position).astype(np.int64), path))
        position += corners * index_kind.itemsize
    table = np.full((len(faces), max(map(len, faces))), -1, dtype=np.int64)
    for row, face in zip(table, faces, strict=True):
        row[: len(face)] = face
    return table, position
