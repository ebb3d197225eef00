"""COLMAP's text model: a folder with cameras.txt, images.txt and points3D.txt (https://colmap.github.io/format.html).

cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS…; images.txt: two lines per image, IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME (world →
camera, Hamilton) and its points. COLMAP's pixel (0.5, 0.5) is the middle of the first pixel: cx_colmap = cx + 0.5.
"""

from pathlib import Path

import numpy as np

from ...foundation import store
from ...foundation.errors import InputError
from ...geometry.rig import MOST_CAMERAS, Rig
from .reading import NO_UNIT, make_camera, numbers, plain, text_of

# Parameters of each model: which of fx fy cx cy k1 k2 p1 p2 k3 they are, in order; "f" is both fx and fy.
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6",
}

LENGTH_TOLERANCE = 0.01  # of a quaternion, whose length is 1


def read(path: Path) -> Rig:
    """Read the folder, or the folder of one of its files; the images' names without ending become the cameras' names.

    Raises:
        InputError: a file is missing or damaged, or a camera has a model that ours does not contain.
    """
    from scipy.spatial.transform import Rotation

    folder = path if path.is_dir() else path.parent
    lenses = {line[0]: line for line in _lines(folder / "cameras.txt")}  # of a large model many more than the images here
    cameras, names = [], list[Path]()
    for line in _image_lines(folder / "images.txt"):
        values = numbers(line[1:8], (7,), f"Image {line[0]} in {folder / 'images.txt'}")
        if line[8] not in lenses:
            raise InputError(f"Image {line[0]} in {folder / 'images.txt'} names camera {line[8]}, which cameras.txt lacks.")
        size, matrix, distortions = _interior(lenses[line[8]], folder)
        if abs((length := np.linalg.norm(values[:4])) - 1) > LENGTH_TOLERANCE:
            raise InputError(f"Image {line[0]} in {folder / 'images.txt'} has no rotation: its quaternion is {length:.3g} long, not 1.")
        R = Rotation.from_quat(values[[1, 2, 3, 0]]).as_matrix()
        image = Path(" ".join(line[9:]))
        names.append(image.parent / image.stem)
        cameras.append((size, matrix, distortions, R, values[4:]))
    if not cameras:
        raise InputError(f"{folder / 'images.txt'} has no posed image; export the finished model as text.")
    alike = len({name.name for name in names}) < len(names)  # such as cam1/0001.png and cam2/0001.png: the folders tell them apart
    named = ["_".join(name.parts) if alike else name.name for name in names]
    return Rig(cameras=tuple(make_camera(name, *camera) for name, camera in zip(named, cameras)), metadata={"scale": NO_UNIT})


def _lines(path: Path) -> list[list[str]]:
    return [line.split() for line in text_of(path).splitlines() if line.strip() and not line.startswith("#")]


def _image_lines(path: Path) -> list[list[str]]:
    """Every other line: the second of an image holds its points and may be empty."""
    lines = [line for line in text_of(path).splitlines() if not line.startswith("#")]
    found = [line.split() for line in lines[0::2] if line.strip()]
    if len(found) > MOST_CAMERAS:
        raise InputError(f"{path} has {len(found)} images; a rig has at most {MOST_CAMERAS} cameras. Leave out those that are not used.")
    if any(len(line) < 10 for line in found) or not all(map(_are_points, lines[1::2])):
        raise InputError(f"{path} is damaged: an image needs ten entries, and a second line, of three numbers a point or empty.")
    return found


def _are_points(line: str) -> bool:
    """Whether a line has x, y and the number of a point for each point, and no name of an image."""
    words = line.split()
    return len(words) % 3 == 0 and (not words or words[-1].lstrip("-").isdecimal())


def _interior(line: list[str], folder: Path) -> tuple[tuple[float, float], np.ndarray, np.ndarray]:
    if len(line) < 5 or line[1] not in MODELS:
        known = ", ".join(MODELS)
        raise InputError(f"Camera {line[0]} in {folder / 'cameras.txt'} has an unknown model {line[1:2]}; use one of {known}.")
    names = MODELS[line[1]].split()
    values = numbers(line[2:], (2 + len(names),), f"Camera {line[0]} in {folder / 'cameras.txt'}")
    p = dict(zip(names, values[2:]))
    if any(p.get(k) for k in ("k4", "k5", "k6")):
        raise InputError(f"Camera {line[0]} in {folder / 'cameras.txt'} uses k4, k5 or k6; calibrate with OPENCV or fewer.")
    fx, fy = p.get("fx", p.get("f", 0.0)), p.get("fy", p.get("f", 0.0))
    matrix = np.array([[fx, 0, p["cx"] - 0.5], [0, fy, p["cy"] - 0.5], [0, 0, 1]])
    return (values[0], values[1]), matrix, np.array([p.get(k, 0.0) for k in ("k1", "k2", "p1", "p2", "k3")])


def write(folder: Path, rig: Rig) -> list[Path]:
    """Write the three text files into a folder, cameras as FULL_OPENCV."""
    from scipy.spatial.transform import Rotation

    inner, outer = ["# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]"], ["# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", "# POINTS2D[]"]
    for n, camera in enumerate(map(plain, rig.cameras), start=1):
        k1, k2, p1, p2, k3 = camera.distortions.tolist()
        fx, fy, cx, cy = camera.matrix[0, 0], camera.matrix[1, 1], camera.matrix[0, 2] + 0.5, camera.matrix[1, 2] + 0.5
        params = [float(v) for v in (fx, fy, cx, cy, k1, k2, p1, p2, k3, 0, 0, 0)]
        inner.append(f"{n} FULL_OPENCV {camera.size_px[0]} {camera.size_px[1]} {' '.join(map(repr, params))}")
        x, y, z, w = Rotation.from_matrix(camera.R_cam_world).as_quat().tolist()
        pose = " ".join(map(repr, [w, x, y, z, *camera.t_cam_world_m.tolist()]))
        outer += [f"{n} {pose} {n} {camera.name}.png", ""]
    paths = [folder / "cameras.txt", folder / "images.txt", folder / "points3D.txt"]
    for path, lines in zip(paths, (inner, outer, ["# POINT3D_ID X Y Z R G B ERROR TRACK[]"])):
        store.write_text(path, "\n".join(lines) + "\n")
    return paths
