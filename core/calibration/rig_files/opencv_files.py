"""OpenCV's FileStorage (YAML or XML), and EasyMocap's pair of such files.

OpenCV's calibration sample writes camera_matrix, distortion_coefficients, image_width, image_height of one camera; its stereo sample M1
D1 M2 D2 and R T (of the second camera). For a rig we write `names` and, for each name n, camera_matrix_n, distortion_coefficients_n,
image_width_n, image_height_n, R_n (3×3), T_n. EasyMocap: intri.yml with names, K_n, dist_n, and H_n, W_n in newer files; extri.yml with
R_n (Rodrigues), Rot_n, T_n in metres.

The top-level entries of OpenCV's FileStorage, YAML or XML: matrices, numbers, texts and lists of texts.

Read by ourselves: OpenCV's own parser writes beyond its memory on damaged files (both 4 and 5, found by tests/test_fuzz.py).
"""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from ...foundation import bounded, store
from ...foundation.errors import InputError
from ...geometry.camera import Camera
from ...geometry.rig import Rig
from ...geometry.rotation import rotation_from_vector, vector_from_rotation
from .reading import five, left_out, make_camera, numbers, plain, text_of

NAMES = re.compile(r'"([^"]*)"|([^\s",]+)')
STEREO_SIZE = ("image_width", "width"), ("image_height", "height")
MOST_LINES, LARGEST_MATRIX = 200_000, 10_000
Entry = np.ndarray | float | str | list[str]


