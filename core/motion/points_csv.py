"""Points over time as CSV, in metres: long like joints.csv (frame, time_s, joint, x, y, z, sigma), or wide with columns frame, time_s,
NAME x, NAME y, NAME z, …"""

import csv
import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from .. import store
from ..errors import InputError
from ..images.fields import frame_time_s
from .markers import Markers, axes_of, check_size, metres_per
from .tables import read_joints

LARGEST_BYTES = 1 << 30
DEFAULT_FPS = 25.0


def write_points_csv(path: Path, markers: Markers, *, axes: str = "Z up", unit: str = "m") -> None:
    """Write points like joints.csv; unknown ones have no row. joints.csv itself has metres and Z up.

    Raises:
        InputError: axes or unit are not known, or the file cannot be written.
    """
    per_unit = metres_per(unit, path)
    rows = ["frame,time_s,joint,x,y,z,sigma"]
    for frame, places, sigmas in zip(markers.frames, markers.xyz_m @ axes_of(axes).T / per_unit, markers.sigma_m / per_unit):
        for name, X, sigma in zip(markers.names, places, sigmas):
            if np.isfinite(X).all():
                text = io.StringIO()
                csv.writer(text, lineterminator="").writerow([name])
                rows.append(
                    f"{frame},{frame_time_s(frame, markers.fps):.6f},{text.getvalue()},{X[0]:.6f},{X[1]:.6f},{X[2]:.6f},"
                    f"{'nan' if np.isnan(sigma) else format(sigma, '.6f')}"
                )
    store.write_text(Path(path), "\n".join(rows) + "\n")


def read_points_csv(path: Path, *, axes: str = "Z up", unit: str = "") -> Markers:
    """Read points, in metres unless `unit` says otherwise.

    Raises:
        InputError: it cannot be read, its columns are none of the two kinds, or axes or unit are not known.
    """
    rotation, per_unit = axes_of(axes), metres_per(unit or "m", path)
    found = _read(path)
    return replace(found, xyz_m=found.xyz_m @ rotation * per_unit, sigma_m=found.sigma_m * per_unit)


def _read(path: Path) -> Markers:
    """Points as they stand in the file."""
    try:
        if Path(path).stat().st_size > LARGEST_BYTES:
            raise InputError(f"{path} is larger than 1 GB; cut it into shorter pieces.")
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            header = [name.strip() for name in next(csv.reader(file), [])]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"Cannot read the table {path}: {error}.") from error
    if "joint" in header:
        table = read_joints(path)
        frames, names = table.frames, tuple(table.joints_m)
        if not names:
            raise InputError(f"The table {path} has no rows; choose one with points.")
        xyz, sigma = (np.stack([column[name] for name in names], axis=1) for column in (table.joints_m, table.sigma_m))
        return Markers(names=names, fps=rate(frames, table.time_s), frames=frames, xyz_m=xyz, sigma_m=sigma)
    return _wide(path, header)


def _wide(path: Path, header: list[str]) -> Markers:
    columns: dict[str, dict[str, int]] = {}
    for i, name in enumerate(header):
        if len(name) > 2 and name[-1].lower() in "xyz" and name[-2] in " _.":
            columns.setdefault(name[:-2], {})[name[-1].lower()] = i
    columns = {name: places for name, places in columns.items() if len(places) == 3}
    if not columns or "frame" not in header:
        raise InputError(f"{path} has no columns of points; write frame, time_s, NAME x, NAME y, NAME z, or rows like joints.csv.")
    try:
        table = np.genfromtxt(path, delimiter=",", skip_header=1, encoding="utf-8-sig", ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} has rows of different lengths; export it again.") from error
    if table.shape[0] == 0 or table.shape[1] != len(header):
        raise InputError(f"{path} has no rows that fit its header; export it again.")
    check_size(table.shape, table.size, path)
    frames = table[:, header.index("frame")]
    if not np.isfinite(frames).all():
        raise InputError(f"{path} has rows without a frame number; export it again.")
    xyz = np.stack([table[:, [places[axis] for axis in "xyz"]] for places in columns.values()], axis=1)
    time = table[:, header.index("time_s")] if "time_s" in header else frames / DEFAULT_FPS
    return Markers(names=tuple(columns), fps=rate(frames, time), frames=frames, xyz_m=xyz, sigma_m=np.full(xyz.shape[:2], np.nan))


def rate(frames: np.ndarray, time_s: np.ndarray) -> float:
    """Frames per second of a table with frame numbers and times."""
    if len(frames) < 2:
        return DEFAULT_FPS
    steps = np.diff(time_s) / np.maximum(np.diff(frames), 1)
    step = float(np.median(steps))
    return 1.0 / step if np.isfinite(step) and step > 0 else DEFAULT_FPS
