"""Named points over time, the content of TRC, C3D and CSV files, in the world's metres, Z up.

Axes of other worlds are given by the rows of a rotation: `file = rotation @ world`. In OpenSim's, X is forward, Y up and Z to the
right of a person who faces −Y here.

Points over time as CSV, in metres: long like joints.csv (frame, time_s, joint, x, y, z, sigma), or wide with columns frame, time_s,
NAME x, NAME y, NAME z, …
"""

import csv
import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ...foundation import bounded, store
from ...foundation.arrays import frozen
from ...foundation.errors import InputError, damage_of
from ...images.interlace import frame_time_s
from ..plausible import check_places, check_times
from ..tables import JOINT_COLUMNS, SIGMA, read_joints

AXES = {
    "Z up": np.eye(3),
    "Y up": np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]),
    "OpenSim": np.array([[0, -1.0, 0], [0, 0, 1.0], [-1.0, 0, 0]]),
}
UNITS_M = {"m": 1.0, "meters": 1.0, "metres": 1.0, "dm": 0.1, "cm": 0.01, "mm": 0.001, "um": 1e-6, "in": 0.0254, "inch": 0.0254}
MOST_VALUES = 1 << 28  # 2 GB of float64
DEFAULT_FPS = 25.0  # of tables without times
UNEVEN = 1.5  # frames by which the time between two rows may be off: those of real cameras jitter


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Markers:
    """N points over T frames; NaN where a point is missing."""

    names: tuple[str, ...]
    fps: float
    frames: np.ndarray  # (T,) integer frame numbers
    xyz_m: np.ndarray  # (T, N, 3) world
    sigma_m: np.ndarray  # (T, N); NaN: unknown
    known: tuple[tuple[str, ...], ...] = ()  # (T, N) how well each point is known, in words: seen, inferred, guessed; empty: not said

    def __post_init__(self) -> None:
        t, n = len(self.frames), len(self.names)
        object.__setattr__(self, "frames", frozen(self.frames, (t,), np.int64, "frames"))
        object.__setattr__(self, "xyz_m", frozen(self.xyz_m, (t, n, 3), float, "xyz_m"))
        object.__setattr__(self, "sigma_m", frozen(self.sigma_m, (t, n), float, "sigma_m"))
        if t == 0 or n == 0:
            raise InputError("There are no points in any frame; choose a file with points.")
        check_times(self.frames, self.fps, "There are points")
        check_places(self.xyz_m, "There are points")


def metres_per(unit: str, where: object) -> float:
    """Metres per unit, by the unit's name.

    Raises:
        InputError: the unit is unknown.
    """
    factor = UNITS_M.get(unit.strip().lower())
    if factor is None:
        raise InputError(f"{where} is in the unit “{unit.strip()[:20]}”, which is unknown; write it in m or mm.")
    return factor


def axes_of(name: str) -> np.ndarray:
    """The rotation (3, 3) from the world to a file's axes.

    Raises:
        InputError: there are no such axes.
    """
    if name not in AXES:
        raise InputError(f"There are no axes “{name}”; choose one of {', '.join(AXES)}.")
    return AXES[name]


def check_size(counts: Sequence[int], available: int, where: object) -> None:
    """Check that a header's counts are possible, before memory is allocated.

    Raises:
        InputError: they are not.
    """
    total = 1
    for count in counts:
        total *= max(int(count), 0)
    if total == 0 or total > min(MOST_VALUES, available):
        promised = " × ".join(map(str, counts))
        raise InputError(f"{where} promises {promised} values but cannot hold them; it is damaged, export it again.")


def filled(markers: Markers) -> Markers:
    """Gaps filled linearly, and the ends with the nearest position; points without any position are left out.

    Raises:
        InputError: no point has a position.
    """
    known = np.isfinite(markers.xyz_m).all(axis=2)
    keep = np.flatnonzero(known.any(axis=0))
    if not len(keep):
        raise InputError("None of the points has a position in any frame; choose a file with points.")
    xyz = np.stack(
        [
            np.stack([np.interp(markers.frames, markers.frames[known[:, n]], markers.xyz_m[known[:, n], n, i]) for i in range(3)], axis=1)
            for n in keep
        ],
        axis=1,
    )
    return Markers(
        names=tuple(markers.names[n] for n in keep), fps=markers.fps, frames=markers.frames, xyz_m=xyz, sigma_m=markers.sigma_m[:, keep]
    )