class Nodes:
    """The entries of a file, by name.

    Raises:
        InputError: it is no FileStorage.
    """

    def __init__(self, path: Path) -> None:
        text = text_of(path)
        self._path = path
        self._entries = _of_xml(text, path) if text.lstrip("\ufeff \r\n\t").startswith("<") else _of_yaml(text, path)
        if not self._entries:
            raise InputError(f"{path} is no YAML or XML that OpenCV can read; write it with cv2.FileStorage.")

    def has(self, key: str) -> bool:
        """Whether there is such an entry."""
        return key in self._entries

    def matrix(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """An entry that is a matrix.

        Raises:
            InputError: it is missing or has another shape.
        """
        value = self._entries.get(key)
        if not isinstance(value, np.ndarray):
            raise InputError(f"{self._path} lacks the matrix “{key}”; it is no complete calibration.")
        return numbers(value, shape, f"“{key}” in {self._path}")

    def number(self, *keys: str) -> float | None:
        """The first of some entries that is a number."""
        return next((value for key in keys if isinstance(value := self._entries.get(key), float)), None)

    def names(self) -> list[str]:
        """The sequence of texts `names`."""
        value = self._entries.get("names")
        return [str(value)] if isinstance(value, (str, float)) else value if isinstance(value, list) else []


def _of_yaml(text: str, path: Path) -> dict[str, Entry]:
    """Blocks begin with “key:” at the margin; lines that are indented, or begin with “-”, belong to the block before."""
    blocks: dict[str, list[str]] = {}
    lines = text.splitlines()
    if len(lines) > MOST_LINES:
        raise InputError(f"{path} has more lines than a calibration has.")
    for line in lines:
        name, colon, rest = line.partition(":")
        if colon and line[:1] not in (" ", "\t", "-", "%", "#", ".") and (not rest or rest[0].isspace()):
            block = blocks[name.strip().strip('"')] = [rest.strip()]
        elif blocks and line.strip() and not line.startswith(("%", "---", "...", "#")):
            block.append(line.strip())
    return {name: _yaml_entry(name, block, path) for name, block in blocks.items()}


def _yaml_entry(name: str, block: list[str], path: Path) -> Entry:
    whole = " ".join(block)
    if whole.startswith("!!opencv-matrix"):
        head, opening, rest = whole.partition("[")
        data, closing, _ = rest.partition("]")
        counts = [re.search(rf"\b{word}:\s*+(\d{{1,9}})\b", head) for word in ("rows", "cols")]
        if not closing or not head.rstrip().endswith("data:") or not all(counts):
            raise InputError(f"The matrix “{name}” in {path} is damaged; write it with cv2.FileStorage.")
        return _matrix(name, data.replace(",", " "), [int(c.group(1)) for c in counts if c], path)
    if len(block) > 1 and not block[0] and block[1].startswith("-"):
        return [item.lstrip("- ").strip().strip('"') for item in block[1:]]
    if whole.strip().startswith("["):
        return [a or b for a, b in NAMES.findall(whole.strip().strip("[]"))]
    return _scalar(whole)


def _of_xml(text: str, path: Path) -> dict[str, Entry]:
    try:
        root = bounded.xml_of(text)
    except ValueError as error:
        raise InputError(f"{path} is not an XML file that can be read ({error}); write it with cv2.FileStorage.") from error
    found: dict[str, Entry] = {}
    for element in root:
        if element.get("type_id") == "opencv-matrix":
            rows, cols = (element.findtext(word, "").strip() for word in ("rows", "cols"))
            if not (rows.isdecimal() and cols.isdecimal() and len(rows + cols) < 16):
                raise InputError(f"The matrix “{element.tag}” in {path} is damaged; write it with cv2.FileStorage.")
            found[element.tag] = _matrix(element.tag, element.findtext("data", ""), [int(rows), int(cols)], path)
        else:
            words = [a or b for a, b in NAMES.findall(element.text or "")]
            found[element.tag] = words if element.tag == "names" or len(words) > 1 else _scalar(" ".join(words))
    return found


def _matrix(name: str, text: str, shape: list[int], path: Path) -> np.ndarray:
    words = text.split()
    if len(words) > LARGEST_MATRIX or len(words) != shape[0] * shape[1]:
        raise InputError(f"The matrix “{name}” in {path} is {shape[0]}×{shape[1]}, but has {len(words)} numbers; the file is damaged.")
    return numbers(words, (shape[0], shape[1]), f"“{name}” in {path}")


def _scalar(text: str) -> Entry:
    word = text.split(" #")[0].strip()
    try:
        return float(word)
    except ValueError:
        return word.strip('"')


def read(path: Path) -> Rig:
    """Read one camera, a stereo pair, a rig, or EasyMocap's intri.yml with extri.yml next to it.

    Raises:
        InputError: an entry is missing or damaged.
    """
    nodes = Nodes(path)
    names = nodes.names()
    if names and nodes.has(f"K_{names[0]}"):
        return read_easymocap(path)
    if names:
        cameras = tuple(_of_rig(nodes, name) for name in names)
        return _rig(cameras, [[nodes.number(f"image_{side}_{name}") for side in ("width", "height")] for name in names])
    if nodes.has("M1") and nodes.has("M2"):
        return _rig(_stereo(path, nodes), [[nodes.number(*words) for words in STEREO_SIZE]] * 2)
    K = nodes.matrix("camera_matrix" if nodes.has("camera_matrix") else "K", (3, 3))
    D = nodes.matrix("distortion_coefficients" if nodes.has("distortion_coefficients") else "D", (-1,))
    sides = [nodes.number("image_width", "image_Width"), nodes.number("image_height", "image_Height")]
    camera = make_camera(path.stem, _size(K, *sides), K, five(D, f"The distortion in {path}"), np.eye(3), np.zeros(3))
    return _rig((camera,), [sides])


def _rig(cameras: tuple[Camera, ...], sizes_px: Sequence[Sequence[float | None]]) -> Rig:
    """The rig, with a remark on the cameras of which a file lacks the width or height of the images."""
    without = [camera for camera, size in zip(cameras, sizes_px) if not all(size)]
    if not without:
        return Rig(cameras=cameras)
    sizes = ", ".join(f"{camera.name} {camera.size_px[0]}×{camera.size_px[1]}" for camera in without)
    remark = f"The file lacks the image size of some cameras, derived from the principal points ({sizes}); compare with the footage."
    return Rig(cameras=cameras, remarks=(remark,))


def _size(K: np.ndarray, width: float | None, height: float | None) -> tuple[float, float]:
    """The image size; without one, the principal point is taken as the image centre."""
    return (width or round(2 * K[0, 2] + 1), height or round(2 * K[1, 2] + 1))


def _of_rig(nodes: Nodes, name: str) -> Camera:
    K = nodes.matrix(f"camera_matrix_{name}", (3, 3))
    return make_camera(
        name,
        _size(K, nodes.number(f"image_width_{name}"), nodes.number(f"image_height_{name}")),
        K,
        five(nodes.matrix(f"distortion_coefficients_{name}", (-1,)), f"The distortion of {name}"),
        nodes.matrix(f"R_{name}", (3, 3)),
        nodes.matrix(f"T_{name}", (3,)),
    )


def _stereo(path: Path, nodes: Nodes) -> tuple[Camera, Camera]:
    """M1 D1 M2 D2, and R T here or in extrinsics.yml next to it."""
    pose = nodes if nodes.has("R") else Nodes(path.with_name("extrinsics" + path.suffix))
    width, height = (nodes.number(*words) for words in STEREO_SIZE)
    poses = ((np.eye(3), np.zeros(3)), (pose.matrix("R", (3, 3)), pose.matrix("T", (3,))))
    made = []
    for n, (R, t) in enumerate(poses, start=1):
        K, D = nodes.matrix(f"M{n}", (3, 3)), five(nodes.matrix(f"D{n}", (-1,)), f"“D{n}” in {path}")
        made.append(make_camera(f"cam_{n}", _size(K, width, height), K, D, R, t))
    return made[0], made[1]


def write(path: Path, rig: Rig) -> list[Path]:
    """Write a rig as OpenCV YAML, or XML if the file's name ends so."""

    def fill(storage: Any) -> None:
        _write_names(storage, rig)
        for camera in map(plain, rig.cameras):
            storage.write(f"image_width_{camera.name}", camera.size_px[0])
            storage.write(f"image_height_{camera.name}", camera.size_px[1])
            storage.write(f"camera_matrix_{camera.name}", camera.matrix.copy())
            storage.write(f"distortion_coefficients_{camera.name}", camera.distortions.reshape(1, 5).copy())
            storage.write(f"R_{camera.name}", camera.R_cam_world.copy())
            storage.write(f"T_{camera.name}", camera.t_cam_world_m.reshape(3, 1).copy())

    store.write_text(path, _storage_text(".xml" if path.suffix.lower() == ".xml" else ".yml", rig, fill))
    return [path]


def read_easymocap(path: Path) -> Rig:
    """Read intri.yml and extri.yml of a folder (or of either file's folder).

    Raises:
        InputError: one of them is missing, or an entry is missing or damaged.
    """
    folder = path if path.is_dir() else path.parent
    inner, outer = Nodes(folder / "intri.yml"), Nodes(folder / "extri.yml")
    cameras = []
    for name in inner.names():
        K = inner.matrix(f"K_{name}", (3, 3))
        D = inner.matrix(f"dist_{name}" if inner.has(f"dist_{name}") else f"D_{name}", (-1,))
        size = _size(K, inner.number(f"W_{name}"), inner.number(f"H_{name}"))
        R = outer.matrix(f"Rot_{name}", (3, 3)) if outer.has(f"Rot_{name}") else rotation_from_vector(outer.matrix(f"R_{name}", (3,)))
        cameras.append(make_camera(name, size, K, five(D, f"The distortion of {name}"), R, outer.matrix(f"T_{name}", (3,))))
    if not cameras:
        raise InputError(f"{folder / 'intri.yml'} names no cameras; it needs the list “names”.")
    rig = _rig(tuple(cameras), [[inner.number(f"{side}_{name}") for side in "WH"] for name in inner.names()])
    surplus = [name for name in outer.names() if name not in inner.names()]
    return replace(rig, remarks=rig.remarks + left_out(surplus, "intri.yml does not name them"))


def write_easymocap(folder: Path, rig: Rig) -> list[Path]:
    """Write intri.yml and extri.yml into a folder."""
    cameras = [plain(camera) for camera in rig.cameras]

    def fill_inner(storage: Any) -> None:
        _write_names(storage, rig)
        for camera in cameras:
            storage.write(f"K_{camera.name}", camera.matrix.copy())
            storage.write(f"dist_{camera.name}", camera.distortions.reshape(1, 5).copy())
            storage.write(f"H_{camera.name}", camera.size_px[1])
            storage.write(f"W_{camera.name}", camera.size_px[0])

    def fill_outer(storage: Any) -> None:
        _write_names(storage, rig)
        for camera in cameras:
            storage.write(f"R_{camera.name}", vector_from_rotation(camera.R_cam_world).reshape(3, 1))
            storage.write(f"Rot_{camera.name}", camera.R_cam_world.copy())
            storage.write(f"T_{camera.name}", camera.t_cam_world_m.reshape(3, 1).copy())

    paths = [folder / "intri.yml", folder / "extri.yml"]
    for path, fill in zip(paths, (fill_inner, fill_outer)):
        store.write_text(path, _storage_text(".yml", rig, fill))
    return paths


def _write_names(storage: Any, rig: Rig) -> None:
    storage.startWriteStruct("names", cv2.FileNode_SEQ)
    for camera in rig.cameras:
        storage.write("", camera.name)
    storage.endWriteStruct()


def _storage_text(ending: str, rig: Rig, fill: Callable[[Any], None]) -> str:
    bad = [c.name for c in rig.cameras if not c.name.replace("_", "").replace("-", "").isalnum() or not c.name.isascii()]
    if bad:
        raise InputError(f"OpenCV's files cannot hold the camera name “{bad[0]}”; use letters, digits, - and _.")
    storage = cv2.FileStorage(ending, cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    fill(storage)
    return str(storage.releaseAndGetString())
