"""The camera rig and its file, rig.toml: the layout of Anipose, Pose2Sim and caliscope, in metres."""

import difflib
import json
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..foundation import bounded, store
from ..foundation.errors import InputError, shown
from ..foundation.settings import nearest_name
from .camera import EXTERIOR, INTERIOR, Camera, is_camera_matrix
from .rotation import rotation_from_vector, vector_from_rotation

LARGEST_NUMBER = 1e12  # of a calibration in any unit; beyond it, powers of it overflow
LARGEST_AFFINITY = 0.5  # pixels that are half as wide as the focal lengths say
MOST_CAMERAS = 200  # much is done for every pair of them
SIGMA_NAMES = (*INTERIOR, "k4", *EXTERIOR)  # of the unknowns in a camera's table “sigma”
NEARLY = 0.8  # likeness of two names, from 0 to 1
UNITS_M = {"m": 1.0, "mm": 1e-3, "cm": 1e-2}


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class Rig:
    """Calibrated cameras, accessed by name. `metadata` is the quality that the calibration reported.

    `sigmas`: standard deviations by camera and unknown (f, cx, cy in px; k1 …; turn [rad] and shift [m] about the camera's own axes).
    `remarks`: what its file lacks, or names nearly as a rig does, a sentence each.
    """

    cameras: tuple[Camera, ...]
    metadata: Mapping[str, Any] = field(default_factory=dict)
    sigmas: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    remarks: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Camera:
        for camera in self.cameras:
            if camera.name == name:
                return camera
        raise InputError(
            f"The rig has no camera “{name}”.{nearest_name(name, [c.name for c in self.cameras])}"
            " Give the views in take.toml the names of the cameras in rig.toml."
        )


def renamed(rig: Rig, names: Mapping[str, str]) -> Rig:
    """The rig with other names for its cameras; `names`: the new ones by the old ones, where they change."""
    cameras = tuple(replace(camera, name=names.get(camera.name, camera.name)) for camera in rig.cameras)
    return replace(rig, cameras=cameras, sigmas={names.get(name, name): sigmas for name, sigmas in rig.sigmas.items()})


def read_rig(path: Path) -> Rig:
    """Read rig.toml.

    Raises:
        InputError: the file is missing, is no TOML, or a camera in it is incomplete or impossible.
    """
    try:
        table = bounded.toml_of(bounded.text_of(path, bounded.TOML_BYTES))
    except OSError as error:
        raise InputError(
            f"Cannot read the rig {path}: {error.strerror or error}. Calibrate first, or correct `rig` in take.toml."
        ) from error
    except ValueError as error:
        raise InputError(f"The rig {path} is not a TOML file: {error}.") from error
    metadata = table.get("metadata", {})
    unit = metadata.get("unit", "m") if isinstance(metadata, dict) else None
    if not isinstance(unit, str) or unit not in UNITS_M:
        raise InputError(f"The rig {path} is in an unknown unit {shown(unit)}; write one of {', '.join(UNITS_M)} under [metadata].")
    cameras = tuple(_camera(key, entry, path, UNITS_M[unit]) for key, entry in table.items() if key.startswith("cam"))
    if not cameras:
        raise InputError(f"The rig {path} has no cameras; it needs tables [cam_0], [cam_1], …")
    check_cameras(cameras, f"The rig {path}")
    tables = [entry for key, entry in table.items() if key.startswith("cam")]
    sigmas = {c.name: sigmas_of(entry["sigma"], c.name, path) for c, entry in zip(cameras, tables) if "sigma" in entry}
    return Rig(cameras=cameras, metadata=metadata, sigmas=sigmas, remarks=tuple(_remarks(table, cameras, path)))