def write_points_csv(path: Path, markers: Markers, *, axes: str = "Z up", unit: str = "m") -> None:
    """Write points like joints.csv; missing ones have no row. joints.csv itself has metres and Z up.

    Raises:
        InputError: axes or unit are not known, or the file cannot be written.
    """
    per_unit = metres_per(unit, path)
    rows = ["frame,time_s,joint,x,y,z,sigma" + (",known" if markers.known else "")]
    words = markers.known or (("",) * len(markers.names),) * len(markers.frames)
    for frame, places, sigmas, row in zip(markers.frames, markers.xyz_m @ axes_of(axes).T / per_unit, markers.sigma_m / per_unit, words):
        for name, X, sigma, word in zip(markers.names, places, sigmas, row):
            if np.isfinite(X).all():
                text = io.StringIO()
                csv.writer(text, lineterminator="").writerow([name])
                rows.append(
                    f"{frame},{frame_time_s(frame, markers.fps):.6f},{text.getvalue()},{X[0]:.6f},{X[1]:.6f},{X[2]:.6f},"
                    f"{'nan' if np.isnan(sigma) else format(sigma, '.6f')}{f',{word}' if markers.known else ''}"
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
    """Points in the file's axes and unit."""
    try:
        text = io.StringIO(bounded.text_of(path, bounded.TABLE_BYTES))
        header = [name.strip() for name in next(csv.reader(text), [])]
    except (OSError, ValueError, csv.Error) as error:
        raise InputError(f"Cannot read the table {path}: {damage_of(error)}.") from error
    if "joint" in header:
        if lacking := [name for name in JOINT_COLUMNS if name not in header and name != SIGMA]:
            raise InputError(f"{path} has no column “{lacking[0]}”; write {', '.join(JOINT_COLUMNS[:-1])}, and sigma where it is known.")
        table = read_joints(path, needs_sigma=SIGMA in header)
        frames, names = table.frames, tuple(table.joints_m)
        if not names:
            raise InputError(f"The table {path} has no rows; choose one with points.")
        xyz, sigma = (np.stack([column[name] for name in names], axis=1) for column in (table.joints_m, table.sigma_m))
        return Markers(names=names, fps=rate(frames, table.time_s, path), frames=frames, xyz_m=xyz, sigma_m=sigma)
    return _wide(path, header, text)


def _wide(path: Path, header: list[str], rows: io.StringIO) -> Markers:
    columns: dict[str, dict[str, int]] = {}
    for i, name in enumerate(header):
        if len(name) > 2 and name[-1].lower() in "xyz" and name[-2] in " _.":
            columns.setdefault(name[:-2], {})[name[-1].lower()] = i
    columns = {name: places for name, places in columns.items() if len(places) == 3}
    if not columns or "frame" not in header:
        raise InputError(f"{path} has no columns of points; write frame, time_s, NAME x, NAME y, NAME z, or rows like joints.csv.")
    try:
        table = np.genfromtxt(rows, delimiter=",", ndmin=2)
    except ValueError as error:
        raise InputError(f"{path} has rows of different lengths; export it again.") from error
    if table.shape[0] == 0 or table.shape[1] != len(header):
        raise InputError(f"{path} has no rows that fit its header; export it again.")
    check_size(table.shape, table.size, path)
    frames = table[:, header.index("frame")]
    check_times(frames, DEFAULT_FPS, f"{path} has rows")
    xyz = np.stack([table[:, [places[axis] for axis in "xyz"]] for places in columns.values()], axis=1)
    time = table[:, header.index("time_s")] if "time_s" in header else frames / DEFAULT_FPS
    return Markers(names=tuple(columns), fps=rate(frames, time, path), frames=frames, xyz_m=xyz, sigma_m=np.full(xyz.shape[:2], np.nan))


def rate(frames: np.ndarray, time_s: np.ndarray, where: object) -> float:
    """Frames per second of a table with frame numbers and times.

    Raises:
        InputError: the times do not increase, or not as the frame numbers do.
    """
    if len(frames) < 2:
        return DEFAULT_FPS
    between = np.diff(time_s)
    if not (between > 0).all():
        row = int(np.flatnonzero(~(between > 0))[0])
        raise InputError(
            f"{where} has the time {time_s[row + 1]:g} s after {time_s[row]:g} s; times must increase. Correct or remove them."
        )
    steps = np.diff(frames)
    usual = 1.0 / float(np.median(between / np.maximum(steps, 1)))
    uneven = np.flatnonzero(np.abs(between * usual - steps) > UNEVEN)
    if len(uneven):
        row = int(uneven[0])
        raise InputError(
            f"{where} has uneven times: frame {frames[row + 1]:g} comes {between[row]:g} s after frame {frames[row]:g}, at {usual:.4g} "
            "frames per second. Number the frames by their times, so that a gap is one in the numbers, too; or remove the column time_s."
        )
    return float((frames[-1] - frames[0]) / (time_s[-1] - time_s[0]))
