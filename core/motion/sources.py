"""Reading motions: a run's folder, BVH, TRC, C3D and CSV files."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from ..body.shape import BodyShape, read_body
from ..body.skeleton import bone_frames
from ..foundation.errors import InputError
from .formats.bvh import read_bvh
from .formats.c3d import read_c3d
from .formats.markers import Markers, metres_per, rate, read_points_csv
from .formats.trc import read_trc
from .plausible import check_places
from .retarget.points import motion_from_points
from .retarget.rig import Motion, Rig
from .retarget.roles import model_roles
from .tables import read_motion

Z_UP = {"": "Z up", "Y": "Y up", "Z": "Z up"}
POINTS: dict[str, tuple[Callable[..., Markers], dict[str, str]]] = {  # the reader of each kind, and its axes by the up axis
    ".trc": (read_trc, {"": "OpenSim", "Y": "OpenSim", "Z": "Z up"}),
    ".c3d": (read_c3d, Z_UP),
    ".csv": (read_points_csv, Z_UP),
}
FILES = (".bvh", *POINTS)


def read_motion_source(path: Path, *, up: str = "", unit: str = "") -> Motion:
    """The motion in a run's folder or a file; frame numbers are the file's own, a BVH file's begin at 1 as in Blender.

    `up`: "Y" or "Z", `unit`: "m", "cm", … of a file that does not define them; empty: the convention of its kind.

    Raises:
        InputError: it cannot be read, has no motion, or the unit is unknown.
    """
    path = Path(path)
    if path.is_dir():
        return from_run(path)
    if not path.exists():
        raise InputError(f"There is no file or folder {path}; check its name.")
    kind = path.suffix.lower()
    if kind == ".bvh":
        motion = read_bvh(path, unit_m=metres_per(unit, path) if unit else None, up=up or None)
        return Motion(rig=motion.rig, fps=motion.fps, frames=motion.frames + 1, R=motion.R, head_m=motion.head_m)
    if kind in POINTS:
        return motion_from_points(read_points(path, up=up, unit=unit))
    raise InputError(f"{path.name} is not a motion that can be read; give a run's folder or one of {', '.join(FILES)}.")


def is_of_points(path: Path) -> bool:
    """Whether a file has the ending of points (markers, joints), which have no rotations."""
    return path.suffix.lower() in POINTS


def read_points(path: Path, *, up: str = "", unit: str = "") -> Markers:
    """The points in a file with such an ending; `up`, `unit`: see `read_motion_source`.

    Raises:
        InputError: see `read_motion_source`.
    """
    if not path.exists():
        raise InputError(f"There is no file or folder {path}; check its name.")
    read, axes = POINTS[path.suffix.lower()]
    return read(path, axes=axes[up], unit=unit)


def from_run(out: Path) -> Motion:
    """The motion of the body in a run's folder; frames without a solution are interpolated linearly.

    Raises:
        InputError: body.toml or motion.csv are missing or damaged, no frame has a solution, or the folder is a take.
    """
    if (out / "take.toml").is_file() and not (out / "body.toml").is_file():
        raise InputError(f"{out} is a take; give the folder with its results instead, which `tricap run` wrote.")
    shape = read_body(out / "body.toml")
    table = read_motion(out / "motion.csv", shape.skeleton)
    check_places(table.values, f"{out / 'motion.csv'} is a motion")
    known = np.isfinite(table.values).all(axis=1)
    if not known.any():
        raise InputError(f"{out / 'motion.csv'} has no frame with a solution; run the fit again.")
    first, last = np.flatnonzero(known)[[0, -1]]
    frames = table.frames[first : last + 1]
    values = np.stack([np.interp(frames, table.frames[known], column) for column in table.values[known].T], axis=1)
    return body_motion(shape, values, frames, rate(table.frames, table.time_s, out / "motion.csv"))


def body_motion(shape: BodyShape, values: np.ndarray, frames: np.ndarray, fps: float) -> Motion:
    """The motion of a body whose DOFs are `values` (T, D) [rad, m] at `frames` (T,)."""
    skeleton = shape.skeleton
    R_rest, head = bone_frames(skeleton, shape.lengths_m, np.zeros(len(skeleton.dof_names)))
    R, heads = bone_frames(skeleton, shape.lengths_m, values)
    names = tuple(bone.name for bone in skeleton.bones)
    rig = Rig(
        names=names,
        parents=skeleton.parents,
        R_rest=R_rest,
        head_m=head,
        tail_m=head + shape.lengths_m[:, None] * R_rest[..., 1],
        connected=skeleton.starts_at_tail,
        inherits_rotation=np.ones(len(names), dtype=bool),
        roles=model_roles(names),
    )
    return Motion(rig=rig, fps=fps, frames=frames, R=R, head_m=heads)