def _remarks(table: Mapping[str, Any], cameras: Sequence[Camera], path: Path) -> Iterator[str]:
    """A sentence for each camera without distortions, and for names at the top of a file that are nearly those of a rig. Other names are
    those of other tools."""
    tables = [entry for key, entry in table.items() if key.startswith("cam")]
    for camera, entry in zip(cameras, tables):
        if "distortions" not in entry:
            yield f"Camera “{camera.name}” of {path.name} has no `distortions`: its lens counts as free of distortion."
        for key in entry.get("sigma", {}):
            if key not in SIGMA_NAMES:
                yield f"`sigma` of camera “{camera.name}” of {path.name} has “{key}”, which is no unknown.{nearest_name(key, [*INTERIOR])}"
        if "sigma" not in entry and (key := _nearly("sigma", entry)):
            yield f"Camera “{camera.name}” of {path.name} has “{key}”, which is not read; did you mean “sigma”?"
    if "metadata" not in table and (key := _nearly("metadata", table)):
        yield f"{path.name} has [{key}], which is not read; did you mean [metadata]?"
    for where, names in (("", table), (" under [metadata]", table.get("metadata", {}))):
        key = _nearly("unit", names) or ("unit" if not where and "unit" in names else "")
        if key and names[key] != table.get("metadata", {}).get("unit"):
            yield f"{path.name} has “{key}”{where}, which is not read: write unit = {shown(names[key])} under [metadata]."


def _nearly(name: str, table: Mapping[str, Any]) -> str:
    """The key of a table that is nearly this name, which the table lacks; empty if none is."""
    plain = {re.sub("[_ -]", "", key).lower(): key for key in table if key != name}
    close = difflib.get_close_matches(name, plain, n=1, cutoff=NEARLY)
    return plain[close[0]] if close and name not in table else ""


def check_cameras(cameras: Sequence[Camera], label: str) -> None:
    """Check the number of cameras, that their names are names, which messages, files of other tools and the scene use, and that each can be
    the camera of an image. `label` begins the message.

    Raises:
        InputError: they are too many, two have the same name, or one is empty, has several lines or control characters, or one has numbers
            that no camera has.
    """
    if len(cameras) > MOST_CAMERAS:
        raise InputError(f"{label} has {len(cameras)} cameras; a rig has at most {MOST_CAMERAS}. Leave out those that are not used.")
    names = [camera.name for camera in cameras]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        raise InputError(f"{label} has two cameras of the name “{twice}”; give each its own name.")
    unfit = next((name for name in names if not bounded.is_plain(name)), None)
    if unfit is not None:
        raise InputError(f"{label} has a camera of the name {shown(unfit)}; give it a name in one line, such as “L”.")
    for camera in cameras:
        if fault := _fault(camera):
            raise InputError(f"{label} has a camera “{camera.name}” {fault}; calibrate it again.")


def _fault(camera: Camera) -> str:
    """What no camera has; empty for a possible one."""
    if not all((np.abs(a) <= LARGEST_NUMBER).all() for a in (camera.matrix, camera.distortions, camera.t_cam_world_m)):
        return f"with numbers beyond {LARGEST_NUMBER:.0e}"
    if not (np.abs(camera.affinity) <= LARGEST_AFFINITY).all():
        return f"whose affinity is beyond {LARGEST_AFFINITY}"
    return "" if camera.is_invertible else "whose distortion folds the middle of the image"


def sigmas_of(table: Any, name: str, path: Path) -> dict[str, float]:
    """A camera's table “sigma”, checked.

    Raises:
        InputError: it is no table of standard deviations.
    """
    numbers = table.values() if isinstance(table, dict) else [None]
    if not all(isinstance(v, (int, float)) and math.isfinite(v) and v >= 0 for v in numbers):
        raise InputError(f"“sigma” of camera “{name}” of the rig {path} must be a table of standard deviations, such as {{f = 0.12}}.")
    return {key: float(value) for key, value in table.items()}


