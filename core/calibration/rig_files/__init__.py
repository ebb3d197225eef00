"""Other tools' calibration files, read and written: Anipose, Pose2Sim, caliscope, OpenCV, EasyMocap, COLMAP, OpenPTV, Agisoft."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from ...foundation.errors import InputError
from ...geometry.camera import Camera
from ...geometry.rig import Rig, check_cameras
from ...results.listed_files import check_files, list_files
from . import agisoft, colmap, opencv_files, openptv, toml_files
from .reading import grid_of, text_of

FORMATS: dict[str, Callable[[Path, Rig], list[Path]]] = {
    "agisoft": agisoft.write,
    "anipose": toml_files.write_anipose,
    "caliscope": toml_files.write_caliscope,
    "colmap": colmap.write,
    "easymocap": opencv_files.write_easymocap,
    "opencv": opencv_files.write,
    "openptv": openptv.write,
    "pose2sim": toml_files.write_pose2sim,
}
WITH_FISHEYE = ("anipose", "pose2sim", "caliscope")  # that can hold OpenCV's fisheye lens
ENDINGS = {  # of the formats of one file, by which it is read again
    "agisoft": (".xml",),
    "anipose": (".toml",),
    "caliscope": (".toml",),
    "opencv": (".yml", ".yaml", ".xml"),
    "pose2sim": (".toml",),
}
NOTED_PX = 0.1  # from this difference on between a camera and the one in an exported file, there is a note
FOLDERS = {  # formats of several files in a folder, and their names
    "colmap": ("cameras.txt", "images.txt", "points3D.txt"),
    "easymocap": ("intri.yml", "extri.yml"),
    "openptv": ("*.ori", "*.addpar", "*.par"),
}


def read_any(path: Path) -> Rig:
    """Read another tool's calibration, whose kind follows from the file or folder.

    Raises:
        InputError: it is missing, of no known kind, or damaged, or its cameras are too many or have no names of their own.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"The calibration {path} is missing; check the path.")
    rig = _read(path)
    check_cameras(rig.cameras, str(path))
    return rig


def _read(path: Path) -> Rig:
    folder, ending = path if path.is_dir() else path.parent, path.suffix.lower()
    if ending == ".toml":
        return toml_files.read(path)
    if ending in (".ori", ".addpar", ".par") or (path.is_dir() and any(folder.glob("*.ori"))):
        return openptv.read(path)
    if path.name in ("cameras.txt", "images.txt") or (path.is_dir() and (folder / "cameras.txt").exists()):
        return colmap.read(path)
    if path.name in ("intri.yml", "extri.yml") or (path.is_dir() and (folder / "intri.yml").exists()):
        return opencv_files.read_easymocap(path)
    if ending == ".xml":
        return opencv_files.read(path) if "opencv_storage" in text_of(path) else agisoft.read(path)
    if ending in (".yml", ".yaml"):
        return opencv_files.read(path)
    raise InputError(f"{path} is of no known kind; give rig.toml, or a file or folder of {', '.join(sorted(FORMATS))}.")


def check_place(path: Path, name: str) -> None:
    """Check that a rig can be written to `path` in this format, before it is made.

    Raises:
        InputError: the format is unknown, or has files of another ending, or is a folder; or files in it are not of an earlier call.
    """
    if name not in FORMATS:
        raise InputError(f"The format “{name}” is unknown; choose one of {', '.join(sorted(FORMATS))}.")
    if name not in FOLDERS and Path(path).suffix.lower() not in ENDINGS[name]:
        raise InputError(f"{Path(path).name} is no name of a file of {name}; let it end in {' or '.join(ENDINGS[name])}.")
    if name in FOLDERS and Path(path).is_file():
        raise InputError(f"{path} is a file; {name} needs a folder.")
    check_files(Path(path), FOLDERS.get(name, ()))


def write_as(path: Path, rig: Rig, name: str) -> list[Path]:
    """Write a rig in another tool's format; the files that were written.

    Raises:
        InputError: as `check_place`, or the format cannot hold this rig.
    """
    check_place(path, name)
    check_cameras(rig.cameras, "The rig")
    curved = [camera.name for camera in rig.cameras if camera.fisheye]
    if curved and name not in WITH_FISHEYE:
        raise InputError(f"{name} has no fisheye lens, as camera {curved[0]} has; choose one of {', '.join(WITH_FISHEYE)}.")
    if name not in FOLDERS:
        return FORMATS[name](Path(path), rig)
    written = FORMATS[name](Path(path), rig)
    list_files(Path(path), FOLDERS[name], [file.name for file in written])
    return written


def lens_note(path: Path, rig: Rig, name: str) -> str:
    """Which camera in a file of `write_as` differs most from the rig's, because the format lacks terms of its lens: a sentence, or ""."""
    again = read_any(path).cameras
    named = {camera.name: camera for camera in again}
    pairs = [(camera, named.get(camera.name, other)) for camera, other in zip(rig.cameras, again)]
    difference_px, worst = max((_largest_difference_px(camera, other), camera.name) for camera, other in pairs)
    if difference_px < NOTED_PX:
        return ""
    return (
        f"Camera {worst} in {path} differs by up to {difference_px:.1f} px from the calibrated one, for {name} lacks terms of its lens; "
        "where that matters, choose another format."
    )


def _largest_difference_px(camera: Camera, other: Camera) -> float:
    """The largest distance between pixels of a camera and where another one sees the same directions; inf where it sees some nowhere."""
    xy = grid_of(camera)
    directions = camera.directions(xy) @ camera.R_cam_world
    seen = replace(other, t_cam_world_m=np.zeros(3)).project(directions)
    apart = np.linalg.norm(seen - xy, axis=1)
    return float(apart.max()) if np.isfinite(apart).all() else np.inf
