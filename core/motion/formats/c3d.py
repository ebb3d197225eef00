"""C3D: points over time with residuals, binary (The C3D File Format User Guide, Motion Lab Systems, 2008).

Points and poses of segments are read and written, no analogue channels. The library `c3d` would be one more wheel in the extension, trusts
the counts in a file's header, and leaves sigmas to its user; it serves the tests as an independent reader.

Blocks of 512 bytes: header, parameters (groups and entries with relative pointers), then per frame and point x, y, z and a fourth word:
negative for a missing point, else its low byte times the scale is the residual; here that is the point's sigma, 0 if unknown.
Segments, as Theia3D and Visual3D write them (C-Motion, "ROTATION data type"): the group ROTATION names them, and its block DATA_START has
per frame and segment the 16 numbers of its pose, column by column, and a residual, negative where the pose is unknown.
Frames are numbered from 1 and without gaps: missing frames are written as missing points, and TRICAP:FRAME_OFFSET is the difference of a
take's own frame numbers, which may begin at 0, from the file's.
"""

import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError, damage_of
from ..plausible import check_places, check_span
from .markers import MOST_VALUES, Markers, axes_of, check_size, metres_per

BLOCK = 512
INTEL, DEC, MIPS = 84, 85, 86  # processor types: byte order and floats
RESIDUAL_SCALE_MM = 0.1
LARGEST_SCALE = 1e6  # of the 16-bit numbers, in the file's unit
MOST_WORD = 65535  # of the header's 16-bit numbers
BATCH = 255  # labels in one parameter
POSE = 17  # numbers per segment and frame
Found = TypeVar("Found")


@dataclass(frozen=True, eq=False, kw_only=True)
class Segments:
    """Poses of S rigid segments over T frames; NaN where a pose is unknown."""

    names: tuple[str, ...]
    frames: np.ndarray  # (T,) integer frame numbers
    R: np.ndarray  # (T, S, 3, 3) the columns are the segment's axes in the world
    origin_m: np.ndarray  # (T, S, 3) world


def write_c3d(path: Path, markers: Markers, *, axes: str = "Z up", unit: str = "mm", segments: Segments | None = None) -> None:
    """Write points as float32, sigmas as residuals in steps of 0.1 mm, from 0.1 to 25.5 mm; and the poses of segments in the same frames.

    Raises:
        InputError: axes or unit are not known, the frames go back, are too far apart or too many, or the file cannot be written.
    """
    markers = without_gaps(markers, path)
    per_unit = metres_per(unit, path)
    xyz = markers.xyz_m @ axes_of(axes).T / per_unit
    t, n = xyz.shape[:2]
    scale = RESIDUAL_SCALE_MM * 1e-3 / per_unit
    known = np.isfinite(xyz).all(axis=2)
    steps = np.where(np.isfinite(markers.sigma_m), np.clip(np.round(np.nan_to_num(markers.sigma_m) / per_unit / scale), 1, 255), 0)
    data = np.concatenate([np.where(known[..., None], xyz, 0.0), np.where(known, steps, -1.0)[..., None]], axis=2).astype("<f4")
    first = int(markers.frames[0]) if 1 <= markers.frames[0] and markers.frames[-1] <= MOST_WORD else 1
    last = first + t - 1
    names = segments.names if segments is not None else ()
    start = 2 + len(_parameters(markers, scale, unit, first, names)) // BLOCK
    points = _padded(data.tobytes())
    poses_start = start + len(points) // BLOCK
    if names and poses_start > MOST_WORD:
        raise InputError(
            f"{path} cannot be written: C3D has room for poses after {MOST_WORD * BLOCK / 1e6:.0f} MB of points only; export fewer frames."
        )
    parameters = _parameters(markers, scale, unit, first, names, start, poses_start)
    poses = _poses(segments, markers.frames, axes_of(axes), per_unit) if segments is not None else b""
    header = struct.pack("<BB5HfHHf", 2, 0x50, n, 0, first, min(last, MOST_WORD), 0, -scale, start, 0, markers.fps)
    store.write_bytes(Path(path), header.ljust(BLOCK, b"\0") + parameters + points + poses)


def _poses(segments: Segments, frames: np.ndarray, A: np.ndarray, per_unit: float) -> bytes:
    """The data of the segments in these frames, in the file's axes and unit; frames without a pose are unknown."""
    table = np.full((len(frames), len(segments.names), POSE), np.nan)
    rows = np.rint(segments.frames).astype(np.int64) - frames[0]
    inside = (rows >= 0) & (rows < len(frames))
    pose = np.zeros((int(inside.sum()), len(segments.names), 4, 4))
    pose[..., :3, :3], pose[..., :3, 3], pose[..., 3, 3] = A @ segments.R[inside], segments.origin_m[inside] @ A.T / per_unit, 1.0
    table[rows[inside], :, :16] = np.swapaxes(pose, -1, -2).reshape(*pose.shape[:2], 16)
    table[..., 16] = np.where(np.isfinite(table[..., :16]).all(axis=-1), 0.0, -1.0)
    return _padded(table.astype("<f4").tobytes())


