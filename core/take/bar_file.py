"""The positions of the reference bar of a calibration, next to its rig: rig.toml has rig_bar.csv.

    frame, 1 from L x, 1 from L y, 1 from L z, 2 from L x, …, 1 from C x, …

Both ends [m] in the frame of every camera: they remain valid when the world's frame changes, and a rig with other cameras is detected,
because its cameras disagree on the positions.
"""

import csv
import io
from pathlib import Path

import numpy as np

from ..foundation import store
from ..foundation.errors import InputError
from ..geometry.rig import Rig
from ..motion.formats.markers import read_points_csv

AGREE_M = 1e-3  # between the positions from all cameras of the right rig, which differ by rounding only


STARTS = ("frame,1 from ", 'frame,"1 from ')  # how the file begins


def bar_path(rig_path: Path) -> Path:
    """The file of the bar of a rig's file."""
    return rig_path.with_name(f"{rig_path.stem}_bar.csv")


def write_bar(rig_path: Path, rig: Rig, frames: np.ndarray, ends_m: np.ndarray) -> Path:
    """Write the bar's ends (T, 2, 3) [m] in the world, at frames (T,) of its recording, next to the rig's file; the path.

    Raises:
        InputError: the file cannot be written.
    """
    seen = np.stack([ends_m @ camera.R_cam_world.T + camera.t_cam_world_m for camera in rig.cameras], axis=1)  # (T, C, 2, 3)
    text = io.StringIO()
    rows = csv.writer(text, lineterminator="\n")
    rows.writerow(["frame", *(f"{end} from {camera.name} {axis}" for camera in rig.cameras for end in (1, 2) for axis in "xyz")])
    rows.writerows([int(frame), *(f"{x:.6f}" for x in row.ravel())] for frame, row in zip(frames, seen))
    store.write_text(bar_path(rig_path), text.getvalue())
    return bar_path(rig_path)


def read_bar(rig_path: Path, rig: Rig) -> tuple[np.ndarray, np.ndarray] | None:
    """Frames (T,) and ends (T, 2, 3) [m] in the world of the bar of a rig; None if there is no such file.

    Raises:
        InputError: the file is damaged, or of another calibration.
    """
    path = bar_path(rig_path)
    if not path.is_file():
        return None
    table = read_points_csv(path)
    place = {name: i for i, name in enumerate(table.names)}
    found = []
    for camera in rig.cameras:
        if {f"1 from {camera.name}", f"2 from {camera.name}"} <= set(place):
            seen = table.xyz_m[:, [place[f"{end} from {camera.name}"] for end in (1, 2)]]
            found.append((seen - camera.t_cam_world_m) @ camera.R_cam_world)
    ends = np.stack(found) if found else np.full((1, 1, 2, 3), np.nan)
    if not np.isfinite(ends).all() or np.abs(ends - ends[0]).max() > AGREE_M:
        raise InputError(f"{path} is of another calibration than {rig_path.name}, or damaged; calibrate again, or remove it.")
    return table.frames.astype(int), ends.mean(axis=0)
