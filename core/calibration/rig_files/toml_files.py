"""TOML calibrations: aniposelib (and FreeMoCap), Pose2Sim, caliscope.

aniposelib `CameraGroup.dump`: tables [cam_0], [cam_1], … of name, size, matrix, distortions (k1 k2 p1 p2 k3), rotation (Rodrigues, world →
camera), translation, in the unit of its board; it sorts the tables' names as text (cam_10 before cam_2).
Pose2Sim: a table per camera's name, distortions (k1 k2 p1 p2), fisheye, metres.
caliscope `camera_array.toml`: [cameras.0], … with cam_id, rotation (Rodrigues, or 3×3 in older files), metres; a missing key is None.
"""

from pathlib import Path
from typing import Any

import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.camera import Camera
from ...geometry.rig import Rig, sigmas_of
from ...geometry.rotation import rotation_from_vector, vector_from_rotation
from .reading import five, left_out, make_camera, numbers, plain, text_of

UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


def read(path: Path) -> Rig:
    """Read any of the three layouts; from rig.toml also the quality that the calibration reported, and its sigmas.

    Raises:
        InputError: it is none of them, or a camera is incomplete.
    """
    try:
        table = bounded.toml_of(text_of(path))
    except ValueError as error:
        raise InputError(f"{path} is not a TOML file: {error}.") from error
    metadata = table.get("metadata", {})
    unit = str(metadata.get("unit", "m")) if isinstance(metadata, dict) else "m"
    if unit not in UNITS_M:
        raise InputError(f"{path} is in an unknown unit “{unit}”; write one of {', '.join(UNITS_M)} under [metadata].")
    entries = table["cameras"] if isinstance(table.get("cameras"), dict) else table
    finished = {k: e for k, e in entries.items() if isinstance(e, dict) and "matrix" in e and e.get("rotation") is not None}
    ignored = [key for key, entry in finished.items() if entry.get("ignore") is True]
    finished = {key: entry for key, entry in finished.items() if key not in ignored}
    cameras = {key: _camera(key, entry, path, UNITS_M[unit]) for key, entry in finished.items()}
    if not cameras:
        raise InputError(f"{path} has no calibrated camera with matrix, rotation and translation; choose the file of the finished rig.")
    sigmas = {cameras[k].name: sigmas_of(e["sigma"], cameras[k].name, path) for k, e in finished.items() if "sigma" in e}
    remarks = left_out([str(entries[key].get("name", key)) for key in ignored], "they are marked `ignore`")
    if rounded := [cameras[key].name for key in finished if any(side != round(side) for side in finished[key]["size"])]:
        remarks += (f"The file has sizes that are no whole pixels, which were rounded ({', '.join(rounded)}); compare with the footage.",)
    return Rig(cameras=tuple(cameras.values()), metadata=metadata if isinstance(metadata, dict) else {}, sigmas=sigmas, remarks=remarks)


def _camera(key: str, entry: dict[str, Any], path: Path, unit_m: float) -> Camera:
    name = str(entry.get("name", f"cam_{entry['cam_id']}" if "cam_id" in entry else key))
    label = f"of camera “{name}” in {path}"
    missing = [k for k in ("size", "rotation", "translation") if k not in entry]
    if missing:
        raise InputError(f"Camera “{name}” in {path} lacks “{missing[0]}”; choose the file of the finished rig.")
    fisheye = entry.get("fisheye") is True
    given = numbers(entry.get("distortions", []), (-1,), f"“distortions” {label}")
    if fisheye and np.any(given[4:]):
        raise InputError(f"Camera “{name}” in {path} has a fisheye lens with more than k1, k2, k3, k4; calibrate it again.")
    rotation = np.asarray(entry["rotation"], dtype=object)
    R = numbers(entry["rotation"], (3, 3), f"“rotation” {label}") if rotation.shape == (3, 3) else None
    if R is None and np.linalg.norm(numbers(entry["rotation"], (3,), f"“rotation” {label}")) > 2 * np.pi:
        raise InputError(f"“rotation” {label} is longer than a whole turn; it is a Rodrigues vector in radians, not in degrees.")
    affinity = numbers(entry["affinity"], (2,), f"“affinity” {label}") if "affinity" in entry else None
    return make_camera(
        name,
        numbers(entry["size"], (2,), f"“size” {label}").tolist(),
        numbers(entry["matrix"], (3, 3), f"“matrix” {label}"),
        five(entry.get("distortions", []), f"“distortions” {label}"),
        rotation_from_vector(numbers(entry["rotation"], (3,), f"“rotation” {label}")) if R is None else R,
        numbers(entry["translation"], (3,), f"“translation” {label}") * unit_m,
        affinity,
        fisheye,
    )


def write_anipose(path: Path, rig: Rig) -> list[Path]:
    """Write as aniposelib does, in metres, cameras without affinity."""
    parts = [_table(f"cam_{n}", plain(camera), 5, ("fisheye = true",) if camera.fisheye else ()) for n, camera in enumerate(rig.cameras)]
    store.write_text(path, "\n".join([*parts, "[metadata]\nadjusted = true\nerror = 0.0\n"]))
    return [path]


def write_pose2sim(path: Path, rig: Rig) -> list[Path]:
    """Write as Pose2Sim does: a table per camera's name, four distortions, metres; k3 is fitted into the others."""
    parts = [_table(_key(camera.name), plain(camera, k3=False), 4, (_fisheye(camera),)) for camera in rig.cameras]
    store.write_text(path, "\n".join([*parts, "[metadata]\nadjusted = false\nerror = 0.0\n"]))
    return [path]


def write_caliscope(path: Path, rig: Rig) -> list[Path]:
    """Write caliscope's camera_array.toml: cameras numbered from 0, metres."""
    parts = []
    for n, camera in enumerate(rig.cameras):
        extra = (f"cam_id = {n}", "rotation_count = 0", _fisheye(camera))
        parts.append(_table(f"cameras.{n}", plain(camera), 5, extra))
    store.write_text(path, "\n".join(parts))
    return [path]


def _table(key: str, camera: Camera, distortions: int, extra: tuple[str, ...]) -> str:
    lines = [
        f"[{key}]",
        f"name = {_quoted(camera.name)}",
        f"size = [{camera.size_px[0]}, {camera.size_px[1]}]",
        f"matrix = {camera.matrix.tolist()!r}",
        f"distortions = {camera.distortions[: 4 if camera.fisheye else distortions].tolist()!r}",
        f"rotation = {vector_from_rotation(camera.R_cam_world).tolist()!r}",
        f"translation = {camera.t_cam_world_m.tolist()!r}",
        *extra,
    ]
    return "\n".join(lines) + "\n"


def _fisheye(camera: Camera) -> str:
    return f"fisheye = {str(camera.fisheye).lower()}"


def _key(name: str) -> str:
    return name if name and all(c.isascii() and (c.isalnum() or c in "-_") for c in name) and name != "metadata" else _quoted(name)


def _quoted(text: str) -> str:
    return '"' + text.replace("\\", "\\\\").replace('"', '\\"').replace("\n", " ") + '"'