def without_gaps(markers: Markers, where: object) -> Markers:
    """The points with a row for every frame number from the first to the last; points of added frames are missing.

    Raises:
        InputError: the numbers do not increase, or are too far apart.
    """
    steps = np.diff(markers.frames)
    if (steps == 1).all():
        return markers
    check_span(markers.frames[0], markers.frames[-1], len(markers.frames), f"{where} cannot be written: there are points")
    t, n = int(markers.frames[-1] - markers.frames[0]) + 1, len(markers.names)
    if (steps < 1).any() or t * n * 4 > MOST_VALUES:
        raise InputError(
            f"{where} cannot be written: C3D needs every frame from the first to the last, and these ({markers.frames[0]} … "
            f"{markers.frames[-1]}) do not increase or are too far apart; correct the frame numbers."
        )
    xyz, sigma = np.full((t, n, 3), np.nan), np.full((t, n), np.nan)
    rows = markers.frames - markers.frames[0]
    xyz[rows], sigma[rows] = markers.xyz_m, markers.sigma_m
    return replace(markers, frames=markers.frames[0] + np.arange(t), xyz_m=xyz, sigma_m=sigma)


def _padded(data: bytes) -> bytes:
    return data + b"\0" * (-len(data) % BLOCK)


def _parameters(
    markers: Markers, scale: float, unit: str, first: int, segments: tuple[str, ...], start: int = 0, poses_start: int = 0
) -> bytes:
    """The parameters of points without gaps, the first frame having the number `first`, the data beginning in block `start`, and of the
    `segments`, whose data begin in block `poses_start`."""
    t, n = len(markers.frames), len(markers.names)
    last = first + t - 1
    point: list[tuple[str, Any]] = [
        ("USED", np.uint16(n)),
        ("FRAMES", np.uint16(min(t, MOST_WORD))),
        ("DATA_START", np.uint16(start)),
        ("SCALE", np.float32(-scale)),
        ("RATE", np.float32(markers.fps)),
        ("UNITS", unit),
    ]
    point += _named(markers.names)
    trial: list[tuple[str, Any]] = [
        ("ACTUAL_START_FIELD", np.array([first & 0xFFFF, first >> 16], dtype=np.uint16)),
        ("ACTUAL_END_FIELD", np.array([last & 0xFFFF, last >> 16], dtype=np.uint16)),
    ]
    groups = [("POINT", point), ("ANALOG", [("USED", np.uint16(0))]), ("TRIAL", trial)]
    if segments:
        used: list[tuple[str, Any]] = [("USED", np.uint16(len(segments))), ("DATA_START", np.uint16(poses_start)), ("RATIO", np.uint16(1))]
        groups.append(("ROTATION", [*used, ("RATE", np.float32(markers.fps)), *_named(segments)]))
    offset = (int(markers.frames[0]) - first) & 0xFFFFFFFF
    if offset:
        groups.append(("TRICAP", [("FRAME_OFFSET", np.array([offset & 0xFFFF, offset >> 16], dtype=np.uint16))]))
    body = b"".join(_entry(name, -k, b"\0") for k, (name, _) in enumerate(groups, 1))
    entries = [_entry(name, k, _value(value) + b"\0") for k, (_, rows) in enumerate(groups, 1) for name, value in rows]
    body += b"".join(entries) + b"\0\0"
    blocks = -(-(len(body) + 4) // BLOCK)
    return _padded(struct.pack("<BBBB", 1, 0x50, blocks, INTEL) + body)


def _named(names: tuple[str, ...]) -> list[tuple[str, Any]]:
    """The parameters with the names of points or segments."""
    rows: list[tuple[str, Any]] = []
    for k in range(0, len(names), BATCH):
        number = "" if k == 0 else str(k // BATCH + 1)
        rows += [(f"LABELS{number}", names[k : k + BATCH]), (f"DESCRIPTIONS{number}", tuple("" for _ in names[k : k + BATCH]))]
    return rows


def _entry(name: str, number: int, rest: bytes) -> bytes:
    """Length of the name, group number, name, pointer to the next entry, and what follows."""
    return struct.pack("<bb", len(name), number) + name.encode("ascii") + struct.pack("<h", 2 + len(rest)) + rest


def _value(value: Any) -> bytes:
    """Type, dimensions and data of a parameter."""
    if isinstance(value, str):
        text = value.encode("utf-8")
        return struct.pack("<bBB", -1, 1, len(text)) + text
    if isinstance(value, tuple):
        texts = [name.encode("utf-8")[:127] for name in value]
        width = max(map(len, texts), default=0)
        return struct.pack("<bBBB", -1, 2, width, len(texts)) + b"".join(text.ljust(width) for text in texts)
    kind = {2: 2, 4: 4}[value.dtype.itemsize]
    shape = value.shape
    return struct.pack(f"<bB{len(shape)}B", kind, len(shape), *shape) + value.astype(value.dtype.newbyteorder("<")).tobytes()


@dataclass
class _Number:
    """The encoding of a file's numbers."""

    order: str
    dec: bool

    def floats(self, data: bytes) -> np.ndarray:
        if self.dec:  # VAX F: words swapped, exponent off by two
            words = np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].copy()
            return np.asarray(words.view("<f4").ravel() / 4.0)
        return np.frombuffer(data, f"{self.order}f4")

    def words(self, data: bytes) -> np.ndarray:
        return np.frombuffer(data, f"{self.order}u2")


def read_c3d(path: Path, *, axes: str = "Z up", unit: str = "") -> Markers:
    """Read the points, in the file's unit unless `unit` says otherwise; their residuals become sigmas.

    Raises:
        InputError: it cannot be read, is no C3D file, or is shorter than its header says.
    """
    return _opened(path, lambda data: _read(data, path, axes_of(axes), unit))


def read_segments(path: Path, *, axes: str = "Z up", unit: str = "") -> Segments | None:
    """Read the poses of segments, in the file's unit unless `unit` says otherwise; None where the file has none.

    Raises:
        InputError: it cannot be read, is no C3D file, or is shorter than its header says.
    """
    return _opened(path, lambda data: _read_segments(data, path, axes_of(axes), unit))


def _opened(path: Path, read: Callable[[bytes], Found]) -> Found:
    try:
        data = bounded.bytes_of(path, bounded.TABLE_BYTES)
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    if len(data) < 2 * BLOCK or data[1] != 0x50 or data[0] < 2:
        raise InputError(f"{path} is not a C3D file; export it again.")
    try:
        return read(data)
    except (struct.error, IndexError, ValueError, KeyError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is a damaged C3D file ({damage_of(error)}); export it again.") from error


def _read_segments(data: bytes, path: Path, rotation: np.ndarray, unit: str) -> Segments | None:
    at = (data[0] - 1) * BLOCK
    number = _Number(order=">" if data[at + 3] == MIPS else "<", dec=data[at + 3] == DEC)
    table = _read_parameters(data, at, number, path)
    n, begin = (int(table.get(("ROTATION", name), 0)) for name in ("USED", "DATA_START"))
    if n == 0:
        return None
    words = number.words(data[2:24])
    first, t = _range(table, int(words[2]), int(words[3]))
    check_size((t, n, POSE, 4), len(data), path)
    begin = (begin - 1) * BLOCK
    if int(table.get(("ROTATION", "RATIO"), 1)) != 1 or begin < BLOCK or begin + 4 * t * n * POSE > len(data):
        raise InputError(f"{path} promises {t} poses of {n} segments but is too short for them; export it again, one pose per frame.")
    raw = number.floats(data[begin : begin + 4 * t * n * POSE]).astype(np.float64).reshape(t, n, POSE)
    pose = np.swapaxes(raw[..., :16].reshape(t, n, 4, 4), -1, -2)
    pose[raw[..., 16] < 0] = np.nan
    per_unit = metres_per(unit or table.get(("POINT", "UNITS"), "mm") or "mm", path)
    frames = first + _offset(table) + np.arange(t)
    names = _labels(table, n, "ROTATION")
    return Segments(names=names, frames=frames, R=rotation.T @ pose[..., :3, :3], origin_m=pose[..., :3, 3] * per_unit @ rotation)


def _read(data: bytes, path: Path, rotation: np.ndarray, unit: str) -> Markers:
    at = (data[0] - 1) * BLOCK
    number = _Number(order=">" if data[at + 3] == MIPS else "<", dec=data[at + 3] == DEC)
    table = _read_parameters(data, at, number, path)
    words = number.words(data[2:24])
    n, analogue, first, last, start = int(words[0]), int(words[1]), int(words[2]), int(words[3]), int(words[7])
    scale, fps = float(number.floats(data[12:16])[0]), float(number.floats(data[20:24])[0])
    if not 0 < abs(scale) < LARGEST_SCALE:
        raise InputError(f"{path} has the scale {scale:g}, in which no point can be stored; export it again.")
    first, t = _range(table, first, last)
    check_size((t, n, 4), len(data), path)
    size = 4 if scale < 0 else 2
    stride = size * (4 * n + analogue)
    begin = (start - 1) * BLOCK
    if begin < BLOCK or begin + t * stride > len(data):
        raise InputError(f"{path} promises {t} frames of {n} points but is too short for them; export it again.")
    rows = np.frombuffer(data, np.uint8, t * stride, begin).reshape(t, stride)[:, : size * 4 * n].tobytes()
    raw = (number.floats(rows) if scale < 0 else np.frombuffer(rows, f"{number.order}i2")).astype(np.float64).reshape(t, n, 4)
    per_unit = metres_per(unit or table.get(("POINT", "UNITS"), "mm") or "mm", path)
    check_places(raw[..., :3], f"{path} is a file")
    xyz = raw[..., :3] * (1.0 if scale < 0 else scale) * per_unit
    known = (raw[..., 3] >= 0) & np.isfinite(xyz).all(axis=2)
    residual = np.clip(np.nan_to_num(raw[..., 3]), 0, MOST_WORD).astype(np.int64) & 0xFF
    sigma = np.where(known & (residual > 0), residual * abs(scale) * per_unit, np.nan)
    xyz[~known] = np.nan
    return Markers(names=_labels(table, n), fps=fps, frames=first + _offset(table) + np.arange(t), xyz_m=xyz @ rotation, sigma_m=sigma)


def _range(table: dict[tuple[str, str], Any], first: int, last: int) -> tuple[int, int]:
    """First frame and their number; the header's words overflow beyond 65535, TRIAL's do not."""
    begin, end = table.get(("TRIAL", "ACTUAL_START_FIELD")), table.get(("TRIAL", "ACTUAL_END_FIELD"))
    if begin is not None and end is not None and np.size(begin) == 2 and np.size(end) == 2:
        first, last = (int(pair[0]) + (int(pair[1]) << 16) for pair in (begin, end))
    return first, last - first + 1


def _offset(table: dict[tuple[str, str], Any]) -> int:
    """The take's frame numbers minus the file's."""
    pair = table.get(("TRICAP", "FRAME_OFFSET"))
    if pair is None or np.size(pair) != 2:
        return 0
    value = int(pair[0]) + (int(pair[1]) << 16)
    return value - (1 << 32) if value >= 1 << 31 else value


def _labels(table: dict[tuple[str, str], Any], n: int, group: str = "POINT") -> tuple[str, ...]:
    names: list[str] = []
    for k in range(1, n // BATCH + 2):
        names += table.get((group, "LABELS" if k == 1 else f"LABELS{k}"), ())
    names = names[:n] + [f"point {i + 1}" for i in range(len(names), n)]
    seen: dict[str, int] = {}
    for i, name in enumerate(names):
        seen[name] = seen.get(name, 0) + 1
        names[i] = name if name and seen[name] == 1 else f"{name or 'point'} {i + 1}"
    return tuple(names)


def _read_parameters(data: bytes, at: int, number: _Number, path: Path) -> dict[tuple[str, str], Any]:
    """Values by (group, name)."""
    position, groups, rows = at + 4, {}, []
    while position + 2 < len(data):
        length, group = struct.unpack_from("<bb", data, position)
        length = abs(length)
        if length == 0 or group == 0:
            break
        name = data[position + 2 : position + 2 + length].decode("ascii", errors="replace").strip().upper()
        pointer = position + 2 + length
        step = int(number.words(data[pointer : pointer + 2])[0])
        if group < 0:
            groups[-group] = name
        else:
            rows.append((group, name, pointer + 2))
        if step == 0:
            break
        position = pointer + step
    return {
        (groups.get(group, ""), name): value for group, name, where in rows if (value := _read_value(data, where, number, path)) is not None
    }


def _read_value(data: bytes, where: int, number: _Number, path: Path) -> Any:
    kind, count = struct.unpack_from("<bB", data, where)
    shape = list(data[where + 2 : where + 2 + count])
    size = int(np.prod(shape)) if shape else 1
    begin = where + 2 + count
    if kind not in (-1, 1, 2, 4) or begin + abs(kind) * size > len(data):
        raise InputError(f"{path} has a parameter that runs over its end; it is damaged, export it again.")
    raw = data[begin : begin + abs(kind) * size]
    if kind == -1:
        if count < 2:
            return raw.decode("utf-8", errors="replace").strip(" \0")
        width = shape[0]
        return [
            raw[i * width : (i + 1) * width].decode("utf-8", errors="replace").strip(" \0") for i in range(size // width if width else 0)
        ]
    if kind == 1:
        return None
    values = number.words(raw) if kind == 2 else number.floats(raw)
    return values if shape else values[0]
