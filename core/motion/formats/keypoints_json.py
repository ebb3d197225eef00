"""2-D keypoints of people as JSON: OpenPose (a file per frame, or one), COCO annotations and COCO results. Input is validated.

Of several people, the one nearest to the person in the image before is tracked; in the first image, the largest and most confident one.
The centre of the top-left pixel is (0, 0), as everywhere in Tricap.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ...foundation import bounded
from ...foundation.arrays import check_sparse, frozen
from ...foundation.errors import InputError, shown
from ...geometry.robust import finite_median

COCO = (
    "nose",
    "left_eye",
    "right_eye",
    "left_ear",
    "right_ear",
    "left_shoulder",
    "right_shoulder",
    "left_elbow",
    "right_elbow",
    "left_wrist",
    "right_wrist",
    "left_hip",
    "right_hip",
    "left_knee",
    "right_knee",
    "left_ankle",
    "right_ankle",
)
ARMS = ("Nose", "Neck", "RShoulder", "RElbow", "RWrist", "LShoulder", "LElbow", "LWrist")
LEGS = ("RHip", "RKnee", "RAnkle", "LHip", "LKnee", "LAnkle")
FACE, FEET = ("REye", "LEye", "REar", "LEar"), ("LBigToe", "LSmallToe", "LHeel", "RBigToe", "RSmallToe", "RHeel")
HALPE = (*COCO, "crown", "neck", "mid_hip", "left_big_toe", "right_big_toe", "left_small_toe", "right_small_toe", "left_heel", "right_heel")
LAYOUTS = {17: COCO, 18: (*ARMS, *LEGS, *FACE), 25: (*ARMS, "MidHip", *LEGS, *FACE, *FEET), 26: HALPE}  # by the number of keypoints
WHOLE_BODY = 133  # COCO with feet, face and hands: the body's come first
NUMBER = re.compile(r"(\d{1,12})(?:_keypoints)?$", re.IGNORECASE)  # in the name of an image's file
MOST_DIGITS = 15
LARGEST_PX = 1e6  # of a coordinate: beyond, it is a mistake of the detector
Person = np.ndarray  # (K, 3) x, y, confidence


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class ImagePoints:
    """K named points of one person over T images of one view; NaN where a point was not detected."""

    names: tuple[str, ...]
    number: np.ndarray  # (T,) of the image
    xy_px: np.ndarray  # (T, K, 2)
    confidence: np.ndarray  # (T, K) 0…1

    def __post_init__(self) -> None:
        t, k = len(self.number), len(self.names)
        object.__setattr__(self, "number", frozen(self.number, (t,), np.int64, "number"))
        object.__setattr__(self, "xy_px", frozen(self.xy_px, (t, k, 2), name="xy_px"))
        object.__setattr__(self, "confidence", frozen(self.confidence, (t, k), name="confidence"))


def read_keypoints(paths: Sequence[Path]) -> ImagePoints:
    """Read one file of all images, or one file per image: its number is the one at the end of its name ("_keypoints" ignored), so that a
    missing file shifts no other; files without such numbers, or with the same one, are counted in the order of `paths`.

    Raises:
        InputError: a file cannot be read, is of another kind, two are of one image, or there is no person in any of them.
    """
    people: list[tuple[int, list[Person]]] = []
    names: tuple[str, ...] = ()
    for number, path in zip(_numbers_of(paths), paths):
        table = _json(path)
        if isinstance(table, dict) and "people" in table:
            people.append((number, [_numbers(p.get("pose_keypoints_2d"), path) for p in _dicts(table["people"], path)]))
        else:
            found, given = _coco(table, path)
            people += found
            names = names or given
    counts = {len(person) for _, those in people for person in those if len(person)}
    if len(counts) != 1:
        raise InputError(
            f"{paths[0]} and the files next to it have {'no person' if not counts else 'people with different numbers of keypoints'}; "
            "give the keypoints of one detector."
        )
    return _tracked(people, names or _layout(counts.pop(), paths[0]))


def _numbers_of(paths: Sequence[Path]) -> Sequence[int]:
    found = [NUMBER.search(path.stem) for path in paths]
    numbers = [int(match[1]) for match in found if match]
    if len(numbers) < len(paths) or len(set(numbers)) == 1 < len(paths):  # the same everywhere: that of the camera
        return range(len(paths))
    for number, path in zip(numbers, paths):
        if (first := paths[numbers.index(number)]) != path:
            raise InputError(f"{first} and {path.name} are both of image {number}; remove one of them.")
    return numbers


def _tracked(people: list[tuple[int, list[Person]]], names: tuple[str, ...]) -> ImagePoints:
    """One person through the images."""
    k = len(names)
    check_sparse(sum(p.size for _, those in people for p in those), len(people), k, "The file of keypoints")
    before: Person | None = None
    table = np.full((len(people), k, 3), np.nan)
    people = sorted(people, key=lambda row: row[0])
    for row, (_, those) in zip(table, people):
        those = [p[:k] for p in those if len(p) >= k and (p[:k, 2] > 0).any()]
        if not those:
            continue
        best = max(those, key=_size) if before is None else min(those, key=partial(_distance, before=before))
        row[:] = before = np.where(best[:, 2:] > 0, best, np.nan)
    return ImagePoints(
        names=names,
        number=np.array([n for n, _ in people]),
        xy_px=table[..., :2],
        confidence=np.clip(np.nan_to_num(table[..., 2]), 0.0, 1.0),
    )


def _size(person: Person) -> float:
    found = person[person[:, 2] > 0]
    return float(np.ptp(found[:, 1]) * found[:, 2].sum())


def _distance(person: Person, before: Person) -> float:
    apart = np.linalg.norm(person[:, :2] - before[:, :2], axis=1)[person[:, 2] > 0]
    return finite_median(apart, np.inf)


def _coco(table: Any, path: Path) -> tuple[list[tuple[int, list[Person]]], tuple[str, ...]]:
    """(image number, people) and the names where the file gives them."""
    rows, order = table, dict[Any, int]()
    names: tuple[str, ...] = ()
    if isinstance(table, dict):
        rows = table.get("annotations")
        categories = [c for c in _dicts(table.get("categories", []), path) if c.get("keypoints")]
        names = tuple(str(n) for n in categories[0]["keypoints"]) if categories else ()
        images = sorted(_dicts(table.get("images", []), path), key=lambda i: natural_order(str(i.get("file_name", i.get("id")))))
        order = {_name(image.get("id"), path): n for n, image in enumerate(images)}
    by_image: dict[Any, list[Person]] = {}
    for row in _dicts(rows, path):
        if "image_id" not in row:
            raise InputError(f"{path} is of no known kind of keypoints; give OpenPose's or COCO's JSON.")
        by_image.setdefault(_name(row["image_id"], path), []).append(_numbers(row.get("keypoints"), path))
    ids = sorted(by_image, key=lambda i: natural_order(str(i)))
    last = {i: [n for n in re.findall(r"\d+", str(i))[-1:] if len(n) <= MOST_DIGITS] for i in ids}
    number = order or {i: int(last[i][0]) if all(last.values()) else n for n, i in enumerate(ids)}
    return [(number[i], by_image[i]) for i in ids if i in number], names


def _layout(count: int, path: Path) -> tuple[str, ...]:
    if count == WHOLE_BODY:
        return COCO
    if count not in LAYOUTS:
        raise InputError(f"{path} has {count} keypoints a person, which is no known layout ({', '.join(map(str, LAYOUTS))}).")
    return LAYOUTS[count]


def _json(path: Path) -> Any:
    try:
        return bounded.json_of(bounded.text_of(path, bounded.JSON_BYTES))
    except OSError as error:
        raise InputError(f"Cannot read {path}: {error.strerror or error}.") from error
    except ValueError as error:
        raise InputError(f"{path} is no JSON file: {error}.") from error


def _name(value: Any, path: Path) -> Any:
    """The name or number of an image."""
    if not isinstance(value, (str, int, float)) and value is not None:
        raise InputError(f"{path} has an image named {shown(value)}; give OpenPose's or COCO's JSON.")
    return value


def _dicts(rows: Any, path: Path) -> list[dict[str, Any]]:
    if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
        raise InputError(f"{path} is of no known kind of keypoints; give OpenPose's or COCO's JSON.")
    return rows


def _numbers(values: Any, path: Path) -> Person:
    """(K, 3) of a flat list x, y, confidence, …; points that are no numbers, or nowhere near an image, are not there: zeros."""
    try:
        points = np.array(values if values is not None else [], dtype=np.float64).reshape(-1, 3)
    except (TypeError, ValueError) as error:
        raise InputError(f"{path} has keypoints that are not x, y, confidence, x, y, …; export them again.") from error
    there = np.isfinite(points).all(axis=1) & (np.abs(points[:, :2]) <= LARGEST_PX).all(axis=1)
    return np.where(there[:, None], points, 0.0)


def natural_order(text: str) -> list[Any]:
    """A key that sorts 2 before 10."""
    parts = [(part, part.lstrip("0")) for part in re.split(r"(\d+)", text) if part]
    return [(0, len(number), number) if part.isdecimal() else (1, 0, part) for part, number in parts]
