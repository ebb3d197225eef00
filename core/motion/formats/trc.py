"""TRC: points over time as text (Motion Analysis; OpenSim). Input is validated; written for OpenSim: Y up."""

from pathlib import Path

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...images.interlace import frame_time_s
from ..plausible import check_places, check_times
from .markers import Markers, axes_of, check_size, metres_per

RATE_TOLERANCE = 0.02  # of the rate: 30 for 29.97 is no contradiction
HEADINGS = "DataRate CameraRate NumFrames NumMarkers Units OrigDataRate OrigDataStartFrame OrigNumFrames".split()


def write_trc(path: Path, markers: Markers, *, axes: str = "OpenSim", unit: str = "m") -> None:
    """Write points; missing ones are left empty.

    Raises:
        InputError: axes or unit are not known, or the file cannot be written.
    """
    xyz = markers.xyz_m @ axes_of(axes).T / metres_per(unit, path)
    t, n = xyz.shape[:2]
    rate = f"{markers.fps:.9g}"
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{Path(path).name}",
        "\t".join(HEADINGS),
        "\t".join([rate, rate, str(t), str(n), unit, rate, str(markers.frames[0]), str(t)]),
        "Frame#\tTime\t" + "\t\t\t".join(markers.names) + "\t\t",
        "\t\t" + "\t".join(f"{axis}{k}" for k in range(1, n + 1) for axis in "XYZ"),
        "",
    ]
    time = frame_time_s(markers.frames - markers.frames[0], markers.fps)
    for frame, second, row in zip(markers.frames, time, xyz.reshape(t, -1)):
        lines.append("\t".join([str(frame), f"{second:.6f}", *("" if np.isnan(v) else f"{v:.6f}" for v in row)]))
    store.write_text(Path(path), "\n".join(lines) + "\n")


def read_trc(path: Path, *, axes: str = "OpenSim", unit: str = "") -> Markers:
    """Read points, in the file's unit unless `unit` says otherwise.

    Raises:
        InputError: it cannot be read, is no TRC file, is cut, or contradicts its header.
    """
    rotation = axes_of(axes)
    lines = _lines(path)
    if len(lines) < 5 or not lines[0].startswith("PathFileType"):
        raise InputError(f"{path} is not a TRC file: its first line is not “PathFileType …”.")
    header = dict(zip(lines[1].split(), lines[2].split()))
    missing = [name for name in HEADINGS[:5] if name not in header]
    if missing:
        raise InputError(f"{path} has no {missing[0]} in its header; export it again.")
    t, n = _count(header["NumFrames"], path), _count(header["NumMarkers"], path)
    check_size((t, n, 3), sum(map(len, lines)), path)
    names = [name.strip() for name in lines[3].split("\t")[2:] if name.strip()]
    if len(names) != n or len(set(names)) < n:
        raise InputError(f"{path} promises {n} markers and names {len(set(names))} different ones; export it again.")
    rows = [line.split("\t") for line in lines[5:] if line.strip()]
    if len(rows) != t:
        raise InputError(f"{path} promises {t} frames and holds {len(rows)}; export it again.")
    if t > 1 and len(rows[-1]) < min(2 + 3 * n, *map(len, rows[:-1])):
        raise InputError(f"{path} ends within its last row, of frame “{rows[-1][0][:20]}”; export it again.")
    fps, table = _rate(header["DataRate"], path), np.array([_row(row, n, path) for row in rows])
    _check_rate(rows, fps, path)
    check_times(table[:, 0], fps, f"{path} is a file")
    check_places(table[:, 1:], f"{path} is a file")
    xyz = table[:, 1:].reshape(t, n, 3) * metres_per(unit or header["Units"], path) @ rotation
    return Markers(names=tuple(names), fps=fps, frames=table[:, 0], xyz_m=xyz, sigma_m=np.full((t, n), np.nan))


def _lines(path: Path) -> list[str]:
    try:
        return bounded.text_of(path, bounded.TABLE_BYTES, errors="replace").splitlines()
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error


def _count(text: str, path: Path) -> int:
    if not text.isdecimal() or len(text) > 12:
        raise InputError(f"{path} has “{text[:20]}” where a count is needed; export it again.")
    return int(text)


def _rate(text: str, path: Path) -> float:
    try:
        return float(text)
    except ValueError as error:
        raise InputError(f"{path} has the data rate “{text[:20]}”, which is no number; export it again.") from error


def _check_rate(rows: list[list[str]], fps: float, path: Path) -> None:
    """Check that the times are those of the data rate, where both are there."""
    try:
        seconds = np.diff([float(row[1]) for row in rows])
    except (ValueError, IndexError):
        return
    step = float(np.median(seconds)) if len(seconds) else np.nan
    if step > 0 and fps > 0 and abs(step * fps - 1) > RATE_TOLERANCE:
        raise InputError(f"{path} has {fps:g} frames per second in its header, and times of {1 / step:.4g}; correct one of them.")


def _row(row: list[str], n: int, path: Path) -> list[float]:
    """Frame number and 3 n coordinates; empty fields are missing points."""
    fields = [row[0], *row[2 : 2 + 3 * n]]
    fields += [""] * (1 + 3 * n - len(fields))
    try:
        values = [float(text) if text.strip() else np.nan for text in fields]
    except ValueError as error:
        raise InputError(f"{path} holds something that is no number in frame “{row[0][:20]}”; export it again.") from error
    if not np.isfinite(values[0]):
        raise InputError(f"{path} has a row without a frame number; export it again.")
    return values