def write_rig(path: Path, rig: Rig) -> None:
    """Write rig.toml so that `read_rig` gives the same cameras, to the last bit."""
    lines: list[str] = []
    for i, camera in enumerate(rig.cameras):
        lines += [
            f"[cam_{i}]",
            f"name = {_text(camera.name)}",
            f"size = [{camera.size_px[0]}, {camera.size_px[1]}]",
            f"matrix = {_numbers(camera.matrix)}",
            f"distortions = {_numbers(camera.distortions[:4] if camera.fisheye else camera.distortions)}",
            *(["fisheye = true"] if camera.fisheye else []),
            f"rotation = {_numbers(vector_from_rotation(camera.R_cam_world))}",
            f"translation = {_numbers(camera.t_cam_world_m)}",
        ]
        if np.any(camera.affinity):
            lines.append(f"affinity = {_numbers(camera.affinity)}")
        if camera.name in rig.sigmas:
            lines.append(f"sigma = {{ {', '.join(f'{_key(k)} = {_number(v)}' for k, v in rig.sigmas[camera.name].items())} }}")
        lines.append("")
    lines += ["[metadata]", 'unit = "m"']
    lines += [f"{_key(k)} = {_value(v)}" for k, v in rig.metadata.items() if k != "unit" and isinstance(v, (str, int, float))]
    store.write_text(Path(path), "\n".join(lines) + "\n")


def _key(text: str) -> str:
    return text if re.fullmatch("[A-Za-z0-9_-]+", text) else _text(text)


def _value(value: str | int | float) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    return _text(value) if isinstance(value, str) else _number(value)


def _camera(key: str, entry: Any, path: Path, unit_m: float) -> Camera:
    if not isinstance(entry, dict):
        raise InputError(f"[{key}] of the rig {path} is not a table.")
    name = entry.get("name", key)
    label = f"Camera “{name}” of the rig {path}"
    for known in ("distortions", "fisheye", "affinity"):
        if misspelt := _nearly(known, entry):
            raise InputError(f"{label} has “{misspelt}”, which would be ignored; write “{known}”.")
    size = _array(entry, "size", (2,), label)
    matrix = _array(entry, "matrix", (3, 3), label)
    distortions = np.zeros(5)
    given = _array(entry, "distortions", None, label) if "distortions" in entry else distortions
    fisheye = entry.get("fisheye", False)
    if not isinstance(fisheye, bool):
        raise InputError(f"“fisheye” of {label[0].lower() + label[1:]} must be true or false.")
    if given.ndim != 1 or len(given) > (4 if fisheye else 5):
        model = "a fisheye lens has k1, k2, k3, k4" if fisheye else "this model has k1, k2, p1, p2, k3"
        raise InputError(f"{label} has {given.size} distortions; {model}.")
    distortions[: len(given)] = given
    upright = matrix[1, 0] == 0 and matrix[2].tolist() == [0, 0, 1]
    if not upright or not is_camera_matrix(matrix) or min(size) < 8:
        raise InputError(f"{label} has an impossible matrix or size; calibrate it again.")
    affinity = _array(entry, "affinity", (2,), label) if "affinity" in entry else np.zeros(2)
    return Camera(
        name=str(name),
        size_px=(int(size[0]), int(size[1])),
        matrix=matrix,
        distortions=distortions,
        affinity=affinity,
        R_cam_world=rotation_from_vector(_array(entry, "rotation", (3,), label)),
        t_cam_world_m=_array(entry, "translation", (3,), label) * unit_m,
        fisheye=fisheye,
    )


def _array(entry: Mapping[str, Any], key: str, shape: tuple[int, ...] | None, label: str) -> np.ndarray:
    if key not in entry:
        raise InputError(f"{label} lacks “{key}”.")
    try:
        array = np.array(entry[key], dtype=np.float64)
    except (TypeError, ValueError):
        array = np.array(math.nan)
    if (shape is not None and array.shape != shape) or not (np.abs(array) <= LARGEST_NUMBER).all():
        count = "x".join(map(str, shape or ("n",)))
        raise InputError(f"“{key}” of {label[0].lower() + label[1:]} must be {count} finite numbers, none beyond {LARGEST_NUMBER:.0e}.")
    return array


def _numbers(array: np.ndarray) -> str:
    return repr(np.asarray(array).tolist())


def _number(value: float) -> str:
    """A number in TOML; the repr of numpy's numbers includes their type."""
    return repr(int(value)) if isinstance(value, int) else repr(float(value))


def _text(text: str) -> str:
    """A TOML basic string; JSON's escapes are a part of TOML's."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
